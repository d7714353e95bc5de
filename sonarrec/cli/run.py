"""`sonarrec run`: recognise the landmarks in logs."""

from __future__ import annotations

import json
import math
import os
import signal
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from sonarrec.cli import options
from sonarrec.cli.endings import (
    FAILED,
    INTERRUPTED,
    MISUSED,
    PARTLY,
    TERMINATED,
    above_the_bar,
    inform,
    leave,
    progress,
    say,
    tell,
)
from sonarrec.cli.groups import (
    FILE,
    FiniteRange,
    command,
    file_names,
    in_batch,
    in_input,
    in_output,
)
from sonarrec.errors import (
    MissingError,
    SonarrecError,
    UsageError,
    is_url,
    name_as_text,
    number_of,
    printable,
)
from sonarrec.nouns import date_text, is_date

if TYPE_CHECKING:
    from sonarrec.readers.named_logs import NamedLog
    from sonarrec.results.sightings import Sighting
    from sonarrec.runs.one import Event, Outcome, Summary, Task
    from sonarrec.runs.run import Runs

MOST_SHOWN = 10
"""If a call has more logs, their passes are not printed."""
MOST_ROWS = 100
"""Of the table of what was found in each log."""
LONGEST_S = 1e9
"""Of --timeout: more than any log takes, and no more than a clock can wait for."""


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
    help="CSV of the sonar's poses (sonarrec help geometry).  [default: NAME.poses.csv or "
    "poses.csv beside the log; else the motion is measured between the images]",
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
    type=click.IntRange(min=1),
    help="How many logs run at once, each in its own process; 1: one after the other, in this "
    "process.  [default: the number of cores]",
)
@in_batch(
    "--dry-run", is_flag=True, help="Print what would be done with each log and why; write nothing."
)
@in_batch(
    "--timeout",
    type=FiniteRange(0, LONGEST_S, min_open=True),
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
    from sonarrec.readers.poses import read_poses
    from sonarrec.results.run_file import LogOptions
    from sonarrec.runs.prepare import RunOptions
    from sonarrec.runs.run import tasks_of

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
    tasks = tasks_of(logs, out, log_options, run_options, overwrite)
    if shard is not None:
        i, _, n = shard.partition("/")
        if not (i.isdecimal() and n.isdecimal() and 1 <= int(i) <= int(n)):
            raise UsageError(f"--shard {shard}: expected I/N with I from 1 to N, such as 2/8")
        tasks = tasks[int(i) - 1 :: int(n)]
    if not tasks:
        inform("nothing to do")
        return
    notes = _unquoted_glob_notes(logs)
    if dry_run:
        code = _plan(tasks)
        tell((), notes)
        leave(code)
    printer = Printer(tasks, jobs=jobs, quiet=quiet, as_json=as_json, notes=notes)
    alone = len(logs) == 1
    run_and_print(tasks, out, printer, timeout_s=timeout, scheduler=scheduler, alone=alone)
    leave(printer.exit_code())


def run_and_print(tasks: Sequence[Task], out: str | Path, printer: Printer, **calling: Any) -> Runs:
    """Run the tasks, as `run_tasks` does, and print what becomes of them; leave if stopped.

    Raises SonarrecError if a single log failed.
    """
    from sonarrec.runs.run import run_tasks

    done = None
    folders = [] if is_url(out) else [Path(out, task.name) for task in tasks]
    try:
        with stoppable(folders), printer:
            done = run_tasks(tasks, out, printer, jobs=printer.jobs, **calling)
    finally:
        printer.end(done)
    (error, *others) = (outcome.error for outcome in done.outcomes)
    if error is not None and not others:
        raise error
    return done


def _unquoted_glob_notes(logs: Sequence[NamedLog]) -> list[str]:
    """A note for each folder of which several images are given as logs of their own."""
    from sonarrec.readers.containers.images import names_an_image

    # Path.is_file raises where a folder without permission is in the way.
    files = [Path(one.path) for one in logs if os.path.isfile(one.path)]  # noqa: PTH113
    counts = Counter(f.parent for f in files if names_an_image(f.name))
    text = "of its images are each run as a log of one frame; give the folder, or quote the glob"
    return [f"{folder}: {count} {text}" for folder, count in counts.items() if count > 1]


def _plan(tasks: Sequence[Task]) -> int:
    """Print what would be done with each log: --dry-run. The exit code."""
    from sonarrec.runs.one import plan_task

    faults = 0
    for task in tasks:
        try:
            plan = plan_task(task)
        except SonarrecError as error:
            faults += 1
            plan = f"fails ({error})"
        say(f"{task.path}: {plan}")
    return 0 if not faults else FAILED if faults == len(tasks) else PARTLY


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
        tell(["stopped" + f"; the frames so far are in {parts}" * bool(parts)])
        leave(TERMINATED if isinstance(error, _Terminated) else INTERRUPTED)
    finally:
        signal.signal(signal.SIGTERM, before)


class Printer:
    """Prints what becomes of the logs of one call, as its `Watch`; a context manager.

    What is wrong is printed when it happens, what was found in the order of the logs, notes at the
    end. jobs: how many logs run at once; default: the number of cores. quiet: only what is wrong,
    and notes. as_json: one document in place of tables. briefly: only what is wrong.
    """

    def __init__(
        self,
        tasks: Sequence[Task],
        *,
        jobs: int | None,
        quiet: bool,
        as_json: bool = False,
        briefly: bool = False,
        notes: Sequence[str] = (),
    ) -> None:
        from sonarrec.runs import cores

        self.outcomes: dict[int, Outcome] = {}  # of the tasks that have ended
        self.jobs = min(jobs or cores(), len(tasks))
        self._tasks, self._apart, self._several = tasks, self.jobs > 1, len(tasks) > 1
        self._quiet, self._as_json, self._briefly = quiet, as_json, briefly
        self._notes = [*notes]
        self._bars, self._step = ExitStack(), _nothing  # the bar that is shown; moves it
        self._done: dict[int, int] = {}  # frames of those that were started
        self._printed = 0  # of how many tasks, in order, the passes were printed

    def __enter__(self) -> Printer:
        if self._apart:
            bar = progress(self._quiet, len(self._tasks), unit="log")
            self._step = self._bars.enter_context(bar)
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.close()

    def __call__(self, i: int | None, event: Event) -> None:
        if isinstance(event, str):
            with above_the_bar():
                if not (self._quiet or self._briefly):
                    inform(event if i is None else f"{self._tasks[i].name}: {event}")
        elif i is not None and isinstance(event, tuple):
            done, total = event
            if not self._apart and not done:
                which = f" ({i + 1} of {len(self._tasks)})" if self._several else ""
                bar = progress(self._quiet, total, f"{self._tasks[i].name}{which}")
                self._step = self._bars.enter_context(bar)
            elif not self._apart:
                self._step(total, done - self._done[i])
            self._done[i] = done
        elif i is not None and not isinstance(event, tuple):
            if self._apart:
                self._step()
            else:
                self._bars.close()
            with above_the_bar():
                self._ended(i, event)

    def _ended(self, i: int, outcome: Outcome) -> None:
        self.outcomes[i] = outcome
        if outcome.fault:
            click.echo(outcome.fault.rstrip(), err=True)
        if outcome.summary is not None:
            name, path = self._tasks[i].name, self._tasks[i].path
            lines = outcome.summary.problems
            tell([x if path in x or not self._several else f"{name}: {x}" for x in lines])
        elif self._several:  # else it is raised
            tell([outcome.message])
        while (ended := self.outcomes.get(self._printed)) is not None:
            self._printed += 1
            silent = self._quiet or self._as_json or self._briefly or len(self._tasks) > MOST_SHOWN
            if ended.summary is not None and not silent:
                say(*found_in(ended.summary, ended.folder))

    def end(self, done: Runs | None) -> None:
        """Print what is for the whole call; done: None if it was stopped."""
        failed = [self._tasks[i].path for i, o in self._ordered() if o.status == "failed"]
        if done is not None and done.fault and not failed:
            tell([done.fault])  # else the disk is full, which was reported
        if self._briefly:
            return
        if self._as_json:
            logs = [self._document(i) for i in range(len(self._tasks))]
            from sonarrec.results.run_file import PROGRAM

            click.echo(json.dumps({"program": PROGRAM, "logs": logs}, indent=2))
        elif done is not None and self._several and not self._quiet:
            say("", *self._table())
        if done is not None and self._several and (failed or not self._quiet):
            counts = Counter(_in_words(outcome) for outcome in self.outcomes.values())
            line = ", ".join(f"{counts[how]} {how}" for how in HOW if counts[how])
            if len(failed) > MOST_SHOWN:
                line += "; logs.csv lists them"
            elif failed:
                line += f": {', '.join(failed)}"
            click.echo(printable(line), err=bool(failed) or self._as_json)
        tell((), [*self._notes, *self._notes_on_logs(), *(done.notes if done else ())])

    def _ordered(self) -> list[tuple[int, Outcome]]:
        return sorted(self.outcomes.items())

    def _notes_on_logs(self) -> Iterator[str]:
        """Those of a single log as they are; of several each once, with the logs it is on."""
        named: dict[str, list[str]] = {}
        for i, outcome in self._ordered():
            for note in outcome.summary.notes if outcome.summary else ():
                task = self._tasks[i]
                text = note.removeprefix(f"{task.path}: ") if self._several else note
                named.setdefault(text, []).append(task.name)
        for text, (first, *others) in named.items():
            more = f" and {number_of(len(others), 'more log')}" if others else ""
            yield f"{first}{more}: {text}" if self._several else text

    def _table(self) -> Iterator[str]:
        """A row for each log: what was found in it."""
        width = max(3, *(min(len(task.name), 40) for task in self._tasks[:MOST_ROWS]))
        yield f"{'log':<{width}}  {'frames':>7}  {'notes':>5}  frames with a landmark declared"
        for i, outcome in self._ordered()[:MOST_ROWS]:
            summary, name = outcome.summary, f"{self._tasks[i].name:<{width}}"
            if summary is None:
                yield f"{name}  {'-':>7}  {'-':>5}  failed"
                continue
            notes = "-" if summary.up_to_date else str(len(summary.notes))
            seen = [f"ID.{one}: {count}" for one, count in sorted(summary.landmarks.items())]
            lost = f"; {summary.unusable} unusable" if summary.unusable else ""
            found = ", ".join(seen) or "none"
            yield f"{name}  {summary.frames:>7}  {notes:>5}  {found}{lost}"
        if len(self.outcomes) > MOST_ROWS:
            yield f"{len(self.outcomes) - MOST_ROWS} more in logs.csv"

    def _document(self, i: int) -> dict[str, Any]:
        """The JSON object of a log, with all its sightings."""
        task, outcome = self._tasks[i], self.outcomes.get(i)
        document: dict[str, Any] = {"name": task.name, "log": task.path}
        if outcome is None:
            return document | {"status": "stopped" if i in self._done else "waiting"}
        document["status"] = outcome.status
        if outcome.summary is None:
            return document | {"message": outcome.message}
        from sonarrec.results.sightings import sightings_in

        summary, file = outcome.summary, outcome.summary.folder / "sightings.csv"
        found = map(asdict, sightings_in(file) if file.is_file() else summary.sightings)
        known = [{k: None if v != v else v for k, v in one.items()} for one in found]  # not nan
        return document | asdict(summary) | {"folder": outcome.folder, "sightings": known}

    def exit_code(self) -> int:
        """The exit code of the call, after all have ended."""
        outcomes = self.outcomes.values()
        if outcomes and all(one.status == "failed" for one in outcomes):
            return (
                MISUSED if all(isinstance(one.error, MissingError) for one in outcomes) else FAILED
            )
        return 0 if all(one.status == "done" for one in outcomes) else PARTLY


def _nothing(*_: object) -> None:
    """Moves no bar."""


HOW = ("done", "up to date", "partial", "failed")


def _in_words(outcome: Outcome) -> str:
    """The status of a log as the end of a call counts it."""
    if outcome.status == "done" and outcome.summary is not None and outcome.summary.up_to_date:
        return "up to date"
    return outcome.status


def found_in(summary: Summary, folder: str) -> list[str]:
    """Lines on one log: its frames, the longest passes of each method, how many more there are.

    folder: where sightings.csv has them.
    """
    again = "up to date, " * summary.up_to_date
    lines = [f"{folder}: {again}{number_of(summary.frames, 'frame')}"]
    for method, count in summary.passes.items() if not summary.up_to_date else ():
        lines += [f"  {method}:"] if len(summary.passes) > 1 else []
        sightings = [s for s in summary.sightings if s.method == method]
        if not sightings:
            lines.append("  no landmark declared")
            continue
        dated = is_date(sightings[0].start_ns)
        ends = [_end(s) if dated else f"{s.end_ns / 1e9:.2f}" for s in sightings]
        starts = [
            date_text(s.start_ns, 2) if dated else f"{s.start_ns / 1e9:.2f}" for s in sightings
        ]
        wide = max(map(len, (*ends, "to UTC"))) if dated else 9
        heads = f"{'from UTC':<22}  {'to UTC':<{wide}}" if dated else f"{'from s':>9} {'to s':>9}"
        lines.append(
            f"  landmark  track  frames       {heads}  declared  best score  range m  bearing deg"
        )
        for s, start, end in zip(sightings, starts, ends, strict=True):
            times = f"{start:<22}  {end:<{wide}}" if dated else f"{start:>9} {end:>9}"
            track = "-" if s.track is None else s.track
            lines.append(
                f"  {s.landmark:>8}  {track:>5}  {f'{s.first_frame}-{s.last_frame}':<11}  {times}"
                f"  {s.frames_declared:>8}  {s.best_score:>10.3f}  {_number(s.range_m, 2):>7}"
                f"  {_number(s.bearing_deg, 1):>11}"
            )
        if count > len(sightings):
            more = count - len(sightings)
            lines.append(f"  these are the longest; {more} more in {folder}/sightings.csv")
    return lines


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _end(s: Sighting) -> str:
    """The end of a pass, with the date if it differs from that of the start."""
    start, end = date_text(s.start_ns, 2), date_text(s.end_ns, 2)
    return end[11:] if end[:10] == start[:10] else end
