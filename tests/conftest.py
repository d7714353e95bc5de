"""Every test process is set up as the program is where it does several logs side by side."""

import gc
import os
import signal
from pathlib import Path

import pytest

import sonarrec  # noqa: F401 - before numpy: it has BLAS run in one thread, as users have it
from sonarrec.batch.cores import cores

# Before OpenCV is loaded, here and in what tests start: there are more test processes than cores,
# and their threads would wait for each other. test_same_bytes.py has several threads.
os.environ["OPENCV_FOR_THREADS_NUM"] = "1"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Begun in the background of a script: the programs that tests stop by Ctrl-C would inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """`evaluate` writes empty files in place of its pictures, to draw which takes it longest; for
    tests of what it says, which is in its tables."""
    from sonarrec.evaluation import write

    def empty(path: Path, *_: object) -> None:
        path.write_bytes(b"")

    for name in ("draw_roc", "draw_roc_by_id", "draw_det", "draw_reliability"):
        monkeypatch.setattr(write, name, empty)


def pytest_xdist_auto_num_workers() -> int:
    """One test process more than there are cores: some tests wait for a log that hangs."""
    return cores() + 1


def pytest_collection_finish() -> None:
    """What was loaded to collect the tests stays: the garbage collector need not look at it again,
    which is a sixth of the time of tests that make many objects."""
    gc.collect()
    gc.freeze()
