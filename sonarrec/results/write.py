"""Results onto disk as they come: frames.csv, estimates.csv and run.toml."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import tomli_w

from sonarrec.landmarks import LandmarkSet
from sonarrec.records import NO_STAMPS, FrameResult, SonarrecError, Stamps
from sonarrec.results.columns import FRAME_COLUMNS, estimate_columns


class ResultsWriter:
    """Appends one log's results as they come; run.toml says `finished = true` only at the end."""

    def __init__(self, folder: Path, landmarks: LandmarkSet, run: dict[str, Any]) -> None:
        """run: the tables of run.toml. Raises SonarrecError where the folder cannot be written."""
        self.frames = 0
        self._folder = folder
        self._run = run
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._write_run(finished=False)
            # Line endings and encoding are fixed, so that equal results are equal bytes anywhere.
            self._frames_file = (folder / "frames.csv").open("w", newline="", encoding="utf-8")
            self._estimates_file = (folder / "estimates.csv").open(
                "w", newline="", encoding="utf-8"
            )
        except OSError as error:
            raise SonarrecError(
                f"{folder}: cannot write results here ({error.strerror}); choose another --out"
            ) from None
        self._frames = csv.writer(self._frames_file, lineterminator="\n")
        self._estimates = csv.writer(self._estimates_file, lineterminator="\n")
        self._columns = estimate_columns(landmarks.ids)
        self._frames.writerow([c.name for c in FRAME_COLUMNS])
        self._estimates.writerow([c.name for c in self._columns])

    def write(self, result: FrameResult, stamps: Stamps = NO_STAMPS) -> None:
        """Append one frame and the times that its log keeps of it.

        Raises SonarrecError where the disk takes no more.
        """
        self.frames += 1
        try:
            self._frames.writerow([c.written(result, stamps) for c in FRAME_COLUMNS])
            self._estimates.writerows(
                [c.written(result, e) for c in self._columns] for e in result.estimates
            )
        except OSError as error:
            raise self._fault(error) from None

    def finish(self, problems: Sequence[str]) -> None:
        """Mark the results as whole: every frame of the log was processed or told of.

        Raises SonarrecError where the disk takes no more.
        """
        self._run["input"]["frames_processed"] = self.frames
        self._run["input"]["problems"] = list(problems)
        try:
            # The last rows leave the buffers before run.toml calls them whole.
            self._frames_file.close()
            self._estimates_file.close()
            self._write_run(finished=True)
        except OSError as error:
            raise self._fault(error) from None

    def _fault(self, error: OSError) -> SonarrecError:
        return SonarrecError(
            f"{self._folder}: cannot write results ({error.strerror}); what is there is good"
        )

    def _write_run(self, finished: bool) -> None:
        """Replace run.toml in one step: readers see the old one or the new one."""
        text = tomli_w.dumps({"finished": finished, **self._run}, multiline_strings=True)
        partial = self._folder / "run.toml.part"
        partial.write_text(text, encoding="utf-8")
        os.replace(partial, self._folder / "run.toml")  # noqa: PTH105

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._frames_file.close()
        self._estimates_file.close()
