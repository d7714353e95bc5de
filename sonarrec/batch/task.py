"""One log of a call: what is to be done with it, and what became of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Literal

from sonarrec.pipeline import Observe, Summary, planned, process
from sonarrec.prepared import Used
from sonarrec.readers.find import log_name
from sonarrec.records import SonarrecError
from sonarrec.results.folders import part_of
from sonarrec.results.run_file import Given

Status = Literal["waiting", "running", "done", "partial", "failed"]


@dataclass(frozen=True, slots=True)
class Task:
    """A log to run; it can be pickled, and handed to another process or machine."""

    path: str
    name: str | None  # of its results, see pipeline.result_names
    out: str
    given: Given
    used: Used
    overwrite: bool = False

    def absolute(self) -> Task:
        """The same for a process that works in another folder."""
        given, used = self.given, self.used
        landmarks = used.landmarks  # a file or a built-in set
        if landmarks is not None and Path(landmarks).is_file():
            landmarks = Path(landmarks).absolute()
        return replace(
            self,
            path=self.path if "://" in self.path else str(Path(self.path).absolute()),
            out=self.out if "://" in self.out else str(Path(self.out).absolute()),
            given=replace(
                given, sonar_file=_absolute(given.sonar_file), odometry=_absolute(given.odometry)
            ),
            used=replace(
                used,
                landmarks=landmarks,
                model=_absolute(used.model),
                earlier_run=_absolute(used.earlier_run),
            ),
        )


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else path.absolute()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a task."""

    status: Status  # `partial`: part of the log could not be used
    seconds: float = 0.0  # taken by the log
    summary: Summary | None = None  # None where it failed
    error: SonarrecError | None = None  # what failed, where it did
    fault: str = ""  # the traceback of a fault of our own, where its process could print one

    @property
    def message(self) -> str:
        """One line on what could not be used; empty where all could."""
        if self.error is not None:
            return str(self.error)
        problems = self.summary.problems if self.summary else []
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        return problems[0] + more if problems else ""


def plan(task: Task) -> str:
    """What `do` would do, and why; nothing is written. Raises SonarrecError as it would."""
    path = Path(task.path)
    folder = Path(task.out) / (task.name or log_name(path))
    if task.overwrite:
        return "done anew (asked for)"
    held = planned(path, task.out, task.given, task.used, name=task.name)
    if held.up_to_date:
        return "up to date"
    if held.why:
        return f"done anew ({held.why})"
    return "done anew (it was stopped before its end)" if part_of(folder).exists() else "new"


def do(task: Task, observe: Observe | None = None) -> Outcome:
    """Run a task in this process. What the input lacks is an outcome; our own faults are raised."""
    begun = monotonic()
    try:
        summary = process(
            Path(task.path),
            task.out,
            task.given,
            task.used,
            observe,
            name=task.name,
            overwrite=task.overwrite,
        )
    except SonarrecError as error:
        return Outcome("failed", monotonic() - begun, error=error)
    return Outcome("partial" if summary.problems else "done", monotonic() - begun, summary)
