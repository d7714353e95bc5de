"""One log's results and its truth, frame by frame, and the landmark nearest to a claim."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import UsageError
from sonarrec.results.columns import in_order
from sonarrec.results.read import LogResults
from sonarrec.sonar import Sonar, sonar_from
from sonarrec.truth.match import Truth

DIGITS = 6
"""Of a score: claims are counted by score, so that memory does not grow with their number."""
ROUNDING_M = 1e-9
"""A claim exactly on the gate counts as inside, despite rounding."""
PAPER_MIN_VISIBLE = 0.5
"""The share of a disc in view from which protocol paper counts it. TP + FN of Tables 4 and 5 are
those of frames with its centre, or half the disc, in view."""
PAUSE = 10
"""Median steps from frame to frame; after as many frames a pass ends, too."""


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
        if self.tolerance_s is not None and not 0 <= self.tolerance_s < math.inf:
            raise UsageError(
                f"--tolerance is a time in seconds, 0 or more, not {self.tolerance_s:g}"
            )
        if self.within_m is not None and not 0 < self.within_m < math.inf:
            raise UsageError(f"--within is a distance in metres above 0, not {self.within_m:g}")


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
    """Results and truth of one log: F frames, T truths, N claims, K IDs.

    A truth is a landmark that is at least partly in view in a frame. A claim is an estimate.
    """

    name: str
    """Name of the log."""
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    frame: IntArray
    """(F,) frame number in the log."""
    seconds: FloatArray
    """(F,) duration of each frame, see `seconds_of_frames`."""
    truth_frame_index: IntArray
    """(T,) into frame."""
    truth_landmark_index: IntArray
    """(T,) into ids."""
    truth_position: FloatArray
    """(T, 2) m in the fan plane, NaN if unknown."""
    truth_orientation: FloatArray
    """(T,) deg, NaN if unknown."""
    truth_positive: BoolArray
    """(T,) whether enough of it is in view to count as a positive under protocol strict."""
    truth_half_in_view: BoolArray
    """(T,) the same under protocol paper: half of it or more."""
    gate_m: float
    """The distance within which a claim is right."""
    method_index: IntArray
    """(N,) into methods."""
    claim_frame_index: IntArray
    """(N,) into frame."""
    claim_landmark_index: IntArray
    """(N,) into ids."""
    claim_position: FloatArray
    """(N, 2) m in the fan plane, NaN if unknown."""
    claim_orientation: FloatArray
    """(N,) deg, NaN if unknown."""
    claim_object: IntArray
    """(N,) number of the candidate or track, -1 if unknown."""
    score: FloatArray
    """(N,) 0 to 1, to six digits, as the program writes them."""
    rounded: bool
    """Whether scores had more digits."""
    declared: BoolArray
    """(N,) whether it is declared, which is the method's operating point."""
    probability: FloatArray
    """(N, K + 1) one per ID, then none of these; NaN if not stated."""
    turn_deg: FloatArray
    """(K,) the smallest rotation after which an ID looks the same."""
    placed: bool
    """Whether positions are known wherever the strict protocol needs them."""


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
    probability = log.probability
    if probability is None:
        probability = np.full((n, k + 1), np.nan, dtype=np.float32)
    position, orientation = truth.position, truth.orientation
    if position is None:
        position = np.full((len(seen), 2), np.nan)
    if orientation is None:
        orientation = np.full(len(seen), np.nan)
    return Matched(
        name=log.name,
        ids=ids,
        methods=methods,
        frame=log.frame,
        seconds=seconds_of_frames(log.timestamp_ns, len(log.frame)),
        truth_frame_index=truth.frame_index[seen],
        truth_landmark_index=of_id[truth.landmark_index[seen]],
        truth_position=position[seen],
        truth_orientation=orientation[seen],
        truth_positive=truth.visible[seen] >= min_visible,
        truth_half_in_view=truth.visible[seen] >= PAPER_MIN_VISIBLE,
        gate_m=within_m or log.landmarks.radius_m,
        method_index=of_method[log.method],
        claim_frame_index=log.frame_index,
        claim_landmark_index=of_id[log.landmark_index],
        claim_position=np.full((n, 2), np.nan) if log.position is None else log.position,
        claim_orientation=log.orientation,
        claim_object=log.object,
        score=np.round(log.score, DIGITS),
        rounded=bool((log.score != np.round(log.score, DIGITS)).any()),
        declared=log.declared,
        probability=probability[:, [*np.argsort(of_id).tolist(), k]],
        turn_deg=log.landmarks.periods_deg()[log.landmarks.indices(np.array(ids))],
        placed=not len(seen)
        or (truth.position is not None and (log.position is not None or not n)),
    )


def seconds_of_frames(timestamp_ns: IntArray | None, frames: int) -> FloatArray:
    """(frames,) the time from each frame to the next; NaN if the log has no times, or only one.

    A step of more than PAUSE is a pause in the recording. The frame before it, and the last frame,
    take the median step. Frames of one time share it: a clock may tick more slowly than frames
    come.
    """
    times, frame, together = np.unique(
        [] if timestamp_ns is None else timestamp_ns, return_inverse=True, return_counts=True
    )
    if len(times) < 2:
        return np.full(frames, np.nan)
    steps = np.diff(times) / 1e9
    usual = np.median(steps)
    lasting = np.append(np.where(steps > PAUSE * usual, usual, steps), usual)
    return np.asarray((lasting / together)[frame])


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


def equal_pairs(a: IntArray, b: IntArray) -> tuple[IntArray, IntArray]:
    """Indices of all pairs of an a and a b that are equal, in the order of a, then of b."""
    order = np.argsort(b, kind="stable")
    low, high = (np.searchsorted(b[order], a, side) for side in ("left", "right"))
    first = np.repeat(np.arange(len(a)), high - low)
    within = np.arange(len(first)) - np.repeat(np.cumsum(high - low) - (high - low), high - low)
    return first, order[low[first] + within]


def truth_beneath(log: Matched) -> IntArray:
    """(N,) for each claim the nearest truth of any ID in its frame, -1 if none is in the gate."""
    everything = np.arange(len(log.claim_frame_index))
    return nearest_truth(log, everything, log.claim_frame_index, log.truth_frame_index)


def distance(log: Matched, claims: IntArray, truths: IntArray) -> FloatArray:
    """(n,) m in the fan plane between the n-th claim and the n-th truth, given by index."""
    offset = log.claim_position[claims] - log.truth_position[truths]
    return np.hypot(offset[:, 0], offset[:, 1])
