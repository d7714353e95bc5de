"""TPR in total and by range, and the rate of false claims, all under protocol strict.

Intervals treat passes of landmarks as independent, not frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.evaluation.counting.behaviour import positive_is_claimed
from sonarrec.evaluation.counting.passes import find_passes, find_units
from sonarrec.evaluation.counting.scoring import Scored
from sonarrec.evaluation.counting.uncertainty import MIN_UNITS, bootstrap_weights, interval
from sonarrec.evaluation.evaluate import Evaluation

SEED = 0


@dataclass(frozen=True, slots=True)
class Rate:
    """A share or a number per frame, and its interval.

    cases: frames with a whole landmark in view, or all frames. units: passes of landmarks, or
    units of `passes.find_units`. count: recognised, or false. low, high: NaN if fewer than
    MIN_UNITS units have a case, or if all are alike.
    """

    cases: int
    units: int
    count: int
    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class RangeRate:
    """The TPR of landmarks at slant ranges from near_m up to far_m."""

    near_m: float
    far_m: float
    tpr: Rate


@dataclass(frozen=True, slots=True)
class RecognitionRates:
    """One method: TPR in total and by range, and false claims per 100 frames."""

    tpr: Rate
    by_range: tuple[RangeRate, ...]
    false_per_100: Rate


def recognition_rates(
    evaluation: Evaluation, method: str, edges_m: Sequence[float]
) -> RecognitionRates:
    """The rates of one method. edges_m: (n + 1,) rising, edges of n steps of slant range."""
    joined = evaluation.joined
    scored = next(s for s in evaluation.scored if (s.protocol, s.method) == ("strict", method))
    passes = find_passes(joined)
    positive = scored.positive
    right = positive_is_claimed(scored, joined).astype(float)
    unit = passes.of_truth[positive]
    range_m = np.hypot(*joined.truth_position[positive].T)
    count = len(passes.first_frame_index)
    steps = []
    for near, far in pairwise(edges_m):
        here = (range_m >= near) & ((range_m < far) | (far == edges_m[-1]))
        steps.append(RangeRate(near, far, _rate(right[here], unit[here], count)))
    return RecognitionRates(
        _rate(right, unit, count), tuple(steps), _false_claims(evaluation, scored)
    )


def _false_claims(evaluation: Evaluation, scored: Scored) -> Rate:
    joined = evaluation.joined
    units = find_units(joined, find_passes(joined))
    wrong = scored.frame_index[scored.declared_claim[scored.declared_effect[:, 2] > 0]]
    per_frame = np.bincount(wrong, minlength=len(joined.frame)).astype(float)
    return _rate(100 * per_frame, units.of_frame, units.count, int(per_frame.sum()))


def _rate(value: FloatArray, unit: IntArray, units: int, count: int | None = None) -> Rate:
    """The mean of (n,) values, with an interval by resampling units."""
    sums = np.stack([np.bincount(unit, w, units) for w in (value, np.ones(len(value)))], axis=1)
    sums = sums[sums[:, 1] > 0]
    total = int(value.sum()) if count is None else count
    mean = float(value.mean()) if len(value) else math.nan
    low = high = math.nan
    shares = sums[:, 0] / sums[:, 1]
    if len(sums) >= MIN_UNITS and np.ptp(shares) > 0:
        drawn = bootstrap_weights(len(sums), np.random.default_rng(SEED)) @ sums
        low, high = interval(drawn[:, 0] / drawn[:, 1], len(sums))
    return Rate(len(value), len(sums), total, mean, low, high)
