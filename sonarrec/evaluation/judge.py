"""Judges the claims on one log: what each adds to the paper's tables and to ROC curves.

Everything is counted from one list per method: the claims by falling score, each with its effect on
TP, TN, FP and FN (`_effects`). The sum over declared claims is the operating point, the cumulative
sum over all claims is the ROC.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.evaluation.match import Matched, nearest_truth

PROTOCOLS = ("paper", "strict")
NEGATIVE, POSITIVE, IGNORED = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Judged:
    """The claims of one method on one log under one protocol.

    There are K IDs, P positives and n claims that count, m of them declared.

    Claims stand by falling score.
    """

    negative: BoolArray
    """(F, K) the frames and IDs that are TN without any claim."""
    positive: IntArray
    """(P,) the truths of Matched that are FN without any claim; in protocol paper one per frame and
    ID."""
    positive_landmark_index: IntArray
    """(P,) into ids."""
    claim: IntArray
    """(n,) index into the claims of Matched."""
    score: FloatArray
    """(n,) 0 to 1, falling."""
    landmark_index: IntArray
    """(n,) into ids."""
    frame_index: IntArray
    """(n,) into Matched.frame."""
    truth: IntArray
    """(n,) the truth of which it is a right claim, else -1."""
    effect: npt.NDArray[np.int8]
    """(n, 4) what it adds to TP, TN, FP, FN after the claims before it."""
    declared_claim: IntArray
    """(m,) which of the n claims are declared."""
    declared_effect: npt.NDArray[np.int8]
    """(m, 4) what these add to TP, TN, FP, FN if there are no other claims."""

    @property
    def right(self) -> IntArray:
        """Indices of the claims that are declared and right."""
        return self.declared_claim[self.declared_effect[:, 0] > 0]

    @property
    def positive_is_claimed(self) -> BoolArray:
        """(P,) whether each positive has a right claim."""
        return np.isin(self.positive, self.truth[self.right])

    def base(self, of_frame: IntArray, of_truth: IntArray, groups: int) -> IntArray:
        """(groups, K, 4) TP, TN, FP, FN without any claim.

        of_frame: (F,) the group of a frame's negatives. of_truth: (T,) the group of a truth.
        """
        k = self.negative.shape[1]
        frame, landmark = np.nonzero(self.negative)
        cells = np.zeros((groups * k, 4), dtype=np.int64)
        cells[:, 1] = np.bincount(of_frame[frame] * k + landmark, minlength=groups * k)
        cells[:, 3] = np.bincount(
            of_truth[self.positive] * k + self.positive_landmark_index, minlength=groups * k
        )
        return cells.reshape(groups, k, 4)

    def group(self, of_frame: IntArray, of_truth: IntArray) -> IntArray:
        """(n,) the group of each claim: that of its truth if it is right, else that of its frame.

        So a claim changes the counts of the group that has its positive or negative in `base`.
        """
        if not len(of_truth):
            return of_frame[self.frame_index]
        return np.where(self.truth >= 0, of_truth[self.truth], of_frame[self.frame_index])

    def declared(self, of_frame: IntArray, of_truth: IntArray, groups: int) -> IntArray:
        """(groups, K, 4) TP, TN, FP, FN at the method's operating point, split as in `base`."""
        counts = self.base(of_frame, of_truth, groups)
        group = self.group(of_frame, of_truth)[self.declared_claim]
        np.add.at(counts, (group, self.landmark_index[self.declared_claim]), self.declared_effect)
        return counts


def judge(log: Matched, method: str, protocol: str) -> Judged:
    """Judge a method's claims as `sonarrec.evaluate` says; a missing method has none.

    A cell is an ID in a frame, numbered as frame * K + ID.
    """
    k = len(log.ids)
    truth_cell = log.truth_frame_index * k + log.truth_landmark_index
    state = np.zeros(len(log.frame) * k, dtype=np.int8)  # of each cell
    number = log.methods.index(method) if method in log.methods else -1
    claim = np.flatnonzero(log.method_index == number)
    claim = claim[np.argsort(-log.score[claim], kind="stable")]
    cell = log.claim_frame_index[claim] * k + log.claim_landmark_index[claim]
    if protocol == "paper":  # positions play no part, and every frame counts
        positive = np.flatnonzero(log.truth_half_in_view)
        # One truth per cell, if possible one that is part of a pass.
        positive = positive[np.argsort(~log.truth_positive[positive], kind="stable")]
        positive = positive[np.unique(truth_cell[positive], return_index=True)[1]]
        state[truth_cell[positive]] = POSITIVE
        truth_of_cell = np.full(len(state), -1)
        truth_of_cell[truth_cell[positive]] = positive
        truth, spot = truth_of_cell[cell], cell
    else:  # claims on a truth that is only partly in view do not count
        positive = np.flatnonzero(log.truth_positive)
        state[truth_cell] = IGNORED
        state[truth_cell[positive]] = POSITIVE  # even if another one is partly in view
        truth = nearest_truth(log, claim, cell, truth_cell)
        on_truth = truth >= 0
        counts = np.ones(len(claim), dtype=bool)
        counts[on_truth] = log.truth_positive[truth[on_truth]]
        spot = np.where(on_truth, len(state) + truth, cell)
        claim, cell, truth, spot = claim[counts], cell[counts], truth[counts], spot[counts]
    right, absent = truth >= 0, state[cell] == NEGATIVE
    declared = np.flatnonzero(log.declared[claim])
    return Judged(
        negative=state.reshape(-1, k) == NEGATIVE,
        positive=positive,
        positive_landmark_index=log.truth_landmark_index[positive],
        claim=claim,
        score=log.score[claim],
        landmark_index=log.claim_landmark_index[claim],
        frame_index=log.claim_frame_index[claim],
        truth=truth,
        effect=_effects(protocol, right, absent, spot),
        declared_claim=declared,
        declared_effect=_effects(protocol, right[declared], absent[declared], spot[declared]),
    )


def _effects(
    protocol: str, right: BoolArray, absent: BoolArray, spot: IntArray
) -> npt.NDArray[np.int8]:
    """(n, 4) what each claim adds to TP, TN, FP, FN after the claims before it.

    right: it is on a positive. absent: its ID is not in view in its frame. spot: what it claims (an
    ID in a frame, or one truth); further claims of a spot count differently from the first.
    """
    first = np.zeros(len(spot), dtype=bool)
    first[np.unique(spot, return_index=True)[1]] = True
    effect = np.zeros((len(spot), 4), dtype=np.int8)
    effect[:, 3] = -(right & first).astype(np.int8)
    if protocol == "paper":
        effect[:, 0] = right
        effect[:, 2] = ~right & first
    else:
        effect[:, 0] = right & first
        effect[:, 2] = ~(right & first)
    effect[:, 1] = -(absent & first).astype(np.int8)
    return effect
