"""One log of a call: how to run it, and its outcome."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Literal

from sonarrec.errors import SonarrecError, hidden
from sonarrec.results.folders import part_of
from sonarrec.results.run_file import LogOptions, existing_results
from sonarrec.runs.one import Observe, Summary, process
from sonarrec.runs.prepare import RunOptions, prepare

Status = Literal["waiting", "running", "done", "partial", "failed"]
GRACE_S = 10.0
"""Time that a process has after SIGTERM to write its results, before SIGKILL."""


@dataclass(frozen=True, slots=True)
class Task:
    """A log to run; it can be pickled, and handed to another process or machine."""

    path: str  # for a log on a server its URL without secrets
    name: str  # of its results folder, see runs.one.result_names
    out: str  # the folder for that folder
    log_options: LogOptions
    run_options: RunOptions
    overwrite: bool = False
    url: str = ""  # of a log on a server
    server_out: str = ""  # the folder of the results, if it is on a server


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a task."""

    status: Status  # `partial`: part of the log could not be used
    seconds: float = 0.0  # duration
    summary: Summary | None = None  # None if it failed
    folder: str = ""  # where its results are now: a path, or a URL
    error: SonarrecError | None = None  # if it failed
    fault: str = ""  # the traceback of a bug, if its process printed one

    @property
    def message(self) -> str:
        """One line on what could not be used; empty if all could."""
        if self.error is not None:
            return self.error.line
        problems = self.summary.problems if self.summary else []
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        return problems[0] + more if problems else ""


Event = str | tuple[int, int | None] | Outcome
"""What happens to a log: a line on what its run goes by; how many frames are done, of how many
(None: not known), 0 as it begins; its end."""


def plan_task(task: Task) -> str:
    """What `run_task` would do, and why; writes nothing. Raises SonarrecError as that would."""
    with (
        _at_hand(task) as (path, out, served_as),
        prepare(path, out, task.log_options, task.run_options, task.name, served_as) as job,
    ):
        if task.overwrite:
            return "done again (asked for)"
        existing = existing_results(job.folder, job.table)
        if existing.up_to_date:
            return "up to date"
        if existing.reason:
            return f"done again ({existing.reason})"
        stopped = part_of(job.folder).exists()
        return "done again (it was stopped before its end)" if stopped else "new"


def run_task(
    task: Task, observe: Observe | None = None, begun: Callable[[str], object] = str
) -> Outcome:
    """Run a task in this process. A fault of the input becomes an outcome; a bug raises.

    begun: as of `process`.
    """
    start_s = monotonic()
    served_as: Callable[[str], str] = str
    try:
        with _at_hand(task) as (path, out, served_as):
            summary = process(
                path,
                out,
                task.log_options,
                task.run_options,
                observe,
                name=task.name,
                overwrite=task.overwrite,
                begun=begun,
                served_as=served_as,
            )
            if task.server_out and not summary.up_to_date:
                from sonarrec.runs.remote import put  # with fsspec, only where needed

                put(summary.folder, f"{task.server_out.rstrip('/')}/{task.name}")
    except SonarrecError as error:
        told = type(error)(served_as(str(error)))
        return Outcome("failed", monotonic() - start_s, error=told)
    status: Status = "partial" if summary.problems else "done"
    return Outcome(status, monotonic() - start_s, summary, served_as(str(summary.folder)))


@contextmanager
def _at_hand(task: Task) -> Iterator[tuple[Path, Path, Callable[[str], str]]]:
    """(what to open, the folder of the results, a function that puts a server's names in a text).

    A log on a server is fetched, and results for a server begin with those that it has. A file
    that cannot be opened inside raises SonarrecError, so that it costs this log only.
    """
    path, out, names = Path(task.path), Path(task.out), dict[str, str]()

    def served_as(text: str) -> str:
        for here, there in names.items():
            text = text.replace(here, there)
        return text

    with ExitStack() as stack:
        try:
            if task.url or task.server_out:
                from sonarrec.runs.remote import fetched, get  # with fsspec, only where needed
            if task.url:
                path, there = stack.enter_context(fetched(task.url))
                names[str(path.parent)] = there
            if task.server_out:
                out = Path(stack.enter_context(TemporaryDirectory(prefix="sonarrec-")))
                names[str(out)] = hidden(task.server_out.rstrip("/"))
                get(f"{task.server_out.rstrip('/')}/{task.name}", out / task.name)
            yield path, out, served_as
        except OSError as error:
            if error.filename is None:  # not a fault of the input
                raise
            raise SonarrecError(f"{error.filename}: {error.strerror}") from None
