"""`sonarrec run`: recognise the landmarks in recorded logs."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sonarrec.cli.options import (
    FAILED,
    FILE,
    FOLDER_OR_URL,
    INPUT,
    OUTPUT,
    PARTLY,
    CacheChoice,
    LogChoice,
    SettingsChoice,
    cache_options,
    command,
    fetching,
    landmarks_option,
    leave,
    log_options,
    option,
    out_option,
    progress,
    quiet_option,
    settings_options,
    tell,
)
from sonarrec.records import FrameResult, SonarrecError, UsageError

if TYPE_CHECKING:
    from sonarrec.pipeline import Summary

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes of a run that was stopped by Ctrl-C or SIGTERM."""


@command(short_help="Recognise the landmarks in logs.")
@click.argument("log", nargs=-1, required=True)
@log_options(time=True)
@landmarks_option
@option(
    INPUT,
    "--odometry",
    type=FILE,
    help="CSV of the sonar's poses: timestamp or timestamp_ns, yaw (deg, positive to the right) "
    "and, where known, x, y (m).  [default: the turn is measured between the images]",
)
@option(
    INPUT,
    "--odometry-topic",
    metavar="TOPIC",
    help="Poses in the MCAP itself: nav_msgs/Odometry or geometry_msgs/PoseStamped.",
)
@option(
    INPUT,
    "--model",
    type=FILE,
    help="Appearance model of `sonarrec calibrate`.  [default: built in]",
)
@settings_options
@out_option(
    FOLDER_OR_URL,
    "Results go to OUT/<log name>; OUT may be of s3://, gs:// or sftp://.",
    default=Path("sonarrec_out"),
    show_default=True,
)
@cache_options
@option(
    OUTPUT,
    "--overwrite",
    is_flag=True,
    help="Do again what is up to date, and replace results of another log of that name.",
)
@quiet_option
def run(
    log: tuple[str, ...],
    log_choice: LogChoice,
    landmarks: str | None,
    odometry: Path | None,
    odometry_topic: str | None,
    model: Path | None,
    settings: SettingsChoice,
    out: Path | str,
    cache: CacheChoice,
    overwrite: bool,
    quiet: bool,
) -> None:
    """Recognise landmarks in LOG, frame by frame.

    LOG is an MCAP file, a folder of images, a video or a quoted glob of these. The sonar's
    geometry is read from sonar.toml beside it (NAME.sonar.toml for one file), from --sonar, or
    from the flags; polar sonar messages tell their own, all but the tilt and the height. Several
    LOGs are processed one after the other; one that cannot be used does not stop the others.
    A LOG may be on a server: s3://, gs://, https:// or sftp:// (`sonarrec help remote`).

    Results are replaced only when the new ones are finished, and not made again where they are up
    to date. A run that is stopped leaves its part in OUT/<log name>.part.

    \b
    Examples:
      sonarrec run sample_data/pan.mcap
      sonarrec run pings/ --tilt-deg 22 --height-m 0.7
      sonarrec run dive.mcap --topic /oculus/ping --tilt-deg 20 --time header
      sonarrec run pings/ --odometry poses.csv --model my.toml
      sonarrec run 'dump/*.png' --preset paper -o results
    """
    from sonarrec.pipeline import Used, process, result_names
    from sonarrec.readers.find import find_logs
    from sonarrec.remote.run import Elsewhere
    from sonarrec.results.run_file import Given

    if odometry is not None and odometry_topic is not None:
        raise UsageError("--odometry and --odometry-topic: choose one of the two")
    given = Given(**log_choice.arguments(), odometry=odometry, odometry_topic=odometry_topic)
    used = Used(settings.configs(), landmarks, model, settings.file)
    elsewhere = Elsewhere(find_logs(log), out, cache.cache)
    logs = elsewhere.logs
    names = result_names(logs, elsewhere.paths)
    ended: dict[str, list[str]] = {"done": [], "up to date": [], "in part": [], "failed": []}

    def one(number: int, path: str, name: str | None) -> None:
        with ExitStack() as held:
            with fetching(quiet, path) as came:
                at, origin = held.enter_context(elsewhere.log(number, came))
            told = held.enter_context(elsewhere.results(name))
            with progress(quiet) as step:

                def observe(result: FrameResult, total: int | None) -> None:
                    step(total, f"{result.tracks} tracks in view")

                summary = process(
                    at,
                    elsewhere.out,
                    given,
                    used,
                    observe,
                    name=name,
                    overwrite=overwrite,
                    origin=origin,
                )
        tell(map(told, summary.problems), map(told, summary.notes))
        how = "in part" if summary.problems else "up to date" if summary.up_to_date else "done"
        ended[how].append(path)
        if not quiet:
            _print(summary, told(str(summary.folder)))

    with _stoppable(elsewhere.out), elsewhere:
        for number, (path, name) in enumerate(zip(logs, names, strict=True)):
            try:
                one(number, path, name)
            except SonarrecError as error:
                if len(logs) == 1:
                    raise
                tell([str(error)])
                ended["failed"].append(path)
    failed = ended["failed"]
    if len(logs) > 1 and (failed or not quiet):
        counts = ", ".join(f"{len(paths)} {how}" for how, paths in ended.items() if paths)
        click.echo(counts + (f": {', '.join(failed)}" if failed else ""), err=bool(failed))
    if len(failed) == len(logs):
        leave(FAILED)
    if failed or ended["in part"]:
        leave(PARTLY)


def _print(summary: Summary, folder: str) -> None:
    frames = f"{summary.frames} frame{'s' * (summary.frames != 1)}"
    click.echo(f"{folder}: {'up to date, ' * summary.up_to_date}{frames}")
    for line in summary.sightings:
        click.echo(f"  {line}")


class _Terminated(KeyboardInterrupt):
    """SIGTERM, as batch systems and containers send it."""


@contextmanager
def _stoppable(out: Path) -> Iterator[None]:
    """SIGTERM stops as Ctrl-C does: what is written stays whole, and a line says where it is."""

    def stop(*_: object) -> None:
        raise _Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt as error:
        from sonarrec.results.folders import PART

        parts = ", ".join(str(p) for p in sorted(out.glob(f"*{PART}")))
        kept = f"; the frames before are in {parts}" if parts else ""
        click.echo(f"sonarrec: stopped{kept}", err=True)
        leave(TERMINATED if isinstance(error, _Terminated) else INTERRUPTED)
    finally:
        signal.signal(signal.SIGTERM, before)
