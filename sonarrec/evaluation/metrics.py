"""The metrics: a metric is one function and one row of METRICS.

All that is told of an evaluation, on screen, in files, in the report and in comparisons, is told
from this table. A metric is a function of a record, (R, ...) in, (R,) out, and serves the figure
and its resampling alike. What a new record needs to be counted is a function of `Case`, below.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sonarrec.evaluation.behaviour import (
    FalseClaims,
    PassOutcomes,
    Switched,
    Switches,
    false_claim_counts,
    orientation_counts,
    position_counts,
    switch_counts,
    wait_counts,
)
from sonarrec.evaluation.counted import Counted, Rates, Spread, rate_counts
from sonarrec.evaluation.curves import FPR_POINTS, PARTIAL_FPR, area, ratio, tpr_at
from sonarrec.evaluation.joined import Joined
from sonarrec.evaluation.passes import Passes, Units
from sonarrec.evaluation.reliability import Calibration, calibration_counts
from sonarrec.evaluation.scoring import Scored
from sonarrec.evaluation.uncertainty import Tally
from sonarrec.records import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Case:
    """An evaluation, and what several kinds of record are counted from."""

    scored: tuple[Scored, ...]
    joined: Joined
    passes: Passes
    units: Units
    outcomes: tuple[PassOutcomes, ...]
    """As `scored`."""
    nearest: IntArray | None
    """(N,) of behaviour.on_truth; None where positions are not known."""
    switches: tuple[Switches, ...]
    """Per method; empty where positions are not known."""


# What is counted, of every method: per ID, then in total. Without positions only the first two are.


def rates(case: Case) -> Iterable[Counted]:
    """Of Rates, under every protocol."""
    return (one for scored in case.scored for one in rate_counts(scored, case.units))


def waits(case: Case) -> Iterable[Counted]:
    """Of a Spread of frames to a lasting right ID, under every protocol."""
    return wait_counts(case.outcomes, case.joined, case.passes, case.units)


def false_claims(case: Case) -> Iterable[Counted]:
    """Of FalseClaims."""
    return () if case.nearest is None else false_claim_counts(case.joined, case.nearest, case.units)


def switched(case: Case) -> Iterable[Counted]:
    """Of Switched."""
    return switch_counts(case.switches, case.joined, case.passes, case.units)


def positions(case: Case) -> Iterable[Counted]:
    """Of a Spread of position errors, m."""
    return position_counts(_strict(case), case.joined, case.units)


def orientations(case: Case) -> Iterable[Counted]:
    """Of a Spread of orientation errors, deg."""
    return orientation_counts(_strict(case), case.joined, case.units)


def calibration(case: Case) -> Iterable[Counted]:
    """Of Calibration."""
    return () if case.nearest is None else calibration_counts(case.joined, case.nearest, case.units)


def _strict(case: Case) -> list[Scored]:
    return [scored for scored in case.scored if scored.protocol == "strict"]


# The metrics.


def true_positive_rate(r: Rates) -> FloatArray:
    """TP / (TP + FN)."""
    return ratio(r.made[:, 0], r.made[:, 0] + r.made[:, 3])


def false_positive_rate(r: Rates) -> FloatArray:
    """FP / (FP + TN)."""
    return ratio(r.made[:, 2], r.made[:, 2] + r.made[:, 1])


def auc(r: Rates) -> FloatArray:
    """As `curves.area`."""
    return area(r.fpr, r.tpr)


def partial_auc(r: Rates) -> FloatArray:
    """As `curves.area`, over FPR 0 to PARTIAL_FPR."""
    return area(r.fpr, r.tpr, PARTIAL_FPR)


def tpr_at_fpr(most: float) -> Callable[[Rates], FloatArray]:
    """As `curves.tpr_at`; `most` is one of FPR_POINTS, about which resampled curves are close."""
    return lambda r: tpr_at(r.fpr, r.tpr, most)


def quantile(share: float) -> Callable[[Spread], FloatArray]:
    """The least value that this share of them does not exceed."""
    return lambda s: s.quantile(share)


def false_per_minute(f: FalseClaims) -> FloatArray:
    """Declared claims on no landmark at all: on a distractor, or the bare floor."""
    return ratio(f.nowhere, f.minutes)


def wrong_per_minute(f: FalseClaims) -> FloatArray:
    """Declared claims on a landmark of another ID."""
    return ratio(f.other, f.minutes)


def id_switches(s: Switched) -> FloatArray:
    """Changes of the declared ID, per pass."""
    return ratio(s.ids, s.passes)


def track_switches(s: Switched) -> FloatArray | None:
    """Changes of the track on a landmark, per pass; None of a method without tracks."""
    return None if s.tracks is None else ratio(s.tracks, s.passes)


def brier(c: Calibration) -> FloatArray:
    """Mean of (p - y)^2 over estimates; in total its sum over the IDs and none of these."""
    return ratio(c.squares, c.count.sum(axis=1))


def ece(c: Calibration) -> FloatArray:
    """Expected calibration error: mean distance of what is said from what is so."""
    return ratio(np.abs(c.said - c.right).sum(axis=1), c.count.sum(axis=1))


@dataclass(frozen=True, slots=True)
class Metric:
    """One row: what a figure is called and what it is."""

    name: str
    """In files."""
    label: str
    """On screen and in the report."""
    digits: int
    """Behind the point."""
    counted: Callable[[Case], Iterable[Counted]]
    """Which record it is a function of."""
    figure: Callable[[Any], FloatArray | None]
    """(R,) of a record of R rows; None of methods that have no such figure."""
    tested: bool = False
    """Whether the differences of methods in it are told with their tests."""
    needs: tuple[Callable[[Any], FloatArray], ...] = ()
    """Figures of which a unit must have one to have a case of this one, by default itself. The
    fewest count: a curve's positives and negatives may come from different units."""

    def value(self, counted: Counted) -> float:
        """The figure itself, of everything counted; NaN where there is none."""
        found = self.figure(counted.exact)
        return np.nan if found is None else float(found[0])


