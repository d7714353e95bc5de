"""Ground truth: read, matched to frames, checked, proposed and converted."""
