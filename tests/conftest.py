"""Every test process is set up as the program is."""

import gc
import signal

import sonarrec  # noqa: F401 - before numpy: it has BLAS run in one thread, as users have it
from sonarrec.batch.cores import cores

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Begun in the background of a script: the programs that tests stop by Ctrl-C would inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_xdist_auto_num_workers() -> int:
    """One test process more than there are cores: some tests wait for a log that hangs."""
    return cores() + 1


def pytest_collection_finish() -> None:
    """What was loaded to collect the tests stays: the garbage collector need not look at it again,
    which is a sixth of the time of tests that make many objects."""
    gc.collect()
    gc.freeze()
