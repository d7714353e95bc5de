"""Scoring against ground truth: the paper's tables, and the curves behind them.

Everything is counted from one list per method: the claims by falling score, each with what it
adds to TP, TN, FP and FN once it is made (`_effects`). Summed over the declared claims it gives
the operating point, summed cumulatively over all claims it gives the ROC.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sonarrec.evaluation.curves import Count, Curve
from sonarrec.evaluation.joined import Joined, join, nearest_truth
from sonarrec.records import BoolArray, FloatArray, IntArray, SonarrecError, UsageError
from sonarrec.results.read import LogResults, find_logs, read_log
from sonarrec.sonar import Sonar
from sonarrec.tables import read_table
from sonarrec.truth.match import Truth, match_truth
from sonarrec.truth.table import TruthTable, read_truth

PROTOCOLS = ("paper", "strict")
NEGATIVE, POSITIVE, IGNORED = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Scored:
    """One method under one protocol.

    ids: K landmark IDs. base, declared: (K, 4) TP, TN, FP, FN with nothing claimed, and at the
    method's operating point. negative: (F, K) bool, the frames and IDs that count as TN in base.
    positive: (P,) indices of the truths that count as FN there, one per frame and ID under the
    paper's protocol; positive_landmark: (P,) index into ids.
    Per claim that counts, by falling score: claim (index into Joined), score, landmark (index
    into ids), frame (index into Joined.frame), truth (the positive it is a right claim of, else
    -1) and effect, (n, 4) int8, what it adds. made: (m,) those of them that are declared, and
    made_effect, (m, 4), what these add where no others are made.
    """

    protocol: str
    method: str
    ids: tuple[int, ...]
    base: IntArray
    declared: IntArray
    negative: BoolArray
    positive: IntArray
    positive_landmark: IntArray
    claim: IntArray
    score: FloatArray
    landmark: IntArray
    frame: IntArray
    truth: IntArray
    effect: npt.NDArray[np.int8]
    made: IntArray
    made_effect: npt.NDArray[np.int8]

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

    def base_by(self, of_frame: IntArray, of_truth: IntArray, groups: int) -> IntArray:
        """(groups, K, 4) `base`, split: (F,) says whose a frame's negatives are, (T,) a truth's."""
        k = len(self.ids)
        frame, landmark = np.nonzero(self.negative)
        cells = np.zeros((groups * k, 4), dtype=np.int64)
        cells[:, 1] = np.bincount(of_frame[frame] * k + landmark, minlength=groups * k)
        cells[:, 3] = np.bincount(
            of_truth[self.positive] * k + self.positive_landmark, minlength=groups * k
        )
        return cells.reshape(groups, k, 4)

    def claims_by(self, of_frame: IntArray, of_truth: IntArray) -> IntArray:
        """(n,) whose the claims are: a right one goes with its truth, a false one with its frame.

        So whatever a claim takes from `base_by` is taken from the group that has it.
        """
        if not len(of_truth):
            return of_frame[self.frame]
        return np.where(self.truth >= 0, of_truth[self.truth], of_frame[self.frame])

    def declared_by(self, of_frame: IntArray, of_truth: IntArray, groups: int) -> IntArray:
        """(groups, K, 4) the count at the operating point, split as in `base_by`."""
        counts = self.base_by(of_frame, of_truth, groups)
        group = self.claims_by(of_frame, of_truth)[self.made]
        np.add.at(counts, (group, self.landmark[self.made]), self.made_effect)
        return counts

    def counts_per_log(self, joined: Joined) -> list[list[Count]]:
        """Per log the count at the operating point of each ID, then of all."""
        split = self.declared_by(joined.log, joined.log[joined.truth_frame], len(joined.logs))
        split = np.concatenate([split, split.sum(axis=1, keepdims=True)], axis=1)
        return [[Count(*cell) for cell in log] for log in split.tolist()]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What `evaluate` found. notes: worth knowing. unused: input that could not be used."""

    joined: Joined
    scored: tuple[Scored, ...]
    min_visible: float
    notes: tuple[str, ...]
    unused: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Pair:
    """The results folder of one log and the truth that goes with it.

    log: the log's name, where the folder's own is not wanted; the log column of the truth is
    matched with it.
    """

    results: Path
    ground_truth: Path
    log: str | None = None


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
    check_options(min_visible, tolerance_s)
    table = read_truth(ground_truth)
    folders = find_logs(results)
    logs = [read_log(folder, landmarks, sonar) for folder in folders]
    if len(logs) > 1 and table.log is None:
        raise SonarrecError(
            f"{ground_truth}: {results} holds {len(logs)} logs "
            f"({', '.join(log.name for log in logs)}), so the truth needs a log column that "
            "names their folders; or give the folder of one log"
        )
    truths = [match_truth(table, log, tolerance_s) for log in logs]
    unused = _unused(table, logs, truths, single=folders == [results])
    return pool(logs, truths, min_visible, unused)


