"""Figures: a metric is a function of sums over units, and one row of METRICS.

All output (screen, files, report, comparisons) uses this table. A metric takes sums of one or of
many draws, (draws, ...), and gives (draws,) figures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import FloatArray, Table, stacked
from sonarrec.errors import number_of, printable
from sonarrec.evaluation.counts import BINS, MILLION, TOTAL, Counts, Units, of_landmark, ratio
from sonarrec.evaluation.rows import COUNTS
from sonarrec.evaluation.uncertainty import (
    MIN_UNITS,
    all_equal,
    draws,
    interval,
    p_value,
    rate_interval,
)
from sonarrec.sonar.frame import follows

FPR_POINTS = (0.01, 0.0276, 0.05)
"""FPRs about which curves are dense; .0276 is that of the paper's framework (Table 5)."""
FPR_GRID = np.unique(
    [
        *np.arange(60) / 1000,
        *np.arange(3, 51) / 50,
        *np.outer(FPR_POINTS, np.linspace(0.8, 1.2, 17)).ravel(),
        *FPR_POINTS,
    ]
)
"""The FPRs of resampled curves. Reported curves are exact."""
QUANTILES = 513
"""Of all errors: the values at which resampled errors are counted."""


# Metrics. Rates have sums (draws, 4, 1 + points): TP, TN, FP, FN at the operating point, then along
# the ROC from the highest threshold down.


def true_positive_rate(sums: FloatArray) -> FloatArray:
    """TP / (TP + FN)."""
    tp, _, _, fn = sums[:, :, 0].T
    return np.asarray(ratio(tp, tp + fn))


def false_positive_rate(sums: FloatArray) -> FloatArray:
    """FP / (FP + TN)."""
    _, tn, fp, _ = sums[:, :, 0].T
    return np.asarray(ratio(fp, fp + tn))


