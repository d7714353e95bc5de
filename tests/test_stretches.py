"""Where stretches begin: made-up clocks, and what must hold for any; times as text."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarrec.sonar.frame import Clock, Stamps, date_text, is_date, time_text
from sonarrec.stretches import Breaks, Rate, Stretches, duration, stretch_numbers

START = datetime(2024, 5, 1, 12, tzinfo=UTC).timestamp()
MAY = int(datetime(2024, 5, 1, 12, 30, tzinfo=UTC).timestamp()) * 10**9
HOUR, YEAR = 3600.0, 31_556_952.0
RNG = np.random.default_rng(0)


def steady(step: float, count: int = 40) -> list[float]:
    return [step] * count


def jittered(step: float, share: float, count: int = 200) -> list[float]:
    return (step * RNG.uniform(1 - share, 1 + share, count)).tolist()


def with_steps(steps: Sequence[float], **at: float) -> list[float]:
    """Steps, some of them (n3=5.0: the third) of another length."""
    return [at.get(f"n{n}", step) for n, step in enumerate(steps)]


WHOLE = np.diff(np.floor(np.arange(80) / 4)).tolist()
"""Steps of a clock of whole seconds at 4 Hz."""
ONE = {
    "4 Hz": steady(0.25),
    "one ping in ten minutes": steady(600.0),
    "jitter": jittered(0.25, 0.9),
    "bursts of ten pings": ([0.1] * 9 + [5.0]) * 6,
    "two sonars in turn": [0.02, 0.48] * 30,
    "one in two minutes, sometimes two": ([120.0] * 4 + [0.3]) * 6,
    "whole seconds": WHOLE,
    "equal stamps": [0.0, 0.25] * 30,
    "hiccups of .7 s at 15 Hz": with_steps(steady(1 / 15, 60), n20=0.7, n40=0.7),
    "2.4 s at 4 Hz": with_steps(steady(0.25), n20=2.4),
    "threads that swap": with_steps(steady(0.25), n20=-0.1, n21=0.6),
    "1 s back": with_steps(steady(0.25), n20=-1.0),
    "slower": steady(0.1) + steady(0.9) + steady(8.0),
    "faster": steady(8.0) + steady(0.1),
    # Not seen, as `sonarrec help limits` says:
    "a pause after five frames": with_steps(steady(0.25), n5=60.0),
    "5 s at 1 Hz": with_steps(steady(1.0), n20=5.0),
}
MORE: dict[str, tuple[list[float], list[int]]] = {
    "5.3 s and an hour": (with_steps(steady(0.25, 90), n59=5.3, n80=HOUR), [60, 81]),
    "30 s soon after an hour": (with_steps(steady(0.25), n20=HOUR, n23=30.0), [21, 24]),
    "2.6 s at 4 Hz": (with_steps(steady(0.25), n20=2.6), [21]),
    "a pause after eleven frames": (with_steps(steady(0.25), n10=60.0), [11]),
    "15 s at whole seconds": (with_steps(WHOLE, n59=15.0), [60]),
    "two pings, then one in two minutes": ([0.25, *steady(120.0)], [2]),
    "eight pings in ten minutes": (([0.25] * 7 + [600.0]) * 5, [8, 16, 24, 32, 40]),
    "61 s after five frames at a third of a Hz": (with_steps(steady(3.0), n4=61.0), [5]),
    "slower by more than ten times": (steady(0.25) + steady(8.0), [41]),
    "fast, then one in two minutes": (steady(0.25) + steady(120.0), [41, 42, 43, 44, 45]),
    "a minute between bursts": (with_steps(([0.1] * 9 + [5.0]) * 6, n39=60.0), [40]),
    "set back between bursts": (with_steps(([0.1] * 9 + [5.0]) * 6, n39=-HOUR), [40]),
    "set back by an hour": (with_steps(steady(0.25), n20=-HOUR + 0.25), [21]),
    "set back by 1.05 s": (with_steps(steady(0.25), n20=-1.05), [21]),
    "set back at once": (with_steps(steady(0.25), n0=-HOUR), [1]),
    "there and back": (with_steps(steady(0.25), n15=2 * YEAR, n25=-2 * YEAR), [16, 26]),
}


def clock(steps: Sequence[float]) -> np.ndarray:
    return np.round((START + np.cumsum([0.0, *steps])) * 1e9).astype(np.int64)


def begins(times_ns: np.ndarray) -> list[int]:
    frame = np.arange(len(times_ns))
    return (np.flatnonzero(np.diff(stretch_numbers(frame, times_ns))) + 1).tolist()


@pytest.mark.parametrize("name", [*ONE, *MORE])
def test_stretches(name: str) -> None:
    steps, expected = MORE.get(name) or (ONE[name], [])
    assert begins(clock(steps)) == expected


@pytest.mark.parametrize("rate_hz", [1.0, 4.0, 30000 / 1001, 0.3])
def test_a_log_without_times_is_one_stretch_though_frames_are_lost(rate_hz: float) -> None:
    frame = np.delete(np.arange(2000), np.s_[100:1500])
    times = np.array([round(n * 1e9 / rate_hz) for n in frame.tolist()])
    assert stretch_numbers(frame, times)[-1] == 0
    if rate_hz > 1:  # by a clock that began at another time it would be a pause
        assert stretch_numbers(frame, times + 10**9)[-1] == 1
    assert stretch_numbers(frame, None).tolist() == [0] * len(frame)


STEPS = st.lists(
    st.one_of(
        st.integers(1, 10**9),
        st.sampled_from([0, -(10**8), -(2 * 10**9), 3 * 10**9, 30 * 10**9, 3600 * 10**9]),
    ),
    max_size=60,
)


@given(STEPS, st.integers(0, 60))
def test_the_rule_looks_only_back(steps: list[int], cut: int) -> None:
    """What follows changes nothing, and frames as they come are as those of a table."""
    times = 10**18 + np.cumsum([0, *steps])
    whole = stretch_numbers(np.arange(len(times)), times)
    begins = Stretches().begins
    one_by_one = [begins(n, t) for n, t in enumerate(times.tolist())]
    assert np.cumsum(one_by_one).tolist() == whole.tolist()
    assert (
        stretch_numbers(np.arange(len(times))[:cut], times[:cut]).tolist() == whole[:cut].tolist()
    )


@given(STEPS)
def test_the_rule_as_it_is_stated(steps: list[int]) -> None:
    """Written again by arrays."""
    expected, earlier, rising = [], list[int](), list[int]()
    for n, step in enumerate(steps, 1):
        last, before = earlier[-10:], rising[-10:]
        is_pause = len(last) == 10 and step > max(2 * 10**9, 10 * max(last), 10 * before[-1])
        above = sum(20 * other < step for other in before)
        is_certain = step > 60 * 10**9 and 2 * above > len(before)
        rising += [step] * (step > 0)
        if step < -(10**9) or is_pause or is_certain:
            expected.append(n)
            step = max(last, default=0)
        earlier += [step] * (step > 0)
    assert begins(10**18 + np.cumsum([0, *steps])) == expected


EVEN, HOLE = np.cumsum(steady(0.25, 60)), np.cumsum(with_steps(steady(0.25, 60), n30=30.0))
STALLED = np.cumsum(with_steps([0.25] * 20 + [5.0] + [0.001] * 19 + [0.25] * 20, n50=1.0))
"""The times of a recorder that wrote nothing for 5 s, then what had waited."""


@pytest.mark.parametrize(
    ("log", "header", "expected", "named_by"),
    [
        (EVEN, HOLE, [30], "header"),
        (HOLE, EVEN, [], "header"),
        (EVEN, HOLE, [30], "log"),
        (HOLE, EVEN, [], "log"),
        (STALLED, EVEN, [], "log"),
        (STALLED, STALLED, [20], "log"),
        (STALLED, 0 * EVEN, [20], "log"),  # stamps that nobody set
        (STALLED, 0 * EVEN + 5.0, [20], "log"),
        (HOLE, HOLE / 1000, [30], "log"),  # the header has another unit
        (120 * HOLE, EVEN, [30], "log"),  # an hour is no hiccup
        (480 * EVEN, 480 * EVEN, [], "log"),
        (EVEN / 250, HOLE, [30], "log"),  # a recording that was converted
        (EVEN, EVEN - 900 * (EVEN > 5), [20], "log"),
        (EVEN, EVEN + HOUR * (np.arange(60) % 2), [2], "log"),  # two sonars
    ],
)  # fmt: skip
def test_any_clock_may_tell_a_pause_and_the_sonar_knows_a_hiccup(
    log: np.ndarray, header: np.ndarray, expected: list[int], named_by: Clock
) -> None:
    breaks, begun = Breaks(named_by), list[int]()
    for n, both in enumerate(zip(log, header, strict=True)):
        stamps = dict(zip(("log", "header"), (round(t * 1e9) for t in both), strict=True))
        if breaks.add(n, stamps[named_by], Stamps(**stamps)):
            begun.append(n)
    assert begun == expected
    assert len([*breaks.pauses(), *breaks.set_clock(None)]) == len(expected)


def told(steps: Sequence[float], other: str | None = None) -> list[str]:
    breaks = Breaks()
    for n, time in enumerate(clock(steps).tolist()):
        breaks.add(n, time)
    return [*breaks.pauses(), *breaks.set_clock(other)]  # type: ignore[arg-type]


def test_pauses_are_told_in_one_line() -> None:
    [line] = told(with_steps(steady(0.25, 150), n59=5.3, n119=HOUR))
    assert "2 pauses: 5.3 s after" in line
    [line] = told(with_steps(steady(0.25, 300), **{f"n{n}": 60.0 for n in range(20, 270, 20)}))
    assert "13 pauses: " in line
    assert "and 10 more" in line
    assert line.count("after frame") == 3
    assert told(steady(0.25)) == []


def test_a_clock_that_was_set_is_told_with_what_to_do() -> None:
    [line] = told(with_steps(steady(0.25), n20=-HOUR), "header")
    assert "back by 1 h" in line
    assert "`run --time header`" in line
    [line] = told(with_steps(steady(0.25), n20=2 * YEAR))
    assert "ahead by 2.0 years" in line
    assert "give truth by frame" in line


@pytest.mark.parametrize("step", [0.25, 1 / 15, 0.9])
@pytest.mark.parametrize(("before", "after"), [(48, 72), (400, 15), (12, 400)])
def test_halves_that_a_clock_exchanged_are_told(step: float, before: int, after: int) -> None:
    """So many frames before and after it was set back by an hour, in the order of their names."""
    hole = HOUR - (before + after - 1) * step
    pause, exchanged = told([*steady(step, after - 1), hole, *steady(step, before - 1)])
    assert f"after frame {after - 1}" in pause
    assert f"frames from {after} on" in exchanged
    for longer in (5.0, -5.0, HOUR):
        steps = [*steady(step, after - 1), hole + longer, *steady(step, before - 1)]
        assert len(told(steps)) == 1


@pytest.mark.parametrize(
    ("steps", "hz"),
    [
        (with_steps(steady(0.25), n20=HOUR), 4),
        (with_steps(steady(0.25), n2=60.0), 4),
        (WHOLE, 4),
        ([0.0, 0.5] * 30, 4),
        (([0.1] * 9 + [5.0]) * 6, 10),
        (jittered(1 / 15, 0.2), 15),
    ],
)
def test_the_rate_is_that_of_the_median_step(steps: list[float], hz: float) -> None:
    rate = Rate()
    for time in clock(steps).tolist():
        rate.add(time)
    assert rate.hz == pytest.approx(hz, rel=0.03)
    assert Rate().hz is None


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(5.3, "5.3 s"), (99, "99 s"), (1800, "30 min"), (3600.25, "1 h"), (1e6, "11.6 days")],
)
def test_lengths_of_time(seconds: float, text: str) -> None:
    assert duration(round(seconds * 1e9)) == text


@pytest.mark.parametrize(
    ("rest_ns", "decimals", "end"), [(0, 0, ""), (999_999_999, 0, ""), (70_000_000, 2, ".07")]
)
def test_times_are_cut_never_rounded_up(rest_ns: int, decimals: int, end: str) -> None:
    assert date_text(MAY + rest_ns, decimals) == f"2024-05-01 12:30:00{end}"
    assert time_text(MAY + rest_ns, decimals) == f"12:30:00{end}"


def test_the_clock_of_a_sonar_that_was_never_set_gives_no_dates() -> None:
    since_1980 = int(datetime(1980, 1, 6, 3, tzinfo=UTC).timestamp()) * 10**9
    assert is_date(MAY)
    assert not is_date(since_1980)
    assert not is_date(3_600 * 10**9)
