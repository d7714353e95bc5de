"""Results onto disk as they come: frames.csv, estimates.csv, sightings.csv and run.toml."""

from __future__ import annotations

import csv
import io
import os
import shutil
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import tomli_w

from sonarrec.files.outputs import replaced
from sonarrec.files.parquet import convert
from sonarrec.landmarks import LandmarkSet
from sonarrec.records import NO_STAMPS, FrameResult, SonarrecError, Stamps, shown
from sonarrec.results.columns import FRAME_COLUMNS, SIGHTING_COLUMNS, estimate_columns
from sonarrec.results.folders import exchange, lock, part_of, release, restore
from sonarrec.results.sightings import Sighting, Sightings


class _Table:
    """A CSV file that holds whole frames at any moment, also where the process is killed."""

    def __init__(self, path: Path, header: Sequence[str]) -> None:
        new = path.with_name(f".{path.name}.new")
        self._file = new.open("wb", buffering=0)
        self._size = 0
        self.append([header])
        new.rename(path)  # where it stands it has a header

    def append(self, rows: Iterable[Sequence[object]]) -> None:
        """Add the rows of a frame, all or none. Raises OSError where the disk takes no more."""
        text = io.StringIO()
        # Line endings and encoding are fixed, so that equal results are equal bytes anywhere.
        csv.writer(text, lineterminator="\n").writerows(rows)
        data = memoryview(text.getvalue().encode())
        try:
            while data:
                data = data[self._file.write(data) :]
        except BaseException:  # the disk is full, or Ctrl-C
            self.cut(self._size)
            raise
        self._size = self._file.tell()

    def cut(self, size: int) -> None:
        """Take back what was appended since the file had this size."""
        self._file.seek(self._file.truncate(size))
        self._size = size

    @property
    def size(self) -> int:
        """Bytes written."""
        return self._size

    def close(self, *, sync: bool = False) -> None:
        if sync:
            os.fsync(self._file.fileno())
        self._file.close()


class ResultsWriter:
    """Appends one log's results as they come, into `<folder>.part` until all are there.

    `finish` puts them in the place of `folder`. Without it, the part stays: its run.toml says
    `finished = false`, its tables hold whole frames, and `folder` is as it was. sightings.csv has
    the passes that ended; of a run that was killed not those that were under way.
    """

    def __init__(
        self,
        folder: Path,
        landmarks: LandmarkSet,
        run: dict[str, Any],
        sightings: Sightings | None = None,
        *,
        parquet: bool = False,
    ) -> None:
        """run: the tables of run.toml. sightings: what gathers them, new. parquet: whether the
        estimates are to be in estimates.parquet when all are there.

        Raises SonarrecError where the folder cannot be written, or another run writes there.
        """
        self.frames = self.candidates = 0
        self.full = False  # the disk took no more: nothing can be written any longer
        self._gathered = sightings or Sightings(landmarks)
        self._folder = folder
        self._part = part_of(folder)
        self._run = run
        self._parquet = parquet
        self._columns = estimate_columns(landmarks.ids)
        try:
            self._part.parent.mkdir(parents=True, exist_ok=True)
            self._lock = lock(folder)
        except OSError as error:
            raise self._unwritable(error) from None
        try:
            restore(folder)
            if self._part.exists():
                # Of a run that was stopped. The table made last goes first: a part that has it is
                # whole, also where this run is stopped right here.
                (self._part / "sightings.csv").unlink(missing_ok=True)
                shutil.rmtree(self._part)
            self._part.mkdir()
            self._write_run(finished=False)
            self._estimates = _Table(self._part / "estimates.csv", [c.name for c in self._columns])
            self._frames = _Table(self._part / "frames.csv", [c.name for c in FRAME_COLUMNS])
            self._sightings = _Table(
                self._part / "sightings.csv", [c.name for c in SIGHTING_COLUMNS]
            )
        except OSError as error:
            release(folder, self._lock)
            raise self._unwritable(error) from None
        except SonarrecError:
            release(folder, self._lock)
            raise

    def _unwritable(self, error: OSError) -> SonarrecError:
        where = f": {shown(error.filename)}" if error.filename else ""
        return SonarrecError(
            f"{shown(self._folder)}: cannot write results here ({error.strerror}{where}); "
            "choose another --out"
        )

    def write(self, result: FrameResult, stamps: Stamps = NO_STAMPS) -> None:
        """Append one frame and the times that its log keeps of it.

        Raises SonarrecError where the disk takes no more.
        """
        before = self.frames, self._estimates.size, self._frames.size
        try:
            # A frame that frames.csv lists has all its estimates.
            self._estimates.append(
                [c.written(result, e) for c in self._columns] for e in result.estimates
            )
            self._frames.append([[c.written(result, stamps) for c in FRAME_COLUMNS]])
            self.frames += 1
            self.candidates += result.candidates
            self._seen(self._gathered.add(result.index, result.timestamp_ns, result.estimates))
        except BaseException as error:
            if self.frames == before[0]:  # not all of the frame is there
                self._estimates.cut(before[1])
                self._frames.cut(before[2])
            if isinstance(error, OSError):
                raise self._fault(error) from None
            raise

    def _seen(self, ended: Sequence[Sighting]) -> None:
        if ended:
            self._sightings.append([c.written(s) for c in SIGHTING_COLUMNS] for s in ended)

    def finish(self, problems: Sequence[str], unusable: int = 0) -> list[str]:
        """Every frame of the log was processed or told of: take the place of what was there.

        unusable: how many frames could not be used. Returns what `exchange` notes.

        Raises SonarrecError where the disk takes no more.
        """
        self._run["input"]["frames_processed"] = self.frames
        self._run["input"]["frames_unusable"] = unusable
        self._run["input"]["candidates"] = self.candidates
        self._run["input"]["problems"] = [shown(problem) for problem in problems]
        try:
            self._seen(self._gathered.rest())
            self._sightings.close(sync=True)
            self._estimates.close(sync=True)
            self._frames.close(sync=True)
            if self._parquet:
                convert(self._part / "estimates.csv", self._part / "estimates.parquet")
            self._write_run(finished=True)
            return exchange(self._folder)
        except OSError as error:
            raise self._fault(error) from None

    def _fault(self, error: OSError) -> SonarrecError:
        self.full = True
        return SonarrecError(
            f"{shown(self._part)}: cannot write results ({error.strerror}); it holds the "
            f"{self.frames} frames before"
        )

    def _write_run(self, finished: bool) -> None:
        """Replace run.toml in one step: readers see the old one or the new one."""
        text = tomli_w.dumps({"finished": finished, **self._run}, multiline_strings=True)
        path = self._part / "run.toml"
        with replaced(path) as new, new.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError, ValueError):  # the disk is full; all is written and closed
            self._seen(self._gathered.rest())
        for table in (self._estimates, self._frames, self._sightings):
            table.close()
        if not self.frames and self._part.is_dir():
            shutil.rmtree(self._part, ignore_errors=True)  # it holds nothing
        release(self._folder, self._lock)
