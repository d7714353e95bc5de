"""Logs read, matched with their truth and counted, one at a time or several side by side."""

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
from typing import Protocol, TypeVar

from sonarrec.batch.cores import cores
from sonarrec.evaluation.counting.parts import Part, part_of
from sonarrec.evaluation.matching.fit import Checked, Matched, checked, matched
from sonarrec.evaluation.matching.joined import join
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.records import SonarrecError, shown
from sonarrec.results.counted_once import Recording, TruthOf, recording
from sonarrec.results.folders import estimates_of
from sonarrec.results.read import read_log
from sonarrec.truth.table import TruthTable, read_truth

WORTH_BYTES = 4_000_000
"""Of tables, for each process: it takes half a second to start, in which so much is read."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One log to be read and scored."""

    folder: Path
    ground_truth: Path
    options: ScoringOptions
    log: str | None = None
    """Its name, where the folder's own is not wanted."""
    ids: tuple[int, ...] | None = None
    """The order that its IDs are wanted in; default, that of its landmark set."""

    @property
    def folders(self) -> tuple[Path, ...]:
        return (self.folder,)


@dataclass(frozen=True, slots=True)
class Unread:
    """A log whose results or truth cannot be read, and why."""

    name: str
    error: SonarrecError

    def told(self, done: str = "scored") -> str:
        return f"{self.error}; {self.name} is not {done}"


@dataclass(frozen=True, slots=True)
class Surveyed:
    """What was found of one log."""

    folder: Path
    ground_truth: TruthOf
    name: str
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    recording: Recording
    between: int
    """Rows of its truth that lie between frames."""
    checked: Checked | None
    """None where truth and log could not be matched: see `error`."""
    error: SonarrecError | None
    case: Matched | None
    """All that was read, where the whole was asked for and log and truth match."""
    part: Part | None
    """The counts, where the whole was not asked for and the log can be scored."""


def survey(reading: Reading, *, whole: bool = False) -> Surveyed | Unread:
    """Read one log. whole: keep all that was read, and count nothing."""
    options = reading.options
    try:
        table = truth_table(reading.ground_truth)
        log = read_log(reading.folder, options.landmarks, options.sonar)
    except SonarrecError as fault:  # the other logs can be scored
        return Unread(reading.log or shown(reading.folder.resolve().name), fault)
    log = log if reading.log is None else replace(log, name=reading.log)
    case: Matched | None = None
    found: Checked | None = None
    error: SonarrecError | None = None
    try:
        case = matched(reading.folder, table, log, options.tolerance_s)
        found = checked(case)
    except SonarrecError as fault:  # of a log that counts already it does not matter
        error = fault
    part = None
    if case is not None and found is not None and found.fault is None and not whole:
        part = part_of(join([log], [case.truth], options.min_visible, reading.ids))
    rows = table.rows_of(log.name)
    return Surveyed(
        folder=reading.folder,
        ground_truth=TruthOf(reading.ground_truth, log.name, len(rows), table.digest_of(rows)),
        name=log.name,
        ids=log.landmarks.ids,
        methods=log.methods,
        recording=recording(reading.folder, log.run, len(log.frame_index)),
        between=0 if case is None else case.truth.between,
        checked=found,
        error=error,
        case=case if whole else None,
        part=part,
    )


@lru_cache(maxsize=1)
def truth_table(path: Path) -> TruthTable:
    """The table; that of the log before as well, where one file covers several."""
    return read_truth(path)


class Readable(Protocol):
    """What is read of one log."""

    @property
    def folders(self) -> tuple[Path, ...]: ...


Asked = TypeVar("Asked", bound=Readable)
Found = TypeVar("Found")


def each(
    work: Callable[[Asked], Found], readings: Sequence[Asked], jobs: int | None
) -> Iterator[Found]:
    """`work`, such as `survey`, of each, in their order; jobs: that many processes side by side.

    By default as many as there are cores, and fewer of logs so small that it would not pay.
    Raises what `work` raises, of the first log that raises anything.
    """
    truth_table.cache_clear()  # the files may have changed since the last call
    if jobs is None:
        jobs = min(cores(), sum(map(_bytes, readings)) // WORTH_BYTES)
    if min(jobs, len(readings)) < 2:
        yield from map(work, readings)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(readings)), context) as workers:
        try:
            yield from _in_order((partial(workers.submit, work, r) for r in readings), jobs)
        except BrokenProcessPool:
            raise SonarrecError(
                "a process that read results was ended from outside, as when memory runs out; "
                "nothing was written; with --jobs 1 the logs are read one after the other"
            ) from None
        finally:
            workers.shutdown(wait=False, cancel_futures=True)


def _in_order(starts: Iterable[Callable[[], Future[Found]]], jobs: int) -> Iterator[Found]:
    """Results as they were asked for; only some ahead, for each is held until its turn."""
    ahead: deque[Future[Found]] = deque()
    for start in starts:
        ahead.append(start())
        if len(ahead) > 2 * jobs:
            yield ahead.popleft().result()
    while ahead:
        yield ahead.popleft().result()


def _bytes(reading: Readable) -> int:
    total = 0
    for folder in reading.folders:
        with suppress(OSError):  # told where it is read
            total += estimates_of(folder).stat().st_size
    return total
