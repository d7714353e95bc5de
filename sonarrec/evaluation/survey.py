"""Reads logs, matches them with their truth and counts them, in parallel if wanted."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TypeVar

from sonarrec.errors import SonarrecError
from sonarrec.evaluation.counting.parts import Part, part_of
from sonarrec.evaluation.matching.fit import MatchedLog, TruthCheck, check_fit
from sonarrec.evaluation.matching.joined import join
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.results.folders import estimates_of, log_of
from sonarrec.results.read import read_log
from sonarrec.results.same_log import Recording, TruthOf, recording
from sonarrec.runs.cores import cores
from sonarrec.truth.match import match_truth
from sonarrec.truth.table import TruthTable, read_truth

WORTH_BYTES = 4_000_000
"""Bytes of tables per process; a process takes as long to start as to read so many."""


@dataclass(frozen=True, slots=True)
class LogToScore:
    """One log to be read and scored."""

    folder: Path
    ground_truth: Path
    options: ScoringOptions
    log: str | None = None
    """The log's name; None: the name of the folder."""
    ids: tuple[int, ...] | None = None
    """Its IDs in the wanted order; None: the order of its landmark set."""


@dataclass(frozen=True, slots=True)
class UnreadableLog:
    """A log whose results or truth cannot be read."""

    name: str
    error: SonarrecError

    def message(self, action: str = "scored") -> str:
        """A message. action: what is done with other logs."""
        return f"{self.error}; {self.name} is not {action}"


@dataclass(frozen=True, slots=True)
class SurveyedLog:
    """One log as it was read."""

    folder: Path
    ground_truth: TruthOf
    name: str
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    recording: Recording
    truth_check: TruthCheck | None
    """None if truth and log could not be matched; then `error` says why."""
    error: SonarrecError | None
    case: MatchedLog | None
    """All that was read, if `whole` was set and log and truth match."""
    part: Part | None
    """The counts, if the log can be scored."""


def survey(reading: LogToScore, *, whole: bool = False) -> SurveyedLog | UnreadableLog:
    """Read and count one log. whole: also keep all that was read."""
    options = reading.options
    try:
        table = truth_table(reading.ground_truth)
        log = read_log(reading.folder, options.landmarks, options.sonar)
    except SonarrecError as fault:  # the other logs can be scored
        return UnreadableLog(reading.log or log_of(reading.folder), fault)
    log = log if reading.log is None else replace(log, name=reading.log)
    case: MatchedLog | None = None
    truth_check: TruthCheck | None = None
    error: SonarrecError | None = None
    try:
        case = MatchedLog(log, table, match_truth(table, log, options.tolerance_s))
        truth_check = check_fit(case)
    except SonarrecError as fault:  # raised later, unless the log is a copy of another
        error = fault
    part = None
    if case is not None and truth_check is not None and truth_check.fault is None:
        part = part_of(join([log], [case.truth], options.min_visible, reading.ids))
    rows = table.rows_of(log.name)
    return SurveyedLog(
        folder=reading.folder,
        ground_truth=TruthOf(reading.ground_truth, log.name, len(rows), table.digest_of(rows)),
        name=log.name,
        ids=log.landmarks.ids,
        methods=log.methods,
        recording=recording(reading.folder, log.run, len(log.frame_index)),
        truth_check=truth_check,
        error=error,
        case=case if whole else None,
        part=part,
    )


@lru_cache(maxsize=1)
def truth_table(path: Path) -> TruthTable:
    """The table; cached, since one file may cover several logs."""
    return read_truth(path)


Log = TypeVar("Log")
Counts = TypeVar("Counts")


def map_logs(
    work: Callable[[Log], Counts],
    readings: Sequence[Log],
    folders: Iterable[Path],
    jobs: int | None,
) -> Iterator[Counts]:
    """Yield the result of `work`, such as `survey`, for each log, in order.

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
            yield from _in_order((partial(workers.submit, work, r) for r in readings), jobs)
        except BrokenProcessPool:
            raise SonarrecError(
                "a process that read results was killed, perhaps for lack of memory; nothing was "
                "written; --jobs 1 reads one log at a time"
            ) from None
        finally:
            workers.shutdown(wait=False, cancel_futures=True)


def _in_order(starts: Iterable[Callable[[], Future[Counts]]], jobs: int) -> Iterator[Counts]:
    """Results in order; only some tasks run ahead, since their results are kept in memory."""
    ahead: deque[Future[Counts]] = deque()
    for start in starts:
        ahead.append(start())
        if len(ahead) > 2 * jobs:
            yield ahead.popleft().result()
    while ahead:
        yield ahead.popleft().result()


def _bytes(folder: Path) -> int:
    with suppress(OSError, SonarrecError):  # reported when it is read
        return estimates_of(folder).stat().st_size
    return 0
