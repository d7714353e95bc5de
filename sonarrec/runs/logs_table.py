"""OUT/logs.csv: one row for each log that was run into OUT."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from threading import Timer
from time import monotonic
from typing import Any

from sonarrec.errors import SonarrecError
from sonarrec.results.folders import LockedError, locked, part_of
from sonarrec.runs.job import Event, Job, Outcome, Status
from sonarrec.tables.outputs import as_cell, below, is_filled, write_csv

NAME = "logs.csv"
WRITE_EVERY_S = 1.0
USABLE = ("done", "partial")


@dataclass(frozen=True, slots=True)
class Row:
    """A row of logs.csv; its fields are the columns."""

    log: str
    """Name of its results folder."""
    path: str
    """As given."""
    status: Status
    frames: int = 0
    """Processed."""
    unusable: int = 0
    """Frames that could not be used."""
    seconds: float = 0.0
    """Duration of its last run; 0: not known."""
    declared: int = 0
    """Passes in sightings.csv, of methods that track objects."""
    message: str = ""
    """What could not be used, or why it failed; or "stopped"."""


COLUMNS = tuple(f.name for f in fields(Row))


class LogsTable:
    """The rows of one call's logs, kept in OUT/logs.csv with those of other calls.

    The file is replaced as a whole, at most every WRITE_EVERY_S; the end of a log is in it after
    that time at the latest. Calls that write into one OUT at the same time, such as those of
    --shard, take turns and keep each other's rows.
    """

    def __init__(self, out: Path, jobs: Sequence[Job], *, alone: bool = False) -> None:
        """alone: there is a single log; if that gives no results, the file is not written."""
        self._alone = alone
        self._path = out / NAME
        self._rows = [Row(as_cell(job.name), as_cell(job.path), "waiting") for job in jobs]
        self._seconds: dict[str, float] = {}  # of finished runs of earlier calls
        with suppress(SonarrecError):
            before = read_logs(self._path)
            self._seconds = {row.log: row.seconds for row in before if row.status in USABLE}
        self._run_elsewhere: set[str] = set()  # logs that another call is running
        self._written_at_s = -math.inf
        self._later = Timer(WRITE_EVERY_S, self.write)
        self.fault: str | None = None  # why the file could not be written

    @property
    def rows(self) -> tuple[Row, ...]:
        """Those of this call."""
        return tuple(self._rows)

    def add(self, i: int, event: Event) -> None:
        """What happened to job i."""
        if isinstance(event, Outcome):
            row = self._rows[i]
            if isinstance(event.error, LockedError):
                self._run_elsewhere.add(row.log)
            before_s = self._seconds.get(row.log, 0.0)
            self._rows[i] = replace(
                row,
                status=event.status,
                frames=event.frames if event.error is None else row.frames,
                unusable=event.unusable,
                seconds=before_s if event.up_to_date else round(event.seconds, 2),
                declared=sum(event.passes.values()),
                message=as_cell(event.message),
            )
        elif isinstance(event, tuple):
            self._rows[i] = replace(self._rows[i], status="running", frames=event[0])
        if monotonic() >= self._written_at_s + WRITE_EVERY_S:
            self.write()
        elif isinstance(event, Outcome):  # the next event may come hours later
            self._later.cancel()
            self._later = Timer(WRITE_EVERY_S, self.write)
            self._later.start()

    def stopped(self) -> None:
        """The call was stopped: running logs become waiting, with their frames so far."""
        for i, row in enumerate(self._rows):
            if row.status == "running":
                frames_file = part_of(self._path.with_name(row.log)) / "frames.csv"
                frames = row.frames  # the last number reported
                with suppress(OSError), frames_file.open("rb") as file:
                    frames = sum(1 for _ in file) - 1
                self._rows[i] = replace(row, status="waiting", frames=frames, message="stopped")

    def write(self) -> None:
        """Write the rows as they are now; `fault` says if that failed."""
        self._later.cancel()
        self.fault, self._written_at_s = None, monotonic()
        if self._alone and not (self._rows[0].frames or self._rows[0].status == "done"):
            return
        try:
            below(self._path.parent, NAME).parent.mkdir(parents=True, exist_ok=True)
            with _file_lock(self._path.parent):
                before = read_logs(self._path) if is_filled(self._path) else []
                rows = map(astuple, self._merged(before).values())
                write_csv(self._path, COLUMNS, rows)
        except OSError as error:
            self.fault = f"{self._path}: cannot be written ({error.strerror})"
        except SonarrecError as error:  # the file there is another kind of table
            self.fault = str(error)

    def _merged(self, before: Sequence[Row]) -> dict[tuple[str, str], Row]:
        """The rows of this call and those that other calls wrote before, by key."""
        usable = {row.log for row in before if row.status in USABLE}
        own = {
            (row.log, row.path): row
            for row in self._rows
            if row.log not in self._run_elsewhere & usable
        }
        # A log may be refused because another log of its name has results there. Then both keep a
        # row, until this log has results too.
        ended = {row.log for row in own.values() if row.status in USABLE}
        others = (row for row in before if row.log not in ended or (row.log, row.path) in own)
        return {(row.log, row.path): row for row in others} | own


@contextmanager
def _file_lock(folder: Path) -> Iterator[None]:
    """Wait until no other call writes the file, if the file system supports locks."""
    with ExitStack() as stack:
        with suppress(OSError):
            handle = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, handle)
            locked(handle, wait=True)
        yield


def read_logs(path: Path) -> list[Row]:
    """The rows of a logs.csv; none if there is no such file.

    Raises SonarrecError if it is not such a table, or has columns of its own.
    """
    kinds: dict[str, Callable[[str], Any]] = dict.fromkeys(("frames", "unusable", "declared"), int)
    kinds["seconds"] = float
    rows = []
    try:
        with path.open(encoding="utf-8", errors="surrogateescape", newline="") as file:
            table = csv.DictReader(file)
            if set(COLUMNS) != set(table.fieldnames or ()):
                raise ValueError
            for cells in table:
                rows.append(Row(**{name: kinds.get(name, str)(cells[name]) for name in COLUMNS}))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    except (TypeError, ValueError, csv.Error):
        line = max(table.line_num, 1)
        raise SonarrecError(
            f"{path} line {line}: not a row of {','.join(COLUMNS)}; rename or delete the file"
        ) from None
    return rows
