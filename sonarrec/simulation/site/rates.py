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
from sonarrec.evaluation.intervals import MIN_UNITS, bootstrap_weights, interval, rate_interval
from sonarrec.evaluation.judge import judge
from sonarrec.evaluation.match import Matched
from sonarrec.evaluation.passes import find_passes

SEED = 0


@dataclass(frozen=True, slots=True)
class Rate:
    """A share or a number per frame, and its interval.

    cases: frames with a whole landmark in view, or all frames. units: passes of landmarks, or
    units of `passes.Passes`. count: recognised, or false. low, high: NaN if fewer than
    MIN_UNITS units have a case; of a number also if all are alike.
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
    logs: Sequence[Matched], method: str, edges_m: Sequence[float]
) -> RecognitionRates:
    """The rates of one method. edges_m: (n + 1,) rising, edges of n steps of slant range."""
    right, of_pass, range_m, false, of_frame = ([] for _ in range(5))
    passes = units = 0
    for log in logs:
        judged, found = judge(log, method, "strict"), find_passes(log)
        right.append(judged.positive_is_claimed.astype(float))
        of_pass.append(found.of_truth[judged.positive] + passes)
        range_m.append(np.hypot(*log.truth_position[judged.positive].T))
        wrong = judged.frame_index[judged.declared_claim[judged.declared_effect[:, 2] > 0]]
        false.append(np.bincount(wrong, minlength=len(log.frame)).astype(float))
        of_frame.append(found.unit_of_frame + units)
        passes, units = passes + len(found.unit), units + found.units
    true, unit, range_of, false_of, frames = map(
        np.concatenate, (right, of_pass, range_m, false, of_frame)
    )
    steps = []
    for near, far in pairwise(edges_m):
        here = (range_of >= near) & ((range_of < far) | (far == edges_m[-1]))
        steps.append(RangeRate(near, far, _rate(true[here], unit[here], passes)))
    false_per_100 = _rate(100 * false_of, frames, units, int(false_of.sum()))
    return RecognitionRates(_rate(true, unit, passes), tuple(steps), false_per_100)


def _rate(value: FloatArray, unit: IntArray, units: int, count: int | None = None) -> Rate:
    """The mean of (n,) values, with its interval. count: given if they are no share."""
    sums = np.stack([np.bincount(unit, w, units) for w in (value, np.ones(len(value)))], axis=1)
    sums = sums[sums[:, 1] > 0]
    total = int(value.sum()) if count is None else count
    mean = float(value.mean()) if len(value) else math.nan
    low = high = math.nan
    if len(sums) >= MIN_UNITS and count is None:
        low, high = rate_interval(*sums.T)
    elif len(sums) >= MIN_UNITS and np.ptp(sums[:, 0] / sums[:, 1]) > 0:
        drawn = bootstrap_weights(len(sums), np.random.default_rng(SEED)) @ sums
        low, high = interval(drawn[:, 0] / drawn[:, 1], len(sums))
    return Rate(len(value), len(sums), total, mean, low, high)
