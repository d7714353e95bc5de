"""`sonarrec run`: recognise the landmarks in recorded logs."""

from __future__ import annotations

from pathlib import Path

import click

from sonarrec.cli.options import (
    FILE,
    FOLDER,
    INPUT,
    PARTLY,
    LogChoice,
    SettingsChoice,
    command,
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
from sonarrec.records import FrameResult, UsageError


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
    FOLDER, "Results go to OUT/<log name>.", default=Path("sonarrec_out"), show_default=True
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
    out: Path,
    quiet: bool,
) -> None:
    """Recognise landmarks in LOG, frame by frame.

    LOG is an MCAP file, a folder of images, a video or a quoted glob of these. The sonar's
    geometry is read from sonar.toml beside it (NAME.sonar.toml for one file), from --sonar, or
    from the flags; polar sonar messages tell their own, all but the tilt and the height. Several
    LOGs are processed one after the other.

    \b
    Examples:
      sonarrec run sample_data/pan.mcap
      sonarrec run pings/ --tilt-deg 22 --height-m 0.7
      sonarrec run dive.mcap --topic /oculus/ping --tilt-deg 20 --time header
      sonarrec run pings/ --odometry poses.csv --model my.toml
      sonarrec run 'dump/*.png' --preset paper -o results
    """
    from sonarrec.readers.find import find_logs
    from sonarrec.run import process

    if odometry is not None and odometry_topic is not None:
        raise UsageError("--odometry and --odometry-topic: choose one of the two")
    configs, reading = settings.configs(), log_choice.arguments()
    partly = False
    for path in find_logs(log):
        with progress(quiet) as step:

            def observe(result: FrameResult, total: int | None) -> None:
                step(total, f"{result.tracks} tracks in view")

            summary = process(
                path,
                out,
                configs,
                **reading,
                landmarks=landmarks,
                earlier_run=settings.file,
                odometry=odometry,
                odometry_topic=odometry_topic,
                model=model,
                observe=observe,
            )
        tell(summary.problems, summary.notes)
        partly |= bool(summary.problems)
        if not quiet:
            click.echo(f"{summary.folder}: {summary.frames} frame{'s' * (summary.frames != 1)}")
            for line in summary.sightings:
                click.echo(f"  {line}")
    if partly:
        leave(PARTLY)
