"""Where places of the floor, a plane that may slope, lie as seen by a sonar that may roll."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonarrec.records import FloatArray
from sonarrec.simulation.motion import Pose
from sonarrec.simulation.scene import Scene


def within_a_turn(bearing_deg: FloatArray | float) -> FloatArray:
    """The same bearings, -180 to 180 deg: a vehicle may have turned right round."""
    return np.asarray(bearing_deg - 360 * np.rint(np.asarray(bearing_deg) / 360))


@dataclass(frozen=True, slots=True)
class Look:
    """What of the floor a sonar sees at slant ranges (bins,) and azimuths (n,).

    x_m, y_m: (bins, n) places of the floor, right and forward along it. depression_deg: (bins, n)
    below the sonar's own horizon. sine: (bins, n) of the grazing angle, 0 where there is no floor.
    """

    x_m: FloatArray
    y_m: FloatArray
    depression_deg: FloatArray
    sine: FloatArray


@dataclass(frozen=True, slots=True)
class Plane:
    """The floor. x, y: right and forward of its origin, measured along the floor.

    The sonar's height is above the floor straight below it. With a roll its right side is down by
    so much, about its level heading, which moves and lights what it sees; a pitch changes its tilt
    alone, for near the beam's axis bearings hardly change.
    """

    slope_deg: float = 0.0
    towards_deg: float = 0.0

    @classmethod
    def of(cls, scene: Scene) -> Plane:
        return cls(scene.floor.slope_deg, scene.floor.slope_towards_deg)

    def seen(
        self,
        pose: Pose,
        x_m: FloatArray | float,
        y_m: FloatArray | float,
        up_m: FloatArray | float = 0.0,
    ) -> tuple[FloatArray, FloatArray]:
        """(slant range in m, bearing in deg) of places up_m above the floor; shapes broadcast."""
        slope, towards = math.radians(self.slope_deg), math.radians(self.towards_deg)
        right, ahead = math.sin(towards), math.cos(towards)
        along = x_m * right + y_m * ahead
        level = along * (math.cos(slope) - 1) - up_m * math.sin(slope)
        dx = x_m + level * right - pose.x_m
        dy = y_m + level * ahead - pose.y_m
        below = (pose.x_m * right + pose.y_m * ahead) * math.tan(slope)
        dz = along * math.sin(slope) + up_m * math.cos(slope) - below - pose.height_m
        slant = np.sqrt(dx**2 + dy**2 + dz**2)
        bearing = np.degrees(np.arctan2(dx, dy)) - pose.pan_deg
        if pose.roll_deg:
            pan, roll = math.radians(pose.pan_deg), math.radians(pose.roll_deg)
            across = dx * math.cos(pan) - dy * math.sin(pan)
            across = across * math.cos(roll) - dz * math.sin(roll)
            bearing = np.degrees(np.arctan2(across, dx * math.sin(pan) + dy * math.cos(pan)))
        return np.asarray(slant), within_a_turn(bearing)

    def look(self, pose: Pose, range_m: FloatArray, azimuth_deg: FloatArray) -> Look:
        """What is seen along beams whose azimuths are these while the sonar is level."""
        slope, towards = math.radians(self.slope_deg), math.radians(self.towards_deg)
        pan, roll = math.radians(pose.pan_deg), math.radians(pose.roll_deg)
        bearing = np.radians(azimuth_deg) - pan
        # The floor's normal in the sonar's own axes, and how far below it the floor is.
        across = -math.sin(slope) * math.sin(towards - pan)
        ahead = -math.sin(slope) * math.cos(towards - pan)
        up = across * math.sin(roll) + math.cos(slope) * math.cos(roll)
        across = across * math.cos(roll) - math.cos(slope) * math.sin(roll)
        away = pose.height_m * math.cos(slope)
        # A ray of depression d meets it where up sin(d) - facing cos(d) = away / range.
        facing = across * np.sin(bearing) + ahead * np.cos(bearing)
        sine = (away / np.maximum(range_m, 1e-6))[:, None]
        steep = np.minimum(sine / np.hypot(up, facing), 1.0)
        depression = np.arcsin(steep) + np.arctan2(facing, up)
        level = range_m[:, None] * np.cos(depression)
        dx, dy = level * np.sin(bearing), level * np.cos(bearing)
        if roll:
            dx = dx * math.cos(roll) - range_m[:, None] * np.sin(depression) * math.sin(roll)
        x = dx * math.cos(pan) + dy * math.sin(pan) + pose.x_m
        y = dy * math.cos(pan) - dx * math.sin(pan) + pose.y_m
        if slope:
            along = (x * math.sin(towards) + y * math.cos(towards)) * (1 / math.cos(slope) - 1)
            x, y = x + along * math.sin(towards), y + along * math.cos(towards)
        floor = (steep < 1) & (depression > 0)
        return Look(x, y, np.degrees(depression), np.where(floor, sine, 0.0))


FLAT = Plane()
