"""From pixels of any kind to the grey frames of one fan."""
