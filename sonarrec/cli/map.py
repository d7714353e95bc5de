"""`sonarrec map`: the positions of the landmarks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sonarrec.cli import options
from sonarrec.cli.endings import finish
from sonarrec.cli.groups import ANY, FILE, FOLDER, IntegerRange, command, in_input, in_output
from sonarrec.errors import UsageError, number_of


@command("map", short_help="Map the positions of the landmarks.")
@click.argument("results", type=ANY, nargs=-1)
@in_input(
    "--odometry",
    type=FILE,
    help="Table of the poses of all logs.  [default: those that each log was run with]",
)
@in_input(
    "--drift",
    metavar="M,DEG",
    help="Standard error of the poses after one minute, in position and heading; it grows with "
    "the square root of time.  [default: 0,0]",
)
@options.landmarks
@options.method
@in_input(
    "--min-frames",
    type=IntegerRange(min=1),
    default=3,
    help="Leave out landmarks declared in fewer frames.",
)
@options.sonar
@in_output(
    "--origin",
    metavar="LAT,LON,HEADING",
    help="Position of the poses' origin on Earth, deg, and the compass heading of yaw 0; writes "
    "map.geojson.",
)
@options.out(FOLDER, "Folder of the files.  [default: RESULTS/map]")
@options.quiet
def map_(
    results: tuple[Path, ...],
    odometry: Path | None,
    drift: str | None,
    landmarks: str | None,
    method: str | None,
    min_frames: int,
    sonar: Any,
    origin: str | None,
    out: Path | None,
    quiet: bool,
) -> None:
    """Map the positions of the landmarks, each one once, even if it was passed several times.

    RESULTS are folders that `sonarrec run` wrote, of one log or of several (default:
    sonarrec_out). Logs of one site, with poses in one coordinate frame, make one map. Without poses
    the map of a log is relative to the sonar at its first frame, and uses the measured motion; then
    several logs make a map each, in RESULTS/LOG/map, or in OUT/LOG.

    Writes map.csv, passes.csv, map.png and, with --origin, map.geojson.

    \b
    Examples:
      sonarrec map sonarrec_out/dive
      sonarrec map day1/dive day2/dive -o site
      sonarrec map sonarrec_out/dive --drift 0.1,5 --origin 54.3233,10.1394,87
    """
    from sonarrec.mapping.build import SeveralFramesError, make_map
    from sonarrec.mapping.path import Drift
    from sonarrec.mapping.write import GeographicOrigin, lines, write_all
    from sonarrec.results.folders import folder_names, log_of
    from sonarrec.tables.outputs import below

    on_earth = None
    if origin is not None:
        on_earth = GeographicOrigin(*options.numbers("--origin", origin, "LAT,LON,HEADING"))
        if not (abs(on_earth.latitude_deg) < 90 and abs(on_earth.longitude_deg) <= 180):
            raise UsageError(
                f"--origin {origin}: LAT must be between -90 and 90, LON from -180 to 180"
            )
    errors = Drift(*options.numbers("--drift", drift or "0,0", "M,DEG"))
    if min(errors.position_m, errors.yaw_deg) < 0:
        raise UsageError(f"--drift {drift}: standard errors must not be negative")
    folders = tuple(dict.fromkeys(results)) or (Path("sonarrec_out"),)
    if out is None and len(folders) > 1:
        raise UsageError("several RESULTS need --out, the folder of their map")
    given: dict[str, Any] = {"odometry": odometry, "drift": errors, "method": method}
    given |= {"landmarks": landmarks, "sonar": sonar, "min_frames": min_frames}
    problems: list[str] = []
    try:
        sites = {out or below(folders[0], "map"): make_map(folders, **given)}
    except SeveralFramesError as error:
        if on_earth is not None:
            raise
        names = folder_names([(log_of(f), f.resolve()) for f in error.folders])
        sites, problems = {}, [*error.left_out]
        for name, folder in zip(names, error.folders, strict=True):
            sites[folder / "map" if out is None else out / name] = make_map([folder], **given)
    summary, notes = list[str](), list[str]()
    for path, site in sites.items():
        write_all(path, site, on_earth)
        summary += [f"{path}: {number_of(site.count, 'log')}", *(f"  {x}" for x in lines(site))]
        problems += site.diagnostics.problems
        notes += site.diagnostics.notes
    finish(quiet, summary, problems, list(dict.fromkeys(notes)))
