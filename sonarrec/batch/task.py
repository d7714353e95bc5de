"""One log of a call: what is to be done with it, and what became of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Literal

from sonarrec.pipeline.prepared import Used
from sonarrec.pipeline.run import Observe, Summary, planned, process
from sonarrec.records import SonarrecError, shown
from sonarrec.remote.fetch import Told, fetched, untold
from sonarrec.remote.run import Elsewhere
from sonarrec.results.folders import part_of
from sonarrec.results.run_file import Given

Status = Literal["waiting", "running", "done", "partial", "failed"]
GRACE_S = 10.0
"""How long a task's process may take to write down what it has after SIGTERM, before SIGKILL."""


@dataclass(frozen=True, slots=True)
class Task:
    """A log to run; it can be pickled, and handed to another process or machine."""

    path: str  # of a log on a server its URL without secrets
    name: str  # of its results, see pipeline.run.result_names
    out: str  # where they are made
    given: Given
    used: Used
    overwrite: bool = False
    elsewhere: Elsewhere | None = None  # what of it lies on servers
    ahead: bool = False  # whether other cores read frames and select candidates in advance

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
                given,
                sonar_file=_absolute(given.sonar_file),
                odometry=_absolute(given.odometry),
                up_to=_absolute(given.up_to),
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
    folder: str = ""  # where its results are now: a path, or a URL
    error: SonarrecError | None = None  # what failed, where it did
    fault: str = ""  # the traceback of a fault of our own, where its process could print one

    @property
    def message(self) -> str:
        """One line on what could not be used; empty where all could."""
        if self.error is not None:
            return self.error.line
        problems = self.summary.problems if self.summary else []
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        return problems[0] + more if problems else ""


def plan(task: Task) -> str:
    """What `do` would do, and why; nothing is written. Raises SonarrecError as it would."""
    with _at_hand(task, upload=False) as (path, given, _):
        folder = Path(task.out) / task.name
        held = planned(path, task.out, given, task.used, name=task.name, overwrite=task.overwrite)
    if held.up_to_date:
        return "up to date"
    if held.why:
        return f"done anew ({held.why})"
    return "done anew (it was stopped before its end)" if part_of(folder).exists() else "new"


def do(task: Task, observe: Observe | None = None, fetching: Told = untold) -> Outcome:
    """Run a task in this process. What the input lacks is an outcome; our own faults are raised.

    fetching: told as the bytes of a log on a server come.
    """
    begun = monotonic()
    try:
        with _at_hand(task, fetching) as (path, given, told):
            summary = process(
                path,
                task.out,
                given,
                task.used,
                observe,
                name=task.name,
                overwrite=task.overwrite,
                ahead=task.ahead,
            )
    except SonarrecError as error:
        return Outcome("failed", monotonic() - begun, error=error)
    summary = replace(
        summary,
        problems=[told(line) for line in summary.problems],
        notes=[told(line) for line in summary.notes],
    )
    status: Status = "partial" if summary.problems else "done"
    return Outcome(status, monotonic() - begun, summary, told(str(summary.folder)))


@contextmanager
def _at_hand(
    task: Task, fetching: Told = untold, *, upload: bool = True
) -> Iterator[tuple[Path, Given, Callable[[str], str]]]:
    """What to open, what is given of it, and what puts a server's names into a line.

    A log on a server is in the cache meanwhile; results for one are uploaded at the end. A file
    or folder that the system refuses inside is a SonarrecError: it costs this log only.
    """
    far = task.elsewhere
    path, given = Path(task.path), task.given
    told: Callable[[str], str] = str
    with ExitStack() as held:
        if far is not None and far.log is not None:
            found = held.enter_context(fetched(far.log, far.cache, fetching))
            path, given = found.path, replace(given, up_to=found.up_to, origin=found.origin)
        if far is not None and far.out is not None:
            from sonarrec.remote.upload import Outbox  # with fsspec, only where needed

            box = Outbox(far.out, far.cache)
            told = box.origin.told
            held.enter_context(box.results(task.name, upload=upload))
        try:
            yield path, given, told
        except OSError as error:
            if error.filename is None:  # no fault of the input
                raise
            raise SonarrecError(f"{shown(error.filename)}: {error.strerror}") from None
