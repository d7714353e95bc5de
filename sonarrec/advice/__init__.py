"""What may be wrong with a log, its geometry, its results and its truth; the commands tell it."""
