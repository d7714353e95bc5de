"""`sonarrec run`: recognise the landmarks in logs."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from sonarrec.cli import options
from sonarrec.cli.endings import (
    INTERRUPTED,
    PARTLY,
    TERMINATED,
    Terminated,
    above_the_bar,
    code_of,
    code_of_all,
    inform,
    leave,
    print_notes,
    progress,
    say,
)
from sonarrec.cli.groups import (
    FILE,
    IntegerRange,
    command,
    file_names,
    in_batch,
    in_input,
    in_output,
)
from sonarrec.errors import SonarrecError, UsageError, is_url, name_as_text, number_of, printable
from sonarrec.sonar.frame import date_text, is_date

if TYPE_CHECKING:
    from sonarrec.runs.job import Event, Job, Outcome
    from sonarrec.runs.run import Runs

MOST_FAILED = 10
"""Logs that failed whose paths are printed at the end; logs.csv lists all."""
MOST_ROWS = 100
"""Of the table of what was found in each log."""


class _FolderOrUrl(click.Path):
    def convert(self, value: Any, *context: Any) -> Any:
        return str(value) if is_url(value) else super().convert(value, *context)


@command(short_help="Recognise the landmarks in logs.", first=("--sonar", "--landmarks", "--out"))
@click.argument("log", shell_complete=file_names, nargs=-1)
@options.many_logs
@options.reading(geometry=True, time=True)
@options.landmarks
@in_input(
    "--odometry",
    type=FILE,
    help="Table of the sonar's poses, CSV or TUM (sonarrec help geometry).  [default: "
    "NAME.poses.csv or poses.csv next to the log; else the motion is measured between the images]",
)
@in_input(
    "--odometry-topic",
    metavar="TOPIC",
    help="Poses in the MCAP or bag: nav_msgs/Odometry or geometry_msgs/PoseStamped.",
)
@options.frames("Process only the frames from A up to, not including, B.")
@in_input(
    "--model",
    type=FILE,
    help="Appearance model that `sonarrec calibrate` wrote.  [default: built in]",
)
@options.settings
@options.out(_FolderOrUrl(file_okay=False), "Results go to OUT/<log name>.", default="sonarrec_out")
@in_output(
    "--overwrite",
    is_flag=True,
    help="Run logs again that are up to date, and replace results of another log of the same name.",
)
@in_batch(
    "-j --jobs",
    type=IntegerRange(min=1),
    help="How many logs run at once, each in its own process; 1: one after the other, in this "
    "process.  [default: the number of cores]",
)
@in_batch(
    "--dry-run", is_flag=True, help="Print what would be done with each log and why; write nothing."
)
@in_batch("--shard", metavar="I/N", help="Run only every N-th log, from the I-th: see help run.")
@in_batch(
    "--scheduler",
    metavar="ADDRESS",
    help="Run the logs on the Dask cluster at this address, such as tcp://host:8786: see help run.",
)
@options.quiet
# Long by its options and its help.
def run(
    log: tuple[str, ...],
    recursive: bool,
    from_file: IO[str] | None,
    reading: dict[str, Any],
    landmarks: str | None,
    odometry: Path | None,
    odometry_topic: str | None,
    frames: tuple[int, int | None] | None,
    model: Path | None,
    settings: options.SettingsChoice,
    out: str,
    overwrite: bool,
    jobs: int | None,
    dry_run: bool,
    shard: str | None,
    scheduler: str | None,
    quiet: bool,
) -> None:
    """Recognise landmarks in LOG, frame by frame.

    LOG is an MCAP file, a bag of ROS 1 or 2, a folder of images, a video, a sonar's own file
    (.aris, .ddf, .oculus, .raw, .glf), a folder of logs, or a quoted glob of these. The sonar's
    geometry comes from sonar.toml next to LOG (NAME.sonar.toml for one file), from --sonar, or from
    the flags below; polar messages and sonars' own files state theirs, mostly without tilt and
    height. Several logs are processed in parallel; one that cannot be used does not stop the
    others. LOG and OUT may be on a server (`sonarrec help run`).

    Logs whose results are up to date are skipped; results of other settings are replaced when the
    new ones are finished. A run that is stopped leaves its results so far in OUT/<log name>.part.

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
    from sonarrec.advice.log import of_run
    from sonarrec.readers.poses import read_poses
    from sonarrec.results.run_file import LogOptions
    from sonarrec.runs.job import RunOptions
    from sonarrec.runs.run import jobs_of

    if odometry is not None and odometry_topic is not None:
        raise UsageError("--odometry and --odometry-topic: choose one of the two")
    log_options = LogOptions(
        **reading, odometry=odometry, odometry_topic=odometry_topic, frames=frames
    )
    run_options = RunOptions(settings.configs(), landmarks, model, settings.config_file)
    run_options.check()
    logs = options.named_logs(log, from_file, recursive)
    if odometry is not None and len(logs) > 1:
        read_poses(odometry)  # so that a fault is reported once, not for each log
    to_run = jobs_of(logs, out, log_options, run_options, overwrite, of_run)
    if shard is not None:
        i, _, n = shard.partition("/")
        if not (i.isdecimal() and n.isdecimal() and 1 <= int(i) <= int(n)):
            raise UsageError(f"--shard {shard}: expected I/N with I from 1 to N, such as 2/8")
        to_run = to_run[int(i) - 1 :: int(n)]
    if not to_run:
        inform("nothing to do")
        return
    if dry_run:
        leave(_plan(to_run))
    done = run_and_print(
        to_run, out, quiet=quiet, at_once=jobs, scheduler=scheduler, alone=len(logs) == 1
    )
    leave(exit_code(done.outcomes))


