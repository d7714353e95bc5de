"""`sonarrec run`: recognise the landmarks in recorded logs."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import click

from sonarrec import __version__
from sonarrec.cli.options import (
    FAILED,
    FILE,
    FOLDER,
    INPUT,
    MISUSED,
    OUTPUT,
    PARTLY,
    LogChoice,
    SettingsChoice,
    command,
    frames_option,
    landmarks_option,
    leave,
    log_options,
    many_logs_options,
    named_logs,
    option,
    out_option,
    progress,
    quiet_option,
    settings_options,
    tell,
    verbose_option,
)
from sonarrec.cli.passes import as_json as told
from sonarrec.cli.passes import table
from sonarrec.records import FrameResult, MissingError, SonarrecError, UsageError, shown

if TYPE_CHECKING:
    from sonarrec.pipeline import Summary
    from sonarrec.readers.many import NamedLog

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes of a run that was stopped by Ctrl-C or SIGTERM."""


@command(short_help="Recognise the landmarks in logs.")
@click.argument("log", nargs=-1)
@many_logs_options
@log_options(time=True)
@landmarks_option
@option(
    INPUT,
    "--odometry",
    type=FILE,
    help="CSV of the sonar's poses: timestamp or timestamp_ns, yaw (deg, positive to the right) "
    "and, where known, x, y (m).  [default: NAME.poses.csv or poses.csv beside the log; without "
    "one the turn is measured between the images]",
)
@option(
    INPUT,
    "--odometry-topic",
    metavar="TOPIC",
    help="Poses in the MCAP or bag itself: nav_msgs/Odometry or geometry_msgs/PoseStamped.",
)
@frames_option("Recognise only these frames, from A up to, not including, B.")
@option(
    INPUT,
    "--model",
    type=FILE,
    help="Appearance model of `sonarrec calibrate`.  [default: built in]",
)
@settings_options
@out_option(
    FOLDER, "Results go to OUT/<log name>.", default=Path("sonarrec_out"), show_default=True
)
@option(
    OUTPUT,
    "--overwrite",
    is_flag=True,
    help="Do again what is up to date, and replace results of another log of that name.",
)
@option(OUTPUT, "--json", "as_json", is_flag=True, help="Print one JSON document on stdout.")
@verbose_option
@quiet_option
def run(
    log: tuple[str, ...],
    recursive: bool,
    from_file: IO[str] | None,
    log_choice: LogChoice,
    landmarks: str | None,
    odometry: Path | None,
    odometry_topic: str | None,
    frames: str | None,
    model: Path | None,
    settings: SettingsChoice,
    out: Path,
    overwrite: bool,
    as_json: bool,
    verbose: bool,
    quiet: bool,
) -> None:
    """Recognise landmarks in LOG, frame by frame.

    LOG is an MCAP file, a bag of ROS 1 or 2, a folder of images, a video, a folder of logs, or a
    quoted glob of these. The sonar's geometry is read from sonar.toml beside it (NAME.sonar.toml
    for one file) or in a folder above, up to the LOG given; from --sonar, or from the flags; polar
    sonar messages tell their own, all but the tilt and the height. Several logs are processed one
    after the other; one that cannot be used does not stop the others.

    Results are replaced only when the new ones are finished, and not made again where they are up
    to date. A run that is stopped leaves its part in OUT/<log name>.part.

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
    """
    from sonarrec.pipeline import Used, process, result_names
    from sonarrec.readers.find import find_logs
    from sonarrec.results.run_file import Given, frame_span

    if odometry is not None and odometry_topic is not None:
        raise UsageError("--odometry and --odometry-topic: choose one of the two")
    given = Given(
        **log_choice.arguments(),
        odometry=odometry,
        odometry_topic=odometry_topic,
        frames=None if frames is None else frame_span(frames),
    )
    used = Used(settings.configs(), landmarks, model, settings.file)
    logs = find_logs(log)
    names = result_names(logs)
    ended = _Ended(len(logs), as_json, verbose=verbose, quiet=quiet)

    def one(path: str, name: str | None, title: str) -> Summary:
        with progress(quiet, title=title) as step:

            def observe(result: FrameResult, total: int | None) -> None:
                step(total, f"{result.tracks} tracks in view")

            return process(path, out, given, used, observe, name=name, overwrite=overwrite)

    folders = [out / name for name in names if name is not None]
    with ended.document(), _stoppable(folders):
        for i, (path, name) in enumerate(zip(logs, names, strict=True)):
            begun = monotonic()
            title = f"{name} ({i + 1} of {len(logs)})" if len(logs) > 1 else str(name)
            try:
                summary = one(path, name, title)
            except KeyboardInterrupt:
                ended.add_failed(path, name, "stopped")
                raise
            except SonarrecError as error:
                ended.add_failed(path, name, "failed", error)
                if len(logs) == 1:
                    raise
                tell([str(error)])
            else:
                ended.add(path, name, summary, monotonic() - begun)
    ended.leave()


