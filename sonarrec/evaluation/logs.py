"""Reads logs, matches them with their truth and counts them, in parallel if wanted."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np

from sonarrec.errors import Diagnostics, SonarrecError
from sonarrec.evaluation.count import LogCounts, count_log
from sonarrec.evaluation.match import Matched, ScoringOptions, match, nearest_truth
from sonarrec.evaluation.pairs import Pair
from sonarrec.results.folders import log_of
from sonarrec.results.read import LogResults, Recording, TruthOf, not_whole, read_log, recording
from sonarrec.results.run_file import read_run
from sonarrec.runs import cores
from sonarrec.truth.check import FEWEST, misfit, tell_fit, without_rows
from sonarrec.truth.match import Truth, match_truth
from sonarrec.truth.table import TruthTable, read_truth

WORTH_BYTES = 4_000_000
"""Bytes of tables per process; a process takes as long to start as to read so many."""


@dataclass(frozen=True, slots=True)
class UnreadableLog:
    """A log whose results or truth cannot be read."""

    name: str
    error: SonarrecError

    def message(self, action: str = "scored") -> str:
        """A message. action: what is done with other logs."""
        return f"{self.error}; {self.name} is not {action}"


@dataclass(frozen=True, slots=True)
class TruthCheck:
    """How a truth fits a log, without the rows of either."""

    name: str
    """Of the log."""
    table: Path
    table_rows: int
    rows: int
    """Those about this log; of them `unprocessed` and `between`, as of Truth."""
    unprocessed: int
    between: int
    frames: int
    fault: str | None
    """Why the truth does not fit the log; None if it does."""
    notes: list[str]


def check_fit(table: TruthTable, log: LogResults, truth: Truth) -> TruthCheck:
    """Check that the truth fits the log."""
    told, proposals = Diagnostics(), "they say nothing about the results that they came from"
    tell_fit(told, table, log, truth, "are scored", proposals)
    return TruthCheck(
        name=log.name,
        table=table.path,
        table_rows=len(table.at),
        rows=truth.rows,
        unprocessed=truth.unprocessed,
        between=truth.between,
        frames=len(log.frame),
        fault=misfit(table, log, truth),
        notes=told.notes,
    )


def _no_claim_right(log: Matched) -> str | None:
    """The doubt that a truth is that of the log, if it bears out no claim that the leading method
    declares; None if it does, or if either has few."""
    claims = np.flatnonzero(log.declared & (log.method_index == 0))
    if min(len(claims), len(log.truth_frame_index)) < FEWEST:
        return None
    ids = len(log.ids)
    claim_key = log.claim_frame_index[claims] * ids + log.claim_landmark_index[claims]
    truth_key = log.truth_frame_index * ids + log.truth_landmark_index
    named = f"none of the {len(claims)} claims of {log.methods[0]} in {log.name}"
    same = np.isin(claim_key, truth_key)
    if not same.any():
        return f"{named} has a row of its ID in its frame; is this the truth of another recording?"
    known = ~np.isnan(log.claim_position).any() and ~np.isnan(log.truth_position).any()
    if not known or np.count_nonzero(same) < FEWEST:
        return None
    if (nearest_truth(log, claims, claim_key, truth_key) >= 0).any():
        return None
    return (
        f"{named} lies within {log.gate_m:g} m of its row, though {np.count_nonzero(same)} have "
        "one in their frame; are these its positions, left and right, in these units?"
    )


def check_logs(checks: Sequence[TruthCheck]) -> tuple[list[str], list[str]]:
    """Notes on the logs whose truth fits, and a line for each other log.

    Raises SonarrecError if there is none whose truth fits, or if no truth has a row.
    """
    if not any(check.rows for check in checks):
        of = next((check for check in checks if check.table_rows), checks[0])
        names = [check.name for check in checks]
        raise SonarrecError(without_rows(of.table, of.table_rows, names, "nothing is scored"))
    faults = [check for check in checks if check.fault is not None]
    # A log without a row counts as empty, but only if others have rows.
    if faults and not any(check.rows for check in checks if check.fault is None):
        raise SonarrecError(str(faults[0].fault))
    notes = [note for check in checks if check.fault is None for note in check.notes]
    return notes, [f"{check.fault}; {check.name} is not scored" for check in faults]


@dataclass(slots=True)
class LogScore:
    """One log as it was read and counted."""

    folder: Path
    ground_truth: TruthOf | None
    """None if it has no row about the log."""
    name: str
    recording: Recording
    check: TruthCheck
    not_whole: list[str]
    """As `results.read.not_whole`."""
    counts: LogCounts | None
    """None if the truth does not fit the log, or once they are added to those of others."""


def score_log(
    pair: Pair, options: ScoringOptions, ids: tuple[int, ...]
) -> LogScore | UnreadableLog:
    """Read, match and count one log. ids: as of `match`."""
    try:
        table = truth_table(pair.ground_truth)
        log = read_log(pair.results, options.landmarks, options.sonar)
        log = log if pair.log is None else replace(log, name=pair.log)
        truth = match_truth(table, log, options.tolerance_s)
        lost = not_whole(log, "scored")
    except SonarrecError as fault:  # the other logs can be scored
        return UnreadableLog(pair.log or log_of(pair.results), fault)
    check, counts, rows = check_fit(table, log, truth), None, table.rows_of(log.name)
    if check.fault is None:
        matched = match(log, truth, options.min_visible, ids, within_m=options.within_m)
        if (doubt := _no_claim_right(matched)) is not None:
            check.notes.append(f"{table.path}: {doubt}")
        counts = count_log(matched)
    return LogScore(
        folder=pair.results,
        ground_truth=(pair.ground_truth, table.digest_of(rows)) if len(rows) else None,
        name=log.name,
        recording=recording(pair.results, log.run),
        check=check,
        not_whole=lost,
        counts=counts,
    )


def first_ids(folders: Iterable[Path], landmarks: str | None) -> tuple[int, ...]:
    """The landmark IDs of the first log whose run.toml can be read: all are counted in its order.

    landmarks: a set in place of that of run.toml.
    """
    for folder in folders:
        with suppress(SonarrecError):
            return read_run(folder / "run.toml").landmark_set(landmarks).ids
    return ()


@lru_cache(maxsize=1)
def truth_table(path: Path) -> TruthTable:
    """The table; cached, since one file may cover several logs."""
    return read_truth(path)


Log = TypeVar("Log")
Found = TypeVar("Found")


def map_logs(
    work: Callable[[Log], Found], readings: Sequence[Log], folders: Iterable[Path], jobs: int | None
) -> Iterator[Found]:
    """Yield the result of `work`, such as `score_log`, for each log, in order.

    folders: the results that are read. jobs: number of processes; default: the number of cores, or
    fewer if the results are small.
    Raises the first error that `work` raises.
    """
    truth_table.cache_clear()  # the files may have changed since the last call
    if jobs is None:
        jobs = min(cores(), sum(map(_bytes, folders)) // WORTH_BYTES)
    if min(jobs, len(readings)) < 2:
        yield from map(work, readings)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(readings)), context) as workers:
        try:
            ahead: deque[Future[Found]] = deque()  # some only: results are kept in memory
            for reading in readings:
                ahead.append(workers.submit(work, reading))
                if len(ahead) > 2 * jobs:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        except BrokenProcessPool:
            raise SonarrecError(
                "a process that read results was killed, perhaps for lack of memory; nothing was "
                "written; --jobs 1 reads one log at a time"
            ) from None
        finally:
            workers.shutdown(wait=False, cancel_futures=True)


def _bytes(folder: Path) -> int:
    with suppress(OSError, SonarrecError):  # reported when it is read
        return (folder / "estimates.csv").stat().st_size
    return 0
