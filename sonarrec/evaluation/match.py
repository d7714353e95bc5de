"""Rows: one log's results and truth frame by frame, and what each claim counts under a protocol.

Everything is counted from one list per method: the claims by falling score, each with its effect on
TP, TN, FP and FN. The sum over declared claims is the operating point, the cumulative sum over all
claims is the ROC.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import UsageError
from sonarrec.results.columns import in_order
from sonarrec.results.read import LogResults
from sonarrec.sonar import Sonar, sonar_from
from sonarrec.truth.match import Truth

PROTOCOLS = ("paper", "strict")
NEGATIVE, POSITIVE, IGNORED = 0, 1, 2
DIGITS = 6
"""Of a score: claims are counted by score, so that memory does not grow with their number."""
ROUNDING_M = 1e-9
"""A claim exactly on the gate counts as inside, despite rounding."""
PAPER_MIN_VISIBLE = 0.5
"""The share of a disc in view from which protocol paper counts it. TP + FN of Tables 4 and 5 are
those of frames with its centre, or half the disc, in view."""


@dataclass(frozen=True, slots=True)
class ScoringOptions:
    """How results are read and compared with truth."""

    min_visible: float = 0.9
    """Under protocol strict a landmark counts if at least this share of its disc is in view."""
    tolerance_s: float | None = None
    """For truth matched by time; None: half the time between frames."""
    landmarks: str | None = None
    """Landmark set, in place of that of run.toml."""
    sonar: Sonar | None = None
    """Geometry that takes precedence over run.toml."""
    within_m: float | None = None
    """Under protocol strict a claim must lie this near; None: within half a disc or plate."""
    methods: tuple[str, ...] = ()
    """Those that are scored or shown, the leading one first; all if none is named."""

    def check(self) -> None:
        """Raises UsageError if an option is invalid."""
        if not 0 <= self.min_visible <= 1:
            raise UsageError(
                f"--min-visible is a share of the disc, 0 to 1, not {self.min_visible:g}"
            )
        if not 0 <= (self.tolerance_s or 0) < math.inf:
            raise UsageError(f"--tolerance is a time in s, 0 or more, not {self.tolerance_s:g}")
        if self.within_m is not None and not 0 < self.within_m < math.inf:
            raise UsageError(f"--within is a distance in m above 0, not {self.within_m:g}")


DEFAULT = ScoringOptions()


def scoring_options(
    method: str | Sequence[str] = (),
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    within_m: float | None = None,
) -> ScoringOptions:
    """The options that a program passes, by the names of the command's."""
    methods = (method,) if isinstance(method, str) else tuple(method)
    geometry = sonar_from(sonar)
    return ScoringOptions(min_visible, tolerance_s, landmarks, geometry, within_m, methods)


@dataclass(frozen=True, slots=True)
class Matched:
    """Results and truth of one log as columns: F frames, T truths, N claims, K IDs.

    A truth is a landmark that is at least partly in view in a frame. A claim is an estimate.
    Columns ending in _index point into frame, ids or methods. Positions are (n, 2) m in the fan
    plane, orientations deg; both NaN if unknown.

    stretch: (F,) the number of the frame's stretch, which rises.
    truth_positive: (T,) whether enough of it is in view for protocol strict; truth_half_in_view:
    for protocol paper. gate_m: the distance within which a claim is right. score: 0 to 1, to
    six digits. probability: (N, K + 1), one per ID, then none of these; NaN if not stated.
    turn_deg: (K,) the smallest rotation after which an ID looks the same. placed: whether
    positions are known wherever protocol strict needs them.
    """

    name: str
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    frame: IntArray
    stretch: IntArray
    truth_frame_index: IntArray
    truth_landmark_index: IntArray
    truth_position: FloatArray
    truth_orientation: FloatArray
    truth_positive: BoolArray
    truth_half_in_view: BoolArray
    gate_m: float
    method_index: IntArray
    claim_frame_index: IntArray
    claim_landmark_index: IntArray
    claim_position: FloatArray
    claim_orientation: FloatArray
    score: FloatArray
    declared: BoolArray
    probability: FloatArray
    turn_deg: FloatArray
    placed: bool


