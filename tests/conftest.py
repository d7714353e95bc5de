"""Every test process is set up as the program is where it does several logs side by side."""

import gc
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

import pytest
from hypothesis import HealthCheck, settings

import sonarrec  # noqa: F401 - before numpy: it has BLAS run in one thread, as users have it
from sonarrec.runs import cores

# Before OpenCV is loaded, here and in what tests start: there are more test processes than cores,
# and their threads would wait for each other. test_same_bytes.py has several threads.
os.environ["OPENCV_FOR_THREADS_NUM"] = "1"

# The same examples each time; and each may take as long as it does: a slow machine fails no test.
settings.register_profile(
    "ours",
    derandomize=True,
    deadline=None,
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("ours")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Begun in the background of a script: the programs that tests stop by Ctrl-C would inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def _one_core() -> Iterator[None]:
    """The tests' own processes are large: to copy one for a run takes longer than many a run."""
    with patch.object(os, "sched_getaffinity", lambda _: {0}, create=True):
        yield


DRAWN: dict[str, Callable[..., None]] = {}


@pytest.fixture(scope="session", autouse=True)
def _no_pictures() -> Iterator[None]:
    """In the tests' own processes `evaluate` and `map` write empty files in place of pictures: to
    draw them takes longest, and what most tests look at is in the tables."""
    from sonarrec.evaluation import plots
    from sonarrec.mapping import write as write_map

    def empty(path: Path, *_: object) -> None:
        path.write_bytes(b"")

    DRAWN["draw_roc"] = plots.draw_roc
    with patch.object(plots, "draw_roc", empty), patch.object(write_map, "draw_map", empty):
        yield


@pytest.fixture(scope="session")
def pan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the sample log, to be read only but for what is made of them."""
    from tests.support import command

    out = tmp_path_factory.mktemp("results")
    command.sonarrec("run", command.SAMPLE, "-q", "-o", out)
    return out / "pan"


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """`evaluate` and `map` draw, as users have it."""
    from sonarrec.evaluation import plots
    from sonarrec.mapping import picture
    from sonarrec.mapping import write as write_map

    monkeypatch.setattr(plots, "draw_roc", DRAWN["draw_roc"])
    monkeypatch.setattr(write_map, "draw_map", picture.draw_map)


def pytest_xdist_auto_num_workers() -> int:
    """One test process a core: to collect the tests takes each of them seconds of CPU."""
    return cores()


def pytest_collection_finish() -> None:
    """What was loaded to collect the tests stays: the garbage collector need not look at it again,
    which is a sixth of the time of tests that make many objects."""
    gc.collect()
    gc.freeze()
