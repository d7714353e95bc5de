"""DDF files of Sound Metrics: DIDSON (DDF_03, DDF_04) and ARIS (DDF_05)."""