def run_and_print(
    jobs: Sequence[Job], out: str | Path, *, quiet: bool, briefly: bool = False, **calling: Any
) -> Runs:
    """Run the jobs, as `run_jobs` does, and print what becomes of them; leave if stopped.

    quiet: only what is wrong, and notes. briefly: only what is wrong. Raises SonarrecError if a
    single log failed.
    """
    from sonarrec.runs.run import run_jobs

    several, frames = len(jobs) > 1, 0
    goes_by: dict[str, list[str]] = {}  # the logs of each line, printed once
    folders = [] if is_url(out) else [Path(out, job.name) for job in jobs]
    # A bar over the logs, or over the frames of the only one.
    bar = (len(jobs), None, "log") if several else (None, jobs[0].name, "frame")

    with stoppable(folders), progress(quiet, *bar) as step:

        def watch(i: int | None, event: Event) -> None:
            nonlocal frames
            if isinstance(event, tuple):
                if not several:
                    step(event[1], event[0] - frames)
                    frames = event[0]
                return
            if not isinstance(event, str) and several:
                step()
            with above_the_bar():
                if not isinstance(event, str):
                    _print_faults(event, jobs[i or 0], several)
                elif i is None and not (quiet or briefly):
                    inform(event)
                elif i is not None:
                    same = goes_by.setdefault(_without_path(event, jobs[i]), [])
                    same.append(jobs[i].name)
                    if not (same[1:] or quiet or briefly):
                        inform(f"{jobs[i].name}: {event}")

        done = run_jobs(jobs, out, watch, **calling)
    failed = [(j.path, o) for j, o in zip(jobs, done.outcomes, strict=True) if o.error is not None]
    if done.fault and not failed:
        print_notes([done.fault])  # else the disk is full, which was reported
    if not several and (error := done.outcomes[0].error) is not None:
        raise error
    if briefly:
        return done
    for first, *others in goes_by.values() if not quiet else ():
        if others:
            logs = others[0] if not others[1:] else f"{len(others)} more logs"
            inform(f"{logs}: as {first}")
    if not several and not quiet:
        say(*found_in(done.outcomes[0], jobs[0].results))
    elif not quiet:
        say(*_table(jobs, done.outcomes))
    if several and (failed or not quiet):
        counts = Counter(_in_words(outcome) for outcome in done.outcomes)
        line = ", ".join(f"{counts[how]} {how}" for how in HOW if counts[how])
        if failed:
            more = "; logs.csv lists them" if len(failed) > MOST_FAILED else ""
            line += more or f": {', '.join(path for path, _ in failed)}"
        elif "/" in (folder := jobs[0].results):
            line += f", in {folder.rpartition('/')[0]}"
        click.echo(printable(line), err=bool(failed))
    if several and not quiet:  # again, for they were printed before the table
        print_notes(outcome.message for _, outcome in failed[:MOST_FAILED])
    print_notes((), [*_notes(jobs, done.outcomes), *done.notes])
    return done


def _print_faults(outcome: Outcome, job: Job, several: bool) -> None:
    """Print what is wrong with a log, as it ends."""
    if outcome.traceback:
        click.echo(outcome.traceback.rstrip(), err=True)
    if outcome.error is None:
        lines = outcome.problems
        print_notes([x if job.path in x or not several else f"{job.name}: {x}" for x in lines])
    elif several:  # else it is raised
        print_notes([outcome.message])


def _plan(jobs: Sequence[Job]) -> int:
    """Print what would be done with each log: --dry-run. The exit code."""
    from sonarrec.runs.one import plan_job

    codes = []
    for job in jobs:
        try:
            plan, code = plan_job(job), 0
        except SonarrecError as error:
            plan, code = f"fails ({error})", code_of(error)
        say(f"{job.path}: {plan}")
        codes.append(code)
    return code_of_all(codes)


