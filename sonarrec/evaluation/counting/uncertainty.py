"""Intervals and tests that take whole units, never frames, for independent.

A figure is a function of sums over units (`Tally`). Drawing units with replacement (the cluster
bootstrap) gives its interval; swapping two methods in units by the toss of a coin (the paired
sign-flip test) gives the p-value of their difference. Both are one matrix product: the weights of
the units times the units' sums. By hand: no library resamples whole units of such figures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from sonarrec.evaluation.counting.curves import ratio
from sonarrec.records import FloatArray

LEVEL = 0.95
DRAWS = 1000
FLIPS = 4095
MIN_UNITS = 6
"""With fewer no test can reach p = .05, for it has 2 ** n outcomes: nothing can be said."""
SAME = 1e-6
"""Figures that differ by less than this share of them are equal: sums are held in 32 bits."""


@dataclass(frozen=True, slots=True)
class Tally:
    """Figures of one method that are functions of sums over U units."""

    protocol: str
    method: str
    landmark_text: str
    """An ID, "none", "total" or "macro"."""
    names: tuple[str, ...]
    values: tuple[float, ...]
    """One per figure, as computed from everything."""
    cases: tuple[int, ...]
    """Per figure the number of units that have any case of it."""
    sums: FloatArray
    """(U, C) what each unit adds."""
    figures: Callable[[FloatArray], FloatArray]
    """Turns (R, C) summed rows into (R, figures)."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of one method, with its interval over the units that have a case of it."""

    protocol: str
    method: str
    landmark_text: str
    """An ID, "none", "total" or "macro"."""
    name: str
    """Of the metric."""
    value: float
    """NaN where it is 0/0."""
    low: float
    high: float
    """NaN where the units say nothing."""
    units: int
    note: str
    """Why there is no interval; "" where there is one."""


@dataclass(frozen=True, slots=True)
class Difference:
    """A figure of method b less that of method a, with interval and p-value over units."""

    protocol: str
    a: str
    b: str
    landmark_text: str
    """An ID or "total"."""
    name: str
    """Of the metric."""
    value_a: float
    value_b: float
    low: float
    high: float
    """Of the difference; NaN where the units say nothing."""
    p: float
    """Two-sided, of the paired sign-flip test; NaN where the units say nothing."""
    units: int
    note: str
    """Why there is no interval or no test; "" where there are both."""

    @property
    def value(self) -> float:
        """The difference, b less a."""
        return self.value_b - self.value_a


def bootstrap_weights(units: int, rng: np.random.Generator, draws: int = DRAWS) -> FloatArray:
    """(draws, units) how often each unit is drawn, with replacement, in each of the draws."""
    return rng.multinomial(units, np.full(units, 1 / units), size=draws).astype(np.float32)


def coin_tosses(units: int, rng: np.random.Generator, flips: int = FLIPS) -> FloatArray:
    """(n, units) 0 or 1: every outcome where these are no more than flips + 1, else `flips`
    random ones and the one without a swap."""
    if 2**units <= flips + 1:
        outcomes = np.arange(2**units)[:, None] >> np.arange(units) & 1
    else:
        outcomes = rng.integers(0, 2, (flips + 1, units))
        outcomes[0] = 0
    return outcomes.astype(np.float32)


def interval(drawn: FloatArray, units: int) -> tuple[float, float]:
    """(low, high) at LEVEL of a figure from its (draws,) replicates over as many units.

    Percentiles, moved outward for few units as Student's t is wider than the normal (Hesterberg
    2015, "expanded percentile interval"): plain ones are too narrow, with 8 units by a fifth.
    """
    z = NormalDist().inv_cdf((1 + LEVEL) / 2)
    tail = NormalDist().cdf(-math.sqrt(units / (units - 1)) * _student(z, units - 1))
    known = drawn[~np.isnan(drawn)]
    if not len(known):
        return math.nan, math.nan
    # Among ordered values, not between them: a figure may be infinite.
    low, high = np.quantile(known, [tail, 1 - tail], method="closest_observation")
    return float(low), float(high)


def unseen_share(units: int) -> float:
    """The largest share of units that may have a case although none of `units` has one.

    At LEVEL: a larger share s would show in one of them, as (1 - s) ** units < 1 - LEVEL.
    """
    return float(1 - (1 - LEVEL) ** (1 / units))


def _student(z: float, freedom: int) -> float:
    """Student's quantile from the normal one (Abramowitz and Stegun 26.7.5); 1e-3 from 5 up."""
    return (
        z
        + (z**3 + z) / (4 * freedom)
        + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * freedom**3)
    )


def _alike(drawn: FloatArray, figure: FloatArray) -> bool:
    """Whether the (draws,) replicates are all the same; figure: those they are differences of, or
    they themselves."""
    known = drawn[~np.isnan(drawn)]
    return not len(known) or float(known.max()) <= float(known.min()) + _same(figure)


