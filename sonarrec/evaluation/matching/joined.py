"""Results and truth of all logs joined frame by frame, and the landmark nearest to a claim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.results.read import LogResults, in_order
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
class Joined:
    """Results and truth of all logs: F frames, T truths, N claims, K IDs.

    A truth is a landmark that is at least partly in view in a frame. A claim is an estimate.
    """

    logs: tuple[str, ...]
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    log_index: IntArray
    """(F,) into logs."""
    frame: IntArray
    """(F,) frame number in its log."""
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
    gate: FloatArray
    """(T,) m, the distance within which a claim is right."""
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


def join(
    logs: Sequence[LogResults],
    truths: Sequence[Truth],
    min_visible: float,
    ids: tuple[int, ...] | None = None,
) -> Joined:
    """Join the logs, which have the same landmark IDs, one after the other.

    ids: the IDs in the wanted order; default: the order of the first log.
    """
    landmarks = logs[0].landmarks
    ids = ids or landmarks.ids
    methods = in_order({name for log in logs for name in log.methods})
    parts, start = [], 0
    for n, (log, truth) in enumerate(zip(logs, truths, strict=True)):
        of_log = {"log_index": np.full(len(log.frame), n)} | _frames_and_claims(log, ids, methods)
        part = of_log | _truths(truth, log, ids, min_visible)
        for name in ("truth_frame_index", "claim_frame_index"):
            part[name] = part[name] + start
        parts.append(part)
        start += len(log.frame)
    return Joined(
        logs=tuple(log.name for log in logs),
        ids=ids,
        methods=methods,
        turn_deg=landmarks.periods_deg()[landmarks.indices(np.array(ids))],
        placed=all(map(_is_placed, logs, truths)),
        rounded=any(bool((log.score != np.round(log.score, DIGITS)).any()) for log in logs),
        **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
    )


def _frames_and_claims(
    log: LogResults, ids: tuple[int, ...], methods: tuple[str, ...]
) -> dict[str, Any]:
    """The fields of Joined from one log's results; frame indices count within the log."""
    of_id = np.array([ids.index(i) for i in log.landmarks.ids])
    of_method = np.array([methods.index(m) for m in log.methods], dtype=int)
    n, k = len(log.frame_index), len(ids)
    probability = log.probability
    if probability is None:
        probability = np.full((n, k + 1), np.nan, dtype=np.float32)
    return {
        "frame": log.frame,
        "seconds": seconds_of_frames(log.timestamp_ns, len(log.frame)),
        "method_index": of_method[log.method],
        "claim_frame_index": log.frame_index,
        "claim_landmark_index": of_id[log.landmark_index],
        "claim_position": _or_nan(log.position, (n, 2)),
        "claim_orientation": log.orientation,
        "claim_object": log.object,
        "score": np.round(log.score, DIGITS),
        "declared": log.declared,
        "probability": probability[:, [*np.argsort(of_id).tolist(), k]],
    }


def _truths(
    truth: Truth, log: LogResults, ids: tuple[int, ...], min_visible: float
) -> dict[str, Any]:
    """The fields of Joined from one log's truth; frame indices count within the log.

    A row with `visible` 0 is no row: nothing of the landmark is in view.
    """
    of_id = np.array([ids.index(i) for i in log.landmarks.ids])
    n = len(truth.frame_index)
    fields = {
        "truth_frame_index": truth.frame_index,
        "truth_landmark_index": of_id[truth.landmark_index],
        "truth_position": _or_nan(truth.position, (n, 2)),
        "truth_orientation": _or_nan(truth.orientation, (n,)),
        "truth_positive": truth.visible >= min_visible,
        "truth_half_in_view": truth.visible >= PAPER_MIN_VISIBLE,
        "gate": np.full(n, log.landmarks.radius_m),
    }
    return {name: column[truth.visible > 0] for name, column in fields.items()}


def _or_nan(values: FloatArray | None, shape: tuple[int, ...]) -> FloatArray:
    return np.full(shape, np.nan) if values is None else values


def _is_placed(log: LogResults, truth: Truth) -> bool:
    """Whether truth and estimates have positions, if there are any of both."""
    if not len(truth.frame_index):
        return True
    return truth.position is not None and (log.position is not None or not len(log.frame_index))


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
    joined: Joined, claims: IntArray, claim_key: IntArray, truth_key: IntArray
) -> IntArray:
    """(n,) the nearest truth of equal key for each claim, -1 if none is within its gate.

    claims: (n,) indices. claim_key: (n,), truth_key: (T,): for example the frame, or frame and ID.
    """
    order = np.argsort(truth_key, kind="stable")
    ordered = truth_key[order]
    low = np.searchsorted(ordered, claim_key, side="left")
    many = np.searchsorted(ordered, claim_key, side="right") - low
    claim = np.repeat(np.arange(len(claims)), many)
    within = np.arange(len(claim)) - np.repeat(np.cumsum(many) - many, many)
    truth = order[np.repeat(low, many) + within]
    away = distance(joined, claims[claim], truth)
    hits = np.flatnonzero(away <= joined.gate[truth] + ROUNDING_M)
    hits = hits[np.lexsort((away[hits], claim[hits]))]
    chosen, first = np.unique(claim[hits], return_index=True)
    nearest = np.full(len(claims), -1, dtype=np.int64)
    nearest[chosen] = truth[hits[first]]
    return nearest


def distance(joined: Joined, claims: IntArray, truths: IntArray) -> FloatArray:
    """(n,) m in the fan plane between the n-th claim and the n-th truth, given by index."""
    apart = joined.claim_position[claims] - joined.truth_position[truths]
    return np.hypot(apart[:, 0], apart[:, 1])
