"""Scoring against ground truth: the counts of the paper's tables and of ROC curves.

Everything is counted from one list per method: the claims by falling score, each with its effect on
TP, TN, FP and FN (`_effects`). The sum over declared claims is the operating point, the cumulative
sum over all claims is the ROC.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.evaluation.counting.curves import Count, Curve, counted
from sonarrec.evaluation.matching.joined import Joined, nearest_truth

PROTOCOLS = ("paper", "strict")
NEGATIVE, POSITIVE, IGNORED = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Scored:
    """The scores of one method under one protocol.

    There are K IDs, P positives and n claims that count, m of them declared.

    Claims stand by falling score.
    """

    protocol: str
    method: str
    ids: tuple[int, ...]
    base: IntArray
    """(K, 4) TP, TN, FP, FN without any claim."""
    declared: IntArray
    """(K, 4) TP, TN, FP, FN at the method's operating point."""
    negative: BoolArray
    """(F, K) the frames and IDs that count as TN in base."""
    positive: IntArray
    """(P,) the truths of Joined that count as FN in base; in protocol paper one per frame and
    ID."""
    positive_landmark_index: IntArray
    """(P,) into ids."""
    claim: IntArray
    """(n,) index into the claims of Joined."""
    score: FloatArray
    """(n,) 0 to 1, falling."""
    landmark_index: IntArray
    """(n,) into ids."""
    frame_index: IntArray
    """(n,) into Joined.frame."""
    truth: IntArray
    """(n,) the truth of which it is a right claim, else -1."""
    effect: npt.NDArray[np.int8]
    """(n, 4) what it adds to TP, TN, FP, FN after the claims before it."""
    declared_claim: IntArray
    """(m,) which of the n claims are declared."""
    declared_effect: npt.NDArray[np.int8]
    """(m, 4) what these add to TP, TN, FP, FN if there are no other claims."""

    def count(self, k: int | None = None) -> Count:
        """The counts at the operating point: of the k-th ID, or the sum over all."""
        base, declared = (
            counts.sum(axis=0) if k is None else counts[k] for counts in (self.base, self.declared)
        )
        return counted(base, declared)

    def curve(self, k: int | None = None) -> Curve:
        """The ROC of the k-th ID, or the micro average over all."""
        mine = slice(None) if k is None else self.landmark_index == k
        score, effect = self.score[mine], self.effect[mine]
        base = self.base.sum(axis=0) if k is None else self.base[k]
        last = np.flatnonzero(np.append(np.diff(score) != 0, True)[: len(score)])
        counts = np.vstack([base, base + np.cumsum(effect, axis=0, dtype=np.int64)[last]])
        return Curve(np.concatenate([[np.inf], score[last]]), *counts.T)

    def base_by(self, of_frame: IntArray, of_truth: IntArray, groups: int) -> IntArray:
        """(groups, K, 4) `base`, split into groups.

        of_frame: (F,) the group of a frame's negatives. of_truth: (T,) the group of a truth.
        """
        k = len(self.ids)
        frame, landmark = np.nonzero(self.negative)
        cells = np.zeros((groups * k, 4), dtype=np.int64)
        cells[:, 1] = np.bincount(of_frame[frame] * k + landmark, minlength=groups * k)
        cells[:, 3] = np.bincount(
            of_truth[self.positive] * k + self.positive_landmark_index, minlength=groups * k
        )
        return cells.reshape(groups, k, 4)

    def claims_by(self, of_frame: IntArray, of_truth: IntArray) -> IntArray:
        """(n,) the group of each claim: that of its truth if it is right, else that of its frame.

        So a claim changes the counts of the group that has its positive or negative in `base_by`.
        """
        if not len(of_truth):
            return of_frame[self.frame_index]
        return np.where(self.truth >= 0, of_truth[self.truth], of_frame[self.frame_index])

    def declared_by(self, of_frame: IntArray, of_truth: IntArray, groups: int) -> IntArray:
        """(groups, K, 4) `declared`, split as in `base_by`."""
        counts = self.base_by(of_frame, of_truth, groups)
        group = self.claims_by(of_frame, of_truth)[self.declared_claim]
        np.add.at(counts, (group, self.landmark_index[self.declared_claim]), self.declared_effect)
        return counts


