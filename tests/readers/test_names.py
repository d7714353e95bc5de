"""The order of images by their names, and times in them: right, or told as a guess."""

from __future__ import annotations

import itertools
import random
import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarrec.readers.containers.images import ImagePaths
from sonarrec.readers.containers.times_in_names import times_in_names
from sonarrec.tables import natural_order
from tests.support.command import sonarrec
from tests.support.logs import frames, image_folder, read

MOMENT = datetime(2026, 11, 20, 10, 0, 0, 250_000, UTC)
MOMENT_NS = 1_795_168_800_250_000_000  # by `date --date=2026-11-20T10:00:00.25Z +%s%N`
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
    "seconds": lambda k: f"{k / 4:g}",
    "negative": lambda k: str(k - 40),
    "case": lambda k: f"{('f', 'F')[k % 2]}rame{k}",
    "hexadecimal": lambda k: f"{k:04x}",
    "8 bits": lambda k: f"{(k + 200) % 256}",
    "folders": lambda k: f"scan{k // 9}_{k % 9}",
    "letters": lambda k: f"{k // 2}{'ab'[k % 2]}",
}


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
        assert found.ns.tolist() == times


@pytest.mark.parametrize(
    "stems",
    [
        "000000 000001 000002",
        "20261120_0001 20261120_0002 20261120_0003",  # a date, then a counter
        "20261320_100000 20261320_100001",  # a 13th month
        "a_1795168800 b_1795168800",  # several in one second
        "1795168800000001 1795168800000002",  # a counter
        "1795168800.5 000001",
        "1795168800.5_1795168800.75 1795168801.5_1795168801.75",
        "9999999999999999999",
        "2026-11-20_13-00-00_PM 2026-11-20_13-00-01_PM",
        "02-05-2026_09-00-00_250 02-05-2026_09-00-01_679",  # 2 May, or 5 February
        "20260502_090000_250_CEST 20260502_090001_679_CEST",
        "Sat_May_02_09-00-00.130_2026 Sat_May_02_09-00-00.380_2026",  # no time of day
        "20260502_090000_12 20260502_090001_12",  # a channel, or hundredths
    ],
)
def test_names_without_times(stems: str) -> None:
    assert times_in_names(stems.split()) is None