def _curve(sums: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(draws, points) FPR and TPR."""
    tp, tn, fp, fn = np.moveaxis(sums[:, :, 1:], 1, 0)
    return ratio(fp, fp + tn), ratio(tp, tp + fn)


def area(fpr: FloatArray, tpr: FloatArray) -> FloatArray:
    """(...,) area under curves (..., points).

    1 is perfect, 0.5 is chance. Points are joined by straight lines, and the last point with
    (1, 1): beyond it every claim would be a guess. scikit-learn gives the same if frames and IDs
    without an estimate share the lowest score.
    """
    last = np.ones((*fpr.shape[:-1], 1), dtype=fpr.dtype)
    x, y = np.concatenate([fpr, last], axis=-1), np.concatenate([tpr, last], axis=-1)
    steps = (x[..., 1:] - x[..., :-1]) * (y[..., :-1] + y[..., 1:])
    return np.asarray(steps.sum(axis=-1) / 2)


def tpr_at(fpr: FloatArray, tpr: FloatArray, most: float) -> FloatArray:
    """(...,) highest TPR among the points of curves (..., points) with an FPR of at most `most`.

    Without interpolation, since no threshold gives a point in between. NaN if a rate is NaN.
    """
    reached = np.where(fpr <= most, tpr, -np.inf).max(axis=-1)
    return np.asarray(np.where(np.isnan(tpr[..., 0]) | np.isnan(fpr[..., 0]), np.nan, reached))


def auc(sums: FloatArray) -> FloatArray:
    """Area under the ROC, see `area`."""
    return area(*_curve(sums))


def tpr_at_paper(sums: FloatArray) -> FloatArray:
    """TPR at the FPR of the paper's framework, see `tpr_at`."""
    return tpr_at(*_curve(sums), FPR_POINTS[1])


def quantile(sums: FloatArray, values: FloatArray, share: float) -> FloatArray:
    """The smallest of (values,) that this share of errors does not exceed; NaN if there is none.

    sums: (draws, values) how many errors do not exceed each.
    """
    total = sums[:, -1:]
    first = np.argmax(sums >= share * total - 1e-3, axis=1)  # counts: integers
    return np.where(total[:, 0] > 0, values[first], np.nan)


def ece(sums: FloatArray) -> FloatArray:
    """Expected calibration error: mean distance between stated and true probability.

    sums: (draws, 3, BINS) number, sum of p, and how many are right.
    """
    count, stated, right = np.moveaxis(sums, 1, 0)
    return np.asarray(ratio(np.abs(stated - right).sum(axis=1), count.sum(axis=1)))


class Metric(NamedTuple):
    """One metric."""

    label: str
    """Its name on screen and in the report."""
    digits: int
    kind: str
    """Of the sums that it is a function of, see Sample."""
    function: Callable[..., FloatArray]
    brief: bool = False
    """Whether it is printed without --details."""


_PAPER = f"{FPR_POINTS[1]:g}"
MEDIAN, MOST = partial(quantile, share=0.5), partial(quantile, share=0.95)
METRICS = {
    "tpr": Metric("TPR", 3, "rates", true_positive_rate, True),
    "fpr": Metric("FPR", 4, "rates", false_positive_rate, True),
    "auc": Metric("AUC", 3, "rates", auc, True),
    f"tpr_at_fpr_{_PAPER}": Metric(f"TPR at FPR {_PAPER} (paper)", 3, "rates", tpr_at_paper, True),
    "position_error_median_m": Metric("position error, median, m", 4, "position", MEDIAN),
    "position_error_95_m": Metric("position error, 95 %, m", 4, "position", MOST, True),
    "orientation_error_median_deg": Metric(
        "orientation off, median, deg", 1, "orientation", MEDIAN
    ),
    "orientation_error_95_deg": Metric("orientation off, 95 %, deg", 1, "orientation", MOST),
    "ece": Metric("calibration error (ECE)", 3, "calibration", ece),
}
"""By their names in files."""
MAIN = ("tpr", "fpr", "auc")
"""Shown per ID, and compared between old and new results."""
SHARES = {"tpr": (0, 3), "fpr": (2, 1)}
"""Metrics that are rates: of COUNTS the numerator, and what completes the denominator."""


# Sums by unit


@dataclass(slots=True)
class Sample:
    """What each unit adds to the figures of one protocol, method and landmark."""

    kind: str
    protocol: str
    method: str
    landmark: str
    per_unit: FloatArray
    """(U, ...) to be weighted and added up."""
    total: FloatArray
    """(1, ...) of all units; of curves and errors in each point."""
    values: tuple[FloatArray, ...] = ()
    """Of errors: the values at which the sums by unit count."""
    total_values: tuple[FloatArray, ...] = ()
    """... and those at which the sums of all units do."""
    drawn: dict[str, FloatArray] = field(default_factory=dict)
    """Replicates of figures that were computed already."""

    def metrics(self) -> list[str]:
        """The names of those that are functions of this kind of sums."""
        return [name for name, metric in METRICS.items() if metric.kind == self.kind]

    def value(self, name: str) -> float:
        """A figure of all units."""
        return float(METRICS[name].function(self.total, *self.total_values)[0])

    def figures(self, name: str, sums: FloatArray) -> FloatArray:
        """(draws,) figures of sums as of `per_unit`."""
        return METRICS[name].function(sums, *self.values)

    def replicates(self, name: str, weights: FloatArray) -> FloatArray:
        """(draws,) of the bootstrap."""
        if name not in self.drawn:
            sums = np.tensordot(weights, self.per_unit, 1)
            self.drawn = {metric: self.figures(metric, sums) for metric in self.metrics()}
        return self.drawn[name]

    def share(self, name: str) -> tuple[FloatArray, FloatArray]:
        """(U,) numerator and denominator of a rate."""
        part, rest = (self.per_unit[:, c, 0] for c in SHARES[name])
        return part, part + rest

    def cases(self, name: str) -> int:
        """How many units have a case of a figure."""
        if self.kind != "rates":
            return int(np.count_nonzero(~np.isnan(self.figures(name, self.per_unit))))
        # A curve's positives and negatives may come from different units.
        names = [name] if name in SHARES else list(SHARES)
        return min(int(np.count_nonzero(self.share(rate)[1])) for rate in names)


def samples(counts: Counts) -> Iterator[Sample]:
    """All, in the order of figures.csv."""
    for method in counts.methods:
        for protocol in counts.protocols:
            yield from rates(counts, method, protocol)
    if counts.placed:
        yield from errors(counts, "position")
        yield from errors(counts, "orientation")
        yield from calibration(counts)


def rates(counts: Counts, method: str, protocol: str) -> Iterator[Sample]:
    """Operating points and ROCs of one method under one protocol, per ID and in total."""
    base, declared, claims = (
        counts.rows(name, source, protocol)
        for name, source in (("base", ""), ("declared", method), ("claims", method))
    )
    for landmark, roc in counts.curves(method, protocol):
        exact = np.stack([roc[name] for name in COUNTS])
        # Bins of FPR, not of score, so that methods with different scores can be swapped bin by
        # bin. The curve of a sum is the sum of curves, so it is made once and not in each draw.
        index = np.maximum(np.searchsorted(roc["fpr"], FPR_GRID, side="right") - 1, 0)
        sums = np.zeros((counts.units.number, 4, 1 + len(FPR_GRID)))
        without = of_landmark(base, landmark)
        for table, columns in ((without, 2), (of_landmark(declared, landmark), 1)):
            added = np.stack([table[name] for name in COUNTS], axis=-1)
            np.add.at(sums[:, :, :columns], table["unit"], added[:, :, None])
        rows = of_landmark(claims, landmark)
        bins = np.searchsorted(-roc["threshold"][index], -rows["score"] / MILLION)
        cell = rows["unit"] * len(FPR_GRID) + np.minimum(bins, len(FPR_GRID) - 1)
        for c, name in enumerate(COUNTS):
            added = np.bincount(cell, rows[name], len(sums) * len(FPR_GRID))
            sums[:, c, 1:] += added.reshape(len(sums), -1)
        np.cumsum(sums[:, :, 1:], axis=2, out=sums[:, :, 1:])
        total = np.column_stack([sums[:, :, 0].sum(axis=0), exact])[None]
        yield Sample("rates", protocol, method, landmark, sums.astype(np.float32), total)


def errors(counts: Counts, kind: str) -> Iterator[Sample]:
    """Errors of right claims: "position", m, or "orientation", deg."""
    errors_of = {method: counts.rows(kind, method) for method in counts.methods}
    every = stacked([*errors_of.values()]).select(["value", "n"]).added_up(["value"])
    if not len(every):
        return
    # The values are quantiles of all errors, the same for every method; their ranks are those of
    # numpy's quantile with the method "inverted_cdf".
    reached = np.cumsum(every["n"])
    ranks = np.ceil(reached[-1] * np.linspace(0, 1, QUANTILES) - 1).clip(0).astype(np.int64)
    values = np.unique(every["value"][np.searchsorted(reached, ranks, side="right")])
    for method in counts.methods:
        for landmark in counts.landmarks:
            rows = of_landmark(errors_of[method], landmark)
            sums = np.zeros((counts.units.number, len(values)))
            column = np.minimum(np.searchsorted(values, rows["value"]), len(values) - 1)
            np.add.at(sums, (rows["unit"], column), rows["n"])
            sums = np.cumsum(sums, axis=1).astype(np.float32)
            own = rows.select(["value", "n"]).added_up(["value"])
            own = own if len(own) else Table(value=values[:1], n=0)
            total = np.cumsum(own["n"]).astype(float)[None]
            yield Sample(kind, "strict", method, landmark, sums, total, (values,), (own["value"],))


def calibration(counts: Counts) -> Iterator[Sample]:
    """Calibration of every method that states probabilities, of the most probable class."""
    for method in counts.methods:
        if len(table := counts.rows("calibration", method)):
            sums = np.zeros((counts.units.number, BINS, 3))
            columns = np.column_stack([table["n"], table["stated"], table["right"]])
            np.add.at(sums, (table["unit"], table["bin"]), columns)
            sums = sums.swapaxes(1, 2)
            yield Sample("calibration", "strict", method, TOTAL, sums, sums.sum(axis=0)[None])


# Figures with intervals, and differences with tests


class Figure(NamedTuple):
    """A row of figures.csv."""

    protocol: str
    method: str
    landmark: str
    figure: str
    """The name of its metric."""
    value: float
    low: float
    high: float
    """low, high: its interval; NaN if there is none, and then `note` says why."""
    units: int
    """How many have a case."""
    note: str


class Difference(NamedTuple):
    """A metric of two methods on the same units; the interval and the test are of b - a."""

    protocol: str
    a: str
    b: str
    landmark: str
    figure: str
    value_a: float
    value_b: float
    low: float
    high: float
    p: float
    units: int
    note: str


def intervals(sample: Sample, weights: FloatArray) -> Iterator[Figure]:
    """The figures of a sample with their intervals."""
    for name in sample.metrics():
        value, units = sample.value(name), sample.cases(name)
        low = high = np.nan
        note = ""
        if np.isnan(value):
            note = "0/0: nothing to measure"
        elif units < MIN_UNITS:
            note = f"cases in {units} of the {MIN_UNITS} units needed: no interval"
        elif name in SHARES:
            low, high = rate_interval(*sample.share(name))
        elif all_equal(drawn := sample.replicates(name, weights), drawn):
            note = f"alike in all {units} units: no interval"
        else:
            low, high = interval(drawn, units)
        key = sample.protocol, sample.method, sample.landmark
        yield Figure(*key, name, value, low, high, units, note)


def differences(
    a: Sample, b: Sample, weights: FloatArray, tosses: FloatArray
) -> Iterator[Difference]:
    """The differences b - a of two methods on the same units."""
    total_a, total_b = (side.per_unit.sum(axis=0) for side in (a, b))
    known = {name: min(a.cases(name), b.cases(name)) for name in a.metrics()}
    enough = max(known.values()) >= MIN_UNITS
    swapped = np.tensordot(tosses[: None if enough else 1], b.per_unit - a.per_unit, 1)
    for name, units in known.items():
        values = a.value(name), b.value(name)
        seen = float(b.figures(name, total_b[None])[0] - a.figures(name, total_a[None])[0])
        low = high = p = np.nan
        if np.isnan(values[1] - values[0]) or np.isnan(seen):
            note = "0/0: nothing to compare"
        elif units < MIN_UNITS:
            note = f"cases in {units} of the {MIN_UNITS} units needed: no test"
        else:
            p = p_value(
                seen, a.figures(name, total_a + swapped), b.figures(name, total_b - swapped)
            )
            drawn = [side.replicates(name, weights) for side in (a, b)]
            is_equal = all_equal(drawn[1] - drawn[0], np.concatenate(drawn))
            note = "alike in every unit" if is_equal else ""
            if not is_equal:
                low, high = interval(drawn[1] - drawn[0], units)
        side = a.protocol, a.method, b.method, a.landmark
        yield Difference(*side, name, *values, low, high, p, units, note)


class Summary(NamedTuple):
    """Figures with intervals, and differences between each two methods, in total."""

    figures: tuple[Figure, ...]
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]

    def figure(self, protocol: str, method: str, name: str, landmark: str = TOTAL) -> Figure | None:
        """One of the figures; None if it was not measured."""
        wanted = (protocol, method, landmark, name)
        return next((figure for figure in self.figures if figure[:4] == wanted), None)


