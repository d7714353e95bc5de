"""Scores results against truth: one folder, several, or a table of pairs.

Each log is read, matched and counted by itself, so that memory does not grow with the logs.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonarrec.errors import Advice, Diagnostics, SonarrecError, listed, number_of, printable
from sonarrec.evaluation.counts import CountedLog, Counts, add_up, count_log
from sonarrec.evaluation.figures import summarise
from sonarrec.evaluation.pairs import Pair, find_truths, usable_pairs
from sonarrec.evaluation.rows import DEFAULT, Matched, ScoringOptions, match
from sonarrec.evaluation.write import Evaluation
from sonarrec.results.folders import log_of
from sonarrec.results.read import (
    CountedOnce,
    LogResults,
    Recording,
    check_one_log,
    find_logs,
    read_log,
    recording,
    rows_of,
    why_incomplete,
)
from sonarrec.runs.logs_table import NAME, read_logs
from sonarrec.runs.recorded import outdated
from sonarrec.truth.check import misfit, report_other_logs, report_rows, without_rows
from sonarrec.truth.match import Truth, match_truth
from sonarrec.truth.table import TruthTable, read_truth

MOST_NAMED = 6
"""IDs, or logs, that a line names."""


class LogToScore(NamedTuple):
    """The results of one log, or its old and its new ones, and its truth."""

    results: tuple[Path, ...]
    ground_truth: Path
    name: str
    """Of the log, also for the log column of the truth."""


class LogTables(NamedTuple):
    """What one log is scored by. Both of old and new results, or of the only ones."""

    truth: TruthTable
    results: list[LogResults]
    """On their common frames, whether labelled or not."""
    truths: list[Truth]
    """The truth as matched to each."""
    matched: list[Matched]
    """Each with its truth, on the frames that count; empty if the truth does not fit."""


@dataclass(slots=True)
class LogScore:
    """One log as it was read and counted, without its tables."""

    log: LogToScore
    recording: Recording
    has_log_column: bool
    """Whether the truth can be of several logs."""
    rows: tuple[int, int, int, int]
    """Of the truth: all, those about this log (also that it holds nothing), of them unprocessed and
    between; see Truth."""
    frames: int
    left_out: int
    """Frames that are not labelled, if only labelled ones count."""
    ids: tuple[int, ...]
    """Of its landmark set, in the order in which they are counted."""
    fault: str | None
    """Why the truth does not fit the log; None if it does."""
    notes: list[str]
    unused: list[str]
    """A line for each part of the results that is not used."""


Advise = Callable[[LogToScore, LogTables, ScoringOptions], Iterable[Advice]]
"""Called with each log that is scored, while its tables are there: what else to tell of it."""
Orders = dict[frozenset[int], tuple[int, ...]]
"""The IDs of each landmark set, in the order of the first log that has them."""


def score_log(
    log: LogToScore, options: ScoringOptions, orders: Orders
) -> tuple[LogScore, LogTables]:
    """Read and match one log, old and new results on their common frames.

    orders: its own is added. Raises SonarrecError if its results or its truth cannot be read.
    """
    table = _truth_table(log.ground_truth)
    sides = [
        replace(read_log(folder, options.landmarks, options.sonar), name=log.name)
        for folder in log.results
    ]
    options.check_against(sides[-1])
    source = recording(log.results[-1], sides[-1].run)
    common, unused = sides[0].frame, list[str]()
    notes = [
        f"{folder}: its model was learned from a log called {side.run.input.name}; if it is this "
        "one, the rates are too good: score logs that the model was not learned from"
        for folder, side in zip(log.results, sides, strict=True)
        if side.run.is_trained_on
    ]
    if sides[1:]:
        notes += _check_comparable(log.results, sides)
        common = np.intersect1d(common, sides[1].frame)
        if not len(common):
            raise SonarrecError(f"{' and '.join(map(str, log.results))} have no frame in common")
    for folder, side in zip(log.results, sides, strict=True):
        if alone := len(side.frame) - len(common):
            frames = number_of(alone, "frame")
            unused.append(f"{log.name}: {frames} in {folder} only; not compared")
        unused += why_incomplete(side, "scored")
    if sides[1:]:
        sides = [_only(side, common) for side in sides]
    last = sides[-1]
    # Each side is scored as by itself: pixels lie where its own geometry puts them.
    truths = [
        match_truth(table, replace(last, fan=side.fan or last.fan), options.tolerance_s)
        for side in sides
    ]
    truth, fault, matched = truths[-1], misfit(table, last, truths[-1]), list[Matched]()
    ids = orders.setdefault(frozenset(last.landmarks.ids), last.landmarks.ids)
    counted, left_out = (sides, truths), 0
    if fault is None:
        if options.labelled_only:
            none = match_truth(table, last, options.tolerance_s, strangers=True)
            labelled = np.union1d(truth.frame_index, none.frame_index)
            left_out = len(last.frame) - len(labelled)
            counted = (
                [_only(side, last.frame[labelled]) for side in sides],
                [
                    replace(rows, frame_index=np.searchsorted(labelled, rows.frame_index))
                    for rows in truths
                ],
            )
        matched = [match(*side, options, ids) for side in zip(*counted, strict=True)]
    none_rows = len(table.rows_of(last.name, strangers=True))
    score = LogScore(
        log=log,
        recording=source,
        has_log_column=table.log is not None,
        rows=(len(table.keys), truth.rows + none_rows, truth.unprocessed, truth.between),
        frames=len(last.frame),
        left_out=left_out,
        ids=ids,
        fault=fault,
        notes=notes,
        unused=unused,
    )
    return score, LogTables(table, sides, truths, matched)


def _check_comparable(folders: Sequence[Path], sides: Sequence[LogResults]) -> Iterator[str]:
    """Notes on two results. Raises SonarrecError if they cannot be compared."""
    (old, new), (a, b) = folders, (side.run for side in sides)
    note = check_one_log(old, a, new, b)
    if note:
        yield note
    ids = [side.landmarks.ids for side in sides]
    if ids[0] != ids[1]:
        both = " and ".join(", ".join(map(str, side)) for side in ids)
        raise SonarrecError(
            f"{old} and {new}: run with the landmark IDs {both}; only results with the same IDs "
            "in the same order can be compared; give one set for both (--landmarks; `landmarks` in "
            "a check file)"
        )


def _only(log: LogResults, frames: np.ndarray) -> LogResults:
    """The results on the frames of these numbers."""
    among = np.isin(log.frame, frames)
    kept = rows_of(log, among[log.frame_index])
    return replace(
        kept,
        frame=log.frame[among],
        timestamp_ns=None if log.timestamp_ns is None else log.timestamp_ns[among],
        stretch=log.stretch[among],
        frame_index=(np.cumsum(among) - 1)[kept.frame_index],
    )


@lru_cache(maxsize=1)
def _truth_table(path: Path) -> TruthTable:
    """The table; cached, since one file may cover several logs."""
    return read_truth(path)


def score_logs(
    logs: Sequence[LogToScore],
    options: ScoringOptions,
    action: str,
    diagnostics: Diagnostics,
    one_truth_of: object = None,
    advise: Advise | None = None,
) -> tuple[list[LogScore], list[Counts], list[str]]:
    """Read, match and count the logs, and note what is not used.

    action: what is done with the logs, such as "scored". one_truth_of: what one truth is for, where
    it is given for all logs. Returns the logs that can be scored, the counts of their results, old
    and new, on the same frames and passes, and the names of all logs. Logs of different landmark
    sets do not add up: those of the set that most have are scored.
    Raises SonarrecError if no log can be scored.
    """
    read: list[LogScore] = []
    kept: list[LogScore] = []
    unread: list[tuple[str, SonarrecError]] = []  # the others can be scored
    copies = Diagnostics()
    once = CountedOnce(action, copies)
    orders: Orders = {}
    counted = defaultdict[tuple[int, ...], list[list[CountedLog]]](list)  # by the IDs
    _truth_table.cache_clear()  # the files may have changed since the last call
    for log in logs:
        try:
            score, tables = score_log(log, options, orders)
        except SonarrecError as error:
            unread.append((log.name, error))
            continue
        read.append(score)
        if once.add(score.log.results[-1], score.recording):
            kept.append(score)
            if advise is not None and score.fault is None:
                lines = Diagnostics()
                lines.advise(advise(log, tables, options))
                score.unused[:0] = lines.problems
                score.notes += lines.notes
            if score.fault is None:
                rates_only = len(log.results) > 1
                both = [count_log(side, rates_only=rates_only) for side in tables.matched]
                counted[score.ids].append(both)
        del tables  # before the next log is read
    if not read:
        raise unread[0][1]
    names = [*(score.log.name for score in kept), *(name for name, _ in unread)]
    if one_truth_of and not kept[0].has_log_column and len(names) > 1:
        raise SonarrecError(
            f"{logs[0].ground_truth}: {one_truth_of} holds {len(names)} logs ({', '.join(names)}), "
            "so the truth needs a log column that names their folders; or give the folder of one"
        )
    scored = [score for score in kept if score.fault is None]
    if not any(score.rows[1] for score in kept):
        first = next((score for score in kept if score.rows[0]), kept[0])
        path, about = first.log.ground_truth, [score.log.name for score in kept]
        raise SonarrecError(without_rows(path, first.rows[0], about, "nothing is scored"))
    # A log without a row counts as empty, but only if others have rows.
    if len(scored) < len(kept) and not any(score.rows[1] for score in scored):
        raise SonarrecError(next(str(score.fault) for score in kept if score.fault is not None))
    ids = Counter(score.ids for score in scored).most_common(1)[0][0]
    others = [score for score in scored if score.ids != ids]
    scored = [score for score in scored if score.ids == ids]
    diagnostics.problem(*(line for score in scored for line in score.unused))
    diagnostics.problem(*_other_sets(others, ids, len(scored), action))
    diagnostics.problem(*(f"{error}; {name} is not {action}" for name, error in unread))
    diagnostics.problem(
        *(f"{s.fault}; {s.log.name} is not scored" for s in kept if s.fault is not None)
    )
    diagnostics.problem(*copies.problems)
    diagnostics.note(*outdated([folder for score in scored for folder in score.log.results]))
    diagnostics.note(*copies.notes)
    diagnostics.note(*(note for score in scored for note in score.notes))
    folders = [score.log.results[-1] for score in scored]
    methods = options.methods if len(logs[0].results) == 1 else ()
    sides = [add_up(side, folders, methods) for side in zip(*counted[ids], strict=True)]
    for score, name in zip(scored, sides[0].logs, strict=True):
        report_rows(diagnostics, name, score.rows[1], score.rows[3])
    return scored, sides, names


def _other_sets(
    others: Sequence[LogScore], ids: tuple[int, ...], scored: int, action: str
) -> Iterator[str]:
    """A line for each landmark set but that of most logs. ids: of the logs that count."""
    for own in dict.fromkeys(score.ids for score in others):
        first, *rest = (score.log for score in others if score.ids == own)
        more = f" and {number_of(len(rest), 'more log')}" if rest else ""
        yield (
            f"{first.results[-1]}{more}: landmark IDs {listed(own, MOST_NAMED)}, where the "
            f"{number_of(scored, 'log')} {action} have {listed(ids, MOST_NAMED)}; not {action}, "
            "since rates of different sets do not add up"
        )


def evaluate_logs(
    results: str | Path | Sequence[Pair],
    ground_truth: str | Path | None = None,
    options: ScoringOptions = DEFAULT,
    advise: Advise | None = None,
) -> Evaluation:
    """Score a results folder, of one log or of several, or pairs of results and truth.

    Logs of equal name get the names of their folders. advise: its lines are among `notes` and
    `unused`.
    """
    options.check()
    diagnostics, table = Diagnostics(), None  # the table of all logs; None if each has its own
    if isinstance(results, str | Path):
        results, truths = Path(results), None if ground_truth is None else Path(ground_truth)
        if truths is not None and not truths.is_dir():
            table = read_truth(truths)
        pairs = find_truths(find_logs(results), diagnostics, truths)
    else:
        pairs = usable_pairs(results, diagnostics)
    logs = [LogToScore((p.results,), p.ground_truth, p.log or log_of(p.results)) for p in pairs]
    one_truth_of = table and results
    scored, [counts], names = score_logs(logs, options, "scored", diagnostics, one_truth_of, advise)
    diagnostics.problem(*_unprocessed(scored, as_one=table is not None))
    if table is not None:
        others = Diagnostics()
        report_other_logs(others, table, names, "they are not scored")
        # If one log was asked for the rows of others are a note.
        add = (
            diagnostics.note
            if [log.results for log in logs] == [(results,)]
            else diagnostics.problem
        )
        add(*others.problems)
    if isinstance(results, Path):
        diagnostics.note(*_failed(results))
    diagnostics.note(*_notes(counts))
    summary = summarise(counts)
    return Evaluation(
        counts=counts,
        summary=summary,
        min_visible=options.min_visible,
        folders=tuple(score.log.results[-1] for score in scored),
        truths=tuple(score.log.ground_truth for score in scored),
        notes=(*map(printable, diagnostics.notes), *summary.notes),
        unused=tuple(map(printable, diagnostics.problems)),
        left_out=sum(score.left_out for score in scored) if options.labelled_only else None,
    )


def _unprocessed(scored: Sequence[LogScore], *, as_one: bool) -> Iterator[str]:
    """A line for each truth with rows on frames without results. as_one: all logs share one."""
    for logs in [scored] if as_one else [[score] for score in scored]:
        if unprocessed := sum(score.rows[2] for score in logs):
            frames = number_of(sum(score.frames for score in logs), "frame")
            yield (
                f"{logs[0].log.ground_truth}: {unprocessed} of {logs[0].rows[0]} rows lie on "
                f"frames that were not processed; they are not scored ({frames} processed)"
            )


def _failed(results: Path) -> Iterator[str]:
    """A note on logs that have no results, since they failed."""
    with suppress(SonarrecError):  # a table of another program
        failed = [row.log for row in read_logs(results / NAME) if row.status == "failed"]
        failed = [log for log in failed if not (results / log / "frames.csv").is_file()]
        if failed:
            names = listed(failed, MOST_NAMED)
            yield f"{number_of(len(failed), 'log')} failed: {names} ({NAME} says why)"


def _notes(counts: Counts) -> Iterator[str]:
    """Notes on what was scored, a line each."""
    if not counts.placed:
        yield (
            "the strict protocol is not scored: truth or estimates have no positions, or they are "
            "in pixels and the geometry is not known (give --sonar FILE)"
        )
    yield from lacks(counts)
    base = counts.rows("base")
    in_view = {*base["landmark"][base["fn"] > 0].tolist()}
    unseen = [f"ID.{landmark}" for landmark in counts.ids if landmark not in in_view]
    if unseen:
        yield f"never in view: {', '.join(unseen)}; a TPR of 0/0 says nothing"


def lacks(counts: Counts) -> Iterator[str]:
    """A note on each log without estimates of a method that others have."""
    for log, missing in counts.lacking():
        yield f"{log}: has no estimates of {', '.join(missing)}; this counts as no claim"