BEFORE_MIDNIGHT = datetime(2026, 5, 13, 23, 59, 40, 130_000, UTC)
QUARTER_NS = 250_000_000
DATES = ["%Y%m%d", "%Y-%m-%d", "%Y_%m_%d", "%d.%m.%Y", "%d-%m-%Y", "%d%b%Y", "%B %d, %Y", "%y%m%d"]
BETWEEN = ["T", "_", " at ", "__", " - "]
CLOCKS = ["%H%M%S", "%H-%M-%S", "%H_%M_%S", "%H.%M.%S", "%H:%M:%S", "%Hh%Mm%Ss", "%-H-%-M-%-S"]
DECIMALS = [".%f", ",%f", "_%f", "-%fZ", " %f+0000", ".%f_left", "_%f_%%s"]
STYLES = [
    DATES[k % 8] + BETWEEN[k % 5] + CLOCKS[k % 7] + DECIMALS[(k // 8 + k) % 7] for k in range(70)
]
STYLES.append("frame17_%Y-%m-%d %H:%M:%S,%f_left")


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("step_ms", [250, 1429, 60_010])
def test_times_written_by_strftime_are_read_back(style: str, step_ms: int) -> None:
    """Over midnight; %s, the seconds since 1970, stands for a number of no meaning."""
    moments = [BEFORE_MIDNIGHT + timedelta(milliseconds=k * step_ms) for k in range(90)]
    stems = sorted((m.strftime(style) for m in moments), key=natural_order)
    found = times_in_names(stems)
    assert found is not None
    epoch = datetime(1970, 1, 1, tzinfo=UTC)
    expected = [(m - epoch) // timedelta(microseconds=1) for m in moments]
    assert (found.ns[found.order] // 1000).tolist() == expected


@pytest.mark.parametrize(
    ("stems", "first_ns", "step_ns"),
    [
        ("20260502_090000_250 20260502_090001_679", 1_777_712_400_250_000_000, 1_429_000_000),
        ("20260502_110000.25+0200 20260502_110000.5+0200", 1_777_712_400_250_000_000, QUARTER_NS),
        ("1777712400.37000000 1777712400.287000000", 1_777_712_400_037_000_000, QUARTER_NS),
        ("0001777712400250 0001777712400500", 1_777_712_400_250_000_000, QUARTER_NS),
        ("1795168801.5 1795168800.5", 1_795_168_800_500_000_000, 10**9),  # natural order falls
        ("2026-5-2_9.00.00.250_PM 2026-5-2_9.00.00.500_PM", 1_777_755_600_250_000_000, QUARTER_NS),
        ("20260502_090000_0001 20260502_090001_0002", 1_777_712_400_000_000_000, 10**9),
    ],
)  # fmt: skip
def test_what_stands_behind_the_seconds(stems: str, first_ns: int, step_ns: int) -> None:
    found = times_in_names(stems.split())
    assert found is not None
    assert found.ns[found.order].tolist() == [first_ns, first_ns + step_ns]


def test_a_time_of_day_goes_over_midnight() -> None:
    moments = [BEFORE_MIDNIGHT + timedelta(seconds=k / 4) for k in range(120)]
    found = times_in_names(sorted(m.strftime("%H-%M-%S.%f") for m in moments))
    assert found is not None
    assert (np.diff(found.ns[found.order]) == 250_000_000).all()


def test_a_counter_gives_the_order_where_the_clock_was_set_back() -> None:
    moments = [MOMENT + timedelta(seconds=k / 4 - 3600 * (k >= 50)) for k in range(90)]
    found = times_in_names([f"{m:%Y%m%d_%H%M%S_%f}_{k:04d}" for k, m in enumerate(moments)])
    assert found is not None
    assert found.order.tolist() == list(range(90))


@pytest.mark.parametrize("form", [*CERTAIN, *GUESSES])
def test_names_in_disorder_come_back_or_are_told_to_be_a_guess(form: str) -> None:
    paths = [f"/9/log.7/{(CERTAIN | GUESSES)[form](k)}.png" for k in range(90)]
    found = ImagePaths(map(Path, random.Random(1).sample(paths, len(paths))))
    if form in CERTAIN:
        assert ([*map(str, found)], found.doubt) == (paths, None)
    else:
        assert found.doubt


def test_frames_have_the_times_of_their_names(tmp_path: Path) -> None:
    names = [f"ping_20261120_10000{k}.25.png" for k in range(3)]
    log = image_folder(tmp_path / "log", frames(3, 20, 20), names=names)
    found = read(log)
    assert [time - MOMENT_NS for time in found.times] == [0, 10**9, 2 * 10**9]
    (note,) = found.notes
    assert "2026-11-20 10:00:00.250 UTC" in note
    assert "2026-11-20 10:00:00 UTC, 2.0 s long\n" in sonarrec("info", log).output


@pytest.mark.parametrize(
    ("hours", "is_told"), [("12 01", True), ("12 13", False), ("12 02", False), ("01 13", False)]
)
def test_a_clock_of_12_hours_is_told(hours: str, is_told: bool, tmp_path: Path) -> None:
    """From 12:59:59 to 01:00:00, as %I writes it."""
    before, after = hours.split()
    names = [f"20261120_{before}5959.{k}0.png" for k in range(10)]
    names += [f"20261120_{after}0000.{k}0.png" for k in range(10)]
    notes = read(image_folder(tmp_path / "log", frames(20, 20, 20), names=names)).notes
    assert ("12 hours" in " ".join(notes)) == is_told


@pytest.mark.parametrize(
    ("names", "told"),
    [("left right1 right2", "right2.png"), ("20261120_000 20261120_001", "not read .*20261120")],
)
def test_one_note_tells_a_guess(names: str, told: str, tmp_path: Path) -> None:
    files = [f"{name}.png" for name in names.split()]
    images = frames(len(files), 20, 20)
    (note,) = read(image_folder(tmp_path / "log", images, names=files)).notes
    assert re.search(told, note)
