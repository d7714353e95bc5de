"""OUT/logs.csv: one row for each log that was run into OUT."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from time import monotonic
from typing import Any, get_args

from sonarrec.errors import SonarrecError
from sonarrec.results.folders import LockedError, locked, part_of
from sonarrec.runs.one import Event, Outcome, Status, Task
from sonarrec.tables.outputs import is_filled, write_csv

NAME = "logs.csv"
WRITE_EVERY_S = 1.0
USABLE: tuple[Status, ...] = ("done", "partial")


@dataclass(frozen=True, slots=True)
class Row:
    """A row of logs.csv; its fields are the columns."""

    log: str  # name of its results folder
    path: str  # as given
    status: Status
    frames: int = 0  # processed
    unusable: int = 0  # frames that could not be used
    seconds: float = 0.0  # duration of its last run; 0: not known
    declared: int = 0  # passes in sightings.csv, of methods that track objects
    message: str = ""  # what could not be used, or why it failed; or "stopped"

    @property
    def key(self) -> tuple[str, str]:
        """Two rows of one key are of one log."""
        return self.log, self.path


COLUMNS = tuple(f.name for f in fields(Row))


class LogsTable:
    """The rows of one call's logs, kept in OUT/logs.csv with those of other calls.

    The file is replaced as a whole, at most every WRITE_EVERY_S. Calls that write into one OUT at
    the same time, such as those of --shard, take turns and keep each other's rows.
    """

    def __init__(self, out: Path, tasks: Sequence[Task], *, alone: bool = False) -> None:
        """alone: there is a single log; if that gives no results, the file is not written."""
        self._alone = alone
        self._path = out / NAME
        self._rows = [Row(t.name, t.path, "waiting") for t in tasks]
        self._seconds: dict[str, float] = {}  # of finished runs of earlier calls
        with suppress(SonarrecError):
            before = read_logs(self._path)
            self._seconds = {row.log: row.seconds for row in before if row.status in USABLE}
        self._run_elsewhere: set[str] = set()  # logs that another call is running
        self._written_at_s = -math.inf
        self.fault: str | None = None  # why the file could not be written

    @property
    def rows(self) -> tuple[Row, ...]:
        """Those of this call."""
        return tuple(self._rows)

    def add(self, i: int, event: Event) -> None:
        """What happened to task i."""
        if isinstance(event, Outcome):
            self._rows[i] = self._ended(self._rows[i], event)
        elif isinstance(event, tuple):
            self._rows[i] = replace(self._rows[i], status="running", frames=event[0])
        if monotonic() >= self._written_at_s + WRITE_EVERY_S:
            self.write()

    def _ended(self, row: Row, outcome: Outcome) -> Row:
        row = replace(row, status=outcome.status, message=outcome.message)
        if isinstance(outcome.error, LockedError):
            self._run_elsewhere.add(row.log)
        seconds = outcome.seconds
        if (summary := outcome.summary) is not None:
            row = replace(
                row,
                frames=summary.frames,
                unusable=summary.unusable,
                declared=sum(summary.passes.values()),
            )
            if summary.up_to_date:
                seconds = self._seconds.get(row.log, 0.0)
        return replace(row, seconds=round(seconds, 2))

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
        self.fault, self._written_at_s = None, monotonic()
        if self._alone and not (self._rows[0].frames or self._rows[0].status == "done"):
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with _turn(self._path.parent):
                before = read_logs(self._path) if is_filled(self._path) else []
                rows = (map(_harmless, astuple(row)) for row in self._merged(before).values())
                write_csv(self._path, COLUMNS, rows)
        except OSError as error:
            self.fault = f"{self._path}: cannot be written ({error.strerror})"
        except SonarrecError as error:  # the file there is another kind of table
            self.fault = str(error)

    def _merged(self, before: Sequence[Row]) -> dict[tuple[str, str], Row]:
        """The rows of this call and those that other calls wrote before, by key."""
        usable = {row.log for row in before if row.status in USABLE}
        own = {row.key: row for row in self._rows if row.log not in self._run_elsewhere & usable}
        # A log may be refused because another log of its name has results there. Then both keep a
        # row, until this log has results too.
        ended = {row.log for row in own.values() if row.status in USABLE}
        others = (row for row in before if row.log not in ended or row.key in own)
        return {row.key: row for row in others} | own


FORMULA = ("=", "+", "-", "@")
"""Spreadsheets run a cell that begins so; a quotation mark in front makes it text."""


def _harmless(cell: object) -> object:
    begins = isinstance(cell, str) and cell.lstrip("'").startswith(FORMULA)
    return f"'{cell}" if begins else cell


def _text(cell: str) -> str:
    """The text from which `_harmless` made a cell."""
    quoted = cell.startswith("'") and cell.lstrip("'").startswith(FORMULA)
    return cell[1:] if quoted else cell


@contextmanager
def _turn(folder: Path) -> Iterator[None]:
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
    whole: dict[str, Callable[[str], Any]] = dict.fromkeys(("frames", "unusable", "declared"), int)
    # A duration that is not positive and finite is not known.
    kinds = whole | {"seconds": lambda cell: s if 0 < (s := float(cell)) < math.inf else 0.0}
    rows = []
    try:
        with path.open(encoding="utf-8-sig", errors="surrogateescape", newline="") as file:
            table = csv.DictReader(file)
            if set(COLUMNS) != set(table.fieldnames or ()):
                raise KeyError
            for cells in table:
                values = {name: kinds.get(name, _text)(cells[name]) for name in COLUMNS}
                if values["status"] not in get_args(Status):
                    raise ValueError
                rows.append(Row(**values))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    except (AttributeError, KeyError, TypeError, ValueError, csv.Error):
        line = max(table.line_num, 1)
        raise SonarrecError(
            f"{path} line {line}: not a row of {','.join(COLUMNS)}; move the file away"
        ) from None
    return rows
