"""The order of images by their names, and times in them: right, or told as a guess."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from sonarrec.cli import main
from sonarrec.readers import open_log
from sonarrec.readers.containers.images import ImagePaths, times_in_names
from sonarrec.tables import natural_order
from tests.support.logs import frames, image_folder

MOMENT = datetime(2026, 11, 20, 10, 0, 0, 250_000, UTC)
MOMENT_NS = 1_795_168_800_250_000_000  # by `date --date=2026-11-20T10:00:00.25Z +%s%N`
MIDNIGHT = datetime(2024, 1, 31, 23, 59, 45)
ISO = ["%Y-%m-%d_%H-%M-%S.%f", "%Y%m%dT%H%M%S.%fZ", "frame17_%Y-%m-%d %H:%M:%S,%f_left"]
CERTAIN: dict[str, Callable[[int], str]] = {
    "counter": lambda k: f"frame{k}",
    "padded counter": lambda k: f"img-{k + 9950:04d}",
    "counter and time": lambda k: f"{k}_{1_700_000_000 + k * 0.25}",
    "two counters": lambda k: f"{k:04d}_{3 * k + 100}",
    "size": lambda k: f"{k}_512x381",
    "since 1970": lambda k: f"{1_700_000_000 + k / 8}",
    "milliseconds": lambda k: f"{1_700_000_000_000 + 125 * k}",
}
GUESSES: dict[str, Callable[[int], str]] = {
    "copies": lambda k: f"Capture 7 ({k + 1})" if k else "Capture 7",
    "date, then counter": lambda k: f"20240{k // 30 + 1}01_{k % 30:03d}",
    "day first": lambda k: (MIDNIGHT + timedelta(seconds=k)).strftime("%d-%m-%Y_%H-%M-%S"),
    "time of day": lambda k: (MIDNIGHT + timedelta(seconds=k)).strftime("%H-%M-%S.%f"),
    "seconds": lambda k: f"{k / 4:g}",
    "negative": lambda k: str(k - 40),
    "case": lambda k: f"{('f', 'F')[k % 2]}rame{k}",
    "hexadecimal": lambda k: f"{k:04x}",
    "8 bits": lambda k: f"{(k + 200) % 256}",
    "folders": lambda k: f"scan{k // 9}_{k % 9}",
    "letters": lambda k: f"{k // 2}{'ab'[k % 2]}",
}


@pytest.mark.parametrize("form", ISO)
def test_dates(form: str) -> None:
    steps = [timedelta(seconds=k / 4) for k in range(3)]
    found = times_in_names([(MOMENT + step).strftime(form) for step in steps])
    assert found is not None
    assert found.tolist() == [MOMENT_NS + k * 250_000_000 for k in range(3)]


@given(st.lists(st.integers(11 * 10**17, 2 * 10**18 - 1), min_size=1, max_size=9, unique=True))
def test_any_length_of_fraction_tells_the_same(times: list[int]) -> None:
    """As names of seconds and nanoseconds, and as 19 digits; in natural order both rise."""
    times.sort()
    seconds = [f"a{time // 10**9}.{time % 10**9:09d}".rstrip("0").rstrip(".") for time in times]
    if min((b - a for a, b in itertools.pairwise(times)), default=10**9) < 5_000_000:
        return
    for stems in (seconds, [str(time) for time in times]):
        assert sorted(stems, key=natural_order) == stems
        found = times_in_names(stems)
        assert found is not None
        assert found.tolist() == times


@pytest.mark.parametrize(
    "stems",
    [
        "000000 000001 000002",
        "20261120_0001 20261120_0002 20261120_0003",  # a date, then a counter
        "20261320_100000 20261320_100001",  # a 13th month
        "a_1795168800 b_1795168800",  # several in one second
        "1795168801.5 1795168800.5",  # falls
        "1795168800000001 1795168800000002",  # a counter
        "1795168800.5 000001",
        "1795168800.5_1795168800.75 1795168801.5_1795168801.75",
        "9999999999999999999",
        "2026-11-20_10-00-00_PM 2026-11-20_10-00-01_PM",
    ],
)
def test_names_without_times(stems: str) -> None:
    assert times_in_names(stems.split()) is None


def ordered(stems: list[str]) -> tuple[bool, str | None]:
    """Whether names in disorder come back, and why that is a guess; None where they hold times."""
    paths = [f"/9/log.7/{stem}.png" for stem in stems]
    found = ImagePaths(map(Path, random.Random(1).sample(paths, len(paths))))
    times = times_in_names([path.stem for path in found])
    return [*map(str, found)] == paths, found.doubt if times is None else None


@pytest.mark.parametrize("form", CERTAIN)
def test_certain_forms(form: str) -> None:
    assert ordered([CERTAIN[form](k) for k in range(90)]) == (True, None)


@pytest.mark.parametrize("form", GUESSES)
def test_guesses_are_told(form: str) -> None:
    _, doubt = ordered([GUESSES[form](k) for k in range(90)])
    assert doubt


def test_frames_have_the_times_of_their_names(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(3, 20, 20))
    for k in range(3):
        (log / f"frame{k}.png").rename(log / f"ping_20261120_10000{k}.25.png")
    with open_log(log) as opened:
        times = [frame.timestamp_ns for frame in opened]
        (note,) = opened.diagnostics.notes
    assert [time - MOMENT_NS for time in times] == [0, 10**9, 2 * 10**9]
    assert "2026-11-20 10:00:00.250 UTC" in note
    told = CliRunner().invoke(main, ["info", str(log)]).output
    assert "  recorded  2026-11-20 10:00:00 UTC, 2.0 s long\n" in told


def test_one_note_tells_a_guess(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(3, 20, 20))
    for k, name in enumerate(("left", "right1", "right2")):
        (log / f"frame{k}.png").rename(log / f"{name}.png")
    with open_log(log) as opened:
        (note,) = opened.diagnostics.notes
    assert "the order of its 3 images, from left.png to right2.png, is a guess" in note
