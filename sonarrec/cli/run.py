"""`sonarrec run`: recognise the landmarks in recorded logs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from sonarrec.cli.options import (
    FILE,
    PARTLY,
    chosen_settings,
    config_option,
    pixel_options,
    preset_option,
    seed_option,
    set_option,
    sonar_from_flags,
    sonar_options,
    topic_option,
)
from sonarrec.records import Clock, FrameResult, UsageError


@click.command()
@click.argument("log", nargs=-1, required=True)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("sonarrec_out"),
    show_default=True,
    help="Results go to OUT/<log name>.",
)
@topic_option
@click.option(
    "--time",
    "clock",
    type=click.Choice(["log", "publish", "header"]),
    help="Which time of an MCAP message names a frame; the order is log time.  [default: log]",
)
@click.option("--landmarks", help="Landmark set: a built-in name or a TOML file.  [default: basin]")
@click.option(
    "--odometry",
    type=FILE,
    help="CSV of the sonar's poses: timestamp or timestamp_ns, yaw (deg, positive to the right) "
    "and, where known, x, y (m).  [default: the turn is measured between the images]",
)
@click.option(
    "--odometry-topic",
    metavar="TOPIC",
    help="Poses in the MCAP itself: nav_msgs/Odometry or geometry_msgs/PoseStamped.",
)
@click.option(
    "--model", type=FILE, help="Appearance model of `sonarrec calibrate`.  [default: built in]"
)
@preset_option
@config_option
@set_option
@seed_option
@sonar_options
@pixel_options
@click.option("-q", "--quiet", is_flag=True, help="No progress bar and no summary.")
def run(
    log: tuple[str, ...],
    out: Path,
    topic: str | None,
    clock: Clock | None,
    landmarks: str | None,
    odometry: Path | None,
    odometry_topic: str | None,
    model: Path | None,
    preset: str | None,
    config_file: Path | None,
    assignments: tuple[str, ...],
    seed: int | None,
    sonar_file: Path | None,
    quiet: bool,
    **flags: Any,
) -> None:
    """Recognise landmarks in LOG, frame by frame.

    LOG is an MCAP file, a folder of images, a video or a quoted glob of these. The sonar's
    geometry is read from sonar.toml beside it (NAME.sonar.toml for one file), from --sonar, or
    from the flags; polar sonar messages tell their own, all but the tilt and the height. Several
    LOGs are processed one after the other.

    \b
    Examples:
      sonarrec run log.mcap
      sonarrec run pings/ --tilt-deg 22 --height-m 0.7
      sonarrec run dive.mcap --topic /oculus/ping --tilt-deg 20 --time header
      sonarrec run pings/ --odometry poses.csv --model my.toml
      sonarrec run dive.mcap --odometry-topic /odom
      sonarrec run 'dump/*.png' --preset paper --out results
    """
    from sonarrec.readers.find import find_logs
    from sonarrec.run import process

    if odometry is not None and odometry_topic is not None:
        raise UsageError("--odometry and --odometry-topic: choose one of the two")
    settings = chosen_settings(preset, config_file, assignments, seed)
    sonar = sonar_from_flags(flags)
    partly = False
    for path in find_logs(log):
        summary = process(
            path,
            out,
            settings,
            landmarks=landmarks,
            sonar=sonar,
            sonar_file=sonar_file,
            earlier_run=config_file,
            topic=topic,
            time=clock,
            odometry=odometry,
            odometry_topic=odometry_topic,
            model=model,
            observe=_progress_bar(quiet),
        )
        for note in summary.notes:
            click.echo(f"sonarrec: note: {note}", err=True)
        for problem in summary.problems:
            click.echo(f"sonarrec: {problem}", err=True)
        partly |= bool(summary.problems)
        if not quiet:
            click.echo(f"{summary.folder}: {summary.frames} frame{'s' * (summary.frames != 1)}")
            for line in summary.sightings:
                click.echo(f"  {line}")
    if partly:
        click.get_current_context().exit(PARTLY)


def _progress_bar(quiet: bool) -> Callable[[FrameResult, int | None], None]:
    """A tqdm bar on stderr; silent when quiet and where stderr is no terminal."""
    from tqdm import tqdm

    bar = tqdm(unit="frame", leave=False, disable=True if quiet else None)

    def observe(result: FrameResult, total: int | None) -> None:
        bar.total = total
        bar.set_postfix_str(f"{result.tracks} tracks in view", refresh=False)
        bar.update()

    return observe
