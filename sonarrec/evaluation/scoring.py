"""Scoring against ground truth: the paper's tables, and the curves behind them.

Everything is counted from one list per method: the claims by falling score, each with what it
adds to TP, TN, FP and FN once it is made (`_effects`). Summed over the declared claims it gives
the operating point, summed cumulatively over all claims it gives the ROC.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sonarrec.evaluation.results import (
    METHODS,
    BoolArray,
    IntArray,
    LogResults,
    find_logs,
    read_log,
)
from sonarrec.evaluation.truth import Truth, TruthTable, match_truth, read_truth
from sonarrec.geometry import Sonar
from sonarrec.records import FloatArray, SonarrecError, UsageError

PROTOCOLS = ("paper", "strict")
NEGATIVE, POSITIVE, IGNORED = 0, 1, 2
ROUNDING_M = 1e-9
"""A claim exactly on the gate is inside it, whatever the last bit says."""


@dataclass(frozen=True, slots=True)
class Count:
    """A confusion count. Rates are NaN where they are 0/0."""

    tp: int
    tn: int
    fp: int
    fn: int

    @property
    def tpr(self) -> float:
        """True positive rate, TP / (TP + FN)."""
        return self.tp / (self.tp + self.fn) if self.tp + self.fn else math.nan

    @property
    def fpr(self) -> float:
        """False positive rate, FP / (FP + TN)."""
        return self.fp / (self.fp + self.tn) if self.fp + self.tn else math.nan

    @property
    def total(self) -> int:
        """The paper's beta."""
        return self.tp + self.tn + self.fp + self.fn


