"""Random worlds, and the built-in appearance model, which is learned from recordings of them."""

import sonarrec  # noqa: F401 - before numpy: it has BLAS run in one thread, else sums may differ
