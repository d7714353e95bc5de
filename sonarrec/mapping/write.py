"""The files of a map, all in one folder, and the lines to print."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sonarrec.arrays import FloatArray
from sonarrec.errors import number_of, refuse_url
from sonarrec.mapping.build import SiteMap, make_map
from sonarrec.mapping.landmarks import Landmark, Pass, ellipse, frames_of
from sonarrec.mapping.path import Drift
from sonarrec.mapping.picture import draw_map
from sonarrec.sonar.stated import Sonar, sonar_from
from sonarrec.tables.outputs import (
    as_cell,
    check_folder,
    check_output,
    check_tables,
    is_filled,
    write_csv,
    write_text,
    writing,
)

_MAP_HEADER = (
    "number,landmark,x_m,y_m,xx_m2,xy_m2,yy_m2,orientation_deg,orientation_sigma_deg,passes,frames,"
    "logs,mean_score,near_m,far_m,first_ns,last_ns,other_frames,path"
)
_PASS_HEADER = (
    "number,log,landmark,track,first_frame,last_frame,frames,mean_score,x_m,y_m,xx_m2,xy_m2,yy_m2,"
    "orientation_deg,orientation_sigma_deg,near_m,far_m,sonar_x_m,sonar_y_m,sonar_yaw_deg,path"
)
MAP_COLUMNS, PASS_COLUMNS = _MAP_HEADER.split(","), _PASS_HEADER.split(",")
Cells = dict[str, object]
"""A row: its cells by column."""
GEOJSON_BEGIN = '{"type": "FeatureCollection", "program": "sonarrec"'
"""How files of this program are recognised; readers of GeoJSON ignore unknown members."""
MOST_POINTS = 2_000  # points of a path in GeoJSON, at most


@dataclass(frozen=True, slots=True)
class GeographicOrigin:
    """Where the origin of the poses lies on Earth (WGS 84, deg)."""

    latitude_deg: float
    longitude_deg: float
    heading_deg: float
    """The compass heading of a sonar whose yaw is 0."""

    def on_earth(self, position: FloatArray) -> FloatArray:
        """(n, 2) longitude and latitude, deg (the order of GeoJSON), of positions on the floor.

        position: (n, 2) m to the right and ahead. By the ellipsoid's radii of curvature at the
        origin, which is right to a millimetre within 1 km of it, but at the poles. Beyond the
        180th meridian longitudes count on, so that lines stay in one piece.
        """
        heading, latitude = math.radians(self.heading_deg), math.radians(self.latitude_deg)
        right, ahead = position.T
        east = right * math.cos(heading) + ahead * math.sin(heading)
        north = ahead * math.cos(heading) - right * math.sin(heading)
        e2 = 0.00669437999014
        slope = 1 - e2 * math.sin(latitude) ** 2
        across = 6378137.0 / math.sqrt(slope)  # radius of curvature east to west
        north = north - east**2 * math.tan(latitude) / (2 * across)  # parallels bend to the pole
        latitudes = latitude + north * slope / (1 - e2) / across
        longitudes = math.radians(self.longitude_deg) + east / (across * np.cos(latitudes))
        return np.asarray(np.degrees(np.column_stack([longitudes, latitudes])))


def write_all(folder: Path, site: SiteMap, origin: GeographicOrigin | None = None) -> None:
    """Write map.csv, passes.csv, map.png and, with an origin, map.geojson.

    Raises SonarrecError where the folder cannot be written, UsageError, before anything is, where
    a file of another kind is there.
    """
    headers = {"map.csv": MAP_COLUMNS, "passes.csv": PASS_COLUMNS}
    picture, earth = folder / "map.png", folder / "map.geojson"
    check_folder(folder, (*headers, "map.png", "map.geojson"))
    check_tables(folder, headers)
    if not is_filled(folder / "map.csv"):  # with it the others are of a map too, marked or not
        check_output(picture, "picture")
        check_output(earth, "JSON", header=GEOJSON_BEGIN)
    with writing(folder):
        write_csv(folder / "map.csv", MAP_COLUMNS, _in_order(MAP_COLUMNS, map_rows(site)))
        write_csv(folder / "passes.csv", PASS_COLUMNS, _in_order(PASS_COLUMNS, pass_rows(site)))
        draw_map(picture, site)
        earth.unlink(missing_ok=True)  # of a map before, with an origin
        if origin is not None:
            write_text(earth, json.dumps(geojson(site, origin), allow_nan=False) + "\n")


def _pose_cells(site: SiteMap, placed: Landmark | Pass, landmark: int) -> Cells:
    """Position, its covariance and orientation, in the axes of the poses. landmark: its ID."""
    x, y = site.position(placed.position)
    (xx, xy), (_, yy) = site.covariance(placed.covariance)
    orientation = site.orientation(placed.orientation_deg, landmark)
    known = not math.isnan(orientation)
    return {
        "x_m": f"{x:.4f}",
        "y_m": f"{y:.4f}",
        "xx_m2": f"{xx:.3e}",
        "xy_m2": f"{xy:.3e}",
        "yy_m2": f"{yy:.3e}",
        "orientation_deg": f"{orientation:.2f}" if known else "",
        "orientation_sigma_deg": f"{placed.orientation_sigma_deg:.2f}" if known else "",
    }


def map_rows(site: SiteMap) -> list[Cells]:
    """The rows of map.csv, one per landmark."""
    rows: list[Cells] = []
    for number, landmark in enumerate(site.landmarks, 1):
        passes = landmark.members
        times = [seen.path.timestamp_ns[seen.row] for seen in passes]
        score = np.average(
            [seen.score for seen in passes], weights=[len(seen.row) for seen in passes]
        )
        cells: Cells = {
            "number": number,
            "landmark": landmark.id,
            "passes": len(passes),
            "frames": frames_of(passes),
            "logs": len({seen.path for seen in passes}),
            "mean_score": f"{score:.4f}",
            "near_m": f"{min(seen.near_m for seen in passes):.3f}",
            "far_m": f"{max(seen.far_m for seen in passes):.3f}",
            "first_ns": min(int(ns[0]) for ns in times),
            "last_ns": max(int(ns[-1]) for ns in times),
            "other_frames": frames_of(landmark.others),
            "path": site.path_of(passes[0]),
        }
        rows.append(cells | _pose_cells(site, landmark, landmark.id))
    return rows


def pass_rows(site: SiteMap) -> list[Cells]:
    """The rows of passes.csv, one per pass, also of landmarks that were left out."""
    number = {
        seen: n
        for n, landmark in enumerate(site.landmarks, 1)
        for passes in (landmark.members, landmark.others)
        for seen in passes
    }
    rows: list[Cells] = []
    for log in site.logs:
        for seen in log.passes:
            pose = log.path.pose[seen.middle]
            sonar_x, sonar_y = site.position(pose[1:])
            cells: Cells = {
                "number": number.get(seen, ""),
                "log": as_cell(log.name),
                "landmark": seen.landmark,
                "track": seen.track,
                "first_frame": log.path.frame[seen.row[0]],
                "last_frame": log.path.frame[seen.row[-1]],
                "frames": frames_of([seen]),
                "mean_score": f"{seen.score:.4f}",
                "near_m": f"{seen.near_m:.3f}",
                "far_m": f"{seen.far_m:.3f}",
                "sonar_x_m": f"{sonar_x:.4f}",
                "sonar_y_m": f"{sonar_y:.4f}",
                "sonar_yaw_deg": f"{-pose[0] if site.ros_axes else pose[0]:.3f}",
                "path": site.path_of(seen),
            }
            rows.append(cells | _pose_cells(site, seen, seen.landmark))
    return rows


def _in_order(columns: Sequence[str], rows: Iterable[Cells]) -> Iterator[list[object]]:
    return ([row[name] for name in columns] for row in rows)


def geojson(site: SiteMap, origin: GeographicOrigin) -> dict[str, object]:
    """The landmarks as points, their 95 % ellipses as polygons, the paths as lines (RFC 7946)."""
    features: list[object] = []

    def add(kind: str, line: FloatArray, properties: dict[str, object]) -> None:
        """line: (n, 2) m, of a point's only one, or of a closed line or a path."""
        along = np.round(origin.on_earth(line), 9).tolist()
        coordinates = {"Point": along[0], "Polygon": [along]}.get(kind, along)
        geometry = {"type": kind, "coordinates": coordinates}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})

    for number, landmark in enumerate(site.landmarks, 1):
        name: dict[str, object] = {"number": number, "landmark": landmark.id}
        if len(site.parts) > 1:
            name["path"] = site.path_of(landmark.members[0])
        facts: dict[str, object] = {"name": f"ID.{landmark.id}", **name}
        # Where the first sector begins, as a compass shows it.
        compass = (90 + origin.heading_deg - landmark.orientation_deg) % 360
        if not math.isnan(compass):
            facts["heading_deg"] = round(compass, 2)
        facts |= {"sigma_m": round(landmark.sigma_m, 4), "passes": len(landmark.members)}
        add("Point", landmark.position[None], facts | {"frames": frames_of(landmark.members)})
        ring = ellipse(landmark.position, landmark.covariance)
        add("Polygon", ring, {**name, "within": 0.95})
    for log in site.logs:
        known = log.path.known
        if len(known) > 1:
            chosen = np.linspace(0, len(known) - 1, min(len(known), MOST_POINTS)).round()
            add("LineString", log.path.pose[known[chosen.astype(int)], 1:], {"log": log.name})
    return {"type": "FeatureCollection", "program": "sonarrec", "features": features}


