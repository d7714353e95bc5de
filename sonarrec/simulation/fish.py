"""Fish that swim through a simulated scene: bright echoes with shadows, not fixed to the floor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.simulation.motion import Plane, Pose, wrapped
from sonarrec.simulation.scene import Scene
from sonarrec.simulation.world import View

WIDTH = 0.25  # width of a fish, and its height, in lengths
BROADSIDE_DB = 4.0  # by how much a fish is brighter from the side than from head or tail
OUTSIDE_M = 0.4  # how far outside of the floor in view fish leave and come in again


@dataclass(frozen=True, slots=True)
class Fishes:
    """The positions of all fish at one moment, each (n,)."""

    x_m: FloatArray
    y_m: FloatArray
    """x_m, y_m: along the floor."""
    up_m: FloatArray
    """Height above it."""
    heading_deg: FloatArray
    """Azimuth."""
    length_m: FloatArray


class Shoal:
    """All fish of a scene. Each swims straight on with a slow weave; schools stay together.

    low, high: (2,) the corners (x, y) of the floor that the sonar may see, m. A fish that leaves it
    comes in again on the other side.
    """

    def __init__(self, scene: Scene, low: FloatArray, high: FloatArray) -> None:
        self._scene, fish = scene, scene.fish
        self._plane = Plane.of(scene)
        rng = np.random.default_rng([scene.seed, 11])
        n = fish.number
        schooled = round(n * fish.schooling) if fish.schools else 0
        # The group of each fish: schools first, then a group for each single fish.
        self._group = np.concatenate(
            [np.arange(schooled) % max(fish.schools, 1), fish.schools + np.arange(n - schooled)]
        ).astype(int)
        groups = fish.schools + n - schooled
        # A school keeps about a length between neighbours.
        size = np.bincount(self._group, minlength=groups)[self._group]
        spread = np.where(size > 1, 0.6 * fish.length_m * np.sqrt(size), 0.0)
        outside = OUTSIDE_M + 2 * spread.max(initial=0)
        self._low = low - outside
        self._span = high + outside - self._low
        self._start = rng.uniform(0, 1, (groups, 2)) * self._span
        self._heading = rng.uniform(0, 2 * np.pi, groups)
        self._speed = fish.speed_m_s * rng.gamma(4.0, 0.25, groups)
        self._period = rng.uniform(3, 9, groups)
        self._phase = rng.uniform(0, 2 * np.pi, groups)
        self._length = fish.length_m * np.exp(rng.normal(0, 0.25, n))
        self._up = rng.uniform(0.15, 1, n) * fish.height_m
        self._offset = rng.normal(0, 1, (n, 2)) * spread[:, None]
        self._mill = rng.uniform(0, 2 * np.pi, (n, 2))

    def positions(self, time_s: float) -> Fishes:
        """The positions of the fish at a time."""
        weave = 2 * np.pi * time_s / self._period + self._phase
        ahead = np.column_stack([np.sin(self._heading), np.cos(self._heading)])
        right = np.column_stack([ahead[:, 1], -ahead[:, 0]])
        swing = self._speed * self._period / (2 * np.pi) * 0.5
        way = (self._speed * time_s)[:, None] * ahead + (swing * np.sin(weave))[:, None] * right
        middle = self._low + np.mod(self._start + way, self._span)
        rotated = self._heading + np.arctan(0.5 * np.cos(weave))
        mill, schooled = np.sin(2 * np.pi * time_s / 5.0 + self._mill), self._offset != 0
        milled = np.where(schooled, self._scene.fish.length_m * mill, 0.0)
        x, y = (middle[self._group] + self._offset + milled).T
        heading = np.degrees(rotated[self._group]) + 40 * schooled[:, 0] * mill[:, 0]
        return Fishes(x, y, self._up, heading, self._length)

    def swim_into(
        self, view: View, range_m: FloatArray, pose: Pose, now: Fishes, rng: np.random.Generator
    ) -> None:
        """Add the echoes and shadows of the fish to a view.

        range_m: (bins,) slant ranges of the view. now: where the fish are.
        """
        slant, bearing = self._plane.seen(pose, now.x_m, now.y_m, now.up_m)
        azimuth = bearing + pose.pan_deg
        first, last = view.azimuth_deg[[0, -1]]
        seen = (slant > range_m[0] - 0.5) & (slant < range_m[-1] + 0.5)
        seen &= (azimuth > first - 5) & (azimuth < last + 5) & (now.up_m < pose.height_m)
        dark = 1 - 10 ** (self._scene.noise.shadow_db / 20)
        bodies = []
        for n in np.flatnonzero(seen):
            below, length = pose.height_m - now.up_m[n], now.length_m[n]
            ground = math.sqrt(max(slant[n] ** 2 - below**2, 1e-4))
            across = float(wrapped(now.heading_deg[n] - azimuth[n]))
            # The shadow lies where the line past the fish meets the floor, so it is larger than
            # the fish; the height of the fish stretches it along that line.
            larger, longer = pose.height_m / below, WIDTH * length * ground / below
            sizes = slant[n] * larger, ground * larger, length * larger
            box, mask = _filled(view, range_m, azimuth[n], across, *sizes, longer)
            view.echoes[box] *= 1 - dark * mask
            view.power[box] *= (1 - dark * mask) ** 2
            bodies.append((azimuth[n], across, slant[n], ground, length))
        for body in bodies:
            side = abs(math.sin(math.radians(body[1]))) - 0.5
            level = self._scene.fish.bright_db + BROADSIDE_DB * side
            box, mask = _filled(view, range_m, *body)
            echo = mask * np.float32(10 ** (level / 20))
            speckle = rng.standard_normal((*mask.shape, 2), dtype=np.float32)
            view.echoes[box] += echo * speckle.view(np.complex64)[..., 0] * math.sqrt(0.5)
            view.power[box] += echo**2


def _filled(
    view: View,
    range_m: FloatArray,
    azimuth_deg: float,
    across_deg: float,
    slant_m: float,
    ground_m: float,
    length_m: float,
    longer_m: float = 0.0,
) -> tuple[tuple[slice, slice], np.ndarray]:
    """(the box of the view that a fish or shadow takes, how far it fills each cell, 0 to 1).

    across_deg: its heading relative to the line of sight. longer_m: stretch along that line.
    """
    reach = 0.7 * (length_m + longer_m)
    angle = math.degrees(reach / ground_m)
    rows = slice(*np.searchsorted(range_m, [slant_m - reach, slant_m + reach]))
    ends = np.searchsorted(view.azimuth_deg, [azimuth_deg - angle, azimuth_deg + angle])
    columns = slice(*ends)
    ahead = (range_m[rows, None] - slant_m) * slant_m / ground_m
    ahead = np.sign(ahead) * np.maximum(np.abs(ahead) - longer_m / 2, 0)
    right = np.radians(view.azimuth_deg[None, columns] - azimuth_deg) * ground_m
    cos, sin = math.cos(math.radians(across_deg)), math.sin(math.radians(across_deg))
    along, across = ahead * cos + right * sin, right * cos - ahead * sin
    half = length_m / 2
    square = (along / half) ** 2 + (across / (WIDTH * half)) ** 2
    return (rows, columns), np.exp(-(square**2)).astype(np.float32)
