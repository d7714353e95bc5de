"""`sonarrec run`: recognise the landmarks in recorded logs."""

from __future__ import annotations

import os
import signal
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import TIMEOUT_MAX
from typing import IO, TYPE_CHECKING

import click

from sonarrec.cli import options, options_log
from sonarrec.cli.endings import FAILED, INTERRUPTED, PARTLY, TERMINATED, leave, say, tell
from sonarrec.cli.groups import NEW_FILE, command, file_names, in_batch, in_input, in_output
from sonarrec.errors import SonarrecError, UsageError, name_as_text, number_of

if TYPE_CHECKING:
    from sonarrec.cli.run_watch import RunWatch
    from sonarrec.readers.named_logs import NamedLog
    from sonarrec.remote.find import RemoteLog
    from sonarrec.remote.upload import Outbox
    from sonarrec.results.run_file import LogOptions
    from sonarrec.runs.prepare import RunOptions
    from sonarrec.runs.task import Task


_ODOMETRY = options_log.odometry_options(in_input)


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
@options.out(options.FOLDER_OR_URL, "Results go to OUT/<log name>.", default=Path("sonarrec_out"))
@in_output(
    "--tables",
    type=click.Choice(["csv", "parquet"]),
    default="csv",
    help="Format of the estimates; parquet needs `pip install 'sonarrec[parquet]'`.",
)
@in_output(
    "--odometry-out",
    type=NEW_FILE,
    metavar="FILE",
    help="Also write the sonar's path, from the poses or measured between the images, as a CSV "
    "that --odometry reads; for one log only.",
)
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
    "--retry-failed",
    is_flag=True,
    help="Run only the logs that are failed or partial in OUT/logs.csv, from the start.",
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
@in_batch(
    "--shard", metavar="I/N", help="Run only every N-th log, from the I-th: see help cluster."
)
@in_batch(
    "--scheduler",
    metavar="ADDRESS",
    help="Run the logs on the Dask cluster at this address, such as tcp://host:8786: see help "
    "cluster.",
)
@options.json()
@options.cache
@in_output("-v --verbose", is_flag=True, help="Print a line on stderr for each finished log.")
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
    out: Path | str,
    tables: str,
    odometry_out: Path | None,
    overwrite: bool,
    jobs: int | None,
    retry_failed: bool,
    dry_run: bool,
    timeout: float | None,
    shard: str | None,
    scheduler: str | None,
    as_json: bool,
    cache: options.GetCache,
    verbose: bool,
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
      sonarrec run rosbag2_2026_11_20-10_00_00/
      sonarrec run campaign/ --recursive
      sonarrec run 'dives/**/*.mcap'
      sonarrec run --from-file dives.txt
      sonarrec run s3://dives/2026-11-20/ -o s3://dives/results
    """
    from sonarrec.cli.run_watch import RunWatch
    from sonarrec.remote.run import RemoteFiles, inside
    from sonarrec.remote.urls import is_url, parse_url
    from sonarrec.runs.cores import cores
    from sonarrec.runs.logs_table import NAME, LogsTable, again
    from sonarrec.runs.prepare import RunOptions
    from sonarrec.tables.outputs import check_output
    from sonarrec.tables.parquet import check_parquet

    log_options = log_choice.log_options(odometry, odometry_topic, frames)
    if tables == "parquet":
        check_parquet()
    run_options = RunOptions(
        settings.configs(), landmarks, model, settings.file, tables == "parquet"
    )
    run_options.check()
    if timeout is not None and not timeout <= TIMEOUT_MAX:  # true for nan as well
        raise UsageError(f"--timeout {timeout:g}: expected at most {TIMEOUT_MAX:.0f} seconds")
    logs = options_log.named_logs(log, from_file, recursive)
    tell([], _unquoted_glob_notes(logs))
    if odometry is not None and len(logs) > 1:
        from sonarrec.readers.poses_csv import read_poses

        read_poses(odometry)  # so that a fault is reported once, not for each log
    outbox, local_out = None, Path(out)
    if is_url(out):
        from sonarrec.remote.upload import Outbox  # with fsspec, only where needed

        outbox = Outbox(parse_url(out), cache())
        local_out = outbox.folder
    tasks = _tasks(logs, local_out, log_options, run_options, overwrite, outbox, cache)
    if shard is not None:
        i, _, n = shard.partition("/")
        if not (i.isdecimal() and n.isdecimal() and 1 <= int(i) <= int(n)):
            raise UsageError(f"--shard {shard}: expected I/N with I from 1 to N, such as 2/8")
        tasks = tasks[int(i) - 1 :: int(n)]
    unfinished = 0
    if retry_failed:
        if outbox is not None:
            outbox.fetch(NAME)
        tasks, unfinished = again(tasks, local_out)
    if not tasks:
        hint = f"; {number_of(unfinished, 'log')} not finished: run without --retry-failed"
        click.echo(f"nothing to do{hint if unfinished else ''}", err=True)
        return
    if odometry_out is not None:
        if len(tasks) > 1:
            raise UsageError(
                f"--odometry-out is for one log, but {len(tasks)} are given; run that log alone"
            )
        read = [tasks[0].path, odometry]
        check_output(odometry_out, "table", read, header="timestamp_ns,yaw,x,y")
    if dry_run:
        _plan(tasks)
        return
    jobs = min(jobs or cores(), len(tasks))
    table = LogsTable(local_out, tasks, alone=len(logs) == 1)
    watch = RunWatch(tasks, table, local_out, outbox, jobs, quiet, verbose, as_json)
    with stoppable([local_out / task.name for task in tasks]), watch:
        if scheduler is not None:
            from sonarrec.runs.cluster import run_on_cluster

            run_on_cluster(tasks, scheduler, watch, timeout)
        else:
            run_tasks(tasks, jobs, watch, timeout)
    if len(tasks) == 1 and watch.error is not None:
        raise watch.error
    if odometry_out is not None:
        from sonarrec.mapping.path import write_path

        with ExitStack() as stack:
            write_path(RemoteFiles(stack, cache).results(inside(out, tasks[0].name)), odometry_out)
    watch.count()
    leave(watch.exit_code())


def run_tasks(
    tasks: Sequence[Task], jobs: int, watch: RunWatch, timeout_s: float | None = None
) -> None:
    """Run the tasks here, `jobs` at a time; each uses a second core if cores are free."""
    from sonarrec.runs.cores import cores
    from sonarrec.runs.many import run_apart, run_here

    tasks = [replace(task, ahead=cores() >= 2 * jobs) for task in tasks]
    if jobs > 1 or timeout_s is not None:
        run_apart(tasks, jobs, watch, timeout_s)
    else:
        run_here(tasks, watch)


def _unquoted_glob_notes(logs: Sequence[NamedLog | RemoteLog]) -> Iterator[str]:
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
    logs: Sequence[NamedLog | RemoteLog],
    out: Path,
    log_options: LogOptions,
    run_options: RunOptions,
    overwrite: bool,
    outbox: Outbox | None,
    cache: options.GetCache,
) -> list[Task]:
    """A task for each log. out: the local folder of the results."""
    from sonarrec.remote.find import RemoteLog
    from sonarrec.runs.one import result_names
    from sonarrec.runs.task import Task

    tasks = []
    names = result_names([log if isinstance(log, RemoteLog) else log.path for log in logs])
    for log, name in zip(logs, names, strict=True):
        if isinstance(log, RemoteLog):
            remote, path, reading = log, log.url.redacted, log_options
        else:
            remote, path, reading = None, log.path, replace(log_options, up_to=log.up_to)
        task = Task(path, name, str(out), reading, run_options, overwrite)
        if remote or outbox:
            to = outbox.url if outbox else None
            task = replace(task, cache=cache(), server_log=remote, server_out=to)
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
