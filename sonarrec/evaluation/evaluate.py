"""Scores results against truth: one folder, several, or a table of pairs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sonarrec.errors import Diagnostics, SonarrecError, local, number_of, printable
from sonarrec.evaluation.count import Adder, Counts
from sonarrec.evaluation.logs import (
    LogScore,
    UnreadableLog,
    check_logs,
    first_ids,
    map_logs,
    score_log,
)
from sonarrec.evaluation.match import DEFAULT, ScoringOptions, scoring_options
from sonarrec.evaluation.pairs import Pair, find_truths_beside, read_pairs, truth_note, usable_pairs
from sonarrec.evaluation.summary import summarise
from sonarrec.evaluation.tables import Evaluation
from sonarrec.results.read import CountedOnce, find_logs
from sonarrec.sonar import Sonar
from sonarrec.truth.check import tell_other_logs, tell_rows
from sonarrec.truth.table import TruthTable, read_truth


def evaluate(
    results: str | Path = "sonarrec_out",
    ground_truth: str | Path | None = None,
    *,
    pairs: str | Path | None = None,
    method: str | Sequence[str] = (),
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    within_m: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    jobs: int | None = 1,
    out: str | Path | None = None,
) -> Evaluation:
    """Score results, of one log or of several, against ground truth.

    `table` of the result has a row per method; figures, intervals and tests are those of the
    command. ground_truth: one table; default: the NAME.gt.csv, or gt.csv, beside each log. pairs: a
    CSV that names results and truth of each log, in place of both. out: a folder for the files;
    default: none is written. Of several results of one recording the first counts.

    A claim is an estimate that is declared (operating point) or whose score reaches the
    threshold (curves). A row with visible 0 is no row.

    Protocol "paper", per frame and ID: in view and claimed = TP, each further claim of it one TP
    more; in view and not claimed = FN; not in view and claimed, however often, = FP; else TN.
    Position plays no part. Half a disc or more is in view, anything less is not: as in the paper,
    every frame counts. Count.tpr_once is the TPR without the further claims.

    Protocol "strict": a landmark with visible >= min_visible is a positive; with less it is
    ignored. A claim belongs to the truth of its ID that is nearest in that frame, if
    its centre is within half a disc diameter, or within_m, of it in the fan plane. The first claim
    of a positive (the one of highest score) is TP; every further one, and every claim that belongs
    to no truth, is FP. A positive without a claim is FN, even if its ID is claimed elsewhere
    (FN and FP). Claims of a partly visible landmark are not counted. TN: a frame and ID of which
    nothing shows and which is not claimed. So an FP replaces a TN the first time an absent ID is
    claimed in a frame, and is an entry of its own otherwise: FPR = FP / (FP + TN) stays within
    0 to 1 and no false claim is free.

    method: one or several to score; default: all, the framework first.
    jobs: how many logs are read at once, each in its own process.
    Raises SonarrecError where files cannot be used or have no frame in common.
    """
    scoring = scoring_options(method, min_visible, tolerance_s, landmarks, sonar, within_m)
    logs = results if pairs is None else read_pairs(Path(pairs))
    found = evaluate_logs(logs, ground_truth, scoring, jobs=jobs)
    if out is not None:
        from sonarrec.evaluation.write import write_evaluation  # brings matplotlib

        write_evaluation(Path(local(out)), found)
    return found


def evaluate_logs(
    results: str | Path | Sequence[Pair],
    ground_truth: str | Path | None = None,
    options: ScoringOptions = DEFAULT,
    *,
    jobs: int | None = None,
) -> Evaluation:
    """Score a results folder, of one log or of several, or pairs of results and truth.

    Each log is read, matched and counted by itself, so that memory does not grow with the logs.
    jobs: number of processes, as in `logs.map_logs`; it does not change the result.
    Logs of equal name get the names of their folders.
    """
    options.check()
    found, told, others = Diagnostics(), Diagnostics(), Diagnostics()
    pairs = _pairs(results, ground_truth, found)
    folders = [pair.results for pair in pairs]
    table: TruthTable | None = None  # of all logs; None if each has its own
    if ground_truth is not None and isinstance(results, str | Path):
        results, table = Path(results), read_truth(Path(ground_truth))
    adder = Adder()
    read: list[LogScore] = []
    unread: list[UnreadableLog] = []
    once = CountedOnce("scored", told)
    kept: list[LogScore] = []
    work = partial(score_log, options=options, ids=first_ids(folders, options.landmarks))
    for log in map_logs(work, pairs, folders, jobs):
        if isinstance(log, UnreadableLog):
            unread.append(log)
            continue
        counts, log.counts = log.counts, None
        read.append(log)
        if once.add(log.folder, log.recording, log.ground_truth):
            kept.append(log)
            if counts is not None:
                adder.add(counts)
    if not read:
        raise unread[0].error
    names = [*(log.name for log in kept), *(log.name for log in unread)]
    if table is not None and table.log is None and len(names) > 1:
        raise SonarrecError(
            f"{table.path}: {results} holds {len(names)} logs ({', '.join(names)}), so the "
            "truth needs a log column that names their folders; or give the folder of one log"
        )
    fit_notes, misfits = check_logs([log.check for log in kept])
    scored = [log for log in kept if log.check.fault is None]
    pooled = adder.counts([log.folder for log in scored], options.methods)
    if table is not None:
        everyone = [*(log.name for log in read), *(log.name for log in unread)]
        tell_other_logs(others, table, everyone, "they are not scored")
    alone = folders == [results]  # one log was asked for: the rows of others are a note
    notes = [*found.notes, *told.notes, *fit_notes, *others.problems * alone]
    notes += _notes(scored, pooled)
    unused = [
        *found.problems,
        *(log.message() for log in unread),
        *misfits,
        *_left_out(scored, as_one=table is not None),
        *others.problems * (not alone),
        *told.problems,
    ]
    summary = summarise(pooled)
    return Evaluation(
        counts=pooled,
        summary=summary,
        min_visible=options.min_visible,
        folders=tuple(log.folder for log in scored),
        notes=(*map(printable, notes), *summary.notes),
        unused=tuple(map(printable, unused)),
    )


def _pairs(
    results: str | Path | Sequence[Pair],
    ground_truth: str | Path | None,
    told: Diagnostics,
) -> list[Pair]:
    """The logs to read with their truth; the arguments are those of `evaluate_logs`."""
    if not isinstance(results, str | Path):
        pairs, unused = usable_pairs(results)
    elif ground_truth is None:  # each log with the truth beside it
        pairs, unused = find_truths_beside(find_logs(Path(results)))
        told.note(*map(truth_note, pairs))
    else:
        return [Pair(folder, Path(ground_truth)) for folder in find_logs(Path(results))]
    told.problem(*unused)
    return pairs


def _left_out(scored: Sequence[LogScore], *, as_one: bool) -> Iterator[str]:
    """A line for each part of truth and results that is not scored. as_one: all share a truth."""
    for logs in [scored] if as_one else [[log] for log in scored]:
        checks = [log.check for log in logs]
        unprocessed = sum(check.unprocessed for check in checks)
        if unprocessed:
            frames = sum(check.frames for check in checks)
            yield (
                f"{checks[0].table}: {unprocessed} of {checks[0].table_rows} rows lie on frames "
                f"that were not processed; they are not scored ({number_of(frames, 'frame')} "
                "processed)"
            )
        for log in logs:
            yield from log.not_whole


def _notes(logs: Sequence[LogScore], counts: Counts) -> Iterator[str]:
    """Notes on what was scored, a line each. logs: those of `counts`."""
    if not counts.placed:
        yield (
            "the strict protocol is not scored: truth or estimates have no positions, or they are "
            "in pixels and the geometry is not known (give --sonar FILE)"
        )
    for part, log in zip(counts.parts, logs, strict=True):
        told = Diagnostics()
        tell_rows(told, part.name, log.check.rows, log.check.between)
        yield from told.notes
        if missing := [method for method in counts.methods if method not in part.methods]:
            yield f"{part.name}: has no estimates of {', '.join(missing)}; this counts as no claim"
    for part in counts.parts:
        if part.rounded:
            yield f"{part.name}: scores are rounded to six digits"
    for method in counts.methods:
        if not any(part.estimates.get(method) for part in counts.parts):
            yield f"{method}: no estimate at all"
    for k, landmark in enumerate(counts.ids):
        if not any(scored.base[:, k, 3].any() for scored in counts.scored):
            yield f"ID.{landmark} is never in view: its TPR is 0/0 and says nothing"