@dataclass(frozen=True, slots=True)
class _Claims:
    """The claims of one method that count, n of them, by falling score.

    A cell is an ID in a frame, numbered as frame * K + ID.
    """

    index: IntArray
    """(n,) into the claims of Joined."""
    cell: IntArray
    """(n,) the cell claimed."""
    truth: IntArray
    """(n,) the truth of which it is a right claim, else -1."""
    spot: IntArray
    """(n,) what is claimed, as in `_effects`."""


def score(joined: Joined, method: int, protocol: str) -> Scored:
    """Score one method (index) under one protocol, as described in `evaluate.evaluate`."""
    k = len(joined.ids)
    truth_cell = joined.truth_frame_index * k + joined.truth_landmark_index
    state = np.zeros(len(joined.frame) * k, dtype=np.int8)  # of each cell
    if protocol == "paper":
        positive = np.flatnonzero(joined.truth_half_in_view)
        # One truth per cell, if possible one that is part of a pass.
        positive = positive[np.argsort(~joined.truth_positive[positive], kind="stable")]
        positive = positive[np.unique(truth_cell[positive], return_index=True)[1]]
        state[truth_cell[positive]] = POSITIVE
        claims = _claims_on_cells(joined, method, len(state), truth_cell, positive)
    else:
        positive = np.flatnonzero(joined.truth_positive)
        state[truth_cell] = IGNORED
        state[truth_cell[positive]] = POSITIVE  # even if another one is partly in view
        claims = _claims_on_places(joined, method, state, truth_cell)
    positive_landmark = joined.truth_landmark_index[positive]
    negative = state.reshape(-1, k) == NEGATIVE
    base = np.zeros((k, 4), dtype=np.int64)
    base[:, 1] = np.count_nonzero(negative, axis=0)
    base[:, 3] = np.bincount(positive_landmark, minlength=k)

    right, absent = claims.truth >= 0, state[claims.cell] == NEGATIVE
    landmark = joined.claim_landmark_index[claims.index]
    declared_claim = np.flatnonzero(joined.declared[claims.index])
    declared_effect = _effects(
        protocol, right[declared_claim], absent[declared_claim], claims.spot[declared_claim]
    )
    declared = base.copy()
    np.add.at(declared, landmark[declared_claim], declared_effect)
    return Scored(
        protocol=protocol,
        method=joined.methods[method],
        ids=joined.ids,
        base=base,
        declared=declared,
        negative=negative,
        positive=positive,
        positive_landmark_index=positive_landmark,
        claim=claims.index,
        score=joined.score[claims.index],
        landmark_index=landmark,
        frame_index=joined.claim_frame_index[claims.index],
        truth=claims.truth,
        effect=_effects(protocol, right, absent, claims.spot),
        declared_claim=declared_claim,
        declared_effect=declared_effect,
    )


def _claims_on_cells(
    joined: Joined, method: int, cells: int, truth_cell: IntArray, positive: IntArray
) -> _Claims:
    """The claims under protocol paper, which ignores positions and counts every frame.

    cells: their number. truth_cell: (T,). positive: (P,) truths, one per cell.
    """
    index, cell = _by_score(joined, method)
    truth_of_cell = np.full(cells, -1)
    truth_of_cell[truth_cell[positive]] = positive
    return _Claims(index, cell, truth_of_cell[cell], spot=cell)


def _claims_on_places(
    joined: Joined, method: int, state: npt.NDArray[np.int8], truth_cell: IntArray
) -> _Claims:
    """The claims under protocol strict; those on a truth that is only partly in view do not count.

    state: of each cell. truth_cell: (T,).
    """
    index, cell = _by_score(joined, method)
    truth = nearest_truth(joined, index, cell, truth_cell)
    on_truth = truth >= 0
    counts = np.ones(len(index), dtype=bool)
    counts[on_truth] = joined.truth_positive[truth[on_truth]]
    spot = np.where(on_truth, len(state) + truth, cell)
    return _Claims(index[counts], cell[counts], truth[counts], spot[counts])


def _by_score(joined: Joined, method: int) -> tuple[IntArray, IntArray]:
    """(index, cell) of a method's claims, by falling score; as in _Claims."""
    index = np.flatnonzero(joined.method_index == method)
    index = index[np.argsort(-joined.score[index], kind="stable")]
    frame, landmark = joined.claim_frame_index[index], joined.claim_landmark_index[index]
    return index, frame * len(joined.ids) + landmark


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
