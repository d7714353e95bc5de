"""One log of a call: how to run it, and its outcome."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Literal

from sonarrec.errors import SonarrecError
from sonarrec.remote.cache import Cache
from sonarrec.remote.fetch import Progress, fetched
from sonarrec.remote.find import RemoteLog
from sonarrec.remote.urls import Url
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
    cache: Cache | None = None  # set if the log or its results lie on a server
    server_log: RemoteLog | None = None
    server_out: Url | None = None
    ahead: bool = False  # on two cores, see `two_cores`


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


def plan_task(task: Task) -> str:
    """What `run_task` would do, and why; writes nothing. Raises SonarrecError as that would."""
    with (
        _at_hand(task, upload=False) as (path, log_options, _),
        prepare(path, Path(task.out), log_options, task.run_options, task.name) as job,
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
    task: Task,
    observe: Observe | None = None,
    fetching: Progress | None = None,
    begun: Callable[[str], object] = str,
) -> Outcome:
    """Run a task in this process. A fault of the input becomes an outcome; a bug raises.

    fetching: called as the bytes of a log on a server arrive. begun: as of `process`.
    """
    start_s = monotonic()
    try:
        with _at_hand(task, fetching) as (path, log_options, renamed):
            summary = process(
                path,
                task.out,
                log_options,
                task.run_options,
                observe,
                name=task.name,
                overwrite=task.overwrite,
                ahead=task.ahead,
                begun=lambda line: begun(renamed(line)),
            )
    except SonarrecError as error:
        return Outcome("failed", monotonic() - start_s, error=error)
    summary = replace(
        summary,
        problems=[renamed(line) for line in summary.problems],
        notes=[renamed(line) for line in summary.notes],
    )
    status: Status = "partial" if summary.problems else "done"
    return Outcome(status, monotonic() - start_s, summary, renamed(str(summary.folder)))


@contextmanager
def _at_hand(
    task: Task, fetching: Progress | None = None, *, upload: bool = True
) -> Iterator[tuple[Path, LogOptions, Callable[[str], str]]]:
    """What to open, how to read it, and a function that puts a server's names into a line.

    A log on a server is held in the cache; results for a server are uploaded at the end. A file
    that cannot be opened inside raises SonarrecError, so that it costs this log only.
    """
    path, log_options = Path(task.path), task.log_options
    renamed: Callable[[str], str] = str
    with ExitStack() as stack:
        if task.cache is not None and task.server_log is not None:
            copy = stack.enter_context(fetched(task.server_log, task.cache, fetching))
            path = copy.path
            log_options = replace(log_options, up_to=copy.up_to, origin=copy.origin)
        if task.cache is not None and task.server_out is not None:
            from sonarrec.remote.upload import Outbox  # with fsspec, only where needed

            box = Outbox(task.server_out, task.cache)
            renamed = box.origin.with_server_names
            stack.enter_context(box.results(task.name, upload=upload))
        try:
            yield path, log_options, renamed
        except OSError as error:
            if error.filename is None:  # not a fault of the input
                raise
            raise SonarrecError(f"{error.filename}: {error.strerror}") from None
