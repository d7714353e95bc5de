"""The contribution of each unit to the figures of a method, and the records that metrics use.

A record has one row per set of units: a single row for all units, or one per bootstrap draw.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.evaluation.counting.curves import FPR_POINTS, Curve, ratio
from sonarrec.evaluation.counting.histogram import Table, sum_by_value, values_at_ranks

FPR_GRID = np.unique(
    [
        *np.arange(60) / 1000,
        *np.arange(3, 51) / 50,
        *np.outer(FPR_POINTS, np.linspace(0.8, 1.2, 17)).ravel(),
        *FPR_POINTS,
    ]
)
"""The FPRs of resampled curves, dense about FPR_POINTS. Reported curves are exact."""
QUANTILES = (0.5, 0.9, 0.95)
"""The quantiles that metrics may use; `exact_histogram` has no others."""

Blocks = Iterable[tuple[FloatArray, IntArray, IntArray]]
"""(n,) scores or errors, (n, C) effects or counts, and (n,) units."""


@dataclass(frozen=True, slots=True)
class UnitSums:
    """The contributions of the units to a record, for one method under one protocol."""

    protocol: str
    method: str
    landmark_text: str
    """An ID, "none" or "total"."""
    sums: FloatArray
    """(U, C) contribution of each unit."""
    record: Callable[[FloatArray], Any]
    """Turns (R, C) summed rows into a record."""
    exact: Any
    """The record of all units, with one row; `sums` may be coarser."""


@dataclass(frozen=True, slots=True)
class Rates:
    """Operating points and ROCs."""

    counts: FloatArray
    """(R, 4) TP, TN, FP, FN at the operating point."""
    tpr: FloatArray
    fpr: FloatArray
    """(R, points) the ROC, from the highest threshold down."""


@dataclass(frozen=True, slots=True)
class CumulativeHistogram:
    """A cumulative histogram."""

    edges: FloatArray
    """(E,) rising."""
    reached: FloatArray
    """(R, E) how many values do not exceed each edge."""

    def quantile(self, share: float) -> FloatArray:
        """(R,) the smallest edge that this share of values does not exceed; NaN if none."""
        total = self.reached[:, -1:]
        edges = self.edges[np.argmax(self.reached >= share * total - 1e-3, axis=1)]  # counts: whole
        return np.where(total[:, 0] > 0, edges, np.nan)


def grid_points(curve: Curve, grid: FloatArray = FPR_GRID) -> IntArray:
    """The last point of a curve at each FPR of a grid."""
    return np.maximum(np.searchsorted(curve.fpr, grid, side="right") - 1, 0)


def rate_sums(
    labels: tuple[str, str, str], base: IntArray, declared: IntArray, curve: Curve, claims: Blocks
) -> UnitSums:
    """The contributions of the units to Rates.

    labels: protocol, method, landmark_text. base: (U, 4) TP, TN, FP, FN without any claim.
    declared: the same at the operating point. curve: the exact ROC.
    """
    units, bins = len(base), len(FPR_GRID)
    # Bins of FPR, not of score, so that methods with different scores can be swapped bin by bin.
    at = grid_points(curve)
    steps = np.zeros((units, 4, bins))
    steps[:, :, 0] = base
    for score, effect, unit in claims:
        if len(score):
            bin_ = np.searchsorted(-curve.threshold[at], -score, side="left")
            first = int(unit.min())  # the units of a log are neighbours
            cell = (unit - first) * bins + np.minimum(bin_, bins - 1)
            size = (int(unit.max()) - first + 1) * bins
            for c in range(4):
                added = np.bincount(cell, effect[:, c], minlength=size).reshape(-1, bins)
                steps[first : first + len(added), c] += added
    # The curve of a sum is the sum of curves, so this is done once and not in each draw.
    np.cumsum(steps, axis=2, out=steps)
    return UnitSums(
        *labels,
        sums=np.hstack([declared, steps.reshape(units, -1)]).astype(np.float32),
        record=_rates,
        exact=Rates(declared.sum(axis=0)[None], curve.tpr[None], curve.fpr[None]),
    )


def _rates(rows: FloatArray) -> Rates:
    """The record of (R, 4 + 4 * bins) rows: operating point, then the counts along the curve."""
    tp, tn, fp, fn = np.moveaxis(rows[:, 4:].reshape(len(rows), 4, -1), 1, 0)
    tpr, fpr = np.zeros((2, len(rows), tp.shape[1] + 1), dtype=rows.dtype)
    tpr[:, 1:], fpr[:, 1:] = ratio(tp, tp + fn), ratio(fp, fp + tn)
    return Rates(rows[:, :4], tpr, fpr)


def histogram_sums(
    labels: tuple[str, str, str],
    values: Blocks,
    units: int,
    edges: FloatArray,
    exact: Table | None = None,
) -> UnitSums:
    """The contributions of the units to a CumulativeHistogram.

    labels: protocol, method, landmark_text. edges: rising; the last is no less than any value.
    Resampled values are rounded up to an edge, so methods need equal edges to be compared. exact:
    all values, if those by unit are coarser.
    """
    values = list(values)
    sums = np.zeros((units, len(edges)), dtype=np.float32)
    for block, count, unit in values:
        if len(block):
            first = int(unit.min())
            place = (unit - first) * len(edges) + np.searchsorted(edges, block)
            size = (int(unit.max()) - first + 1) * len(edges)
            added = np.bincount(place, count[:, 0], minlength=size).reshape(-1, len(edges))
            sums[first : first + len(added)] += added
    np.cumsum(sums, axis=1, out=sums)
    exact = sum_by_value((block, count) for block, count, _ in values) if exact is None else exact
    record = exact_histogram(exact)
    return UnitSums(*labels, sums, lambda rows: CumulativeHistogram(edges, rows), record)


def exact_histogram(table: Table) -> CumulativeHistogram:
    """The histogram of all values; its edges, their QUANTILES and maximum, are thus exact."""
    total = int(table[1].sum())
    if not total:
        return CumulativeHistogram(np.zeros(1), np.zeros((1, 1)))
    least = np.ceil(
        np.array([*QUANTILES, 1.0]) * total - 1e-3
    )  # as in CumulativeHistogram.quantile
    reached = np.clip(least, 1, total)
    return CumulativeHistogram(values_at_ranks(table, reached.astype(np.int64) - 1), reached[None])


def plain_sums(
    labels: tuple[str, str, str],
    record: Callable[..., Any],
    columns: Sequence[FloatArray | IntArray],
) -> UnitSums:
    """Plain sums. columns: (U,) each, contributions to the fields of `record` in order."""
    sums = np.stack(columns, axis=1).astype(float)
    return UnitSums(*labels, sums, lambda rows: record(*rows.T), record(*sums.sum(axis=0)[:, None]))


def by_landmark(ids: Sequence[int], landmark_index: IntArray) -> list[tuple[str, BoolArray]]:
    """(name, which elements belong to it) of each ID, then of all."""
    per_id = [(str(i), landmark_index == k) for k, i in enumerate(ids)]
    return [*per_id, ("total", np.ones(len(landmark_index), dtype=bool))]
