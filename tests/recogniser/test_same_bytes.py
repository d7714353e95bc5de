"""The same log, settings and version give the same bytes, however the arithmetic is set up.

Fails where a choice hangs on a sum's last digits, which differ between the kernels of numpy's
BLAS, between its thread counts and OpenCV's, and between Intel's routines in OpenCV and its own.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

SAMPLE = Path(__file__).parents[2] / "sample_data" / "pan.mcap"


def tables(out: Path, log: Path = SAMPLE, **setting: str) -> list[bytes]:
    """The tables of a log, by default the sample, recognised in a process of its own."""
    command = [sys.executable, "-m", "sonarrec", "run", str(log), "-q", "--out", str(out)]
    subprocess.run(command, check=True, env=os.environ | setting)
    return [(out / "pan" / name).read_bytes() for name in ("frames.csv", "estimates.csv")]


@pytest.fixture(scope="module")
def as_it_is(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    return tables(tmp_path_factory.mktemp("as_it_is"))


def test_the_folder_of_the_same_pictures(as_it_is: list[bytes], tmp_path: Path) -> None:
    """frames.csv has the clocks of the recording, too, which a folder of images lacks."""
    assert tables(tmp_path, log=SAMPLE.with_suffix(""))[1] == as_it_is[1]


@pytest.mark.parametrize(
    "setting",
    [
        {},
        {"OPENBLAS_NUM_THREADS": "8", "OPENCV_FOR_THREADS_NUM": "4", "OPENCV_IPP": "enabled"},
        {"OPENBLAS_CORETYPE": "Haswell"},
        {"OPENBLAS_CORETYPE": "Nehalem"},
    ],
    ids=["again", "threads and IPP", "Haswell", "Nehalem"],
)
def test_setting(setting: dict[str, str], as_it_is: list[bytes], tmp_path: Path) -> None:
    assert tables(tmp_path, **setting) == as_it_is
