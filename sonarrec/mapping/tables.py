"""A map as tables: map.csv, passes.csv and, if the site's place on Earth is known, GeoJSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import number_of
from sonarrec.files.outputs import write_csv, write_text
from sonarrec.mapping.build import SiteMap
from sonarrec.mapping.join import Landmark

_PLACE = ("x_m", "y_m", "xx_m2", "xy_m2", "yy_m2")  # of `_numbers`
_TURN = ("orientation_deg", "orientation_sigma_deg")  # of `_turn`
MAP_COLUMNS = (
    *("number", "landmark", *_PLACE, *_TURN, "passes", "frames", "logs", "mean_score"),
    *("near_m", "far_m", "first_ns", "last_ns", "other_frames"),
)
PASS_COLUMNS = (
    *("number", "log", "landmark", "track", "first_frame", "last_frame", "frames", "mean_score"),
    *(*_PLACE, *_TURN, "near_m", "far_m", "sonar_x_m", "sonar_y_m", "sonar_yaw_deg"),
)
ELLIPSE_CORNERS = 48
CHI2_95 = 5.991
"""Squared Mahalanobis distance that 95 % of places in a plane do not exceed."""
GEOJSON_BEGIN = '{"type": "FeatureCollection", "program": "sonarrec"'
"""How files of this program are recognised; readers of GeoJSON ignore unknown members."""
MOST_POINTS = 2_000
"""Points of a path in GeoJSON, at most."""


@dataclass(frozen=True, slots=True)
class Axes:
    """Converts from the map's axes to those of the poses.

    In the map, x is to the right and y ahead of a sonar whose yaw is 0. ros: whether the poses have
    x ahead, y to the left and yaw counter-clockwise; else nothing changes.
    """

    ros: bool

    def place(self, place: FloatArray) -> FloatArray:
        """(..., 2) places in the poses' axes, m."""
        if not self.ros:
            return place
        return np.stack([place[..., 1], -place[..., 0]], axis=-1)

    def covariance(self, covariance: FloatArray) -> FloatArray:
        """(2, 2) covariance of a place in the poses' axes, m^2."""
        if not self.ros:
            return covariance
        (xx, xy), (_, yy) = covariance
        return np.array([[yy, -xy], [-xy, xx]])

    def turn(self, turn_deg: float, period_deg: float) -> float:
        """A landmark's turn, deg, counter-clockwise from the poses' x axis, 0 to the period."""
        return (turn_deg - 90 * self.ros) % period_deg

    def yaw(self, yaw_deg: float) -> float:
        """The sonar's yaw as the poses count it, deg."""
        return -yaw_deg if self.ros else yaw_deg


@dataclass(frozen=True, slots=True)
class GeographicOrigin:
    """Where the origin of the poses lies on Earth (WGS 84, deg).

    heading_deg: the compass heading of a sonar whose yaw is 0.
    """

    latitude_deg: float
    longitude_deg: float
    heading_deg: float

    def on_earth(self, place: FloatArray) -> FloatArray:
        """(n, 2) longitude and latitude (in this order, as in GeoJSON) of places on the floor, deg.

        place: (n, 2) m to the right and ahead, on the plane that touches the ellipsoid at the
        origin. The conversion uses Earth-centred axes, so that it also works near a pole.
        """
        heading, latitude = math.radians(self.heading_deg), math.radians(self.latitude_deg)
        right, ahead = place.T
        east = right * math.cos(heading) + ahead * math.sin(heading)
        north = ahead * math.cos(heading) - right * math.sin(heading)
        a, e2 = 6378137.0, 0.00669437999014
        n = a / math.sqrt(1 - e2 * math.sin(latitude) ** 2)
        # Distance from the Earth's axis, towards the origin's meridian; distance along the axis.
        out = n * math.cos(latitude) - north * math.sin(latitude)
        up = n * (1 - e2) * math.sin(latitude) + north * math.cos(latitude)
        away, b = np.hypot(out, east), a * math.sqrt(1 - e2)
        angle = np.arctan2(up * a, away * b)  # Bowring's latitude
        latitudes = np.arctan2(
            up + e2 / (1 - e2) * b * np.sin(angle) ** 3, away - e2 * a * np.cos(angle) ** 3
        )
        longitudes = self.longitude_deg + np.degrees(np.arctan2(east, out))
        return np.column_stack([(longitudes + 180) % 360 - 180, np.degrees(latitudes)])