def evaluate_pairs(
    pairs: Sequence[Pair],
    *,
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
) -> Evaluation:
    """Score several logs, each with a truth of its own, and pool them; see `evaluate`.

    Logs of equal name are told apart by their folders as given.
    """
    check_options(min_visible, tolerance_s)
    if not pairs:
        raise SonarrecError("no pair of results and ground truth to score")
    tables = {path: read_truth(path) for path in {pair.ground_truth for pair in pairs}}
    logs: list[LogResults] = []
    truths: list[Truth] = []
    unused: list[str] = []
    for pair in pairs:
        folders = find_logs(pair.results)
        if folders != [pair.results]:
            raise SonarrecError(
                f"{pair.results}: holds {len(folders)} logs; give each a row of its own"
            )
        log = read_log(pair.results, landmarks, sonar)
        log = log if pair.log is None else replace(log, name=pair.log)
        table = tables[pair.ground_truth]
        logs.append(log)
        truths.append(match_truth(table, log, tolerance_s))
        unused += _unused(table, logs[-1:], truths[-1:], single=True)
    names = [log.name for log in logs]
    if len(set(names)) < len(names):
        logs = [
            log if names.count(log.name) == 1 else replace(log, name=str(pair.results))
            for log, pair in zip(logs, pairs, strict=True)
        ]
    return pool(logs, truths, min_visible, unused)


def read_pairs(path: Path) -> list[Pair]:
    """Read a table of pairs: columns results, ground_truth and, if wanted, log.

    Paths are taken from the folder of the table. Raises SonarrecError where it cannot be used.
    """
    columns = ("results", "ground_truth")
    table = read_table(path, dict.fromkeys((*columns, "log"), "text"), columns, ",".join(columns))
    logs = [str(log) for log in table["log"]] if "log" in table else [None] * len(table["results"])
    return [
        Pair(path.parent / str(results), path.parent / str(truth), log)
        for results, truth, log in zip(*(table[c] for c in columns), logs, strict=True)
    ]


def check_options(min_visible: float, tolerance_s: float | None) -> None:
    """Raises UsageError where one of them cannot be meant."""
    if not 0 <= min_visible <= 1:
        raise UsageError(f"--min-visible is a share of the disc, 0 to 1, not {min_visible:g}")
    if tolerance_s is not None and not 0 <= tolerance_s < math.inf:
        raise UsageError(f"--tolerance is a time in seconds, 0 or more, not {tolerance_s:g}")


def pool(
    logs: Sequence[LogResults],
    truths: Sequence[Truth],
    min_visible: float,
    unused: Sequence[str] = (),
) -> Evaluation:
    """Score logs that were read, each with its truth, as one.

    Raises SonarrecError where their landmark IDs differ, or where they name no method.
    """
    for log in logs:
        if set(log.landmarks.ids) != set(logs[0].landmarks.ids):
            raise SonarrecError(
                f"logs {logs[0].name} and {log.name} were run with different landmark IDs and "
                "cannot be pooled; evaluate them one by one, or give --landmarks"
            )
    joined = join(logs, truths, min_visible)
    notes = _notes(joined, logs, truths)
    scored = tuple(
        score(joined, m, protocol)
        for m in range(len(joined.methods))
        for protocol in PROTOCOLS
        if protocol == "paper" or joined.placed
    )
    return Evaluation(joined, scored, min_visible, notes, tuple(unused))


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


def _notes(joined: Joined, logs: Sequence[LogResults], truths: Sequence[Truth]) -> tuple[str, ...]:
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
        missing = [m for m in joined.methods if m not in log.methods]
        if missing:
            notes.append(
                f"{log.name}: holds nothing of {', '.join(missing)}, which counts as no claim"
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
    positive = np.flatnonzero(joined.truth_positive)
    if protocol == "paper":
        positive = positive[np.unique(truth_cell[positive], return_index=True)[1]]
        of_cell = np.full(len(state), -1)
        of_cell[truth_cell[positive]] = positive
        truth = of_cell[cell]
        counted = state[cell] != IGNORED
        spot = cell
    else:
        truth = nearest_truth(joined, mine, cell, truth_cell)
        counted = np.ones(len(mine), dtype=bool)
        on_one = truth >= 0
        counted[on_one] = joined.truth_positive[truth[on_one]]
        spot = np.where(on_one, len(state) + truth, cell)
    mine, cell, truth, spot = mine[counted], cell[counted], truth[counted], spot[counted]

    negative = state.reshape(-1, k) == NEGATIVE
    base = np.zeros((k, 4), dtype=np.int64)
    base[:, 1] = np.count_nonzero(negative, axis=0)
    base[:, 3] = np.bincount(joined.truth_landmark[positive], minlength=k)
    right, absent = truth >= 0, state[cell] == NEGATIVE
    made = np.flatnonzero(joined.declared[mine])
    made_effect = _effects(protocol, right[made], absent[made], spot[made])
    landmark = joined.claim_landmark[mine]
    declared = base.copy()
    np.add.at(declared, landmark[made], made_effect)
    return Scored(
        protocol=protocol,
        method=joined.methods[method],
        ids=joined.ids,
        base=base,
        declared=declared,
        negative=negative,
        positive=positive,
        positive_landmark=joined.truth_landmark[positive],
        claim=mine,
        score=joined.score[mine],
        landmark=landmark,
        frame=joined.claim_frame[mine],
        truth=truth,
        effect=_effects(protocol, right, absent, spot),
        made=made,
        made_effect=made_effect,
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
