"""The metrics: a metric is one function and one row of METRICS.

All output (screen, files, report, comparisons) uses this table. A metric is a function of a record,
(R, ...) in, (R,) out, and gives both the figure and its resampled values. A new kind of record
needs a function in `unit_sums`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.evaluation.count import Counts, Units
from sonarrec.evaluation.curves import FPR_POINTS, area, ratio, tpr_at
from sonarrec.evaluation.intervals import Tally
from sonarrec.evaluation.tracking import A
from sonarrec.evaluation.unit_sums import (
    QUANTILES,
    Calibration,
    CumulativeHistogram,
    Rates,
    UnitSums,
    calibration,
    orientations,
    positions,
    rates,
    switches,
    tracking,
    waits,
)

Kind = Callable[[Counts, Units], Iterable[UnitSums]]
"""A kind of records: gives what the units add to them."""


def positives(r: Rates) -> tuple[FloatArray, FloatArray]:
    """TP, and TP + FN."""
    tp, _, _, fn = r.counts.T
    return tp, tp + fn


def negatives(r: Rates) -> tuple[FloatArray, FloatArray]:
    """FP, and FP + TN."""
    _, tn, fp, _ = r.counts.T
    return fp, fp + tn


def true_positive_rate(r: Rates) -> FloatArray:
    """TP / (TP + FN)."""
    return ratio(*positives(r))


def false_positive_rate(r: Rates) -> FloatArray:
    """FP / (FP + TN)."""
    return ratio(*negatives(r))


def auc(r: Rates) -> FloatArray:
    """Area under the ROC, see `curves.area`."""
    return area(r.fpr, r.tpr)


def tpr_at_fpr(most: float) -> Callable[[Rates], FloatArray]:
    """TPR at an FPR of `most`, see `curves.tpr_at`.

    most: one of FPR_POINTS, where resampled curves are dense.
    """
    return lambda r: tpr_at(r.fpr, r.tpr, most)


def quantile(share: float) -> Callable[[CumulativeHistogram], FloatArray]:
    """The smallest value that this share of values, one of QUANTILES, does not exceed."""
    return lambda s: s.quantile(share)


def quotient(part: int, whole: int) -> Callable[[FloatArray], FloatArray]:
    """One column of sums over another; the kind of records tells what they are."""
    return lambda sums: ratio(sums[:, part], sums[:, whole])


def hota(sums: FloatArray) -> FloatArray:
    """Higher order tracking accuracy: the mean over alpha of sqrt(DetA * AssA)."""
    tp, fn, fp, together = np.split(sums[:, : 4 * A], 4, axis=1)
    detected, associated = ratio(tp, tp + fn + fp), together / np.maximum(1, tp)
    return np.asarray(np.sqrt(detected * associated).mean(axis=1))


def idf1(sums: FloatArray) -> FloatArray:
    """Share of truths and claims that the best pairing of tracks and landmarks makes right."""
    tp, fn, fp = sums[:, 4 * A : 4 * A + 3].T
    return ratio(2 * tp, 2 * tp + fp + fn)


def track_switches(sums: FloatArray) -> FloatArray | None:
    """Changes of the track on a landmark, per pass; None for a method without tracks."""
    return ratio(sums[:, 2], sums[:, 0]) if sums.shape[1] > 2 else None


def brier(c: Calibration) -> FloatArray:
    """Mean of (p - y)^2 over estimates; in total, of its sum over all IDs and "none"."""
    return ratio(c.squares, c.count.sum(axis=1))


def ece(c: Calibration) -> FloatArray:
    """Expected calibration error: mean distance between stated and true probability."""
    return ratio(np.abs(c.stated - c.right).sum(axis=1), c.count.sum(axis=1))


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric."""

    name: str
    """Name in files."""
    label: str
    """Name on screen and in the report."""
    digits: int
    """After the decimal point."""
    counted: Kind
    """The records that it is a function of."""
    figure: Callable[[Any], FloatArray | None]
    """(R,) of a record of R rows; None if the method has no such figure."""
    tested: bool = False
    """Whether the screen and the report show differences of methods with their tests."""
    needs: tuple[Callable[[Any], FloatArray], ...] = ()
    """A unit has a case of the metric if these figures, by default the metric itself, are not NaN.
    The one with the fewest cases counts: a curve's positives and negatives may come from different
    units."""
    share: Callable[[Any], tuple[FloatArray, FloatArray]] | None = None
    """Of a rate: its numerator and denominator."""

    def value(self, counted: UnitSums) -> float:
        """The figure over all units; NaN if there is none."""
        found = self.figure(counted.exact)
        return np.nan if found is None else float(found[0])


