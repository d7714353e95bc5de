"""The files of a map, all in one folder, and the lines to print."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sonarrec.arrays import FloatArray
from sonarrec.errors import local, number_of
from sonarrec.mapping.axes import Axes, GeographicOrigin, cut_at_180, ellipse, rings_at_180
from sonarrec.mapping.build import MapOptions, SiteMap, make_map
from sonarrec.mapping.join import Landmark, frames_of
from sonarrec.mapping.passes import Pass
from sonarrec.mapping.path import Drift
from sonarrec.mapping.picture import draw_map
from sonarrec.sonar import Sonar, sonar_from
from sonarrec.tables.outputs import (
    check_no_recording,
    check_output,
    check_tables,
    is_filled,
    write_csv,
    write_text,
    writing,
)

_POSITION = ("x_m", "y_m", "xx_m2", "xy_m2", "yy_m2")
_ORIENTATION = ("orientation_deg", "orientation_sigma_deg")
MAP_COLUMNS = (
    *("number", "landmark", *_POSITION, *_ORIENTATION, "passes", "frames", "logs", "mean_score"),
    *("near_m", "far_m", "first_ns", "last_ns", "other_frames"),
)
PASS_COLUMNS = (
    *("number", "log", "landmark", "track", "first_frame", "last_frame", "frames", "mean_score"),
    *(*_POSITION, *_ORIENTATION, "near_m", "far_m", "sonar_x_m", "sonar_y_m", "sonar_yaw_deg"),
)
GEOJSON_BEGIN = '{"type": "FeatureCollection", "program": "sonarrec"'
"""How files of this program are recognised; readers of GeoJSON ignore unknown members."""
MOST_POINTS = 2_000  # points of a path in GeoJSON, at most


def write_all(folder: Path, site: SiteMap, origin: GeographicOrigin | None = None) -> None:
    """Write map.csv, passes.csv, map.png and, with an origin, map.geojson.

    Raises SonarrecError where the folder cannot be written, UsageError, before anything is, where
    a file of another kind is there.
    """
    headers = {"map.csv": MAP_COLUMNS, "passes.csv": PASS_COLUMNS}
    tables = [folder / name for name in headers]
    picture, earth = folder / "map.png", folder / "map.geojson"
    check_tables(folder, headers)
    if not is_filled(tables[0]):  # beside it the others are of a map as well, marked or not
        check_output(picture, "picture")
        check_output(earth, "JSON", header=GEOJSON_BEGIN)
    check_no_recording(folder, headers)
    with writing(folder):
        write_csv(tables[0], MAP_COLUMNS, map_rows(site))
        write_csv(tables[1], PASS_COLUMNS, pass_rows(site))
        draw_map(picture, site)
        earth.unlink(missing_ok=True)  # of a map before, with an origin
        if origin is not None:
            _write_geojson(earth, site, origin)


def _pose_cells(site: SiteMap, one: Landmark | Pass, landmark: int) -> list[str]:
    """The cells of _POSITION and _ORIENTATION, in the axes of the poses. landmark: its ID."""
    axes = Axes(site.ros_axes)
    (xx, xy), (_, yy) = axes.covariance(one.covariance)
    cells = [f"{v:.4f}" for v in axes.position(one.position)]
    cells += [f"{v:.3e}" for v in (xx, xy, yy)]
    orientation = axes.orientation(one.orientation_deg, _periods_deg(site)[landmark])
    if math.isnan(orientation):
        return [*cells, "", ""]
    return [*cells, f"{orientation:.2f}", f"{one.orientation_sigma_deg:.2f}"]


def map_rows(site: SiteMap) -> list[list[object]]:
    """The rows of map.csv, one per landmark."""
    rows: list[list[object]] = []
    for number, landmark in enumerate(site.landmarks, 1):
        passes = [one for _, one in landmark.members]
        times = [site.logs[g].path.timestamp_ns[one.row] for g, one in landmark.members]
        score = np.average([one.score for one in passes], weights=[len(one.row) for one in passes])
        rows.append(
            [
                *(number, landmark.id, *_pose_cells(site, landmark, landmark.id)),
                *(len(passes), frames_of(landmark.members)),
                *(len({g for g, _ in landmark.members}), f"{score:.4f}"),
                f"{min(one.near_m for one in passes):.3f}",
                f"{max(one.far_m for one in passes):.3f}",
                *(min(int(ns[0]) for ns in times), max(int(ns[-1]) for ns in times)),
                frames_of(landmark.others),
            ]
        )
    return rows


def pass_rows(site: SiteMap) -> list[list[object]]:
    """The rows of passes.csv, one per pass, also of landmarks that were left out."""
    axes = Axes(site.ros_axes)
    number = {
        one: n
        for n, landmark in enumerate(site.landmarks, 1)
        for _, one in (*landmark.members, *landmark.others)
    }
    rows: list[list[object]] = []
    for g, log in enumerate(site.logs):
        for one in log.passes:
            yaw, *position = log.path.pose[one.middle].tolist()
            rows.append(
                [
                    *(number.get(one, ""), log.name, one.landmark, one.track),
                    *log.path.frame[one.row[[0, -1]]],
                    *(frames_of([(g, one)]), f"{one.score:.4f}"),
                    *_pose_cells(site, one, one.landmark),
                    *(f"{one.near_m:.3f}", f"{one.far_m:.3f}"),
                    *(f"{v:.4f}" for v in axes.position(np.array(position))),
                    f"{axes.yaw(yaw):.3f}",
                ]
            )
    return rows


def _periods_deg(site: SiteMap) -> dict[int, float]:
    landmark_set = site.landmark_set
    return dict(zip(landmark_set.ids, landmark_set.periods_deg().tolist(), strict=True))


def _write_geojson(path: Path, site: SiteMap, origin: GeographicOrigin) -> None:
    """The landmarks as points, their 95 % ellipses as polygons, the paths as lines (RFC 7946)."""
    features = []
    for number, landmark in enumerate(site.landmarks, 1):
        name: dict[str, object] = {"number": number, "landmark": landmark.id}
        point = _rounded(origin.on_earth(landmark.position[None]))
        # Where the first sector begins, as a compass shows it.
        compass = (90 + origin.heading_deg - landmark.orientation_deg) % 360
        facts: dict[str, object] = {} if math.isnan(compass) else {"heading_deg": round(compass, 2)}
        sigma_m = math.sqrt(float(np.linalg.eigvalsh(landmark.covariance)[-1]))
        seen = {"passes": len(landmark.members), "frames": frames_of(landmark.members)}
        facts |= {"sigma_m": round(sigma_m, 4), **seen}
        features.append(_feature("Point", point, {"name": f"ID.{landmark.id}", **name, **facts}))
        rings = rings_at_180(origin.on_earth(ellipse(landmark.position, landmark.covariance)))
        if rings:
            polygon = [[_rounded(ring)] for ring in rings]
            features.append(_feature("Polygon", polygon, {**name, "within": 0.95}))
    for log in site.logs:
        known = log.path.known
        if len(known) > 1:
            chosen = np.linspace(0, len(known) - 1, min(len(known), MOST_POINTS)).round()
            path_deg = origin.on_earth(log.path.pose[known[chosen.astype(int)], 1:])
            parts = list(map(_rounded, cut_at_180(path_deg)))
            features.append(_feature("LineString", parts, {"log": log.name}))
    document = {"type": "FeatureCollection", "program": "sonarrec", "features": features}
    write_text(path, json.dumps(document, allow_nan=False) + "\n")


def _feature(
    kind: str, parts: Sequence[Any], properties: Mapping[str, object]
) -> dict[str, object]:
    """A feature of GeoJSON; of several parts it is, for example, a MultiPolygon."""
    geometry = {"type": f"Multi{kind}", "coordinates": parts}
    if len(parts) == 1:
        geometry = {"type": kind, "coordinates": parts[0]}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _rounded(line: FloatArray) -> list[Any]:
    coordinates: list[Any] = np.round(line, 9).tolist()
    return coordinates


def lines(site: SiteMap) -> list[str]:
    """The map to print, a line per landmark."""
    few = number_of(site.left_out, "landmark")
    left_out = [f"{few} left out by --min-frames"] if site.left_out else []
    if not site.landmarks:
        return left_out or ["no landmark declared"]
    axes, periods_deg = Axes(site.ros_axes), _periods_deg(site)
    rows = ["number  landmark       x m       y m  sigma m  orientation  sigma  passes  frames"]
    for number, landmark in enumerate(site.landmarks, 1):
        x, y = axes.position(landmark.position)
        sigma = math.sqrt(float(np.linalg.eigvalsh(landmark.covariance)[-1]))
        orientation = axes.orientation(landmark.orientation_deg, periods_deg[landmark.id])
        angles = (orientation, landmark.orientation_sigma_deg)
        angle, angle_sigma = ("-" if math.isnan(deg) else f"{deg:.1f}" for deg in angles)
        rows.append(
            f"{number:>6}  {landmark.id:>8}  {x:>8.3f}  {y:>8.3f}  {sigma:>7.3f}  {angle:>11}  "
            f"{angle_sigma:>5}  {len(landmark.members):>6}  {frames_of(landmark.members):>6}"
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
        found = number_of(len(self.landmarks), "landmark")
        return f"<map of {found} from {number_of(self.logs, 'log')}>"


def map_landmarks(
    results: str | Path | Sequence[str | Path] = "sonarrec_out",
    out: str | Path | None = None,
    *,
    odometry: str | Path | Sequence[str | Path] = (),
    drift: tuple[float, float] = (0.0, 0.0),
    method: str | None = None,
    landmarks: str | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    min_frames: int = 3,
) -> LandmarkMap:
    """Map the landmarks of one log or of several, each one once.

    out: a folder for the files of `sonarrec map`; default: none is written. odometry: tables of
    poses. drift: standard error of the poses after one minute, m and deg.
    """
    geometry = sonar_from(sonar)
    site = make_map(
        _paths(results),
        MapOptions(_paths(odometry), Drift(*drift), method, landmarks, geometry, min_frames),
    )
    if out is not None:
        write_all(Path(local(out)), site)
    found = _table(MAP_COLUMNS, map_rows(site)), _table(PASS_COLUMNS, pass_rows(site))
    told = site.diagnostics
    return LandmarkMap(*found, len(site.logs), tuple(told.notes), tuple(told.problems))


def _table(header: Iterable[str], rows: Iterable[Iterable[object]]) -> pd.DataFrame:
    """The cells of a CSV as numbers where they are numbers."""
    text = StringIO()
    csv.writer(text).writerows([header, *rows])
    text.seek(0)
    return pd.read_csv(text, dtype={"log": str})


def _paths(paths: str | Path | Sequence[str | Path]) -> list[Path]:
    return [Path(paths)] if isinstance(paths, str | Path) else [*map(Path, paths)]
