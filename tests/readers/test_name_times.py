"""Times in the names of images."""

from __future__ import annotations

import itertools
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from sonarrec.cli import main
from sonarrec.readers import open_log
from sonarrec.readers.guess.times import times_in_names
from sonarrec.tables.order import natural_order
from tests.support.logs import frames, image_folder

MOMENT = datetime(2026, 11, 20, 10, 0, 0, 250_000, UTC)
MOMENT_NS = 1_795_168_800_250_000_000  # by `date --date=2026-11-20T10:00:00.25Z +%s%N`


@pytest.mark.parametrize(
    "form",
    [
        "%Y-%m-%d_%H-%M-%S.%f",
        "%Y%m%d_%H%M%S_%f",
        "%Y%m%dT%H%M%S.%fZ",
        "%Y%m%d%H%M%S%f",
        "frame000017_%Y.%m.%d %H:%M:%S,%f_left",
        "sonar-%Y-%m-%dT%H%M%S-%f",
        "%Y-%m-%d-%Hh%Mm%S.%f",
        "Screenshot %Y-%m-%d at %H.%M.%S.%f",
    ],
)
def test_dates(form: str) -> None:
    steps = [timedelta(seconds=k / 4) for k in range(3)]
    stems = [(MOMENT + step).strftime(form) for step in steps]
    found = times_in_names(stems)
    assert found is not None
    assert found.tolist() == [MOMENT_NS + k * 250_000_000 for k in range(3)]


@pytest.mark.parametrize(
    ("stems", "steps_ms"),
    [
        ("1795168800.25 1795168800.5 1795168801", [0, 250, 750]),
        ("a_1795168800_250 a_1795168800_500 a_1795168801_000", [0, 250, 750]),
        ("20261120_100000_250ms 20261120_100000_500ms", [0, 250]),
        ("1795168800250 1795168800500 1795168801000", [0, 250, 750]),
        ("1795168800250000 1795168800500000 1795168801000000", [0, 250, 750]),
        ("1795168800250000000_left 1795168800500000000_left", [0, 250]),
        ("2026-11-20-09-59-00_1795168800.25 2026-11-20-09-59-00_1795168800.5", [0, 250]),
        ("1_1795168800.250000 2_1795168800.500000 10_1795168801.0", [0, 250, 750]),
    ],
)
def test_seconds_since_1970(stems: str, steps_ms: list[int]) -> None:
    found = times_in_names(stems.split())
    assert found is not None
    assert (found - MOMENT_NS).tolist() == [step * 1_000_000 for step in steps_ms]


@pytest.mark.parametrize(
    "stems",
    [
        "000000 000001 000002",
        "20261120_0001 20261120_0002 20261120_0003",  # a date, then a counter
        "20261120_100000_001 20261120_100000_002 20261120_100000_003",  # a counter in a second
        "20261120_100000 20261120_100000_1 20261120_100001",
        "a_1795168800 b_1795168800",  # several in one second
        "1795168801.5 1795168800.5",  # falls
        "20261320_100000 20261320_100001",  # a 13th month
        "1795168800.5 000001",
        "1795168800.5_1795168800.75 1795168801.5_1795168801.75",
        "1795168800_5000000 1795168800_250000000",  # nanoseconds without their leading zeros
        "9999999999999999999",
        "sonar sonar2",
        "20261120_100000_010 20261120_100000_020 20261120_100000_030",  # every tenth frame
        "20261120_100000_001 20261120_100000_002 20261120_100001_003 20261120_100001_004",
        "20261120_000000 20261120_000001 20261120_000002",  # a counter of six digits
        "20261120_1000_00 20261120_1000_01",
        "1000000001 1000000002",
        "2026-11-20_13.00.00PM 2026-11-20_13.00.01PM",  # the half of the day is not told apart
        "Screenshot_2026-11-20_at_9.59.51_PM Screenshot_2026-11-20_at_9.59.52_PM",
    ],
)
def test_names_without_times(stems: str) -> None:
    assert times_in_names(stems.split()) is None


@pytest.mark.parametrize("behind", ["_512x381 _512x381 _512x381", "_007 _008 _009", "-01 -02 -03"])
def test_what_stands_behind_the_seconds_may_be_no_fraction(behind: str) -> None:
    found = times_in_names(f"20261120_10000{k}{text}" for k, text in enumerate(behind.split()))
    assert found is not None
    assert (found - MOMENT_NS).tolist() == [k * 10**9 - 250_000_000 for k in range(3)]


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


def test_frames_have_these_times(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(3, 20, 20))
    for k in range(3):
        (log / f"frame{k}.png").rename(log / f"ping_20261120_10000{k}.25.png")
    with open_log(log) as opened:
        times = [frame.timestamp_ns for frame in opened]
        (note,) = opened.diagnostics.notes
    assert [time - MOMENT_NS for time in times] == [0, 10**9, 2 * 10**9]
    assert "the times in the names of its images, the first 2026-11-20 10:00:00.250 UTC" in note
    assert note.endswith(", and 1 a second")
    told = CliRunner().invoke(main, ["info", str(log)]).output
    assert "  recorded  2026-11-20 10:00:00 UTC, 2.0 s long\n" in told


def test_an_image_without_a_time_among_others_is_told(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(4, 20, 20))
    for k in range(3):
        (log / f"frame{k}.png").rename(log / f"ping_20261120_10000{k}.25.png")
    with open_log(log) as opened:
        times = [frame.timestamp_ns for frame in opened]
        (note,) = opened.diagnostics.notes
    assert times == [k * 10**9 // 4 for k in range(4)]  # by frame_rate_hz
    assert "frame3 is not named as" in note or "is not named as frame3" in note
