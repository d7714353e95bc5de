"""The simulator: recordings with known truth, from a scene's description."""