def match(
    log: LogResults,
    truth: Truth,
    min_visible: float,
    ids: tuple[int, ...] = (),
    *,
    within_m: float | None = None,
) -> Matched:
    """Match one log with its truth.

    within_m: as of ScoringOptions. ids: the log's IDs in the wanted order; others are not used. A
    truth with `visible` 0 is none: nothing of the landmark is in view.
    """
    ids = ids if set(ids) == set(log.landmarks.ids) else log.landmarks.ids
    methods = in_order(log.methods)
    of_id = np.array([ids.index(i) for i in log.landmarks.ids])
    of_method = np.array([methods.index(m) for m in log.methods], dtype=int)
    n, k, seen = len(log.frame_index), len(ids), truth.visible > 0

    def known(column: Any, *shape: int) -> Any:
        return np.full(shape, np.nan, dtype=np.float32) if column is None else column

    return Matched(
        name=log.name,
        ids=ids,
        methods=methods,
        frame=log.frame,
        stretch=log.stretch,
        truth_frame_index=truth.frame_index[seen],
        truth_landmark_index=of_id[truth.landmark_index[seen]],
        truth_position=known(truth.position, len(seen), 2)[seen],
        truth_orientation=known(truth.orientation, len(seen))[seen],
        truth_positive=truth.visible[seen] >= min_visible,
        truth_half_in_view=truth.visible[seen] >= PAPER_MIN_VISIBLE,
        gate_m=within_m or log.landmarks.radius_m,
        method_index=of_method[log.method],
        claim_frame_index=log.frame_index,
        claim_landmark_index=of_id[log.landmark_index],
        claim_position=known(log.position, n, 2),
        claim_orientation=log.orientation,
        score=np.round(log.score, DIGITS),
        declared=log.declared,
        probability=known(log.probability, n, k + 1)[:, [*np.argsort(of_id).tolist(), k]],
        turn_deg=log.landmarks.periods_deg()[log.landmarks.indices(np.array(ids))],
        placed=not len(seen)
        or (truth.position is not None and (log.position is not None or not n)),
    )


def equal_pairs(a: IntArray, b: IntArray) -> tuple[IntArray, IntArray]:
    """Indices of all pairs of an a and a b that are equal, in the order of a, then of b."""
    order = np.argsort(b, kind="stable")
    low, high = (np.searchsorted(b[order], a, side) for side in ("left", "right"))
    first = np.repeat(np.arange(len(a)), high - low)
    within = np.arange(len(first)) - np.repeat(np.cumsum(high - low) - (high - low), high - low)
    return first, order[low[first] + within]


def distance(log: Matched, claims: IntArray, truths: IntArray) -> FloatArray:
    """(n,) m in the fan plane between the n-th claim and the n-th truth, given by index."""
    offset = log.claim_position[claims] - log.truth_position[truths]
    return np.hypot(offset[:, 0], offset[:, 1])


def nearest_truth(
    log: Matched, claims: IntArray, claim_key: IntArray, truth_key: IntArray
) -> IntArray:
    """(n,) the nearest truth of equal key for each claim, -1 if none is within the gate.

    claims: (n,) indices. claim_key: (n,), truth_key: (T,): for example the frame, or frame and ID.
    """
    claim, truth = equal_pairs(claim_key, truth_key)
    offset_m = distance(log, claims[claim], truth)
    hits = np.flatnonzero(offset_m <= log.gate_m + ROUNDING_M)
    hits = hits[np.lexsort((offset_m[hits], claim[hits]))]
    chosen, first = np.unique(claim[hits], return_index=True)
    nearest = np.full(len(claims), -1, dtype=np.int64)
    nearest[chosen] = truth[hits[first]]
    return nearest


def truth_beneath(log: Matched) -> IntArray:
    """(N,) for each claim the nearest truth of any ID in its frame, -1 if none is in the gate."""
    everything = np.arange(len(log.claim_frame_index))
    return nearest_truth(log, everything, log.claim_frame_index, log.truth_frame_index)


@dataclass(frozen=True, slots=True)
class Judged:
    """The claims of one method on one log under one protocol, by falling score.

    There are K IDs, P positives and n claims that count, m of them declared.
    """

    negative: BoolArray
    """(F, K) the frames and IDs that are TN without any claim."""
    positive: IntArray
    """(P,) the truths of Matched that are FN without any claim; in protocol paper one per frame and
    ID."""
    positive_landmark_index: IntArray
    claim: IntArray
    """(n,) index into the claims of Matched."""
    score: FloatArray
    landmark_index: IntArray
    frame_index: IntArray
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

    def group(self, of_frame: IntArray, of_truth: IntArray) -> IntArray:
        """(n,) the group of each claim: that of its truth if it is right, else that of its frame.

        So a claim changes the counts of the group that has its positive or negative.
        """
        if not len(of_truth):
            return of_frame[self.frame_index]
        return np.where(self.truth >= 0, of_truth[self.truth], of_frame[self.frame_index])

    def declared(self, of_frame: IntArray, of_truth: IntArray, groups: int) -> IntArray:
        """(groups, K, 4) TP, TN, FP, FN at the method's operating point.

        of_frame: (F,) the group of a frame's negatives. of_truth: (T,) the group of a truth.
        """
        counts = np.zeros((groups, self.negative.shape[1], 4), dtype=np.int64)
        frame, landmark = np.nonzero(self.negative)
        np.add.at(counts[:, :, 1], (of_frame[frame], landmark), 1)
        positive = of_truth[self.positive], self.positive_landmark_index
        np.add.at(counts[:, :, 3], positive, 1)
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
    tp, fp = (right, ~right & first) if protocol == "paper" else (right & first, ~(right & first))
    effect = np.stack([tp, absent & first, fp, right & first], axis=1).astype(np.int8)
    effect[:, [1, 3]] *= -1
    return effect