@dataclass(frozen=True, slots=True)
class Curve:
    """A ROC: the count at every threshold, from infinity down. Arrays are (points,).

    Equal scores are one point. Rates are NaN throughout where they are 0/0. The curve ends where
    every estimate is a claim, which need not be at (1, 1): what was never seen cannot be claimed.
    """

    threshold: FloatArray
    tp: IntArray
    tn: IntArray
    fp: IntArray
    fn: IntArray

    @property
    def tpr(self) -> FloatArray:
        """True positive rate at every threshold."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.tp / (self.tp + self.fn))

    @property
    def fpr(self) -> FloatArray:
        """False positive rate at every threshold."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.fp / (self.fp + self.tn))

    def turns(self, most: int = 2000) -> IntArray:
        """Indices of the points that draw the curve: its corners, both ends among them.

        Where those are more than `most`, points that move neither rate past the next of
        `most` / 2 equal steps are left out.
        """
        step = np.stack([np.diff(self.tp - self.fn), np.diff(self.fp - self.tn)])
        keep = np.ones(len(self.tp), dtype=bool)
        # Three points on one horizontal or vertical line need no middle one.
        keep[1:-1] = ((step[:, 1:] != 0) != (step[:, :-1] != 0)).any(axis=0) | (
            step[:, 1:] != 0
        ).all(axis=0)
        index = np.flatnonzero(keep)
        if len(index) > most:
            rates = np.nan_to_num(np.stack([self.tpr[index], self.fpr[index]]))
            moved = (np.diff(np.floor(rates * (most // 2))) != 0).any(axis=0)
            moved[-1] = True
            index = index[np.concatenate([[True], moved])]
        return index


@dataclass(frozen=True, slots=True)
class Scored:
    """One method under one protocol.

    ids: K landmark IDs. base, declared: (K, 4) TP, TN, FP, FN with nothing claimed, and at the
    method's operating point. Per claim that counts, by falling score: score, landmark (index
    into ids), frame (index into Joined.frame) and effect, (n, 4) int8, what it adds.
    """

    protocol: str
    method: str
    ids: tuple[int, ...]
    base: IntArray
    declared: IntArray
    score: FloatArray
    landmark: IntArray
    frame: IntArray
    effect: npt.NDArray[np.int8]

    def count(self, k: int | None = None) -> Count:
        """At the operating point: of the k-th ID, or the micro sum over all of them."""
        row = self.declared.sum(axis=0) if k is None else self.declared[k]
        return Count(*map(int, row))

    def curve(self, k: int | None = None) -> Curve:
        """The ROC of the k-th ID, or the micro-averaged one over all of them."""
        mine = slice(None) if k is None else self.landmark == k
        score, effect = self.score[mine], self.effect[mine]
        base = self.base.sum(axis=0) if k is None else self.base[k]
        last = np.flatnonzero(np.append(np.diff(score) != 0, True)[: len(score)])
        counts = np.vstack([base, base + np.cumsum(effect, axis=0, dtype=np.int64)[last]])
        return Curve(np.concatenate([[np.inf], score[last]]), *counts.T)


@dataclass(frozen=True, slots=True)
class Joined:
    """Results and truth of all logs on one axis of F frames and one of K IDs.

    log, frame: (F,) index into logs, and frame number there. Truths (T,): truth_frame (index),
    truth_landmark (index into ids), truth_position (T, 2) m, truth_positive, and gate, the
    distance (m) within which a claim is right. Claims (N,): method (index), claim_frame,
    claim_landmark, claim_position (N, 2) m, score, declared. Positions are NaN where unknown;
    placed: whether they are known wherever the strict protocol needs them.
    """

    logs: tuple[str, ...]
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    log: IntArray
    frame: IntArray
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
    placed: bool


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What `evaluate` found. notes: worth knowing. unused: input that could not be used."""

    joined: Joined
    scored: tuple[Scored, ...]
    min_visible: float
    notes: tuple[str, ...]
    unused: tuple[str, ...]


def evaluate(
    results: Path,
    ground_truth: Path,
    *,
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
) -> Evaluation:
    """Score a results folder (of one log, or of several) against gt.csv.

    A claim is an estimate that is declared (operating point) or whose score reaches the
    threshold (curves). A landmark with visible >= min_visible is a positive.

    Protocol "paper", per frame and ID: in view and claimed = TP, each further claim of it one TP
    more; in view and not claimed = FN; not in view and claimed, however often, = FP; else TN.
    Position plays no part. Partly visible and nothing else of that ID in view: not counted.

    Protocol "strict": a claim belongs to the truth of its ID that is nearest in that frame, if
    its centre is within half a disc diameter of it in the fan plane. The first claim of a
    positive (the one of highest score) is TP; every further one, and every claim that belongs to
    no truth, is FP. A positive without a claim is FN, also where its ID is claimed elsewhere
    (FN and FP). Claims of a partly visible landmark are not counted. TN: a frame and ID of which
    nothing shows and which is not claimed. So an FP replaces a TN the first time an absent ID is
    claimed in a frame, and is an entry of its own otherwise: FPR = FP / (FP + TN) stays within
    0 to 1 and no false claim is free.

    Raises SonarrecError where files cannot be used or have no frame in common.
    """
    if not 0 <= min_visible <= 1:
        raise UsageError(f"--min-visible is a share of the disc, 0 to 1, not {min_visible:g}")
    if tolerance_s is not None and not 0 <= tolerance_s < math.inf:
        raise UsageError(f"--tolerance is a time in seconds, 0 or more, not {tolerance_s:g}")
    table = read_truth(ground_truth)
    folders = find_logs(results)
    logs = [read_log(folder, landmarks, sonar) for folder in folders]
    for log in logs:
        if set(log.landmarks.ids) != set(logs[0].landmarks.ids):
            raise SonarrecError(
                f"{results}: logs {logs[0].name} and {log.name} were run with different landmark "
                "IDs and cannot be pooled; evaluate them one by one, or give --landmarks"
            )
    if len(logs) > 1 and table.log is None:
        raise SonarrecError(
            f"{ground_truth}: {results} holds {len(logs)} logs "
            f"({', '.join(log.name for log in logs)}), so the truth needs a log column that "
            "names their folders; or give the folder of one log"
        )
    truths = [match_truth(table, log, tolerance_s) for log in logs]
    unused = _unused(table, logs, truths, single=folders == [results])
    joined = join(logs, truths, min_visible)
    notes = _notes(joined, logs, truths)
    scored = tuple(
        score(joined, m, protocol)
        for m in range(len(joined.methods))
        for protocol in PROTOCOLS
        if protocol == "paper" or joined.placed
    )
    return Evaluation(joined, scored, min_visible, notes, unused)


def _unused(
    table: TruthTable, logs: list[LogResults], truths: list[Truth], single: bool
) -> tuple[str, ...]:
    """One line per part of the input that was left out; SonarrecError where no truth is left."""
    said = []
    rows = sum(t.rows for t in truths)
    elsewhere = len(table.at) - rows
    lost = sum(t.unprocessed for t in truths) + (0 if single else elsewhere)
    frames = sum(len(log.frame) for log in logs)
    if len(table.at) and not rows:
        raise SonarrecError(
            f"{table.path}: its log column names none of {', '.join(log.name for log in logs)}"
        )
    if rows and not any(len(t.row) for t in truths):
        raise SonarrecError(
            f"{table.path}: none of its {rows} rows ({table.key} {table.at.min()} to "
            f"{table.at.max()}) lies on a processed frame ({frames} frames, "
            f"{logs[0].frame[0]} to {logs[-1].frame[-1]}); is this the truth of another log?"
        )
    if lost:
        said.append(
            f"{table.path}: {lost} of {len(table.at)} rows lie on frames that were not processed; "
            f"they are not scored (the {frames} frames processed are)"
        )
    for log in logs:
        if not log.finished:
            said.append(
                f"{log.name}: the run was cut short (run.toml says finished = false); "
                f"only its {len(log.frame)} frames are scored"
            )
        if log.strays:
            said.append(
                f"{log.name}: {log.strays} estimates lie on frames that frames.csv does not list; "
                "they are not scored"
            )
    return tuple(said)


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
        placed=all(
            not len(t.row)
            or (t.position is not None and (log.position is not None or not len(log.row)))
            for log, t in pairs
        ),
    )


def _notes(joined: Joined, logs: list[LogResults], truths: list[Truth]) -> tuple[str, ...]:
    notes = []
    if not joined.methods:
        raise SonarrecError(f"{', '.join(joined.logs)}: estimates.csv names no method to score")
    if not joined.placed:
        notes.append(
            "the strict protocol is not scored: truth or estimates lack positions, or give them "
            "in pixels while neither run.toml nor flags state metres_per_pixel and apex_px"
        )
    for log, truth in zip(logs, truths, strict=True):
        if not truth.rows:
            notes.append(f"{log.name}: no row in the ground truth, so taken to hold no landmark")
        if truth.between:
            notes.append(
                f"{log.name}: {truth.between} ground-truth rows lie between frames and are passed "
                "over for others nearer in time"
            )
    seen = np.bincount(joined.method, minlength=len(joined.methods))
    notes += [
        f"{m}: no estimate at all" for m, n in zip(joined.methods, seen, strict=True) if not n
    ]
    positives = np.bincount(joined.truth_landmark[joined.truth_positive], minlength=len(joined.ids))
    for i, n in zip(joined.ids, positives, strict=True):
        if not n:
            notes.append(f"ID.{i} is never in view: its TPR is 0/0 and says nothing")
    return tuple(notes)


def score(joined: Joined, method: int, protocol: str) -> Scored:
    """Score one method (index) under one protocol, as `evaluate` says."""
    k = len(joined.ids)
    state = np.zeros(len(joined.frame) * k, dtype=np.int8)
    truth_cell = joined.truth_frame * k + joined.truth_landmark
    state[truth_cell[~joined.truth_positive]] = IGNORED
    state[truth_cell[joined.truth_positive]] = POSITIVE  # a whole one goes before a part of another

    mine = np.flatnonzero(joined.method == method)
    mine = mine[np.argsort(-joined.score[mine], kind="stable")]
    cell = joined.claim_frame[mine] * k + joined.claim_landmark[mine]
    base = np.zeros((k, 4), dtype=np.int64)
    base[:, 1] = np.count_nonzero(state.reshape(-1, k) == NEGATIVE, axis=0)
    if protocol == "paper":
        base[:, 3] = np.count_nonzero(state.reshape(-1, k) == POSITIVE, axis=0)
        counted = state[cell] != IGNORED
        right = state[cell] == POSITIVE
        spot = cell
    else:
        base[:, 3] = np.bincount(joined.truth_landmark[joined.truth_positive], minlength=k)
        truth = _nearest_truth(joined, truth_cell, mine, cell)
        right = truth >= 0
        counted = np.ones(len(mine), dtype=bool)
        counted[right] = joined.truth_positive[truth[right]]
        spot = np.where(right, len(state) + truth, cell)
    mine, cell, right, spot = mine[counted], cell[counted], right[counted], spot[counted]

    absent = state[cell] == NEGATIVE
    effect = _effects(protocol, right, absent, spot)
    declared = joined.declared[mine]
    chosen = _effects(protocol, right[declared], absent[declared], spot[declared])
    landmark = joined.claim_landmark[mine]
    at_operating_point = base.copy()
    np.add.at(at_operating_point, landmark[declared], chosen)
    return Scored(
        protocol=protocol,
        method=joined.methods[method],
        ids=joined.ids,
        base=base,
        declared=at_operating_point,
        score=joined.score[mine],
        landmark=landmark,
        frame=joined.claim_frame[mine],
        effect=effect,
    )


def _effects(
    protocol: str, right: BoolArray, absent: BoolArray, spot: IntArray
) -> npt.NDArray[np.int8]:
    """(n, 4) what each claim adds to TP, TN, FP, FN when made after those before it.

    right: of a positive. absent: its ID shows nowhere in its frame. spot: what it is a claim of
    (a frame's ID, or one truth); the second claim of one spot counts differently.
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


def _nearest_truth(
    joined: Joined, truth_cell: IntArray, mine: IntArray, cell: IntArray
) -> IntArray:
    """(n,) index of the nearest truth of a claim's ID in its frame, -1 if beyond the gate."""
    order = np.argsort(truth_cell, kind="stable")
    ordered = truth_cell[order]
    low = np.searchsorted(ordered, cell, side="left")
    many = np.searchsorted(ordered, cell, side="right") - low
    claim = np.repeat(np.arange(len(mine)), many)
    within = np.arange(len(claim)) - np.repeat(np.cumsum(many) - many, many)
    truth = order[np.repeat(low, many) + within]
    away = np.linalg.norm(joined.claim_position[mine[claim]] - joined.truth_position[truth], axis=1)
    hits = np.flatnonzero(away <= joined.gate[truth] + ROUNDING_M)
    hits = hits[np.lexsort((away[hits], claim[hits]))]
    chosen, first = np.unique(claim[hits], return_index=True)
    nearest = np.full(len(mine), -1, dtype=np.int64)
    nearest[chosen] = truth[hits[first]]
    return nearest
