"""Runs logs, one or many, and gives what became of each: `sonarrec.run`, and the command's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, overload

from sonarrec.errors import UsageError, hidden, is_url, local, number_of
from sonarrec.nouns import Clock
from sonarrec.readers.named_logs import NamedLog
from sonarrec.results.folders import MADE, PAGES
from sonarrec.results.run_file import LogOptions, frame_span, span_text
from sonarrec.runs import cores
from sonarrec.runs.frames import Presets, configs_of
from sonarrec.runs.logs_table import COLUMNS, NAME, LogsTable, Row
from sonarrec.runs.many import Watch, run_apart, run_here
from sonarrec.runs.one import Observe, Summary, process, result_names
from sonarrec.runs.prepare import RunOptions
from sonarrec.runs.task import Event, Outcome, Task
from sonarrec.sonar import Sonar, sonar_from

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, slots=True, repr=False)
class Runs:
    """How the runs of several logs went."""

    folder: Path
    """That which holds the results of each."""
    rows: tuple[Row, ...]
    """As in logs.csv."""
    outcomes: tuple[Outcome, ...]
    """What became of each log, in their order."""
    fault: str | None
    """Why logs.csv could not be written."""
    notes: tuple[str, ...]
    """On the folder as a whole."""

    @property
    def summaries(self) -> tuple[Summary, ...]:
        """Of the logs that have results now."""
        return tuple(o.summary for o in self.outcomes if o.summary is not None)

    @property
    def table(self) -> pd.DataFrame:
        """A row for each log, as in logs.csv; `message` says why one failed."""
        import pandas as pd  # slow to load

        return pd.DataFrame(map(astuple, self.rows), columns=list(COLUMNS))

    def __iter__(self) -> Iterator[Summary]:
        return iter(self.summaries)

    def __repr__(self) -> str:
        failed = len(self.rows) - len(self.summaries)
        frames = sum(summary.frames for summary in self.summaries)
        done = f"{number_of(len(self.summaries), 'log')}, {number_of(frames, 'frame')}"
        return f"<{self.folder}: {done}{f'; {failed} failed' * bool(failed)}>"


@overload
def run(log: str | Path, out: str | Path = ..., **options: Any) -> Summary: ...
@overload
def run(log: Sequence[str | Path], out: str | Path = ..., **options: Any) -> Runs: ...


def run(  # type: ignore[misc]  # the overloads leave out what both have
    log: str | Path | Sequence[str | Path],
    out: str | Path = "sonarrec_out",
    *,
    preset: Presets = "default",
    landmarks: str | Path | None = None,
    model: str | Path | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    sonar_file: str | Path | None = None,
    topic: str | None = None,
    time: Clock | None = None,
    odometry: str | Path | None = None,
    frames: tuple[int, int | None] | None = None,
    overwrite: bool = False,
    jobs: int | None = None,
    observe: Observe | None = None,
) -> Summary | Runs:
    """Recognise the landmarks in a log, or in each of several; results go to `out`/<log name>/.

    One log gives its Summary. Several give Runs, and one that cannot be used does not stop the
    others.

    log: an MCAP file, a bag of ROS, a folder or glob of images, a video or a sonar's own file.
    preset: "default", "offline", "paper", a Config, or several, each of a name of its own.
    landmarks: a set by name or TOML file, default `basin`. model: of `sonarrec calibrate`. sonar:
    geometry that wins over files, such as {"tilt_deg": 20.0} (keys and units of sonar.toml: m,
    deg). sonar_file: in place of the sonar.toml beside the log. topic: the image channel of an
    MCAP or bag. time: which time of its messages names a frame, "log" (default), "publish" or
    "header". odometry: CSV of the sonar's poses. frames: only those from the first number up to,
    not including, the second, if there is one; they keep their numbers. overwrite: do again what is
    up to date, and replace the results of another log of that name. jobs: how many logs
    run at once; default: the number of cores. observe: called after each frame of a single log with
    its FrameResult and the number of frames (None where unknown).

    Raises SonarrecError for input or settings that cannot be used; what was written stays.
    """
    log_options = LogOptions(
        sonar=sonar_from(sonar),
        sonar_file=None if sonar_file is None else Path(sonar_file),
        topic=topic,
        time=time,
        odometry=None if odometry is None else Path(odometry),
        # By the text that run.toml will hold: what it could not give back is refused.
        frames=None if frames is None else frame_span(span_text(frames)),
    )
    learned = None if model is None else Path(model)
    run_options = RunOptions(configs_of(preset), landmarks, learned)
    if isinstance(log, str | Path):
        return process(log, local(out), log_options, run_options, observe, overwrite=overwrite)
    if observe is not None:
        raise UsageError("observe is for a single log")
    logs = [NamedLog(str(one)) for one in log]
    tasks = tasks_of(logs, str(local(out)), log_options, run_options, overwrite)
    done = run_tasks(tasks, out, jobs=jobs)
    errors = [one.error for one in done.outcomes if one.error is not None]
    if not done.summaries and errors:
        raise errors[0]
    return done


def tasks_of(
    logs: Sequence[NamedLog],
    out: str,
    log_options: LogOptions,
    run_options: RunOptions,
    overwrite: bool = False,
) -> list[Task]:
    """A task for each log. out: the folder of the results, or its URL.

    Raises UsageError if two logs cannot be told apart.
    """
    names = result_names([hidden(log.path) if is_url(log.path) else log.path for log in logs])
    places = {"out": "", "server_out": out} if is_url(out) else {"out": out}
    return [
        Task(
            path=hidden(log.path) if is_url(log.path) else log.path,
            name=name,
            log_options=replace(log_options, up_to=log.up_to),
            run_options=run_options,
            overwrite=overwrite,
            url=log.path if is_url(log.path) else "",
            **places,
        )
        for log, name in zip(logs, names, strict=True)
    ]


def run_tasks(
    tasks: Sequence[Task],
    out: str | Path,
    watch: Watch | None = None,
    *,
    jobs: int | None = None,
    timeout_s: float | None = None,
    scheduler: str | None = None,
    alone: bool = False,
) -> Runs:
    """Run the tasks and keep OUT/logs.csv, also if the call is stopped.

    out: a folder, or the URL of one. watch: gets what happens meanwhile. jobs: how many run at
    once; default: the number of cores. timeout_s: for one log. scheduler: address of a Dask cluster
    that runs them. alone: the call names a single log; if that gives no results, logs.csv is not
    written.
    """
    outcomes: dict[int, Outcome] = {}
    with _folder_of(out) as folder:
        table = LogsTable(folder, tasks, alone=alone)

        def keep(i: int | None, event: Event) -> None:
            if i is not None:
                table.add(i, event)
            if i is not None and isinstance(event, Outcome):
                outcomes[i] = event
            if watch is not None:
                watch(i, event)

        jobs = min(jobs or cores(), len(tasks))
        table.write()
        try:
            if scheduler is not None:
                from sonarrec.runs.cluster import run_on_cluster  # with dask, only where needed

                run_on_cluster(tasks, scheduler, keep, timeout_s)
            elif jobs > 1 or timeout_s is not None:
                run_apart(tasks, jobs, keep, timeout_s)
            else:
                run_here(tasks, keep)
        except BaseException:  # Ctrl-C as well
            table.stopped()
            raise
        finally:
            table.write()
        ended = tuple(outcome for _, outcome in sorted(outcomes.items()))
        return Runs(folder, table.rows, ended, table.fault, _outdated(folder, ended))


@contextmanager
def _folder_of(out: str | Path) -> Iterator[Path]:
    """The folder of the results; of a URL one for logs.csv, which is put there at the end.

    A run that is stopped does not wait for a server.
    """
    if not is_url(out):
        yield Path(out)
        return
    from sonarrec.runs.remote import check_out, get, put  # with fsspec, only where needed

    check_out(str(out))
    url = f"{str(out).rstrip('/')}/{NAME}"
    with TemporaryDirectory(prefix="sonarrec-") as folder:
        get(url, Path(folder, NAME))  # with the rows of other calls
        yield Path(folder)
        put(Path(folder, NAME), url)


def _outdated(out: Path, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    """A note on pages and folders in OUT that were made from results replaced now."""
    summaries = [outcome.summary for outcome in outcomes]
    if all(s is None or s.up_to_date for s in summaries):
        return ()
    older = [name for name in PAGES if (out / name).exists()]
    older += [name for name, made in MADE.items() if (out / name / made[-1]).is_file()]
    text = f"{out}: {', '.join(older)} show the results of before; make them again"
    return (text,) if older else ()