def summarise(counts: Counts) -> Summary:
    """Figures, intervals and tests of an evaluation."""
    weights, tosses = draws(counts.units.number)
    figures: list[Figure] = []
    totals: dict[str, list[Sample]] = {}  # by kind and protocol
    for sample in samples(counts):
        figures += intervals(sample, weights)
        if sample.landmark == TOTAL:
            totals.setdefault(f"{sample.kind} {sample.protocol}", []).append(sample)
    # What one without tracks, the baseline, has is subtracted.
    tests: list[Difference] = []
    for group in totals.values():
        for pair in combinations(group, 2):
            a, b = sorted(pair, key=lambda sample: follows(sample.method))
            tests += differences(a, b, weights, tosses)
    notes = tuple(map(printable, few_units(counts, figures)))
    return Summary(tuple(figures), tuple(tests), notes)


def few_units(counts: Counts, figures: Sequence[Figure] = ()) -> Iterator[str]:
    """A note if the units are too few for intervals and tests: why they are, how much it takes.

    figures: so that one on those with cases in too few of the units can be given.
    """
    units, logs = counts.units, len(counts.logs)
    few = [f.units for f in figures if f.landmark == TOTAL and 0 < f.units < MIN_UNITS]
    least = min([units.number, *few]) if units.kind == "pass" else MIN_UNITS
    if least >= MIN_UNITS:
        return
    which, cases = "no intervals and no tests", ""
    if units.number >= MIN_UNITS:
        which, cases = "some figures have no interval and no test", "cases in "
    more, like = math.ceil((MIN_UNITS - least) * logs / least), "these" if logs > 1 else "it"
    yield (
        f"{which}: they need {cases}{MIN_UNITS} passes of landmarks at different times, and "
        f"{number_of(logs, 'log')} here {'has' if logs == 1 else 'have'} {least}; score about "
        f"{number_of(more, 'more log')} like {like}"
    )


def units_text(units: Units) -> str:
    """The number of units with their kind, such as "12 passes"."""
    return number_of(units.number, units.kind, {"pass": "es", "log": "s"}[units.kind])