def lines(site: SiteMap) -> list[str]:
    """The map to print, a line per landmark."""
    few = number_of(site.left_out, "landmark")
    left_out = [f"{few} left out by --min-frames"] if site.left_out else []
    if not site.landmarks:
        return left_out or ["no landmark declared"]
    rows = ["number  landmark       x m       y m  sigma m  orientation  sigma  passes  frames"]
    path = 1
    for number, landmark in enumerate(site.landmarks, 1):
        if (own := site.path_of(landmark.members[0])) > path:
            path = own
            rows.append(f"path {own}, from frame {site.logs[own - 1].path.frame[0]}")
        x, y = site.position(landmark.position)
        orientation = site.orientation(landmark.orientation_deg, landmark.id)
        angles = (orientation, landmark.orientation_sigma_deg)
        angle, angle_sigma = ("-" if math.isnan(deg) else f"{deg:.1f}" for deg in angles)
        rows.append(
            f"{number:>6}  {landmark.id:>8}  {x:>8.3f}  {y:>8.3f}  {landmark.sigma_m:>7.3f}  "
            f"{angle:>11}  {angle_sigma:>5}  {len(landmark.members):>6}  "
            f"{frames_of(landmark.members):>6}"
        )
    return rows + left_out


@dataclass(frozen=True, slots=True, repr=False)
class LandmarkMap:
    """Where the landmarks of a site lie."""

    landmarks: pd.DataFrame
    """A row for each, as in map.csv."""
    passes: pd.DataFrame
    """A row for each pass, as in passes.csv."""
    logs: int
    notes: tuple[str, ...]
    unused: tuple[str, ...]
    """Input that could not be used, a line each."""

    def __repr__(self) -> str:
        number = number_of(len(self.landmarks), "landmark")
        return f"<map of {number} from {number_of(self.logs, 'log')}>"