class _Ended:
    """How the logs of one call ended, told as each does and at the end."""

    def __init__(self, logs: int, as_json: bool, *, verbose: bool, quiet: bool) -> None:
        self._logs, self._as_json = logs, as_json
        self._verbose, self._quiet = verbose, quiet
        self._paths: dict[str, list[str]] = {
            how: [] for how in ("done", "up to date", "in part", "failed")
        }
        self._missing = 0
        self._told: list[dict[str, Any]] = []  # a table per log, where JSON is asked for

    def add(self, path: str, name: str | None, summary: Summary, seconds: float) -> None:
        """A log that was processed, or was up to date."""
        tell(summary.problems, summary.notes)
        how = "in part" if summary.problems else "up to date" if summary.up_to_date else "done"
        self._paths[how].append(path)
        if self._verbose:
            counts = f"{summary.frames} frames in {seconds:.1f} s, {summary.candidates} candidates"
            passes = sum(summary.passes.values())
            tell([f"{path} ({self._nth()}): {how}, {counts}, {passes} passes"])
        if self._as_json:
            status = "partial" if summary.problems else "done"
            self._told.append({"name": name, "log": path, "status": status} | told(summary))
        elif not self._quiet:
            frames = f"{summary.frames} frame{'s' * (summary.frames != 1)}"
            click.echo(f"{summary.folder}: {'up to date, ' * summary.up_to_date}{frames}")
            for line in [] if summary.up_to_date else table(summary):
                click.echo(f"  {line}")

    def add_failed(
        self, path: str, name: str | None, status: str, error: SonarrecError | None = None
    ) -> None:
        """A log that could not be used, or not to its end."""
        message = {} if error is None else {"message": str(error)}
        self._told.append({"name": name, "log": path, "status": status} | message)
        self._paths["failed"].append(path)
        self._missing += isinstance(error, MissingError)

    def _nth(self) -> str:
        return f"{sum(map(len, self._paths.values()))} of {self._logs}"

    @contextmanager
    def document(self) -> Iterator[None]:
        """Print what is known of each log as JSON, where it is asked for, however the logs end."""
        try:
            yield
        finally:
            if self._as_json:
                program = {"name": "sonarrec", "version": __version__}
                click.echo(json.dumps({"program": program, "logs": self._told}, indent=2))

    def leave(self) -> None:
        """Count the logs, where there are several, and end with the exit code they make."""
        failed = self._paths["failed"]
        if self._logs > 1 and (failed or not self._quiet):
            counts = ", ".join(f"{len(paths)} {how}" for how, paths in self._paths.items() if paths)
            to_stderr = bool(failed) or self._as_json
            click.echo(counts + (f": {', '.join(failed)}" if failed else ""), err=to_stderr)
        if len(failed) == self._logs:
            leave(MISUSED if self._missing == len(failed) else FAILED)
        if failed or self._paths["in part"]:
            leave(PARTLY)


class _Terminated(KeyboardInterrupt):
    """SIGTERM, as batch systems and containers send it."""


@contextmanager
def _stoppable(folders: Sequence[Path]) -> Iterator[None]:
    """SIGTERM stops as Ctrl-C does: what is written stays whole, and a line says where it is."""

    def stop(*_: object) -> None:
        raise _Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt as error:
        from sonarrec.results.folders import part_of

        parts = ", ".join(shown(part_of(f)) for f in folders if part_of(f).is_dir())
        kept = f"; the frames before are in {parts}" if parts else ""
        click.echo(f"sonarrec: stopped{kept}", err=True)
        leave(TERMINATED if isinstance(error, _Terminated) else INTERRUPTED)
    finally:
        signal.signal(signal.SIGTERM, before)
