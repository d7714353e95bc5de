"""Results and truth of all logs on one axis of frames, and which claim lies on which landmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec.records import BoolArray, FloatArray, IntArray
from sonarrec.results.read import METHODS, LogResults
from sonarrec.truth.match import Truth

ROUNDING_M = 1e-9
"""A claim exactly on the gate is inside it, whatever the last bit says."""


@dataclass(frozen=True, slots=True)
class Joined:
    """Results and truth of all logs on one axis of F frames and one of K IDs.

    log, frame: (F,) index into logs, and frame number there. seconds: (F,) that a frame stands
    for, NaN where the log tells no time. Truths (T,): truth_frame (index), truth_landmark (index
    into ids), truth_position (T, 2) m, truth_positive, and gate, the distance (m) within which a
    claim is right. Claims (N,): method (index), claim_frame, claim_landmark, claim_position
    (N, 2) m, score, declared, claim_object (-1 unknown) and probability (N, K + 1), one per ID,
    then none of these, NaN where not stated. Positions are NaN where unknown; placed: whether
    they are known wherever the strict protocol needs them. truth_orientation (T,) and
    claim_orientation (N,): deg, NaN where unknown; turn_deg: (K,) the least turn that an ID looks
    the same after.
    """

    logs: tuple[str, ...]
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    log: IntArray
    frame: IntArray
    seconds: FloatArray
    truth_frame: IntArray
    truth_landmark: IntArray
    truth_position: FloatArray
    truth_positive: BoolArray
    gate: FloatArray
    method: IntArray
    claim_frame: IntArray
    claim_landmark: IntArray
    claim_position: FloatArray
    score: FloatArray
    declared: BoolArray
    claim_object: IntArray
    probability: FloatArray
    placed: bool
    truth_orientation: FloatArray
    claim_orientation: FloatArray
    turn_deg: FloatArray


def join(logs: Sequence[LogResults], truths: Sequence[Truth], min_visible: float) -> Joined:
    """Put the logs end to end. All have the same landmark IDs."""
    ids = logs[0].landmarks.ids
    names = {name for log in logs for name in log.methods}
    methods = tuple(m for m in METHODS if m in names) + tuple(sorted(names - set(METHODS)))
    length = np.array([len(log.frame) for log in logs])
    start = np.cumsum(length) - length

    def place(position: FloatArray | None, rows: int) -> FloatArray:
        return np.full((rows, 2), np.nan) if position is None else position

    pairs = list(zip(logs, truths, strict=True))
    ids_of = [np.array([ids.index(i) for i in log.landmarks.ids]) for log in logs]
    methods_of = [np.array([methods.index(m) for m in log.methods], dtype=int) for log in logs]
    cat = np.concatenate
    return Joined(
        logs=tuple(log.name for log in logs),
        ids=ids,
        methods=methods,
        log=np.repeat(np.arange(len(logs)), length),
        frame=cat([log.frame for log in logs]),
        seconds=np.repeat([_seconds_per_frame(log) for log in logs], length),
        truth_frame=cat([t.row + s for t, s in zip(truths, start, strict=True)]),
        truth_landmark=cat([i[t.landmark] for t, i in zip(truths, ids_of, strict=True)]),
        truth_position=cat([place(t.position, len(t.row)) for t in truths]),
        truth_positive=cat([t.visible >= min_visible for t in truths]),
        gate=cat([np.full(len(t.row), log.landmarks.radius_m) for log, t in pairs]),
        method=cat([m[log.method] for log, m in zip(logs, methods_of, strict=True)]),
        claim_frame=cat([log.row + s for log, s in zip(logs, start, strict=True)]),
        claim_landmark=cat([i[log.landmark] for log, i in zip(logs, ids_of, strict=True)]),
        claim_position=cat([place(log.position, len(log.row)) for log in logs]),
        score=cat([log.score for log in logs]),
        declared=cat([log.declared for log in logs]),
        claim_object=cat([log.object for log in logs]),
        probability=cat([_probability(log, i) for log, i in zip(logs, ids_of, strict=True)]),
        placed=all(
            not len(t.row)
            or (t.position is not None and (log.position is not None or not len(log.row)))
            for log, t in pairs
        ),
        truth_orientation=cat(
            [
                np.full(len(t.row), np.nan) if t.orientation is None else t.orientation
                for t in truths
            ]
        ),
        claim_orientation=cat([log.orientation for log in logs]),
        turn_deg=np.array([_turn_deg(np.array(s)) for s in logs[0].landmarks.sectors]),
    )


def _turn_deg(sectors: IntArray) -> float:
    """The least turn after which equal sectors are as before: 180 for 1010, 360 for 1000."""
    n = len(sectors)
    same = next(i for i in range(1, n + 1) if (np.roll(sectors, i) == sectors).all())
    return 360 * same / n


def _seconds_per_frame(log: LogResults) -> float:
    """The median time between frames, so that a pause in the recording does not count."""
    if log.timestamp_ns is None or len(log.frame) < 2:
        return np.nan
    seconds = float(np.median(np.diff(np.sort(log.timestamp_ns)))) / 1e9
    return seconds if seconds > 0 else np.nan


def _probability(log: LogResults, ids_of: IntArray) -> FloatArray:
    """(n, K + 1) of one log in the order of the joined IDs."""
    k = len(ids_of)
    if log.probability is None:
        return np.full((len(log.row), k + 1), np.nan, dtype=np.float32)
    return log.probability[:, [*np.argsort(ids_of).tolist(), k]]


def nearest_truth(
    joined: Joined, claims: IntArray, claim_key: IntArray, truth_key: IntArray
) -> IntArray:
    """(n,) per claim the nearest truth of equal key, -1 where none of these is within its gate.

    claims: (n,) indices; claim_key: (n,) and truth_key: (T,) say which truths are asked: those
    of the same frame, or of the same frame and ID.
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
    """(n,) metres in the fan plane between claims and truths, given by index, pair by pair."""
    apart = joined.claim_position[claims] - joined.truth_position[truths]
    return np.hypot(apart[:, 0], apart[:, 1])