def cut_at_180(line: FloatArray) -> list[FloatArray]:
    """Cut a line into parts that do not cross the 180th meridian.

    line: (n, 2) longitude and latitude, deg. From point to point it takes the shorter way.
    """
    longitude, latitude = np.unwrap(line[:, 0], period=360), line[:, 1]
    turn = np.floor((longitude + 180) / 360)  # how often it went round
    parts = [[(longitude[0] - 360 * turn[0], latitude[0])]]
    for k in range(1, len(line)):
        if turn[k] != turn[k - 1]:
            edge = 360 * max(turn[k], turn[k - 1]) - 180
            share = (edge - longitude[k - 1]) / (longitude[k] - longitude[k - 1])
            latitude_at_180 = latitude[k - 1] + share * (latitude[k] - latitude[k - 1])
            parts[-1].append((edge - 360 * turn[k - 1], latitude_at_180))
            parts.append([(edge - 360 * turn[k], latitude_at_180)])
        parts[-1].append((longitude[k] - 360 * turn[k], latitude[k]))
    return [np.array(part) for part in parts]


def rings_at_180(ring: FloatArray) -> list[FloatArray]:
    """Cut a closed convex line at the 180th meridian into closed lines.

    Empty if it goes round a pole.
    """
    first, *others = cut_at_180(ring)
    if not others:
        return [ring]
    if len(others) == 1:
        return []
    joined = np.concatenate([others.pop()[:-1], first])  # the first part and the last are one
    parts = [joined, *others]
    return [np.concatenate([part, part[:1]]) for part in parts]


def _numbers(place: FloatArray, covariance: FloatArray) -> list[str]:
    (xx, xy), (_, yy) = covariance
    return [*(f"{v:.4f}" for v in place), *(f"{v:.3e}" for v in (xx, xy, yy))]


def _turn(turn_deg: float, sigma_deg: float) -> list[str]:
    return ["", ""] if math.isnan(turn_deg) else [f"{turn_deg:.2f}", f"{sigma_deg:.2f}"]


def write_map(path: Path, site: SiteMap) -> None:
    """Write map.csv: a row per landmark."""
    axes, periods = Axes(site.ros_axes), _periods(site)
    rows: list[list[object]] = []
    for number, landmark in enumerate(site.landmarks, 1):
        passes = [(site.logs[g], site.logs[g].passes, k) for g, k in landmark.members]
        estimates = [int(p.estimates[k]) for _, p, k in passes]
        scores = [float(p.score[k]) for _, p, k in passes]
        rows.append(
            [
                number,
                landmark.id,
                *_numbers(axes.place(landmark.place), axes.covariance(landmark.covariance)),
                *_turn(axes.turn(landmark.turn_deg, periods[landmark.id]), landmark.turn_sigma_deg),
                len(passes),
                site.frames_of(landmark.members),
                len({g for g, _ in landmark.members}),
                f"{np.average(scores, weights=estimates):.4f}",
                f"{min(p.near_m[k] for _, p, k in passes):.3f}",
                f"{max(p.far_m[k] for _, p, k in passes):.3f}",
                min(int(log.path.timestamp_ns[p.first[k]]) for log, p, k in passes),
                max(int(log.path.timestamp_ns[p.last[k]]) for log, p, k in passes),
                site.frames_of(landmark.others),
            ]
        )
    write_csv(path, MAP_COLUMNS, rows)


def write_passes(path: Path, site: SiteMap) -> None:
    """Write passes.csv: a row per pass, also for passes of landmarks that were left out."""
    axes, periods = Axes(site.ros_axes), _periods(site)
    number = {
        pair: n
        for n, found in enumerate(site.landmarks, 1)
        for pair in (*found.members, *found.others)
    }
    rows: list[list[object]] = []
    for g, log in enumerate(site.logs):
        p = log.passes
        for k in range(len(p.landmark)):
            yaw, x, y = log.path.pose[p.middle[k]].tolist()
            rows.append(
                [
                    number.get((g, k), ""),
                    log.name,
                    int(p.landmark[k]),
                    int(p.track[k]),
                    int(log.path.frame[p.first[k]]),
                    int(log.path.frame[p.last[k]]),
                    site.frames_of([(g, k)]),
                    f"{p.score[k]:.4f}",
                    *_numbers(axes.place(p.place[k]), axes.covariance(p.covariance[k])),
                    *_turn(
                        axes.turn(float(p.turn_deg[k]), periods[int(p.landmark[k])]),
                        float(p.turn_sigma_deg[k]),
                    ),
                    f"{p.near_m[k]:.3f}",
                    f"{p.far_m[k]:.3f}",
                    *(f"{v:.4f}" for v in axes.place(np.array([x, y]))),
                    f"{axes.yaw(yaw):.3f}",
                ]
            )
    write_csv(path, PASS_COLUMNS, rows)


