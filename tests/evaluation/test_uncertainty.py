"""Units, intervals and the sign-flip test: what they count, cover and reject."""

from __future__ import annotations

import math
import re
from itertools import product

import numpy as np
import pytest
from scipy.special import stdtrit

from sonarrec.evaluation.figures import METRICS, Sample, differences, intervals, rates, summarise
from sonarrec.evaluation.uncertainty import bootstrap_weights, coin_tosses, interval, rate_interval
from sonarrec.reports.screen import over_units
from tests.support.claims import counts, matched

LABELS = ("strict", "m", "total")
RATES = [name for name, m in METRICS.items() if m.kind == "rates"]


def of_rates(part, whole) -> Sample:
    """TPR is sum(part) / sum(whole), each (U,) per unit; there are no negatives."""
    sums = np.zeros((len(part), 4, 2))
    sums[:, 0] = np.asarray(part)[:, None]
    sums[:, 3] = np.asarray(whole - part)[:, None]
    return Sample("rates", *LABELS, sums, sums.sum(axis=0)[None])


def the_tpr(rows):
    (row,) = [row for row in rows if row.figure == "tpr"]
    return row


def rate_samples(found, protocol: str, method: str) -> list[Sample]:
    """Per ID, then in total."""
    return list(rates(found, method, protocol))


def seen(landmark: int, first: int, last: int) -> list[tuple]:
    return [(f, landmark, 0, 0, True) for f in range(first, last + 1)]


def spans(case) -> list[tuple[int, int, int]]:
    columns = (case.passes[name].tolist() for name in ("landmark", "first", "last"))
    return [*zip(*columns, strict=True)]


def test_passes_end_where_a_landmark_stays_away() -> None:
    truth = seen(1, 5, 20) + seen(1, 30, 40) + seen(1, 60, 70) + seen(2, 10, 12)
    truth += [(f, 3, 0, 0, False) for f in range(80)]  # partly in view only
    assert spans(matched(100, truth, [])) == [(1, 5, 40), (2, 10, 12), (1, 60, 70)]


def test_units_are_passes_and_what_is_nearest() -> None:
    # ID.1 and ID.2 are seen together, ID.3 after them with little in common, ID.4 long after.
    truth = seen(1, 10, 29) + seen(2, 15, 34) + seen(3, 31, 50) + seen(4, 71, 90)
    case = matched(100, truth, [])
    assert case.units == 3
    assert counts(case).units.kind == "pass"
    unit, landmark = case.truths["unit"], case.truths["landmark"]
    assert set(unit[landmark < 3]) == {0}
    assert set(unit[landmark == 3]) == {1}  # also in the frames that ID.2 shares
    assert set(unit[landmark == 4]) == {2}
    # Borders: the middle of frames 31 to 34, then of the gap from 50 to 71.
    assert case.unit.tolist() == [0] * 33 + [1] * 28 + [2] * 39


def test_a_log_without_landmarks_is_a_unit_and_many_logs_are_units() -> None:
    three = [seen(1, 0, 9) + seen(1, 25, 29), [], seen(2, 0, 20)]
    found = counts(*(matched(30, truth, []) for truth in three))
    assert found.units.number == 4
    assert counts(*[matched(10, seen(1, 0, 9), [])] * 10).units.kind == "log"


def random_case(rng: np.random.Generator, passes: int, length: int = 20, gap: int = 15):
    """Two methods with right, wrong and misplaced claims and scores of many values."""
    truth, claims = [], []
    for i in range(passes):
        first, landmark = i * (length + gap), int(rng.integers(1, 5))
        truth += seen(landmark, first, first + length - 1)
        for method, frame in product((0, 1), range(first, first + length + gap)):
            for _ in range(rng.integers(0, 3)):
                claim = landmark if rng.random() < 0.7 else int(rng.integers(1, 5))
                place = 0 if rng.random() < 0.7 else 1
                points = float(rng.random())
                claims.append((method, frame, claim, place, 0, points, points > 0.4))
    return matched(passes * (length + gap), truth, claims)


def test_units_add_up_to_the_whole() -> None:
    found = counts(random_case(np.random.default_rng(1), 8))
    for protocol in ("paper", "strict"):
        for k, of in enumerate(rate_samples(found, protocol, "a")):
            assert (of.per_unit >= 0).all()  # its own unit has it
            for name in RATES:
                summed = of.figures(name, of.per_unit.sum(axis=0)[None])[0]
                # Curves are held in steps of .001 to .02 of FPR, over each of which the TPR rises.
                near = 0.01 if name == "auc" else 1e-6
                assert summed == pytest.approx(of.value(name), abs=near), (name, k)


