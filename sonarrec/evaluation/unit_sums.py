"""What each unit adds to the figures of a method, and the records that metrics use.

A record has one row per set of units: a single row for all units, or one per bootstrap draw. The
functions at the end, the kinds of records, give them per ID and in total.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.evaluation.behaviour import BINS
from sonarrec.evaluation.count import NOBODY, Counts, Scored, Units
from sonarrec.evaluation.curves import FPR_POINTS, Curve, ratio
from sonarrec.evaluation.histogram import Rows, Table, sum_by_value, values_at_ranks
from sonarrec.evaluation.tracking import COLUMNS

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


@dataclass(frozen=True, slots=True)
class Calibration:
    """Estimates in BINS equal bins of the probability that they state."""

    squares: FloatArray
    """(R,) sum of (p - y)^2."""
    count: FloatArray
    """(R, BINS) estimates."""
    stated: FloatArray
    """(R, BINS) sum of their probabilities."""
    right: FloatArray
    """(R, BINS) how many are right."""


def rates(counts: Counts, units: Units) -> Iterator[UnitSums]:
    """Rates of every method under every protocol."""
    for scored in counts.scored:
        yield from rates_of(counts, units, scored)


def rates_of(counts: Counts, units: Units, s: Scored) -> Iterator[UnitSums]:
    """Rates of one method under one protocol."""
    base = counts.declared(units, s.protocol, NOBODY)
    declared = counts.declared(units, s.protocol, s.method)
    for k, landmark in enumerate(s.ids):
        labels, rows = (s.protocol, s.method, str(landmark)), _rows(s, units, k)
        yield _rate_sums(labels, base[:, k], declared[:, k], s.curve(k), rows)
    labels, rows = (s.protocol, s.method, "total"), _rows(s, units, None)
    yield _rate_sums(labels, base.sum(axis=1), declared.sum(axis=1), s.curve(), rows)


def _rows(s: Scored, units: Units, k: int | None) -> Iterator[Rows]:
    """The claims of the k-th ID, or of all, by unit."""
    for key in s.keys(k):
        for value, unit, effect in s.values.rows(key):
            yield value, units.of_pass_unit[unit], effect


def _rate_sums(
    labels: tuple[str, str, str],
    base: IntArray,
    declared: IntArray,
    curve: Curve,
    claims: Iterator[Rows],
) -> UnitSums:
    """What the units add to Rates.

    labels: protocol, method, landmark_text. base: (U, 4) TP, TN, FP, FN without any claim.
    declared: the same at the operating point. curve: the exact ROC.
    """
    units, bins = len(base), len(FPR_GRID)
    # Bins of FPR, not of score, so that methods with different scores can be swapped bin by bin.
    at = np.maximum(np.searchsorted(curve.fpr, FPR_GRID, side="right") - 1, 0)
    steps = np.zeros((units, 4, bins))
    steps[:, :, 0] = base
    for score, unit, effect in claims:
        bin_ = np.searchsorted(-curve.threshold[at], -score, side="left")
        for c in range(4):
            _add(steps[:, c], unit, np.minimum(bin_, bins - 1), effect[:, c])
    # The curve of a sum is the sum of curves, so this is done once and not in each draw.
    np.cumsum(steps, axis=2, out=steps)

    def record(rows: FloatArray) -> Rates:
        tp, tn, fp, fn = np.moveaxis(rows[:, 4:].reshape(len(rows), 4, -1), 1, 0)
        tpr, fpr = np.zeros((2, len(rows), tp.shape[1] + 1), dtype=rows.dtype)
        tpr[:, 1:], fpr[:, 1:] = ratio(tp, tp + fn), ratio(fp, fp + tn)
        return Rates(rows[:, :4], tpr, fpr)

    sums = np.hstack([declared, steps.reshape(units, -1)]).astype(np.float32)
    exact = Rates(declared.sum(axis=0)[None], curve.tpr[None], curve.fpr[None])
    return UnitSums(*labels, sums, record, exact)


def _add(sums: FloatArray, unit: IntArray, column: IntArray, number: IntArray) -> None:
    """Add (n,) whole numbers to the cells (unit, column) of (U, C) sums."""
    if len(unit):
        first, size = int(unit.min()), sums.shape[1]  # the units of a log are neighbours
        rows = int(unit.max()) - first + 1
        added = np.bincount((unit - first) * size + column, number, rows * size)
        sums[first : first + rows] += added.reshape(rows, size)


def waits(counts: Counts, units: Units) -> Iterator[UnitSums]:
    """Histograms of the frames to a lasting ID, under every protocol.

    A pass without a lasting ID counts as infinite.
    """
    passes = counts.passes
    unit = units.of_pass_unit[passes.unit]
    found = {(s.protocol, s.method): counts.outcomes(s.protocol, s.method) for s in counts.scored}
    edges = np.unique(np.concatenate([[np.inf], *(o.wait[o.frames > 0] for o in found.values())]))
    for of, outcome in found.items():
        for k, name in _landmarks(counts.ids):
            seen = (outcome.frames > 0) & ((passes.landmark_index == k) | (k is None))
            one = np.ones((int(seen.sum()), 1), dtype=np.int64)
            rows = [(outcome.wait[seen], unit[seen], one)]
            yield _histogram_sums((*of, name), rows, units.count, edges)


def _landmarks(ids: Sequence[int]) -> list[tuple[int | None, str]]:
    """(index, text) of each ID, then of all."""
    return [*((k, str(i)) for k, i in enumerate(ids)), (None, "total")]


def _histogram_sums(
    labels: tuple[str, str, str],
    rows: Sequence[Rows],
    units: int,
    edges: FloatArray,
    exact: Table | None = None,
) -> UnitSums:
    """What the units add to a CumulativeHistogram.

    labels: protocol, method, landmark_text. edges: rising; resampled values are rounded up to one,
    so methods need equal edges to be compared. exact: all values, if those by unit are rounded.
    """
    sums = np.zeros((units, len(edges)), dtype=np.float32)
    for value, unit, number in rows:
        _add(sums, unit, np.minimum(np.searchsorted(edges, value), len(edges) - 1), number[:, 0])
    np.cumsum(sums, axis=1, out=sums)
    exact = exact or sum_by_value((value, number) for value, _, number in rows)
    total = int(exact[1].sum())
    record = CumulativeHistogram(np.zeros(1), np.zeros((1, 1)))
    if total:  # its edges, the QUANTILES and the maximum, are those of all values
        share = np.array([*QUANTILES, 1.0])
        reached = np.clip(np.ceil(share * total - 1e-3), 1, total)  # as in CumulativeHistogram
        at_ranks = values_at_ranks(exact, reached.astype(np.int64) - 1)
        record = CumulativeHistogram(at_ranks, reached[None])
    return UnitSums(*labels, sums, lambda summed: CumulativeHistogram(edges, summed), record)


def _plain_sums(
    labels: tuple[str, str, str], sums: FloatArray | IntArray, columns: int = 3
) -> UnitSums:
    """Sums that are a record as they stand, (R, columns); further columns are not read."""
    kept: FloatArray = np.asarray(sums, dtype=float)
    return UnitSums(*labels, kept, lambda rows: rows[:, :columns], kept.sum(axis=0)[None, :columns])


def tracking(counts: Counts, units: Units) -> Iterator[UnitSums]:
    """Sums for HOTA and IDF1 of every method with tracks, over all IDs; see `tracking.tracking`."""
    for method in counts.methods if counts.placed else ():
        if (found := counts.sums(units, "tracking", method)) is not None:
            yield _plain_sums(("strict", method, "total"), found, COLUMNS)


def switches(counts: Counts, units: Units) -> Iterator[UnitSums]:
    """Switches of every method; columns: passes, switches of ID and, if it has tracks, of track."""
    passes = counts.passes
    unit = units.of_pass_unit[passes.unit]
    for method in counts.methods if counts.placed else ():
        found = counts.switches(method)
        # All methods have the same columns, so that tests can swap them.
        tracks = np.zeros_like(found.ids) if found.tracks is None else found.tracks
        for k, name in _landmarks(counts.ids):
            mine = (passes.landmark_index == k) | (k is None)
            weights = (None, found.ids[mine], tracks[mine])
            sums = np.column_stack([np.bincount(unit[mine], w, units.count) for w in weights])
            yield _plain_sums(("strict", method, name), sums, 2 if found.tracks is None else 3)


def positions(counts: Counts, units: Units) -> Iterator[UnitSums]:
    """Histograms of position errors, m."""
    return _error_sums(counts, units, "position")


def orientations(counts: Counts, units: Units) -> Iterator[UnitSums]:
    """Histograms of orientation errors, deg."""
    return _error_sums(counts, units, "orientation")


def _error_sums(counts: Counts, units: Units, error: str) -> Iterator[UnitSums]:
    """Errors of right claims, per ID and in all."""
    methods = counts.methods if counts.placed else ()
    values, of = counts.values, range(len(counts.ids))
    value, number = sum_by_value(values.table((error, m, k)) for m in methods for k in of)
    if not len(value):
        return
    # The edges are quantiles of all errors, the same for every method; their ranks are those of
    # numpy's quantile with the method "inverted_cdf".
    ranks = np.ceil(number.sum() * np.linspace(0, 1, 513) - 1).clip(0).astype(np.int64)
    edges = np.unique(values_at_ranks((value, number), ranks))
    for method in methods:
        for k, name in _landmarks(counts.ids):
            keys = [(error, method, i) for i in (of if k is None else [k])]
            rows = [(v, units.of_pass_unit[u], n) for key in keys for v, u, n in values.rows(key)]
            exact = sum_by_value(map(values.table, keys))
            yield _histogram_sums(("strict", method, name), rows, units.count, edges, exact)


def calibration(counts: Counts, units: Units) -> Iterator[UnitSums]:
    """Calibration of every method that states probabilities, also for "none"."""

    def record(rows: FloatArray) -> Calibration:
        in_bins = np.moveaxis(rows[:, 1:].reshape(len(rows), 3, BINS), 1, 0)
        return Calibration(rows[:, 0], *in_bins)

    for method in counts.methods if counts.placed else ():
        found = counts.sums(units, "calibration", method)
        if found is None:
            continue
        for c, name in enumerate([*map(str, counts.ids), "none", "total"]):
            sums = np.ascontiguousarray(found[:, c], dtype=float)
            yield UnitSums("strict", method, name, sums, record, record(sums.sum(axis=0)[None]))
