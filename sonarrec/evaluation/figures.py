"""Figures: a metric is one function of counts and one row of METRICS.

All output (screen, files, report, comparisons) uses this table. A function of `KINDS` gives what
the units add up to; a metric is a function of such sums, (R, C) rows in, (R,) figures out: of one
row for all units, or of a row for each bootstrap draw.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import number_of, printable
from sonarrec.evaluation.count import (
    BINS,
    NOBODY,
    Counts,
    Key,
    Rows,
    Scored,
    Units,
    sum_by_value,
)
from sonarrec.evaluation.curves import FPR_POINTS, area, ratio, tpr_at
from sonarrec.evaluation.uncertainty import (
    LEVEL,
    MIN_UNITS,
    Difference,
    Figure,
    Tally,
    bootstrap_weights,
    coin_tosses,
    differences,
    intervals,
)
from sonarrec.records import follows

FPR_GRID = np.unique(
    [
        *np.arange(60) / 1000,
        *np.arange(3, 51) / 50,
        *np.outer(FPR_POINTS, np.linspace(0.8, 1.2, 17)).ravel(),
        *FPR_POINTS,
    ]
)
"""The FPRs of resampled curves, dense about FPR_POINTS. Reported curves are exact."""
AT_ONCE = 256
"""Draws whose figures are computed together: so few lie in the processor's cache."""
SEED = 0
"""Of the random draws, so that the same input gives the same intervals."""

Edges = FloatArray
"""(E,) the values at which a cumulative histogram counts; empty for other kinds of sums."""
NO_EDGES = np.empty(0)