_PAPER = FPR_POINTS[1]
_HALF, _NINE_IN_TEN, _MOST = QUANTILES
_BOTH = true_positive_rate, false_positive_rate
METRICS = (
    Metric("tpr", "TPR", 3, rates, true_positive_rate, tested=True, share=positives),
    Metric("fpr", "FPR", 4, rates, false_positive_rate, tested=True, share=negatives),
    Metric("auc", "AUC", 3, rates, auc, True, _BOTH),
    Metric(
        "tpr_at_fpr_0.0276", "TPR at FPR 0.0276 (paper)", 3, rates, tpr_at_fpr(_PAPER), True, _BOTH
    ),
    Metric("hota", "HOTA", 3, tracking, hota),
    Metric("idf1", "IDF1", 3, tracking, idf1),
    Metric("tracks_per_landmark", "tracks per landmark", 2, tracking, quotient(-2, -1)),
    Metric("frames_to_id_median", "frames to lasting ID, median", 0, waits, quantile(_HALF)),
    Metric("frames_to_id_90", "frames to lasting ID, 90 %", 0, waits, quantile(_NINE_IN_TEN)),
    Metric("id_switches_per_pass", "ID switches per pass", 2, switches, quotient(1, 0)),
    Metric("track_switches_per_pass", "track switches per pass", 2, switches, track_switches),
    Metric("position_error_median_m", "position error, median, m", 4, positions, quantile(_HALF)),
    Metric("position_error_95_m", "position error, 95 %, m", 4, positions, quantile(_MOST)),
    Metric(
        "orientation_error_median_deg",
        "orientation off, median, deg",
        1,
        orientations,
        quantile(_HALF),
    ),
    Metric(
        "orientation_error_95_deg", "orientation off, 95 %, deg", 1, orientations, quantile(_MOST)
    ),
    Metric("brier", "Brier score, 0 to 2", 3, calibration, brier),
    Metric("ece", "calibration error (ECE)", 3, calibration, ece),
)
MAIN = ("tpr", "fpr", "auc")
"""Shown per ID, and compared between old and new results."""
BY_NAME = {metric.name: metric for metric in METRICS}
KINDS = tuple(dict.fromkeys((rates, waits, switches, *(m.counted for m in METRICS))))
"""The kinds of records, in the order of figures.csv."""
AT_ONCE = 256
"""Draws whose figures are computed together: so few lie in the processor's cache."""


def tally(kind: Kind, counted: UnitSums) -> Tally:
    """The figures of one kind of record."""
    exact = [(m, m.figure(counted.exact)) for m in METRICS if m.counted is kind]
    available = [(m, value) for m, value in exact if value is not None]

    def figures(rows: FloatArray) -> FloatArray:
        starts = range(0, len(rows), AT_ONCE)
        records = (counted.record(rows[start : start + AT_ONCE]) for start in starts)
        return np.concatenate(
            [np.column_stack([np.asarray(m.figure(r)) for m, _ in available]) for r in records]
        )

    by_unit = counted.record(counted.sums)
    known = [
        [~np.isnan(np.asarray(need(by_unit))) for need in m.needs or (m.figure,)]
        for m, _ in available
    ]
    return Tally(
        protocol=counted.protocol,
        method=counted.method,
        landmark_text=counted.landmark_text,
        names=tuple(m.name for m, _ in available),
        values=tuple(float(value[0]) for _, value in available),
        cases=tuple(min(int(np.count_nonzero(has)) for has in needed) for needed in known),
        sums=counted.sums,
        figures=figures,
        shares={m.name: m.share(by_unit) for m, _ in available if m.share is not None},
    )
