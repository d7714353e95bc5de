"""Results on disk: written as they come, read back whole or frame by frame."""
