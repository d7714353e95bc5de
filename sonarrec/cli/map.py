"""`sonarrec map`: where the landmarks lie."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from sonarrec.cli.endings import end, tell
from sonarrec.cli.groups import ANY, FILE, FOLDER, INPUT, OUTPUT, command, option
from sonarrec.cli.options import landmarks_option, out_option, quiet_option
from sonarrec.cli.options_log import geometry_options
from sonarrec.records import UsageError, number_of


@command("map", short_help="Say where the landmarks lie.")
@click.argument("results", type=ANY, nargs=-1)
@option(
    INPUT,
    "--odometry",
    type=FILE,
    multiple=True,
    help="Table of the poses that a log was run with, where it is no longer beside the log; "
    "repeatable.",
)
@option(
    INPUT,
    "--drift",
    metavar="M,DEG",
    help="Standard error that the poses gather in a minute, in place and heading; it grows with "
    "the root of the time.  [default: 0,0]",
)
@landmarks_option
@option(INPUT, "--method", help="Method of estimates.csv.  [default: framework]")
@option(
    INPUT,
    "--min-frames",
    type=click.IntRange(min=1),
    default=3,
    show_default=True,
    help="A landmark declared in fewer frames is left out.",
)
@geometry_options
@option(
    OUTPUT,
    "--origin",
    metavar="LAT,LON,HEADING",
    help="Where the poses' origin lies on Earth, deg, and the compass heading of yaw 0: writes "
    "map.geojson.",
)
@out_option(FOLDER, "Folder of the files.  [default: RESULTS/map]")
@quiet_option
def map_(
    results: tuple[Path, ...],
    odometry: tuple[Path, ...],
    drift: str | None,
    landmarks: str | None,
    method: str | None,
    min_frames: int,
    sonar: Any,
    origin: str | None,
    out: Path | None,
    quiet: bool,
) -> None:
    """Say where the landmarks lie: each one once, however often it was passed.

    RESULTS are folders that `sonarrec run` wrote, of one log or of several (default:
    sonarrec_out); logs of one site, with poses in one frame, make one map. Without poses a log's
    map is relative to the sonar at its first frame, as far as the measured motion carries.

    \b
    Writes map.csv, passes.csv, factors.csv (measurements for a SLAM back end),
    graph.g2o, map.png and, with --origin, map.geojson.

    \b
    Examples:
      sonarrec map sonarrec_out/dive
      sonarrec map day1/dive day2/dive -o site
      sonarrec map sonarrec_out/dive --drift 0.1,5 --origin 54.3233,10.1394,87
    """
    from sonarrec.mapping.build import make_map
    from sonarrec.mapping.tables import lines
    from sonarrec.mapping.write import write_all

    folders = tuple(dict.fromkeys(results)) or (Path("sonarrec_out"),)
    if out is None:
        if len(folders) > 1:
            raise UsageError("several RESULTS: give the folder of their map with --out")
        out = folders[0] / "map"
    on_earth = None if origin is None else _origin(origin)
    drifts = None if drift is None else _drift(drift)
    site = make_map(
        folders,
        odometry=odometry,
        drift=drifts,
        method=method,
        landmarks=landmarks,
        sonar=sonar,
        least_frames=min_frames,
    )
    write_all(out, site, on_earth)
    tell(site.problems, site.notes)
    if not quiet:
        click.echo(f"{out}: {number_of(len(site.logs), 'log')}")
        for line in lines(site):
            click.echo(f"  {line}")
    end(site.problems)


def _origin(text: str) -> Any:
    """The Origin of LAT,LON,HEADING. Raises UsageError where it cannot be meant."""
    from sonarrec.mapping.tables import Origin

    origin = Origin(*_numbers("--origin", text, 3))
    if not (abs(origin.latitude_deg) < 90 and abs(origin.longitude_deg) <= 180):
        raise UsageError(f"--origin {text}: latitude between the poles, longitude -180 to 180")
    return origin


def _drift(text: str) -> Any:
    """The Drift of M,DEG. Raises UsageError where it cannot be meant."""
    from sonarrec.mapping.path import Drift

    drift = Drift(*_numbers("--drift", text, 2))
    if min(drift.place_m, drift.yaw_deg) < 0:
        raise UsageError(f"--drift {text}: standard errors are not negative")
    return drift


def _numbers(flag: str, text: str, count: int) -> list[float]:
    """The numbers of M,DEG or the like. Raises UsageError where they cannot be meant."""
    try:
        found = [float(number) for number in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise UsageError(f"{flag} {text}: expected {count} numbers with commas between")
    return found
