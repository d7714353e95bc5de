"""Every test process is set up as the program is."""

import sonarrec  # noqa: F401 - before numpy: it has BLAS run in one thread, as users have it
