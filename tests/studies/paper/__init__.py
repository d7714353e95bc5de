"""The paper's experiment, reproduced: the search of worlds, the worlds, the prediction."""

import sonarrec  # noqa: F401  before numpy: it pins BLAS to one thread, so that sums repeat