def test_interval_is_widened_as_student() -> None:
    """Of normal replicates it is the t interval: 2.365 sqrt(8 / 7) standard deviations for 8."""
    drawn = np.random.default_rng(0).normal(size=400_000)
    low, high = interval(drawn, 8)
    assert (low, high) == pytest.approx((-2.528, 2.528), abs=0.03)


@pytest.mark.parametrize("units", [8, 20])
def test_intervals_cover(units: int) -> None:
    """Clusters of correlated frames: 95 % intervals hold the truth in 92 to 98 % of 600 cases."""
    rng = np.random.default_rng(units)
    held = 0
    for _ in range(600):
        rates = rng.beta(4, 2, units)
        part = rng.binomial(30, rates).astype(float)
        drawn = (bootstrap_weights(units, rng, 500) @ part) / (30 * units)
        low, high = interval(drawn, units)
        held += low <= 4 / 6 <= high
    assert 0.92 <= held / 600 <= 0.98


def test_intervals_of_rates_against_the_textbook() -> None:
    """Where units are alike five cases each are independent: Wilson's formula as published, with
    Student's quantile from scipy."""
    for units, right in ((6, 20), (8, 10), (30, 19)):
        p, n = right / 20, 5 * units
        z = stdtrit(units - 1, 0.975)
        middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
        half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
        found = rate_interval(np.full(units, right), np.full(units, 20))
        assert found == pytest.approx((middle - half, min(middle + half, 1)), abs=1e-3)
    # Units that have no case say nothing; those that differ are fewer independent cases.
    part, whole = np.array([9, 9, 9, 9, 9, 9, 0]), np.array([10] * 6 + [0])
    assert rate_interval(part, whole) == rate_interval(part[:6], whole[:6])
    spread = rate_interval(np.array([0, 20] * 4), np.full(8, 20))
    assert spread[0] < rate_interval(np.full(8, 10), np.full(8, 20))[0]


def test_few_or_equal_units_are_said_to_say_nothing() -> None:
    few = of_rates(np.arange(5.0), np.full(5, 9.0))
    rng = np.random.default_rng(0)
    figure = the_tpr(intervals(few, bootstrap_weights(5, rng)))
    assert math.isnan(figure.low)
    assert "cases in 5 of the 6 units needed" in figure.note
    difference = the_tpr(differences(few, few, bootstrap_weights(5, rng), coin_tosses(5, rng)))
    assert math.isnan(difference.p)
    sums = np.tile([[0.0, 9.0]], (9, 1))
    at = (np.array([0.1, 0.2]),)
    equal = Sample("position", *LABELS, sums, np.array([[0.0, 81.0]]), at, at)
    figure = next(intervals(equal, bootstrap_weights(9, rng)))
    assert (figure.value, figure.note) == (0.2, "alike in all 9 units: no interval")
    assert math.isnan(figure.high)

    two_passes = counts(matched(40, seen(1, 0, 9) + seen(2, 20, 29), []))
    summary = summarise(two_passes)
    # Why they are few, and how much more it takes: 2 passes a log, and 6 are needed.
    (note,) = summary.notes
    assert re.search("need 6 passes .* 1 log here has 2; .* 2 more logs", note)
    together = [*seen(1, 0, 9), *seen(2, 0, 9), *seen(3, 1, 9)]
    (note,) = summarise(counts(matched(40, together, []))).notes
    assert re.search("1 log here has 1; .* 5 more logs", note)
    assert over_units(two_passes.units) == ""
    often = [row for n in range(0, 90, 15) for row in seen(1, n, n)]
    assert over_units(counts(matched(90, often, [])).units) == "; 95% intervals over 6 passes"
    assert all(math.isnan(f.low) for f in summary.figures)
    assert all(math.isnan(d.p) for d in summary.differences)


def test_p_value_by_enumeration() -> None:
    """All 2^7 ways to swap two methods, one by one."""
    rng = np.random.default_rng(4)
    part = rng.integers(0, 20, (2, 7)).astype(float)
    whole = rng.integers(20, 30, (2, 7)).astype(float)
    a, b = (of_rates(p, w) for p, w in zip(part, whole, strict=True))
    tosses = coin_tosses(7, rng)
    assert len(tosses) == len(np.unique(tosses, axis=0)) == 2**7
    found = the_tpr(differences(a, b, bootstrap_weights(7, rng), tosses))

    def difference(swap: tuple[int, ...]) -> float:
        rows = np.arange(7)
        s = np.array(swap)
        rate = [part[s ^ i, rows].sum() / whole[s ^ i, rows].sum() for i in (0, 1)]
        return rate[1] - rate[0]

    seen_one = difference((0,) * 7)
    all_ways = [abs(difference(s)) >= abs(seen_one) - 1e-12 for s in product((0, 1), repeat=7)]
    assert found.value_b - found.value_a == pytest.approx(seen_one)
    assert found.p == pytest.approx(np.mean(all_ways))
