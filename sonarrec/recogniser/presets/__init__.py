"""Several presets over the same frames, and the revision of past results by later frames."""