@contextmanager
def stoppable(folders: Sequence[Path]) -> Iterator[None]:
    """Where the run is stopped, a line says where the results so far are."""
    try:
        yield
    except KeyboardInterrupt as error:
        from sonarrec.results.folders import part_of

        parts = ", ".join(name_as_text(part_of(f)) for f in folders if part_of(f).is_dir())
        print_notes([f"stopped; the frames so far are in {parts}" if parts else "stopped"])
        leave(TERMINATED if isinstance(error, Terminated) else INTERRUPTED)


def _notes(jobs: Sequence[Job], outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Those of a single log as they are; of several each once, with the logs it is on."""
    named: dict[str, list[tuple[str, str]]] = {}
    for job, outcome in zip(jobs, outcomes, strict=True):
        for note in outcome.notes:
            text = note.removeprefix(f"{job.path}: ") if len(jobs) > 1 else note
            named.setdefault(_without_path(text, job), []).append((job.name, text))
    for (first, text), *others in named.values():
        more = f" and {number_of(len(others), 'more log')}" if others else ""
        yield f"{first}{more}: {text}" if len(jobs) > 1 else text


def _without_path(text: str, job: Job) -> str:
    """A line on a log without the log's path, so that equal lines on several are equal."""
    return text.replace(os.path.splitext(Path(job.path))[0], "")  # noqa: PTH122 - also of "."


def _table(jobs: Sequence[Job], outcomes: Sequence[Outcome]) -> Iterator[str]:
    """A row for each log: what was found in it."""
    width = max(3, *(min(len(job.name), 40) for job in jobs[:MOST_ROWS]))
    head = f"{'log':<{width}}  {'frames':>7}  {'notes':>5}"
    yield f"{head}  {'state':<10}  frames with a landmark declared"
    for job, outcome in [*zip(jobs, outcomes, strict=True)][:MOST_ROWS]:
        name = f"{job.name:<{width}}"
        if outcome.error is not None:
            yield f"{name}  {'-':>7}  {'-':>5}  failed      -"
            continue
        notes = "-" if outcome.up_to_date else str(len(outcome.notes))
        seen = [f"ID.{landmark}: {count}" for landmark, count in sorted(outcome.landmarks.items())]
        lost = f"; {outcome.unusable} unusable" if outcome.unusable else ""
        state = f"{outcome.frames:>7}  {notes:>5}  {_in_words(outcome):<10}"
        yield f"{name}  {state}  {', '.join(seen) or 'none'}{lost}"
    if len(jobs) > MOST_ROWS:
        yield f"{len(jobs) - MOST_ROWS} more in logs.csv"


def exit_code(outcomes: Sequence[Outcome]) -> int:
    """The exit code of a call by what became of its logs."""
    return code_of_all(
        [
            code_of(o.error) if o.error is not None else PARTLY * (o.status != "done")
            for o in outcomes
        ]
    )


HOW = ("done", "up to date", "partial", "failed")


def _in_words(outcome: Outcome) -> str:
    """The status of a log as the end of a call counts it."""
    if outcome.status == "done" and outcome.up_to_date:
        return "up to date"
    return outcome.status


def found_in(outcome: Outcome, folder: str | Path) -> list[str]:
    """Lines on one log: its frames, the longest passes of each method, how many more there are.

    folder: where sightings.csv has them.
    """
    again = "up to date, " if outcome.up_to_date else ""
    lines = [f"{folder}: {again}{number_of(outcome.frames, 'frame')}"]
    for method, count in outcome.passes.items():
        lines += [f"  {method}:"] if len(outcome.passes) > 1 else []
        sightings = [s for s in outcome.sightings if s.method == method]
        if not sightings:
            lines.append("  no landmark declared")
            continue
        dated = is_date(sightings[0].start_ns)
        unit, wide = ("UTC", 22) if dated else ("s", 9)
        lines.append(
            f"  landmark  track  frames       {f'from {unit}':>{wide}} {f'to {unit}':>{wide}}  "
            "declared  best score  range m  bearing deg"
        )
        for s in sightings:
            start, end = (
                date_text(ns, 2) if dated else f"{ns / 1e9:.2f}" for ns in (s.start_ns, s.end_ns)
            )
            track = "-" if s.track is None else s.track
            range_m = "-" if math.isnan(s.range_m) else f"{s.range_m:.2f}"
            bearing = "-" if math.isnan(s.bearing_deg) else f"{s.bearing_deg:.1f}"
            lines.append(
                f"  {s.landmark:>8}  {track:>5}  {f'{s.first_frame}-{s.last_frame}':<11}  "
                f"{start:>{wide}} {end:>{wide}}  {s.frames_declared:>8}  {s.best_score:>10.3f}  "
                f"{range_m:>7}  {bearing:>11}"
            )
        if count > len(sightings):
            more = count - len(sightings)
            lines.append(f"  these are the longest; {more} more in {folder}/sightings.csv")
    return lines
