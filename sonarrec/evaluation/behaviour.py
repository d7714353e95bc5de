"""What one log shows besides rates: frames to a lasting ID, kinds of false claims, switches of ID
and track, errors of position and orientation, calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.evaluation.histogram import Rows, sum_by_unit
from sonarrec.evaluation.judge import Judged
from sonarrec.evaluation.match import Matched, distance
from sonarrec.evaluation.passes import Passes
from sonarrec.nouns import follows

BINS = 10
"""Of the probability that an estimate states."""


@dataclass(frozen=True, slots=True)
class PassOutcomes:
    """How one method did in each of P passes under one protocol."""

    frames: IntArray
    """(P,) frames with the whole landmark in view."""
    right: IntArray
    """(P,) frames of these in which it was claimed."""
    wait: FloatArray
    """(P,) frames from the first of these to the first one from which on it is claimed in all;
    infinite if it is not claimed in the last, NaN without a frame."""


@dataclass(frozen=True, slots=True)
class Switches:
    """Changes between neighbouring frames of P passes that have an estimate, of one method."""

    ids: IntArray
    """(P,) changes of the declared ID."""
    tracks: IntArray | None
    """(P,) changes of the track on the landmark; None if the method has no tracks, or if no
    estimate on a landmark has the number of its track."""


def pass_outcomes(judged: Judged, log: Matched, passes: Passes) -> PassOutcomes:
    """How one method did in each pass."""
    truth, right = judged.positive, judged.positive_is_claimed
    of_pass = passes.of_truth[truth] >= 0  # not so for one that is half in view, in protocol paper
    truth, right = truth[of_pass], right[of_pass]
    number, frame = passes.of_truth[truth], log.truth_frame_index[truth]
    count = len(passes.first_frame_index)
    wrong_last = passes.first_frame_index - 1
    np.maximum.at(wrong_last, number[~right], frame[~right])
    lasting = frame > wrong_last[number]
    settled = np.full(count, np.inf)
    np.minimum.at(settled, number[lasting], frame[lasting])
    frames = np.bincount(number, minlength=count)
    return PassOutcomes(
        frames=frames,
        right=np.bincount(number[right], minlength=count),
        wait=np.where(frames > 0, settled - passes.first_frame_index, np.nan),
    )


def switches(log: Matched, beneath: IntArray, passes: Passes) -> dict[str, Switches]:
    """The Switches of each method.

    The track is that of the estimate nearest to the landmark, the ID that of the nearest declared
    estimate. Frames with two landmarks of one ID are ignored, since they cannot be told apart.
    Candidates of the single-frame method (smi) are not tracks.
    """
    k = len(log.ids)
    cell = log.truth_frame_index * k + log.truth_landmark_index
    alone = log.truth_positive & (np.bincount(cell, minlength=1)[cell] == 1)
    claims = np.flatnonzero(beneath >= 0)
    claims = claims[alone[beneath[claims]]]
    # In order of pass and frame, the nearest claim first.
    truth = beneath[claims]
    offset_m = distance(log, claims, truth)
    order = np.lexsort((offset_m, truth, log.truth_frame_index[truth], passes.of_truth[truth]))
    claims = claims[order]

    def changes(labels: IntArray, truth: IntArray) -> IntArray:
        """(P,) changes along each pass; of each truth the first label counts."""
        first = np.ones(len(truth), dtype=bool)
        first[1:] = np.diff(truth) != 0
        labels, number = labels[first], passes.of_truth[truth[first]]
        changed = (np.diff(labels) != 0) & (np.diff(number) == 0)
        return np.bincount(number[1:][changed], minlength=len(passes.first_frame_index))

    of_methods = {}
    for m, method in enumerate(log.methods):
        mine = claims[log.method_index[claims] == m]
        declared = mine[log.declared[mine]]
        tracked = follows(method) and (log.claim_object[mine] >= 0).any()
        of_methods[method] = Switches(
            changes(log.claim_landmark_index[declared], beneath[declared]),
            changes(log.claim_object[mine], beneath[mine]) if tracked else None,
        )
    return of_methods


def errors(strict: Judged, log: Matched, unit_of_truth: IntArray) -> dict[tuple[str, int], Rows]:
    """("position", k) and ("orientation", k): how often each error of right claims of the k-th ID.

    Positions in m, at most the gate, since claims beyond it are not right; orientations in deg: a
    rotation after which the ID looks the same is no error. Unknown ones are left out.
    """
    right = strict.right
    claim, truth, landmark = strict.claim[right], strict.truth[right], strict.landmark_index[right]
    period = log.turn_deg[landmark]
    off = log.claim_orientation[claim] - log.truth_orientation[truth]
    kinds: dict[str, FloatArray] = {
        "position": distance(log, claim, truth),
        "orientation": np.asarray(np.abs((off + period / 2) % period - period / 2)),
    }
    found = {}
    for name, error in kinds.items():
        for k in range(len(log.ids)):
            of_id = (landmark == k) & ~np.isnan(error)
            one = np.ones((int(of_id.sum()), 1), dtype=np.int64)
            found[name, k] = sum_by_unit(error[of_id], unit_of_truth[truth[of_id]], one)
    return found


def calibration(log: Matched, beneath: IntArray, passes: Passes, method: int) -> FloatArray | None:
    """(U, K + 2, 1 + 3 * BINS) sums for the Brier score and the expected calibration error.

    For one method: per ID, for "none" and in total; None if it states no probabilities. An
    estimate's true class is the landmark that it lies on, else "none". Estimates on a landmark
    partly in view, and those without probabilities, are left out. Each row holds squares, then
    per bin the number, the sum of p and how many are right. Per ID and for "none" the squares are
    (p - y)^2; in total they are the sum of these (Brier's own form, 0 to 2), and the bins are those
    of the most probable class.
    """
    k = len(log.ids)
    used = np.asarray(~np.isnan(log.probability).any(axis=1)) & (log.method_index == method)
    on_one = beneath >= 0
    outcome = np.full(len(beneath), k)
    unit = passes.unit_of_frame[log.claim_frame_index]
    if len(log.truth_landmark_index):
        outcome[on_one] = log.truth_landmark_index[beneath[on_one]]
        used[on_one] &= log.truth_positive[beneath[on_one]]
        unit = np.where(on_one, passes.unit_of_truth[beneath], unit)
    if not used.any():
        return None
    p, y, unit = log.probability[used], outcome[used], unit[used]
    sums = np.zeros((passes.units, k + 2, 1 + 3 * BINS))
    for c in range(k + 1):
        sums[:, c, 0] = np.bincount(unit, (p[:, c] - (y == c)) ** 2, minlength=passes.units)
        sums[:, c, 1:] = _in_bins(p[:, c], y == c, unit, passes.units)
        sums[:, -1, 0] += sums[:, c, 0]
    sums[:, -1, 1:] = _in_bins(p.max(axis=1), p.argmax(axis=1) == y, unit, passes.units)
    return sums


def _in_bins(p: FloatArray, right: BoolArray, unit: IntArray, units: int) -> FloatArray:
    """(U, 3 * BINS) per bin the number, the sum of p and how many are right."""
    cell = unit * BINS + np.minimum((p * BINS).astype(np.int64), BINS - 1)
    size = units * BINS
    columns = (
        np.bincount(cell, minlength=size),
        np.bincount(cell, p, minlength=size),
        np.bincount(cell[right], minlength=size),
    )
    return np.hstack([column.reshape(units, BINS) for column in columns])