def positives(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """TP, and TP + FN, at the operating point. rows: of `rates`."""
    tp, _, _, fn = rows[:, :4].T
    return tp, tp + fn


def negatives(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """FP, and FP + TN."""
    _, tn, fp, _ = rows[:, :4].T
    return fp, fp + tn


def curve(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(R, points) FPR and TPR of the ROC, from the highest threshold down."""
    tp, tn, fp, fn = np.moveaxis(rows[:, 4:].reshape(len(rows), 4, -1), 1, 0)
    return ratio(fp, fp + tn), ratio(tp, tp + fn)


def true_positive_rate(rows: FloatArray, _: Edges) -> FloatArray:
    """TP / (TP + FN)."""
    return ratio(*positives(rows))


def false_positive_rate(rows: FloatArray, _: Edges) -> FloatArray:
    """FP / (FP + TN)."""
    return ratio(*negatives(rows))


def auc(rows: FloatArray, _: Edges) -> FloatArray:
    """Area under the ROC, see `curves.area`."""
    return area(*curve(rows))


def tpr_at_papers_fpr(rows: FloatArray, _: Edges) -> FloatArray:
    """TPR at the FPR of the paper's framework, see `curves.tpr_at`."""
    return tpr_at(*curve(rows), FPR_POINTS[1])


def quantile(share: float) -> Callable[[FloatArray, Edges], FloatArray]:
    """The smallest value that this share of values does not exceed; NaN if there is none."""

    def of(reached: FloatArray, edges: Edges) -> FloatArray:
        total = reached[:, -1:]
        value = edges[np.argmax(reached >= share * total - 1e-3, axis=1)]  # counts: whole
        return np.where(total[:, 0] > 0, value, np.nan)

    return of


def ece(sums: FloatArray, _: Edges) -> FloatArray:
    """Expected calibration error: mean distance between stated and true probability."""
    count, stated, right = np.moveaxis(sums.reshape(len(sums), 3, BINS), 1, 0)
    return ratio(np.abs(stated - right).sum(axis=1), count.sum(axis=1))


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric."""

    name: str
    """Name in files."""
    label: str
    """Name on screen and in the report."""
    digits: int
    """After the decimal point."""
    kind: str
    """Of the sums that it is a function of, in KINDS."""
    figure: Callable[[FloatArray, Edges], FloatArray]
    brief: bool = False
    """Whether it is printed without --details."""


_PAPER = f"{FPR_POINTS[1]:g}"
METRICS = (
    Metric("tpr", "TPR", 3, "rates", true_positive_rate, True),
    Metric("fpr", "FPR", 4, "rates", false_positive_rate, True),
    Metric("auc", "AUC", 3, "rates", auc, True),
    Metric(
        *(f"tpr_at_fpr_{_PAPER}", f"TPR at FPR {_PAPER} (paper)", 3, "rates", tpr_at_papers_fpr),
        True,
    ),
    Metric("position_error_median_m", "position error, median, m", 4, "position", quantile(0.5)),
    Metric("position_error_95_m", "position error, 95 %, m", 4, "position", quantile(0.95), True),
    Metric(
        *("orientation_error_median_deg", "orientation off, median, deg", 1, "orientation"),
        quantile(0.5),
    ),
    Metric(
        *("orientation_error_95_deg", "orientation off, 95 %, deg", 1, "orientation"),
        quantile(0.95),
    ),
    Metric("ece", "calibration error (ECE)", 3, "calibration", ece),
)
MAIN = ("tpr", "fpr", "auc")
"""Shown per ID, and compared between old and new results."""
BY_NAME = {metric.name: metric for metric in METRICS}
SHARES = {"tpr": positives, "fpr": negatives}
"""Metrics that are rates: their numerators and denominators."""


def _tally(
    kind: str,
    labels: tuple[str, str, str],
    sums: FloatArray,
    exact: tuple[FloatArray, Edges] | None = None,
    edges: Edges = NO_EDGES,
) -> Tally:
    """The figures of one kind. labels: protocol, method, landmark.

    sums: (U, C) what each unit adds. exact: a row of all units, with its edges, if sums are
    coarser.
    """
    metrics = [metric for metric in METRICS if metric.kind == kind]
    row, its_edges = exact or (sums.sum(axis=0), edges)

    def figures(rows: FloatArray) -> FloatArray:
        some = (rows[start : start + AT_ONCE] for start in range(0, len(rows), AT_ONCE))
        return np.concatenate(
            [np.column_stack([m.figure(r, edges) for m in metrics]) for r in some]
        )

    if kind == "rates":  # a curve's positives and negatives may come from different units
        shares = {name: share(sums) for name, share in SHARES.items()}
        known = {name: int(np.count_nonzero(whole)) for name, (_, whole) in shares.items()}
        cases = [known.get(m.name, min(known.values())) for m in metrics]
    else:
        shares = {}
        cases = np.count_nonzero(~np.isnan(figures(sums)), axis=0).tolist()
    return Tally(
        *labels,
        names=tuple(m.name for m in metrics),
        values=tuple(float(m.figure(row[None], its_edges)[0]) for m in metrics),
        cases=tuple(cases),
        sums=sums,
        figures=figures,
        shares=shares,
    )


def rates(counts: Counts) -> Iterator[Tally]:
    """Operating points and ROCs of every method under every protocol."""
    for scored in counts.scored:
        yield from rates_of(counts, scored)


def rates_of(counts: Counts, s: Scored) -> Iterator[Tally]:
    """Operating points and ROCs of one method under one protocol: of each ID, then of all.

    Columns: TP, TN, FP, FN at the operating point, then each along the ROC.
    """
    base, declared = (counts.sums("declared", s.protocol, m) for m in (NOBODY, s.method))
    assert base is not None
    assert declared is not None
    for k, name in _landmarks(s.ids):
        roc = s.curve(k)
        # Bins of FPR, not of score, so that methods with different scores can be swapped bin by
        # bin. The curve of a sum is the sum of curves, so it is made once and not in each draw.
        at = np.maximum(np.searchsorted(roc.fpr, FPR_GRID, side="right") - 1, 0)
        steps = np.zeros((counts.units.count, 4, len(FPR_GRID)))
        first, now = (of.sum(axis=1) if k is None else of[:, k] for of in (base, declared))
        steps[:, :, 0] = first
        for score, unit, effect in _by_unit(counts, s.keys(k)):
            bins = np.searchsorted(-roc.threshold[at], -score, side="left")
            for c in range(4):
                _add(steps[:, c], unit, np.minimum(bins, len(FPR_GRID) - 1), effect[:, c])
        np.cumsum(steps, axis=2, out=steps)
        sums = np.hstack([now, steps.reshape(len(steps), -1)]).astype(np.float32)
        points = (now.sum(axis=0), roc.tp, roc.tn, roc.fp, roc.fn)
        exact = np.concatenate(points), NO_EDGES
        yield _tally("rates", (s.protocol, s.method, name), sums, exact)


def _landmarks(ids: Sequence[int]) -> list[tuple[int | None, str]]:
    """(index, text) of each ID, then of all."""
    return [*((k, str(i)) for k, i in enumerate(ids)), (None, "total")]


def _by_unit(counts: Counts, keys: Sequence[Key]) -> Iterator[Rows]:
    """The values of some keys, by unit."""
    for key in keys:
        for value, unit, number in counts.values.rows(key):
            yield value, counts.units.of_pass_unit[unit], number


def _add(sums: FloatArray, unit: IntArray, column: IntArray, number: IntArray) -> None:
    """Add (n,) whole numbers to the cells (unit, column) of (U, C) sums."""
    if len(unit):
        first, size = int(unit.min()), sums.shape[1]  # the units of a log are neighbours
        rows = int(unit.max()) - first + 1
        added = np.bincount((unit - first) * size + column, number, rows * size)
        sums[first : first + rows] += added.reshape(rows, size)


def _histogram(rows: Sequence[Rows], units: int, edges: Edges) -> FloatArray:
    """(U, E) how many values of each unit do not exceed each edge; other values are rounded up."""
    sums = np.zeros((units, len(edges)), dtype=np.float32)
    for value, unit, number in rows:
        _add(sums, unit, np.minimum(np.searchsorted(edges, value), len(edges) - 1), number[:, 0])
    return np.cumsum(sums, axis=1, out=sums)


def errors(counts: Counts, kind: str) -> Iterator[Tally]:
    """Errors of right claims: "position", m, or "orientation", deg."""
    methods, of = counts.methods if counts.placed else (), range(len(counts.ids))
    of_all = sum_by_value(counts.values.table((kind, m, k)) for m in methods for k in of)
    if not len(of_all[0]):
        return
    # The edges are quantiles of all errors, the same for every method; their ranks are those of
    # numpy's quantile with the method "inverted_cdf".
    ranks = np.ceil(of_all[1].sum() * np.linspace(0, 1, 513) - 1).clip(0).astype(np.int64)
    edges = np.unique(of_all[0][np.searchsorted(np.cumsum(of_all[1][:, 0]), ranks, side="right")])
    for method in methods:
        for k, name in _landmarks(counts.ids):
            keys: list[Key] = [(kind, method, i) for i in (of if k is None else [k])]
            sums = _histogram([*_by_unit(counts, keys)], counts.units.count, edges)
            value, number = sum_by_value(map(counts.values.table, keys))
            exact = (np.cumsum(number[:, 0], dtype=float), value) if len(value) else None
            yield _tally(kind, ("strict", method, name), sums, exact, edges)


def calibration(counts: Counts) -> Iterator[Tally]:
    """Calibration of every method that states probabilities, of the most probable class."""
    for method in counts.methods if counts.placed else ():
        if (found := counts.sums("calibration", method)) is not None:
            yield _tally("calibration", ("strict", method, "total"), found)


KINDS: dict[str, Callable[[Counts], Iterator[Tally]]] = {
    "rates": rates,
    "position": lambda counts: errors(counts, "position"),
    "orientation": lambda counts: errors(counts, "orientation"),
    "calibration": calibration,
}
"""In the order of figures.csv."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Figures with intervals, and differences between methods."""

    units: Units
    figures: tuple[Figure, ...]
    """Per protocol, method and landmark, by metric."""
    differences: tuple[Difference, ...]
    """Of each two methods, in total."""
    notes: tuple[str, ...]

    def figure(
        self, protocol: str, method: str, name: str, landmark: str = "total"
    ) -> Figure | None:
        """One figure; None if it was not measured."""
        wanted = (protocol, method, landmark, name)
        return next((f for f in self.figures if f[:4] == wanted), None)


def draws(units: Units) -> tuple[FloatArray, FloatArray]:
    """The weights of the bootstrap and the coin tosses of the tests."""
    rng = np.random.default_rng(SEED)
    return bootstrap_weights(units.count, rng), coin_tosses(units.count, rng)


def summarise(counts: Counts) -> Summary:
    """Figures, intervals and tests of an evaluation."""
    units = counts.units
    weights, tosses = draws(units)
    figures: list[Figure] = []
    totals: dict[tuple[str, str], list[Tally]] = defaultdict(list)  # of a kind and protocol
    for kind, of_kind in KINDS.items():
        for tally in of_kind(counts):
            figures += intervals(tally, weights)
            if tally.landmark == "total":
                totals[kind, tally.protocol].append(tally)
    return Summary(
        units=units,
        figures=tuple(figures),
        differences=tuple(
            difference
            for group in totals.values()
            for pair in combinations(group, 2)
            # What one without tracks, the baseline, has is subtracted.
            for a, b in [sorted(pair, key=lambda tally: follows(tally.method))]
            for difference in differences(a, b, weights, tosses)
        ),
        notes=tuple(map(printable, few_units(counts, figures))),
    )


def few_units(counts: Counts, figures: Sequence[Figure] = ()) -> Iterator[str]:
    """A note if the units are too few for intervals and tests: why they are, how much it takes.

    figures: so that one on those with cases in too few of the units can be given.
    """
    units, logs, passes = counts.units, len(counts.parts), len(counts.passes)
    cases = [f.units for f in figures if f.landmark == "total" and 0 < f.units < MIN_UNITS]
    least = min([units.count, *cases]) if units.kind == "pass" else MIN_UNITS
    if least >= MIN_UNITS:
        return
    which, has = "no intervals and no tests", "are"
    if units.count >= MIN_UNITS:
        which, has = "some figures have no interval and no test", "have cases in"
    more, like = math.ceil((MIN_UNITS - least) * logs / least), "these" if logs > 1 else "it"
    yield (
        f"{which}: {number_of(passes, 'pass', 'es')} of landmarks in {number_of(logs, 'log')} "
        f"{has} {number_of(least, 'independent unit')}, as passes at the same time are one, and a "
        f"log without any; {MIN_UNITS} are needed: some {number_of(more, 'more log')} like {like}"
    )


def units_text(units: Units) -> str:
    """The number of units with their kind, such as "12 passes"."""
    return number_of(units.count, units.kind, {"pass": "es", "log": "s"}[units.kind])


def over_units(summary: Summary) -> str:
    """The part of a table's caption about its intervals; empty if there are none."""
    if summary.units.count < MIN_UNITS:
        return ""
    return f"; {LEVEL:.0%} intervals over {units_text(summary.units)}"
