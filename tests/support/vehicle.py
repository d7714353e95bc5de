"""Simulated vehicle runs: a sonar that is carried round a course past landmarks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.simulation.motion import Pose, ar1
from sonarrec.simulation.scene import Scene
from tests.studies.learning.random_scenes import random_scene

SPEED_M_S = 0.35
RATE_HZ = 4.0
CENTRE = (0.0, 8.0)
"""Of every course: the floor is drawn about the origin, and reaches from near it to far beyond."""
RANGE_BINS = 256
KINDS = ("plain", "fading", "low_contrast", "ring_widths")
"""Of random scene, one after the other: whose picture and landmarks the runs have."""
HEIGHT_ERROR_M = 0.02
"""The stated height is wrong by up to so much."""


@dataclass(frozen=True, slots=True)
class VehicleRun:
    """One run: what lies there, and the way past it.

    scene: landmarks and other things. ground: as `render` takes it. path: (N, 3) yaw in deg,
    positive to the right, then x and y in m, of every frame. height_m: (N,).
    """

    scene: Scene
    ground: Scene
    path: FloatArray
    height_m: FloatArray

    def poses(self) -> list[Pose]:
        """As `render` takes them."""
        values = np.column_stack([self.path[:, 0], self.height_m, self.path[:, 1:]])
        return [Pose(*row) for row in values.tolist()]


def vehicle_run(seed: int) -> VehicleRun:
    """A course in the shape of a racetrack, past landmarks and other things."""
    rng = np.random.default_rng([seed, 7])
    path = _course(rng)
    time = np.arange(len(path)) / RATE_HZ
    drawn = random_scene(seed, KINDS[seed % len(KINDS)])
    off = round(rng.uniform(-HEIGHT_ERROR_M, HEIGHT_ERROR_M), 4)
    sonar = replace(drawn.sonar, height_error_m=off, range_bins=RANGE_BINS)
    landmarks = tuple(replace(item, **_ahead(rng, path)) for item in drawn.landmarks * 3)
    objects = tuple(replace(o, **_ahead(rng, path)) for o in drawn.objects if o.kind != "wall")
    scene = replace(drawn, frames=len(path), rate_hz=RATE_HZ, sonar=sonar)
    scene = replace(scene, landmarks=landmarks, objects=objects)
    bin_m = (sonar.range_max_m - sonar.range_min_m) / sonar.range_bins
    near, far = 3.0, 14.0
    bins = round((far - near) / bin_m)
    ground = replace(
        scene,
        sonar=replace(sonar, range_min_m=near, range_max_m=far, range_bins=bins),
        motion=replace(scene.motion, pan_min_deg=-55.0, pan_max_deg=55.0, pan_start_deg=0.0),
    )
    heave = rng.uniform(0.005, 0.015) * np.sin(2 * np.pi * time / rng.uniform(5, 9))
    return VehicleRun(scene, ground, path, sonar.height_m + heave)


def _course(rng: np.random.Generator) -> FloatArray:
    """(N, 3) yaw (deg), x, y: two straights and two half circles, clockwise, and a wander."""
    straight, radius = rng.uniform(0.8, 1.4), rng.uniform(1.2, 1.4)
    lap = 2 * straight + 2 * math.pi * radius
    at = np.arange(0, lap, SPEED_M_S / RATE_HZ)
    turn = math.pi * radius
    yaw = np.select(
        [at < straight, at < straight + turn, at < 2 * straight + turn],
        [0.0 * at, (at - straight) / radius, np.pi + 0.0 * at],
        np.pi + (at - 2 * straight - turn) / radius,
    )
    wander = np.radians(1.0) * ar1(rng, len(at), 1, 1 / RATE_HZ, 4.0)[:, 0]
    step = SPEED_M_S / RATE_HZ
    x = np.cumsum(np.sin(yaw + wander)) * step
    y = np.cumsum(np.cos(yaw + wander)) * step
    x += CENTRE[0] - (x.max() + x.min()) / 2
    y += CENTRE[1] - (y.max() + y.min()) / 2
    return np.column_stack([np.degrees(yaw + wander), x, y])


def _ahead(rng: np.random.Generator, path: FloatArray) -> dict[str, float]:
    """A place in view from somewhere on the path, from the floor's origin, and an orientation."""
    yaw, x, y = path[rng.integers(len(path))]
    angle, away = math.radians(yaw + rng.uniform(-8, 8)), rng.uniform(1.6, 2.8)
    x, y = x + away * math.sin(angle), y + away * math.cos(angle)
    azimuth_deg = math.degrees(math.atan2(x, y))
    turn = rng.uniform(0, 360)
    return {"ground_m": math.hypot(x, y), "azimuth_deg": azimuth_deg, "orientation_deg": turn}
