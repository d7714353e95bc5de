"""How a simulated sonar moves over the floor, a plane that may slope, and where it sees it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.simulation.scene import Scene


@dataclass(frozen=True, slots=True)
class Pose:
    """The sonar's true pose."""

    pan_deg: float
    height_m: float
    x_m: float
    y_m: float
    """x_m, y_m: to the right and forward of the floor's origin."""
    pitch_deg: float = 0.0
    """By how much it is tilted more than stated."""
    roll_deg: float = 0.0
    """By how much its right side is down."""


def ar1(
    rng: np.random.Generator, steps: int, size: int, step_s: float, time_s: float
) -> FloatArray:
    """(steps, size) first-order autoregressive processes of unit variance.

    step_s: time between steps. time_s: after which the correlation has fallen to 1/e.
    """
    keep = math.exp(-step_s / time_s)
    drawn = rng.standard_normal((steps, size))
    drawn[1:] *= math.sqrt(1 - keep**2)
    for step in range(1, steps):
        drawn[step] += keep * drawn[step - 1]
    return drawn


def _run(scene: Scene) -> FloatArray:
    """(frames, 3) heading (deg), x and y (m) of the vehicle; all begin at 0."""
    motion = scene.motion
    phase = np.random.default_rng([scene.seed, 9]).uniform(0, 2 * np.pi, 3)
    # In tenths of a frame, so that the result hardly depends on how the steps are summed.
    time = np.arange((scene.frames - 1) * 10 + 1) / (10 * scene.rate_hz)
    swing = np.sin(2 * np.pi * time[:, None] / motion.swing_period_s + phase)
    throughout, amplitude = motion.speeds
    ahead, right, yaw_rate = (throughout + amplitude * swing).T

    def summed(speed: FloatArray) -> FloatArray:  # by the trapezoidal rule
        steps = np.diff(time) * (speed[1:] + speed[:-1]) / 2
        return np.concatenate([[0.0], np.cumsum(steps)])

    heading = summed(yaw_rate)
    sine, cosine = np.sin(np.radians(heading)), np.cos(np.radians(heading))
    x, y = summed(ahead * sine + right * cosine), summed(ahead * cosine - right * sine)
    return np.column_stack([heading, x, y])[::10]


def poses(scene: Scene) -> list[Pose]:
    """The sonar's true pose in every frame."""
    motion, frames = scene.motion, scene.frames
    rng = np.random.default_rng([scene.seed, 2])
    phase = rng.uniform(0, 2 * np.pi, 3)
    time = np.arange(frames) / scene.rate_hz
    pan, span = np.full(frames, motion.pan_min_deg), motion.pan_max_deg - motion.pan_min_deg
    if span:  # to and fro, at first to the right
        swept = np.mod(motion.pan_start_deg - pan + motion.pan_deg_s * time, 2 * span)
        pan = pan + np.minimum(swept, 2 * span - swept)
    jitter = ar1(rng, frames, 1, 1 / scene.rate_hz, motion.yaw_jitter_s)[:, 0]
    pan = pan + motion.yaw_jitter_deg * jitter
    heave = motion.heave_m * np.sin(2 * np.pi * time / motion.heave_period_s + phase[0])
    slow = 2 * np.pi * time / motion.sway_period_s
    heading, x, y = _run(scene).T if motion.speeds.any() else np.zeros((3, frames))
    tossed = np.random.default_rng([scene.seed, 10]).uniform(0, 2 * np.pi, 2)
    toss = np.sin(2 * np.pi * time[:, None] / motion.attitude_period_s + tossed)
    attitude = toss * (motion.pitch_deg, motion.roll_deg)
    x = motion.sway_x_m * np.sin(slow + phase[1]) + x
    y = motion.sway_y_m * np.sin(slow + phase[2]) + y
    every = np.column_stack([pan + heading, scene.sonar.height_m + heave, x, y, attitude])
    return [Pose(*values) for values in every.tolist()]


def wrapped(bearing_deg: FloatArray | float) -> FloatArray:
    """Bearings shifted by multiples of 360 deg to -180 to 180 deg."""
    return np.asarray(bearing_deg - 360 * np.rint(np.asarray(bearing_deg) / 360))


@dataclass(frozen=True, slots=True)
class Plane:
    """The floor: by how much it slopes, and the azimuth towards which it rises, deg.

    x and y are measured along the floor, to the right and forward of its origin. The sonar's height
    is above the floor straight below it. A roll turns the sonar about its level heading, right side
    down. A pitch changes only the tilt, because near the beam's axis bearings hardly change.
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
        """(slant range in m, bearing in deg) of points up_m above the floor; shapes broadcast."""
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
        return np.asarray(slant), wrapped(bearing)

    def view(
        self, pose: Pose, range_m: FloatArray, azimuth_deg: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """What the sonar sees, each (bins, n) float32: x and y along the floor (m), the angle below
        its own horizon (deg), and the sine of the grazing angle, 0 where there is no floor.

        range_m: (bins,) slant ranges. azimuth_deg: (n,) azimuths of the beams before it rolls.
        """
        slope, towards = math.radians(self.slope_deg), math.radians(self.towards_deg)
        pan, roll = math.radians(pose.pan_deg), math.radians(pose.roll_deg)
        bearing = np.radians(azimuth_deg) - pan
        # The floor's normal in the sonar's own axes, and the sonar's distance from the floor.
        across = -math.sin(slope) * math.sin(towards - pan)
        ahead = -math.sin(slope) * math.cos(towards - pan)
        up = across * math.sin(roll) + math.cos(slope) * math.cos(roll)
        across = across * math.cos(roll) - math.cos(slope) * math.sin(roll)
        distance = pose.height_m * math.cos(slope)
        # A ray of depression d meets the floor where up sin(d) - facing cos(d) = distance / range.
        facing = across * np.sin(bearing) + ahead * np.cos(bearing)
        sine = (distance / np.maximum(range_m, 1e-6))[:, None]
        # Single precision from here on, which is enough for a grid of scatterers.
        steep = (sine / np.hypot(up, facing)).astype(np.float32)
        floor = steep < 1
        depression = np.arcsin(np.minimum(steep, np.float32(1)))
        depression += np.arctan2(facing, up).astype(np.float32)
        floor &= depression > 0
        slant = range_m[:, None].astype(np.float32)
        level = slant * np.cos(depression)
        dx = level * np.sin(bearing).astype(np.float32)
        dy = level * np.cos(bearing).astype(np.float32)
        if roll:
            dx = dx * np.float32(math.cos(roll))
            dx += slant * np.sin(depression) * np.float32(math.sin(-roll))
        # From the sonar's heading to the floor's axes, and along the slope: one matrix.
        rotation = np.array([[math.cos(pan), math.sin(pan)], [-math.sin(pan), math.cos(pan)]])
        uphill = np.array([math.sin(towards), math.cos(towards)])
        along = np.eye(2) + (1 / math.cos(slope) - 1) * np.outer(uphill, uphill)
        matrix = (along @ rotation).astype(np.float32)
        first = (along @ np.array([pose.x_m, pose.y_m])).astype(np.float32)
        x = matrix[0, 0] * dx + matrix[0, 1] * dy + first[0]
        y = matrix[1, 0] * dx + matrix[1, 1] * dy + first[1]
        return x, y, np.degrees(depression), np.where(floor, sine.astype(np.float32), 0)
