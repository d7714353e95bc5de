"""Two sets of results on one truth, held against each other."""
