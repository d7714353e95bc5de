"""The metrics: a metric is one function and one row of METRICS.

All output (screen, files, report, comparisons) uses this table. A metric is a function of a record,
(R, ...) in, (R,) out, and gives both the figure and its resampled values. A new kind of record
needs a function of `Case`, below, that counts it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.evaluation.counting.behaviour import (
    FalseClaims,
    SwitchTotals,
    error_counts,
    false_claim_counts,
    switch_counts,
    wait_counts,
)
from sonarrec.evaluation.counting.curves import FPR_POINTS, PARTIAL_FPR, area, ratio, tpr_at
from sonarrec.evaluation.counting.pooled import Pooled, PooledScored, PooledUnits
from sonarrec.evaluation.counting.reliability import Calibration, calibration_counts
from sonarrec.evaluation.counting.uncertainty import Tally
from sonarrec.evaluation.counting.unit_sums import (
    QUANTILES,
    CumulativeHistogram,
    Rates,
    UnitSums,
    rate_sums,
)


@dataclass(frozen=True, slots=True)
class Case:
    """An evaluation and its independent units."""

    pooled: Pooled
    units: PooledUnits


# The kinds of records, per ID and in total. Without positions only the first two are counted.


def rates(case: Case) -> Iterable[UnitSums]:
    """Rates of every method under every protocol."""
    for scored in case.pooled.scored:
        yield from rates_of(case, scored)


def rates_of(case: Case, s: PooledScored) -> Iterable[UnitSums]:
    """Rates of one method under one protocol."""
    pooled, units = case.pooled, case.units
    base = pooled.sums(("base", s.protocol), units)
    declared = base + pooled.sums(("made", s.protocol, s.method), units)
    for k, landmark in enumerate(s.ids):
        labels, claims = (s.protocol, s.method, str(landmark)), pooled.claims(s, k, units)
        yield rate_sums(labels, base[:, k], declared[:, k], s.curve(k), claims)
    labels, claims = (s.protocol, s.method, "total"), pooled.claims(s, None, units)
    yield rate_sums(labels, base.sum(axis=1), declared.sum(axis=1), s.curve(), claims)


def waits(case: Case) -> Iterable[UnitSums]:
    """Histograms of the frames to a lasting ID, under every protocol."""
    return wait_counts(case.pooled.outcomes, *_passes(case))


def _passes(case: Case) -> tuple[tuple[int, ...], IntArray, IntArray, int]:
    """The arguments of `wait_counts` that say of which ID and unit each pass is."""
    passes, units = case.pooled.passes, case.units
    return case.pooled.ids, passes.landmark_index, units.of_pass_unit[passes.unit], units.count


def false_claims(case: Case) -> Iterable[UnitSums]:
    """FalseClaims of every method."""
    pooled, units = case.pooled, case.units
    minutes = pooled.sums_of_kind(("minutes",), units)
    if pooled.placed and minutes is not None:
        for method in pooled.methods:
            claims = pooled.sums(("false", method), units)
            yield from false_claim_counts(method, pooled.ids, claims, minutes)


def switches(case: Case) -> Iterable[UnitSums]:
    """SwitchTotals of every method."""
    return switch_counts(case.pooled.switches, *_passes(case))


def positions(case: Case) -> Iterable[UnitSums]:
    """Histograms of position errors, m."""
    return _errors(case, "position")


def orientations(case: Case) -> Iterable[UnitSums]:
    """Histograms of orientation errors, deg."""
    return _errors(case, "orientation")


def _errors(case: Case, name: str) -> Iterable[UnitSums]:
    pooled = case.pooled
    errors = partial(pooled.errors, name, case.units)
    return error_counts(
        pooled.methods if pooled.placed else (), pooled.ids, errors, case.units.count
    )


def calibration(case: Case) -> Iterable[UnitSums]:
    """Calibration of every method that states probabilities."""
    pooled = case.pooled
    for method in pooled.methods if pooled.placed else ():
        rows = pooled.sums_of_kind(("calibration", method), case.units)
        if rows is not None:
            yield from calibration_counts(method, pooled.ids, rows)


# The metrics.


def true_positive_rate(r: Rates) -> FloatArray:
    """TP / (TP + FN)."""
    tp, _, _, fn = r.counts.T
    return ratio(tp, tp + fn)


def false_positive_rate(r: Rates) -> FloatArray:
    """FP / (FP + TN)."""
    _, tn, fp, _ = r.counts.T
    return ratio(fp, fp + tn)


def auc(r: Rates) -> FloatArray:
    """Area under the ROC, see `curves.area`."""
    return area(r.fpr, r.tpr)


def partial_auc(r: Rates) -> FloatArray:
    """Area under the ROC from FPR 0 to PARTIAL_FPR, see `curves.area`."""
    return area(r.fpr, r.tpr, PARTIAL_FPR)


def tpr_at_fpr(most: float) -> Callable[[Rates], FloatArray]:
    """TPR at an FPR of `most`, see `curves.tpr_at`.

    most: one of FPR_POINTS, where resampled curves are dense.
    """
    return lambda r: tpr_at(r.fpr, r.tpr, most)


def quantile(share: float) -> Callable[[CumulativeHistogram], FloatArray]:
    """The smallest value that this share of values, one of QUANTILES, does not exceed."""
    return lambda s: s.quantile(share)


def false_per_minute(f: FalseClaims) -> FloatArray:
    """Declared claims on no landmark: on a distractor or the bare floor."""
    return ratio(f.nowhere, f.minutes)


def wrong_per_minute(f: FalseClaims) -> FloatArray:
    """Declared claims on a landmark of another ID."""
    return ratio(f.other, f.minutes)


def id_switches(s: SwitchTotals) -> FloatArray:
    """Changes of the declared ID, per pass."""
    return ratio(s.ids, s.passes)


def track_switches(s: SwitchTotals) -> FloatArray | None:
    """Changes of the track on a landmark, per pass; None for a method without tracks."""
    return None if s.tracks is None else ratio(s.tracks, s.passes)


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
    counted: Callable[[Case], Iterable[UnitSums]]
    """Gives the sums of the records that it is a function of."""
    figure: Callable[[Any], FloatArray | None]
    """(R,) of a record of R rows; None if the method has no such figure."""
    tested: bool = False
    """Whether the screen and the report show differences of methods with their tests."""
    needs: tuple[Callable[[Any], FloatArray], ...] = ()
    """A unit has a case of the metric if these figures, by default the metric itself, are not NaN.
    The one with the fewest cases counts: a curve's positives and negatives may come from different
    units."""

    def value(self, counted: UnitSums) -> float:
        """The figure over all units; NaN if there is none."""
        found = self.figure(counted.exact)
        return np.nan if found is None else float(found[0])


_LOW, _PAPER, _HIGH = FPR_POINTS
_HALF, _NINE_IN_TEN, _MOST = QUANTILES
_BOTH = true_positive_rate, false_positive_rate
METRICS = (
    Metric("tpr", "TPR", 3, rates, true_positive_rate, tested=True),
    Metric("fpr", "FPR", 4, rates, false_positive_rate, tested=True),
    Metric("auc", "AUC", 3, rates, auc, True, _BOTH),
    Metric("pauc_0.05", "AUC to FPR 0.05, over 0.05", 3, rates, partial_auc, False, _BOTH),
    Metric("tpr_at_fpr_0.01", "TPR at FPR 0.01", 3, rates, tpr_at_fpr(_LOW), False, _BOTH),
    Metric(
        "tpr_at_fpr_0.0276", "TPR at FPR 0.0276 (paper)", 3, rates, tpr_at_fpr(_PAPER), True, _BOTH
    ),
    Metric("tpr_at_fpr_0.05", "TPR at FPR 0.05", 3, rates, tpr_at_fpr(_HIGH), False, _BOTH),
    Metric("frames_to_id_median", "frames to lasting ID, median", 0, waits, quantile(_HALF)),
    Metric("frames_to_id_90", "frames to lasting ID, 90 %", 0, waits, quantile(_NINE_IN_TEN)),
    Metric("false_claims_per_min", "claims/min on no landmark", 2, false_claims, false_per_minute),
    Metric("wrong_ids_per_min", "claims/min of a wrong ID", 2, false_claims, wrong_per_minute),
    Metric("id_switches_per_pass", "ID switches per pass", 2, switches, id_switches),
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


def tally(kind: Callable[[Case], Iterable[UnitSums]], counted: UnitSums) -> Tally:
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
    )
