"""`sonarrec run`: recognise the landmarks in logs."""

from __future__ import annotations

import os
import signal
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import TIMEOUT_MAX
from typing import IO, TYPE_CHECKING, Any

import click

from sonarrec.cli import options, options_log
from sonarrec.cli.endings import FAILED, INTERRUPTED, PARTLY, TERMINATED, leave, say, tell
from sonarrec.cli.groups import command, file_names, in_batch, in_input, in_output
from sonarrec.errors import SonarrecError, UsageError, hidden, is_url, name_as_text

if TYPE_CHECKING:
    from sonarrec.cli.run_watch import RunWatch
    from sonarrec.readers.named_logs import NamedLog
    from sonarrec.results.run_file import LogOptions
    from sonarrec.runs.prepare import RunOptions
    from sonarrec.runs.task import Task

_ODOMETRY = options_log.odometry_options(in_input)


class _FolderOrUrl(click.Path):
    def convert(self, value: Any, *context: Any) -> Any:
        return str(value) if is_url(value) else super().convert(value, *context)


@command(short_help="Recognise the landmarks in logs.", first=("--sonar", "--landmarks", "--out"))
@click.argument("log", shell_complete=file_names, nargs=-1)
@options_log.many_logs_options
@options_log.log_options(flags=True, time=True)
@options.landmarks
@_ODOMETRY["odometry"]
@_ODOMETRY["odometry_topic"]
@options.frames("Process only the frames from A up to, not including, B.")
@options.model
@options.settings
@options.out(_FolderOrUrl(file_okay=False), "Results go to OUT/<log name>.", default="sonarrec_out")
@in_output(
    "--overwrite",
    is_flag=True,
    help="Run logs again that are up to date, and replace results of another log of the same name.",
)
@in_batch(
    "-j --jobs",
    type=click.IntRange(min=1),
    help="How many logs run at once, each in its own process; 1: one after the other, in this "
    "process.  [default: the number of cores]",
)
@in_batch(
    "--dry-run", is_flag=True, help="Print what would be done with each log and why; write nothing."
)
@in_batch(
    "--timeout",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="Stop a log that takes longer.",
)
@in_batch("--shard", metavar="I/N", help="Run only every N-th log, from the I-th: see help remote.")
@in_batch(
    "--scheduler",
    metavar="ADDRESS",
    help="Run the logs on the Dask cluster at this address, such as tcp://host:8786: see help "
    "cluster.",
)
@options.json()
@options.quiet
# Long by its options and its help.
def run(
    log: tuple[str, ...],
    recursive: bool,
    from_file: IO[str] | None,
    log_choice: options_log.LogChoice,
    landmarks: str | None,
    odometry: Path | None,
    odometry_topic: str | None,
    frames: str | None,
    model: Path | None,
    settings: options.SettingsChoice,
    out: str,
    overwrite: bool,
    jobs: int | None,
    dry_run: bool,
    timeout: float | None,
    shard: str | None,
    scheduler: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Recognise landmarks in LOG, frame by frame.

    LOG is an MCAP file, a bag of ROS 1 or 2, a folder of images, a video, a sonar's own file
    (.aris, .ddf, .oculus, .raw, .glf), a folder of logs, or a quoted glob of these. The sonar's
    geometry comes from sonar.toml beside LOG (NAME.sonar.toml for one file), from --sonar, or from
    the flags below; polar messages and sonars' own files state theirs, mostly without tilt and
    height. Several logs are processed in parallel; one that cannot be used does not stop the
    others. LOG and OUT may be on a server (`sonarrec help remote`).

    Logs whose results are up to date are skipped; other results are replaced when the new ones are
    finished. A run that is stopped leaves its results so far in OUT/<log name>.part.

    \b
    Examples:
      sonarrec run sample_data/pan.mcap
      sonarrec run pings/ --tilt-deg 22 --height-m 0.7
      sonarrec run dive.mcap --topic /oculus/ping --tilt-deg 20 --time header
      sonarrec run pings/ --odometry poses.csv --model my.toml
      sonarrec run 'dump/*.png' --preset paper -o results
      sonarrec run campaign/ --recursive
      sonarrec run 'dives/**/*.mcap'
      sonarrec run s3://dives/2026-11-20/ -o s3://dives/results
    """
    from sonarrec.cli.run_watch import RunWatch
    from sonarrec.runs import cores
    from sonarrec.runs.logs_table import NAME, LogsTable
    from sonarrec.runs.prepare import RunOptions

    log_options = log_choice.log_options(odometry, odometry_topic, frames)
    run_options = RunOptions(settings.configs(), landmarks, model, settings.file)
    run_options.check()
    if timeout is not None and not timeout <= TIMEOUT_MAX:  # true for nan as well
        raise UsageError(f"--timeout {timeout:g}: expected at most {TIMEOUT_MAX:.0f} seconds")
    logs = options_log.named_logs(log, from_file, recursive)
    tell([], _unquoted_glob_notes(logs))
    if odometry is not None and len(logs) > 1:
        from sonarrec.readers.poses import read_poses

        read_poses(odometry)  # so that a fault is reported once, not for each log
    tasks = _tasks(logs, out, log_options, run_options, overwrite)
    if shard is not None:
        i, _, n = shard.partition("/")
        if not (i.isdecimal() and n.isdecimal() and 1 <= int(i) <= int(n)):
            raise UsageError(f"--shard {shard}: expected I/N with I from 1 to N, such as 2/8")
        tasks = tasks[int(i) - 1 :: int(n)]
    if not tasks:
        click.echo("nothing to do", err=True)
        return
    if dry_run:
        _plan(tasks)
        return
    jobs = min(jobs or cores(), len(tasks))
    with ExitStack() as stack:
        local_out = Path(out)
        if is_url(out):
            from sonarrec.runs.remote import check_out, get  # with fsspec, only where needed

            check_out(out)
            local_out = Path(stack.enter_context(TemporaryDirectory(prefix="sonarrec-")))
            get(f"{out.rstrip('/')}/{NAME}", local_out / NAME)  # with the rows of other calls
        table = LogsTable(local_out, tasks, alone=len(logs) == 1)
        server_out = out if is_url(out) else ""
        watch = RunWatch(tasks, table, local_out, server_out, jobs, quiet, as_json)
        folders = [] if server_out else [local_out / task.name for task in tasks]
        with stoppable(folders), watch:
            if scheduler is not None:
                from sonarrec.runs.cluster import run_on_cluster

                run_on_cluster(tasks, scheduler, watch, timeout)
            else:
                run_tasks(tasks, jobs, watch, timeout)
    if len(tasks) == 1 and watch.error is not None:
        raise watch.error
    watch.count()
    leave(watch.exit_code())


def run_tasks(
    tasks: Sequence[Task], jobs: int, watch: RunWatch, timeout_s: float | None = None
) -> None:
    """Run the tasks here, `jobs` at a time."""
    from sonarrec.runs.many import run_apart, run_here

    if jobs > 1 or timeout_s is not None:
        run_apart([*tasks], jobs, watch, timeout_s)
    else:
        run_here([*tasks], watch)


def _unquoted_glob_notes(logs: Sequence[NamedLog]) -> Iterator[str]:
    """A note for each folder of which several images are given as logs of their own."""
    from sonarrec.readers.containers.images import names_an_image

    # Path.is_file raises where a folder without permission is in the way.
    files = [Path(one.path) for one in logs if os.path.isfile(one.path)]  # noqa: PTH113
    for folder, count in Counter(f.parent for f in files if names_an_image(f.name)).items():
        if count > 1:
            yield (
                f"{folder}: {count} of its images are each run as a log of one "
                "frame; give the folder, or quote the glob, to run them as one log"
            )


def _tasks(
    logs: Sequence[NamedLog],
    out: str,
    log_options: LogOptions,
    run_options: RunOptions,
    overwrite: bool,
) -> list[Task]:
    """A task for each log. out: the folder of the results, or its URL."""
    from sonarrec.runs.one import result_names
    from sonarrec.runs.task import Task

    tasks = []
    names = result_names([hidden(log.path) if is_url(log.path) else log.path for log in logs])
    local_out, server_out = ("", out) if is_url(out) else (out, "")
    for log, name in zip(logs, names, strict=True):
        url = log.path if is_url(log.path) else ""
        path, reading = hidden(url) or log.path, replace(log_options, up_to=log.up_to)
        task = Task(path, name, local_out, reading, run_options, overwrite, url, server_out)
        tasks.append(task)
    return tasks


def _plan(tasks: list[Task]) -> None:
    """Print what would be done with each log: --dry-run."""
    from sonarrec.runs.task import plan_task

    faults = 0
    for task in tasks:
        try:
            plan = plan_task(task)
        except SonarrecError as error:
            faults += 1
            plan = f"fails ({error})"
        say(f"{task.path}: {plan}")
    if faults:
        leave(FAILED if faults == len(tasks) else PARTLY)


class _Terminated(KeyboardInterrupt):
    """Raised at SIGTERM, which batch systems and containers send."""


@contextmanager
def stoppable(folders: Sequence[Path]) -> Iterator[None]:
    """Let SIGTERM stop the run as Ctrl-C does; a line says where the results so far are."""

    def stop(*_: object) -> None:
        raise _Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt as error:
        from sonarrec.results.folders import part_of

        parts = ", ".join(name_as_text(part_of(f)) for f in folders if part_of(f).is_dir())
        where = f"; the frames so far are in {parts}" if parts else ""
        tell([f"stopped{where}"])
        leave(TERMINATED if isinstance(error, _Terminated) else INTERRUPTED)
    finally:
        signal.signal(signal.SIGTERM, before)
