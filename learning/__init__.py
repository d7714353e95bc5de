"""Random worlds, and the built-in appearance model, which is learned from recordings of them."""