_LOW, _PAPER, _HIGH = FPR_POINTS
_BOTH = true_positive_rate, false_positive_rate
METRICS = (
    Metric("tpr", "TPR", 3, rates, true_positive_rate, tested=True),
    Metric("fpr", "FPR", 4, rates, false_positive_rate, tested=True),
    Metric("auc", "AUC", 3, rates, auc, True, _BOTH),
    Metric("pauc_0.05", "AUC to FPR 0.05, over 0.05", 3, rates, partial_auc, False, _BOTH),
    Metric("tpr_at_fpr_0.01", "TPR at FPR 0.01", 3, rates, tpr_at_fpr(_LOW), False, _BOTH),
    Metric(
        *("tpr_at_fpr_0.0276", "TPR at FPR 0.0276 (paper)", 3, rates, tpr_at_fpr(_PAPER)),
        tested=True,
        needs=_BOTH,
    ),
    Metric("tpr_at_fpr_0.05", "TPR at FPR 0.05", 3, rates, tpr_at_fpr(_HIGH), False, _BOTH),
    Metric("frames_to_id_median", "frames to lasting ID, median", 0, waits, quantile(0.5)),
    Metric("frames_to_id_90", "frames to lasting ID, 90 %", 0, waits, quantile(0.9)),
    Metric("false_claims_per_min", "claims/min on no landmark", 2, false_claims, false_per_minute),
    Metric("wrong_ids_per_min", "claims/min of a wrong ID", 2, false_claims, wrong_per_minute),
    Metric("id_switches_per_pass", "ID switches per pass", 2, switched, id_switches),
    Metric("track_switches_per_pass", "track switches per pass", 2, switched, track_switches),
    Metric("position_error_median_m", "position error, median, m", 4, positions, quantile(0.5)),
    Metric("position_error_95_m", "position error, 95 %, m", 4, positions, quantile(0.95)),
    Metric(
        *("orientation_error_median_deg", "orientation off, median, deg", 1),
        *(orientations, quantile(0.5)),
    ),
    Metric(
        *("orientation_error_95_deg", "orientation off, 95 %, deg", 1),
        *(orientations, quantile(0.95)),
    ),
    Metric("brier", "Brier score, 0 to 2", 3, calibration, brier),
    Metric("ece", "calibration error (ECE)", 3, calibration, ece),
)
MAIN = ("tpr", "fpr", "auc")
"""Told per ID, and compared from one set of results to the next."""
BY_NAME = {metric.name: metric for metric in METRICS}
KINDS = tuple(dict.fromkeys((rates, waits, switched, *(m.counted for m in METRICS))))
"""What is counted, in the order of figures.csv."""


def tally(kind: Callable[[Case], Iterable[Counted]], counted: Counted) -> Tally:
    """The figures of one kind, of what was counted."""
    exact = [(m, m.figure(counted.exact)) for m in METRICS if m.counted is kind]
    told = [(m, value) for m, value in exact if value is not None]

    def figures(rows: FloatArray) -> FloatArray:
        record = counted.record(rows)
        return np.column_stack([np.asarray(m.figure(record)) for m, _ in told])

    by_unit = counted.record(counted.sums)
    known = [
        [~np.isnan(np.asarray(need(by_unit))) for need in m.needs or (m.figure,)] for m, _ in told
    ]
    return Tally(
        protocol=counted.protocol,
        method=counted.method,
        landmark_text=counted.landmark_text,
        names=tuple(m.name for m, _ in told),
        values=tuple(float(value[0]) for _, value in told),
        cases=tuple(min(int(np.count_nonzero(has)) for has in needed) for needed in known),
        sums=counted.sums,
        figures=figures,
    )
