"""Simulated vehicle runs: a sonar that is carried round a course past landmarks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.simulation.motion import Pose, ar1
from sonarrec.simulation.scene import PlacedLandmark, PlacedObject, Scene
from tests.studies.learning.random_scenes import random_scene

SPEED_M_S = 0.35
RATE_HZ = 4.0
CENTRE = (0.0, 8.0)
"""Of every course: the floor is drawn about the origin, and reaches from near it to far beyond."""
LAPS = 3
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


def vehicle_run(seed: int, laps: int = LAPS, landmarks: int = 10) -> VehicleRun:
    """A course in the shape of a racetrack, driven `laps` times, with landmarks that lie in view.

    Of each ID there are two; of one of them the two lie near each other.
    """
    rng = np.random.default_rng([seed, 7])
    path = _course(rng, laps)
    time = np.arange(len(path)) / RATE_HZ
    drawn = random_scene(seed, KINDS[seed % len(KINDS)])
    off = round(rng.uniform(-HEIGHT_ERROR_M, HEIGHT_ERROR_M), 4)
    sonar = replace(drawn.sonar, height_error_m=off, range_bins=RANGE_BINS)
    things = _things(rng, drawn, path, landmarks)
    scene = replace(
        drawn,
        name=f"vehicle_{seed}",
        frames=len(path),
        rate_hz=RATE_HZ,
        sonar=sonar,
        landmarks=tuple(t for t in things if isinstance(t, PlacedLandmark)),
        objects=tuple(t for t in things if isinstance(t, PlacedObject)),
    )
    bin_m = (sonar.range_max_m - sonar.range_min_m) / sonar.range_bins
    near, far = 3.0, 14.0
    ground = replace(
        scene,
        sonar=replace(
            sonar, range_min_m=near, range_max_m=far, range_bins=round((far - near) / bin_m)
        ),
        motion=replace(scene.motion, pan_min_deg=-55.0, pan_max_deg=55.0, pan_start_deg=0.0),
    )
    heave = rng.uniform(0.005, 0.015) * np.sin(2 * np.pi * time / rng.uniform(5, 9))
    return VehicleRun(scene, ground, path, sonar.height_m + heave)


def _course(rng: np.random.Generator, laps: int) -> FloatArray:
    """(N, 3) yaw (deg), x, y: two straights and two half circles, clockwise, and a wander."""
    straight, radius = rng.uniform(0.8, 1.4), rng.uniform(1.2, 1.4)
    lap = 2 * straight + 2 * math.pi * radius
    along = np.arange(0, laps * lap, SPEED_M_S / RATE_HZ)
    at = along % lap
    turn = math.pi * radius
    yaw = np.select(
        [at < straight, at < straight + turn, at < 2 * straight + turn],
        [0.0 * at, (at - straight) / radius, np.pi + 0.0 * at],
        np.pi + (at - 2 * straight - turn) / radius,
    )
    yaw = yaw + 2 * np.pi * np.floor(along / lap)
    wander = np.radians(1.0) * ar1(rng, len(along), 1, 1 / RATE_HZ, 4.0)[:, 0]
    step = SPEED_M_S / RATE_HZ
    x = np.cumsum(np.sin(yaw + wander)) * step
    y = np.cumsum(np.cos(yaw + wander)) * step
    x += CENTRE[0] - (x.max() + x.min()) / 2
    y += CENTRE[1] - (y.max() + y.min()) / 2
    return np.column_stack([np.degrees(yaw + wander), x, y])


def _things(
    rng: np.random.Generator, drawn: Scene, path: FloatArray, landmarks: int
) -> list[PlacedLandmark | PlacedObject]:
    """Landmarks and other discs ahead of places of the path, none on another.

    They look like those drawn for the scene. The first three landmarks lie ahead of where the
    vehicle sets out; the last has the ID of the first, and lies beside it.
    """
    apart = 3 * drawn.landmark_set.radius_m
    taken: list[tuple[float, float]] = []

    def free(beside: tuple[float, float] | None = None) -> tuple[float, float]:
        while True:
            # The first three lie ahead of where the vehicle sets out.
            begins = len(taken) < 3
            (yaw, x, y), spread = path[0 if begins else rng.integers(len(path))], 8.0
            away = rng.uniform(1.6, 3.2 if begins else 2.8)
            if beside is not None:
                (x, y), away, spread = beside, rng.uniform(apart, apart + 0.3), 180.0
            angle = math.radians(yaw + rng.uniform(-spread, spread))
            place = x + away * math.sin(angle), y + away * math.cos(angle)
            if all(math.dist(place, other) > apart for other in taken):
                taken.append(place)
                return place

    def polar(place: tuple[float, float]) -> dict[str, float]:
        return {
            "ground_m": round(math.hypot(*place), 4),
            "azimuth_deg": round(math.degrees(math.atan2(*place)), 4),
            "orientation_deg": round(rng.uniform(0, 360), 1),
        }

    ids = [*np.resize(drawn.landmark_set.ids, landmarks - 1), drawn.landmark_set.ids[0]]
    found: list[PlacedLandmark | PlacedObject] = []
    for n, number in enumerate(ids):
        like = drawn.landmarks[n % len(drawn.landmarks)]
        place = free(taken[0] if n == landmarks - 1 else None)
        found.append(replace(like, id=int(number), **polar(place)))
    discs = [o for o in drawn.objects if o.kind in ("blank", "filled", "spokes", "half_ring")]
    return found + [replace(o, **polar(free())) for o in discs]