def _periods(site: SiteMap) -> dict[int, float]:
    landmark_set = site.landmark_set
    return dict(zip(landmark_set.ids, landmark_set.periods_deg().tolist(), strict=True))


def ellipse(place: FloatArray, covariance: FloatArray) -> FloatArray:
    """(n, 2) a closed line within which a place lies with a probability of 95 %.

    Counter-clockwise, x to the right and y up.
    """
    angle = np.linspace(0, 2 * np.pi, ELLIPSE_CORNERS + 1)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    values, axes = np.linalg.eigh(covariance)
    axes[:, 0] *= np.linalg.det(axes)  # else it may be a reflection
    half = np.sqrt(CHI2_95 * np.maximum(values, 0))
    return np.asarray(place + circle * half @ axes.T)


def write_geojson(path: Path, site: SiteMap, origin: GeographicOrigin) -> None:
    """The landmarks as points, their 95 % ellipses as polygons, the paths as lines (RFC 7946).

    Ellipses and paths are cut in two at the 180th meridian; an ellipse round a pole is left out.
    """
    features = []
    for number, landmark in enumerate(site.landmarks, 1):
        name: dict[str, object] = {"number": number, "landmark": landmark.id}
        place = _rounded(origin.on_earth(landmark.place[None]))
        facts = _point_facts(site, landmark, origin)
        features.append(_feature("Point", place, {"name": f"ID.{landmark.id}", **name, **facts}))
        rings = rings_at_180(origin.on_earth(ellipse(landmark.place, landmark.covariance)))
        if rings:
            polygon = [[_rounded(ring)] for ring in rings]
            features.append(_feature("Polygon", polygon, {**name, "within": 0.95}))
    for log in site.logs:
        places = log.path.pose[np.isfinite(log.path.pose).all(axis=1), 1:]
        if len(places) > 1:
            chosen = np.linspace(0, len(places) - 1, min(len(places), MOST_POINTS)).round()
            path_deg = origin.on_earth(places[chosen.astype(int)])
            parts = list(map(_rounded, cut_at_180(path_deg)))
            features.append(_feature("LineString", parts, {"log": log.name}))
    document = {"type": "FeatureCollection", "program": "sonarrec", "features": features}
    write_text(path, json.dumps(document, allow_nan=False) + "\n")


def _point_facts(site: SiteMap, landmark: Landmark, origin: GeographicOrigin) -> dict[str, object]:
    """The properties of a landmark's point, apart from its names."""
    # Where the first sector begins, as a compass shows it.
    turn = (90 + origin.heading_deg - landmark.turn_deg) % 360
    heading = {} if math.isnan(turn) else {"heading_deg": round(turn, 2)}
    return {
        **heading,
        "sigma_m": round(float(np.sqrt(np.linalg.eigvalsh(landmark.covariance)[-1])), 4),
        "passes": len(landmark.members),
        "frames": site.frames_of(landmark.members),
    }


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
    axes, periods = Axes(site.ros_axes), _periods(site)
    rows = ["number  landmark       x m       y m  sigma m  orientation  sigma  passes  frames"]
    for number, landmark in enumerate(site.landmarks, 1):
        x, y = axes.place(landmark.place)
        sigma = math.sqrt(float(np.linalg.eigvalsh(landmark.covariance)[-1]))
        angles = axes.turn(landmark.turn_deg, periods[landmark.id]), landmark.turn_sigma_deg
        turn, turn_sigma = ("-" if math.isnan(angle) else f"{angle:.1f}" for angle in angles)
        frames = site.frames_of(landmark.members)
        rows.append(
            f"{number:>6}  {landmark.id:>8}  {x:>8.3f}  {y:>8.3f}  {sigma:>7.3f}  {turn:>11}  "
            f"{turn_sigma:>5}  {len(landmark.members):>6}  {frames:>6}"
        )
    return rows + left_out
