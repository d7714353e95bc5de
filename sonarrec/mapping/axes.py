"""The axes of a map: those of its poses, and the Earth's; and the ellipse round a position."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import FloatArray

ELLIPSE_CORNERS = 48
CHI2_95 = 5.991  # squared Mahalanobis distance that 95 % of positions in a plane do not exceed


@dataclass(frozen=True, slots=True)
class Axes:
    """Converts from the map's axes to those of the poses.

    In the map, x is to the right and y ahead of a sonar whose yaw is 0. ros: whether the poses have
    x ahead, y to the left and yaw counter-clockwise; else nothing changes.
    """

    ros: bool

    def position(self, position: FloatArray) -> FloatArray:
        """(..., 2) positions in the poses' axes, m."""
        if not self.ros:
            return position
        return np.stack([position[..., 1], -position[..., 0]], axis=-1)

    def covariance(self, covariance: FloatArray) -> FloatArray:
        """(2, 2) covariance of a position in the poses' axes, m^2."""
        if not self.ros:
            return covariance
        (xx, xy), (_, yy) = covariance
        return np.array([[yy, -xy], [-xy, xx]])

    def orientation(self, orientation_deg: float, period_deg: float) -> float:
        """A landmark's orientation counter-clockwise from the poses' x axis, 0 to period_deg."""
        return (orientation_deg - 90 * self.ros) % period_deg

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

    def on_earth(self, position: FloatArray) -> FloatArray:
        """(n, 2) longitude and latitude, deg (the order of GeoJSON), of positions on the floor.

        position: (n, 2) m to the right and ahead, on the plane that touches the ellipsoid at the
        origin. The conversion uses Earth-centred axes, so that it also works near a pole.
        """
        heading, latitude = math.radians(self.heading_deg), math.radians(self.latitude_deg)
        right, ahead = position.T
        east = right * math.cos(heading) + ahead * math.sin(heading)
        north = ahead * math.cos(heading) - right * math.sin(heading)
        a, e2 = 6378137.0, 0.00669437999014
        n = a / math.sqrt(1 - e2 * math.sin(latitude) ** 2)
        # Distance from the Earth's axis, towards the origin's meridian; distance along the axis.
        out = n * math.cos(latitude) - north * math.sin(latitude)
        up = n * (1 - e2) * math.sin(latitude) + north * math.cos(latitude)
        distance, b = np.hypot(out, east), a * math.sqrt(1 - e2)
        angle = np.arctan2(up * a, distance * b)  # Bowring's latitude
        latitudes = np.arctan2(
            up + e2 / (1 - e2) * b * np.sin(angle) ** 3, distance - e2 * a * np.cos(angle) ** 3
        )
        longitudes = self.longitude_deg + np.degrees(np.arctan2(east, out))
        return np.column_stack([(longitudes + 180) % 360 - 180, np.degrees(latitudes)])


def cut_at_180(line: FloatArray) -> list[FloatArray]:
    """Cut a line into parts that do not cross the 180th meridian.

    line: (n, 2) longitude and latitude, deg. From point to point it takes the shorter way.
    """
    longitude, latitude = np.unwrap(line[:, 0], period=360), line[:, 1]
    lap = np.floor((longitude + 180) / 360)  # how often it went round
    parts = [[(longitude[0] - 360 * lap[0], latitude[0])]]
    for k in range(1, len(line)):
        if lap[k] != lap[k - 1]:
            edge = 360 * max(lap[k], lap[k - 1]) - 180
            share = (edge - longitude[k - 1]) / (longitude[k] - longitude[k - 1])
            latitude_at_180 = latitude[k - 1] + share * (latitude[k] - latitude[k - 1])
            parts[-1].append((edge - 360 * lap[k - 1], latitude_at_180))
            parts.append([(edge - 360 * lap[k], latitude_at_180)])
        parts[-1].append((longitude[k] - 360 * lap[k], latitude[k]))
    return [np.array(part) for part in parts]


def rings_at_180(ring: FloatArray) -> list[FloatArray]:
    """Cut a closed convex line at the 180th meridian into closed lines; none round a pole."""
    first, *others = cut_at_180(ring)
    if not others:
        return [ring]
    if len(others) == 1:
        return []
    joined = np.concatenate([others.pop()[:-1], first])  # the first part and the last are one
    parts = [joined, *others]
    return [np.concatenate([part, part[:1]]) for part in parts]


def ellipse(position: FloatArray, covariance: FloatArray) -> FloatArray:
    """(n, 2) a closed line that holds a position with a probability of 95 %, counter-clockwise."""
    angle = np.linspace(0, 2 * np.pi, ELLIPSE_CORNERS + 1)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    values, axes = np.linalg.eigh(covariance)
    axes[:, 0] *= np.linalg.det(axes)  # else it may be a reflection
    half = np.sqrt(CHI2_95 * np.maximum(values, 0))
    return np.asarray(position + circle * half @ axes.T)