def _same(figure: FloatArray) -> float:
    """How far apart such figures, (n,), are equal."""
    return SAME * float(np.abs(figure[np.isfinite(figure)]).max(initial=0))


def _less(b: FloatArray, a: FloatArray) -> FloatArray:
    """b - a; 0 where both are infinite."""
    return np.asarray(np.subtract(b, a, out=np.zeros_like(b), where=b != a))


def replicates(tally: Tally, weights: FloatArray) -> FloatArray:
    """(draws, figures) the figures of a tally for each row of `bootstrap_weights`."""
    return tally.figures(weights @ tally.sums)


def intervals(tally: Tally, drawn: FloatArray) -> list[Figure]:
    """The figures of a tally with their intervals, from their (draws, figures) replicates."""
    found = []
    for i, name in enumerate(tally.names):
        value, units = tally.values[i], tally.cases[i]
        low = high = math.nan
        if math.isnan(value):
            note = "0/0: nothing to measure"
        elif units < MIN_UNITS:
            note = f"cases in {units} of the {MIN_UNITS} units needed: no interval"
        elif _alike(drawn[:, i], drawn[:, i]):
            # Resampling equal units gives no width, which is not certainty.
            note = f"alike in all {units} units: no interval"
        else:
            low, high = interval(drawn[:, i], units)
            note = ""
        labels = (tally.protocol, tally.method, tally.landmark_text)
        found.append(Figure(*labels, name, value, low, high, units, note))
    return found


def differences(a: Tally, b: Tally, weights: FloatArray, tosses: FloatArray) -> list[Difference]:
    """What tells two methods apart in each figure that both have; their tallies are over the same
    units.

    weights: `bootstrap_weights`. tosses: `coin_tosses`. If the methods are equal, what they did
    in a unit could as well be the other way round; p is the share of all such swaps that give a
    difference at least as large. Frames within a unit may depend on each other in any way.
    """
    if a.names != b.names:
        names = [name for name in a.names if name in b.names]
        a, b = _only(a, names), _only(b, names)
    total_a, total_b = a.sums.sum(axis=0), b.sums.sum(axis=0)
    swapped = tosses @ (b.sums - a.sums)
    drawn_a, drawn_b = replicates(a, weights), replicates(b, weights)
    tossed_a, tossed_b = a.figures(total_a + swapped), b.figures(total_b - swapped)
    drawn, tossed = _less(drawn_b, drawn_a), _less(tossed_b, tossed_a)
    seen = _less(b.figures(total_b[None]), a.figures(total_a[None]))[0]
    found = []
    for i, name in enumerate(a.names):
        units = min(a.cases[i], b.cases[i])
        low = high = p = math.nan
        if math.isnan(b.values[i] - a.values[i]) or math.isnan(seen[i]):
            note = "0/0 or infinite: nothing to compare"
        elif units < MIN_UNITS:
            note = f"cases in {units} of the {MIN_UNITS} units needed: no test"
        else:
            least = abs(seen[i]) - _same(np.append(tossed_a[:, i], tossed_b[:, i]))
            p = float(np.mean(~(np.abs(tossed[:, i]) < least)))
            of = np.append(drawn_a[:, i], drawn_b[:, i])
            note = "alike in every unit" if _alike(drawn[:, i], of) else ""
            if not note:
                low, high = interval(drawn[:, i], units)
        labels = (a.protocol, a.method, b.method, a.landmark_text, name)
        found.append(Difference(*labels, a.values[i], b.values[i], low, high, p, units, note))
    return found


def _only(tally: Tally, names: Sequence[str]) -> Tally:
    """These of its figures."""
    at = [tally.names.index(name) for name in names]
    return replace(
        tally,
        names=tuple(names),
        values=tuple(tally.values[i] for i in at),
        cases=tuple(tally.cases[i] for i in at),
        figures=lambda rows: tally.figures(rows)[:, at],
    )


def macro(per_id: Sequence[Tally], drawn: Sequence[FloatArray]) -> list[Figure]:
    """The mean of each figure over the IDs that have it; drawn: the replicates of each ID's.

    A replicate that lacks one of these IDs is none: the mean of the others is another figure.
    """
    values = np.array([t.values for t in per_id])
    known = ~np.isnan(values)
    cases = np.where(known, [t.cases for t in per_id], np.inf).min(axis=0)

    def mean(rows: FloatArray) -> FloatArray:  # (IDs, R, figures)
        return ratio(np.where(known[:, None], rows, 0).sum(axis=0), known.sum(axis=0))

    whole = Tally(
        protocol=per_id[0].protocol,
        method=per_id[0].method,
        landmark_text="macro",
        names=per_id[0].names,
        values=tuple(mean(values[:, None])[0].tolist()),
        cases=tuple(int(n) if n < np.inf else 0 for n in cases),
        sums=np.empty((0, 0)),
        figures=mean,
    )
    return intervals(whole, mean(np.stack(drawn)))
