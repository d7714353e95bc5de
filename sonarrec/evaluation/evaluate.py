"""Scores results against truth: one folder, several, or a table of pairs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.errors import Diagnostics, SonarrecError, number_of, printable
from sonarrec.evaluation.count import Adder, Counts
from sonarrec.evaluation.logs import (
    LogScore,
    LogToScore,
    UnreadableLog,
    check_logs,
    first_ids,
    map_logs,
    score_log,
)
from sonarrec.evaluation.match import DEFAULT, ScoringOptions
from sonarrec.evaluation.pairs import (
    FindBeside,
    Pair,
    find_truths_beside,
    truth_note,
    usable_pairs,
)
from sonarrec.evaluation.passes import UnitKind
from sonarrec.evaluation.summary import summarise
from sonarrec.evaluation.tables import Evaluation
from sonarrec.results.read import find_logs, read_frames
from sonarrec.results.same_log import CountedOnce
from sonarrec.truth.fits import tell_other_logs, tell_rows
from sonarrec.truth.table import TruthTable, read_truth


def evaluate_logs(
    results: str | Path | Sequence[Pair],
    ground_truth: str | Path | None = None,
    options: ScoringOptions = DEFAULT,
    *,
    unit: UnitKind | None = None,
    jobs: int | None = None,
    find_beside: FindBeside | None = None,
) -> Evaluation:
    """Score a results folder, of one log or of several, or pairs of results and truth.

    Each log is read, matched and counted by itself, so that memory does not grow with the logs.
    jobs: number of processes, as in `logs.map_logs`; it does not change the result. find_beside:
    finds truth beside logs on servers, as in `pairs.find_truths_beside`. Logs of equal name get
    the names of their folders.
    """
    inputs = _inputs(results, ground_truth, options, find_beside)
    folders = [folder for folder, *_ in inputs.logs]
    ids = first_ids(folders, options.landmarks)
    readings = [LogToScore(*log, options=options, ids=ids) for log in inputs.logs]
    adder = Adder()
    read: list[LogScore] = []
    unread: list[UnreadableLog] = []
    told = Diagnostics()
    once = CountedOnce(lambda i: np.asarray(read_frames(read[i].folder)["frame"]), "scored", told)
    kept: list[LogScore] = []
    for log in map_logs(score_log, readings, folders, jobs):
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
    table = inputs.table
    if table is not None and table.log is None and len(names) > 1:
        raise SonarrecError(
            f"{table.path}: {inputs.folder} holds {len(names)} logs ({', '.join(names)}), so the "
            "truth needs a log column that names their folders; or give the folder of one log"
        )
    faults = [UnreadableLog(log.name, log.error) for log in kept if log.error is not None]
    if len(faults) == len(kept):
        raise faults[0].error
    fit_notes, misfits = check_logs([log.check for log in kept if log.check is not None])
    scored = [log for log in kept if log.check is not None and log.check.fault is None]
    pooled = adder.counts([log.folder for log in scored], options.methods)
    others = Diagnostics()
    if table is not None:
        everyone = [*(log.name for log in read), *(log.name for log in unread)]
        tell_other_logs(others, table, everyone, "they are not scored")
    alone = folders == [inputs.folder]  # one log was asked for: the rows of others are a note
    notes = [*inputs.notes, *told.notes, *fit_notes, *others.problems * alone]
    notes += _notes(scored, pooled)
    unused = [
        *inputs.unused,
        *(log.message() for log in [*unread, *faults]),
        *misfits,
        *_left_out(inputs, scored),
        *others.problems * (not alone),
        *told.problems,
    ]
    summary = summarise(pooled, unit)
    return Evaluation(
        counts=pooled,
        summary=summary,
        min_visible=options.min_visible,
        folders=tuple(log.folder for log in scored),
        notes=(*map(printable, notes), *summary.notes),
        unused=tuple(map(printable, unused)),
    )


@dataclass(frozen=True, slots=True)
class _Inputs:
    """The logs to read, with their truth."""

    logs: list[tuple[Path, Path, str | None]]
    """Results, truth and, if it is not that of the folder, name of each."""
    notes: list[str]
    unused: list[str]
    table: TruthTable | None = None
    """The truth of all logs; None if each has its own."""
    folder: Path | None = None
    """If there is a `table`: the results folder as given."""


def _inputs(
    results: str | Path | Sequence[Pair],
    ground_truth: str | Path | None,
    options: ScoringOptions,
    find_beside: FindBeside | None,
) -> _Inputs:
    """The logs to read and their truth; the arguments are those of `evaluate_logs`."""
    options.check()
    if not isinstance(results, str | Path):
        pairs, unused = usable_pairs(results)
        return _Inputs([(p.results, p.ground_truth, p.log) for p in pairs], [], unused)
    folders = find_logs(Path(results))
    if ground_truth is None:  # each log with the truth beside it
        pairs, without = find_truths_beside(folders, find_beside)
        logs = [(p.results, p.ground_truth, p.log) for p in pairs]
        return _Inputs(logs, list(map(truth_note, pairs)), without)
    path = Path(ground_truth)
    table = read_truth(path)
    return _Inputs([(folder, path, None) for folder in folders], [], [], table, Path(results))


def _left_out(inputs: _Inputs, scored: Sequence[LogScore]) -> Iterator[str]:
    """A line for each part of truth and results that is not scored."""
    for logs in [scored] if inputs.table is not None else [[log] for log in scored]:
        checks = [log.check for log in logs if log.check is not None]
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
        assert log.check is not None
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