def map_landmarks(
    results: str | Path | Sequence[str | Path] = "sonarrec_out",
    out: str | Path | None = None,
    *,
    odometry: str | Path | None = None,
    drift: tuple[float, float] = (0.0, 0.0),
    method: str | None = None,
    landmarks: str | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    min_frames: int = 3,
) -> LandmarkMap:
    """Map the landmarks of a site from the results of one log or of several, each landmark once.

    Parameters
    ----------
    results : str, Path or sequence of these, default "sonarrec_out"
        Folders of the results of single logs, or folders of such folders.
    out : str or Path, optional
        A folder for the files of `sonarrec map`. Default: none is written.
    odometry : str or Path, optional
        A table of the poses of all logs, in place of those that they were run with.
    drift : tuple of float, default (0.0, 0.0)
        The standard error of the poses after one minute: position in m, yaw in deg.
    method : str, optional
        Whose claims are mapped. Default: `framework`, or the only method.
    landmarks : str, optional
        A landmark set, in place of that of run.toml.
    sonar : Sonar or mapping, optional
        Geometry that takes precedence over run.toml, with the keys and units of sonar.toml.
    min_frames : int, default 3
        Landmarks that are declared in fewer frames, over all passes, are left out.

    Returns
    -------
    LandmarkMap
        `landmarks` has a row per landmark, `passes` a row per pass; m and deg.

    Raises
    ------
    SonarrecError
        None of the logs can be used, they have no common axes, or `out` cannot be written.
    """
    site = make_map(
        [Path(results)] if isinstance(results, str | Path) else [*map(Path, results)],
        None if odometry is None else Path(odometry),
        Drift(*drift),
        method,
        landmarks=landmarks,
        sonar=sonar_from(sonar),
        min_frames=min_frames,
    )
    if out is not None:
        write_all(Path(refuse_url(out)), site)
    return LandmarkMap(
        landmarks=_table(MAP_COLUMNS, map_rows(site)),
        passes=_table(PASS_COLUMNS, pass_rows(site)),
        logs=site.count,
        notes=tuple(site.diagnostics.notes),
        unused=tuple(site.diagnostics.problems),
    )


def _table(columns: Sequence[str], rows: Iterable[Cells]) -> pd.DataFrame:
    """The cells of a CSV as numbers where they are numbers."""
    text = StringIO()
    table = csv.DictWriter(text, columns)
    table.writeheader()
    table.writerows(rows)
    text.seek(0)
    return pd.read_csv(text, dtype={"log": str})
