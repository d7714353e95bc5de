"""Writes results as they come: frames.csv, estimates.csv, sightings.csv and run.toml."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from time import monotonic
from typing import Any, Self

import tomli_w

from sonarrec.errors import SonarrecError, name_as_text, number_of
from sonarrec.landmarks import DrawnSet, LandmarkSet
from sonarrec.results.columns import (
    FRAME_COLUMNS,
    SIGHTING_COLUMNS,
    Column,
    EstimateLines,
    estimate_columns,
    frame_line,
)
from sonarrec.results.folders import alone, exchange, part_of
from sonarrec.results.run_file import tables_written
from sonarrec.results.sightings import Sightings
from sonarrec.sonar.frame import NO_STAMPS, FrameResult, Stamps
from sonarrec.tables.outputs import replaced

AT_ONCE = 16
"""Frames that are written together: as many as stage 3 looks at together."""
WAIT_S = 1.0
"""A frame waits no longer for others."""


class _Table:
    """A CSV file that always holds complete lines, even if the process is killed.

    Line ends and encoding are fixed, so that equal results have equal bytes everywhere.
    """

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        new = path.with_name(f".{path.name}.new")
        self._file = new.open("wb", buffering=0)
        self.size = 0  # bytes written
        self.append(",".join(c.name for c in columns) + "\n")
        new.rename(path)  # so the file always has a header

    def append(self, lines: str) -> None:
        """Add lines, all or none. Raises OSError if the disk is full."""
        data = memoryview(lines.encode())
        size = self.size + len(data)
        try:
            while data:
                data = data[self._file.write(data) :]
        except BaseException:  # the disk is full, or Ctrl-C
            self.cut(self.size)
            raise
        self.size = size

    def cut(self, size: int) -> None:
        """Cut the file back to this size."""
        self._file.seek(self._file.truncate(size))
        self.size = size

    def close(self, *, sync: bool = False) -> None:
        if sync:
            os.fsync(self._file.fileno())
        self._file.close()


def write_run(path: Path, table: dict[str, Any]) -> None:
    """Replace a run.toml in one step: readers see the old or the new one. Raises OSError."""
    text = tomli_w.dumps(table, multiline_strings=True)
    with replaced(path) as new, new.open("w", encoding="utf-8", newline="") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


class ResultsWriter:
    """Writes one log's results as they come, into `<folder>.part`.

    `finish` replaces `folder` by it. Without `finish` the part stays: its run.toml says
    `finished = false`, its tables hold complete frames, and `folder` is unchanged. If the run is
    killed, sightings.csv lacks the passes that had not ended.
    """

    def __init__(
        self,
        folder: Path,
        landmarks: LandmarkSet,
        run: dict[str, Any],
        sightings: Sightings | None = None,
    ) -> None:
        """run: the tables of run.toml. sightings: an empty collector.

        Raises SonarrecError if the folder cannot be written or another run writes there.
        """
        self.frames = self.candidates = 0
        self.last = -1  # index of the last frame given to `write`
        self.full = False  # whether the disk is full
        self._gathered = sightings or Sightings(landmarks)
        self._folder = folder
        self._part = part_of(folder)
        self._run = run
        self._waiting: list[tuple[FrameResult, Stamps]] = []
        self._passes = ""  # lines of sightings.csv that wait
        self._written_s = monotonic()
        self._lock = ExitStack()
        columns = estimate_columns(landmarks.ids, isinstance(landmarks, DrawnSet))
        self._lines = EstimateLines(columns)
        try:
            self._part.parent.mkdir(parents=True, exist_ok=True)
            self._lock.enter_context(alone(folder))
            if self._part.exists():
                # A stopped run left it. The file created last is deleted first: a part that has
                # it is complete, even if this run is stopped right here.
                (self._part / "sightings.csv").unlink(missing_ok=True)
                shutil.rmtree(self._part)
            self._part.mkdir()
            write_run(self._part / "run.toml", {"finished": False, **self._run})
            self._estimates = _Table(self._part / "estimates.csv", columns)
            self._frames = _Table(self._part / "frames.csv", FRAME_COLUMNS)
            self._sightings = _Table(self._part / "sightings.csv", SIGHTING_COLUMNS)
        except OSError as error:
            self._lock.close()
            where = f": {name_as_text(error.filename)}" if error.filename else ""
            raise SonarrecError(
                f"{name_as_text(folder)}: cannot write results here ({error.strerror}{where}); "
                "choose another --out"
            ) from None

    def write(self, result: FrameResult, stamps: Stamps = NO_STAMPS) -> None:
        """Append a frame. stamps: its times in the log. Raises SonarrecError: the disk is full."""
        # At Ctrl-C both are set, or none.
        self._waiting, self.last = [*self._waiting, (result, stamps)], result.index
        if len(self._waiting) >= AT_ONCE or monotonic() > self._written_s + WAIT_S:
            self._flush()

    def _flush(self) -> None:
        """Write the frames that wait; on a full disk as many as there is room for, then raise."""
        try:
            self._append(len(self._waiting))
        except OSError:
            try:
                while self._waiting or self._passes:
                    self._append(1)
            except OSError as error:
                raise self._fault(error) from None

    def _append(self, count: int) -> None:
        """Write the first frames that wait, all or none. Raises OSError."""
        block, rest = self._waiting[:count], self._waiting[count:]
        frames = self.frames + len(block)
        before = self._estimates.size, self._frames.size
        try:
            # Written first, so that a frame in frames.csv has all its estimates.
            self._estimates.append("".join([self._lines(result) for result, _ in block]))
            self._frames.append("".join([frame_line(*each) for each in block]))
            self._waiting, self.frames = rest, frames
        except BaseException:
            if self.frames < frames:
                self._estimates.cut(before[0])
                self._frames.cut(before[1])
            raise
        self._written_s = monotonic()
        for result, _ in block:
            self.candidates += result.candidates
            ended = self._gathered.add(
                result.index, result.timestamp_ns, result.estimates, result.stretch
            )
            self._passes += "".join(s.line() for s in ended)
        self._sightings.append(self._passes)
        self._passes = ""

    def _end(self) -> None:
        """Write all that waits."""
        self._flush()
        self._passes += "".join(s.line() for s in self._gathered.close_all())
        self._flush()

    def finish(self, problems: Sequence[str], unusable: int = 0) -> list[str]:
        """End a complete run: replace older results. Returns the notes of `exchange`.

        problems: a line for each part of the log that could not be used. unusable: how many frames.
        Raises SonarrecError if the disk is full.
        """
        self._end()
        self._run["input"]["frames_unusable"] = unusable
        self._run["input"]["candidates"] = self.candidates
        self._run["input"]["problems"] = [name_as_text(problem) for problem in problems]
        try:
            self._sightings.close(sync=True)
            self._estimates.close(sync=True)
            self._frames.close(sync=True)
            self._run["input"] |= tables_written(self._part)
            write_run(self._part / "run.toml", {"finished": True, **self._run})
            return exchange(self._folder)
        except OSError as error:
            raise self._fault(error) from None

    def _fault(self, error: OSError) -> SonarrecError:
        self.full = True
        return SonarrecError(
            f"{name_as_text(self._part)}: cannot write results ({error.strerror}); it holds the "
            f"{number_of(self.frames, 'frame')} before"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(SonarrecError, ValueError):  # full disk, or the files are closed already
            self._end()
        for table in (self._estimates, self._frames, self._sightings):
            table.close()
        if not self.frames and self._part.is_dir():
            shutil.rmtree(self._part, ignore_errors=True)  # it is empty
        self._lock.close()
