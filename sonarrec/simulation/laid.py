"""How things lie on the simulated floor: leaning, under silt, and on rippled sand."""

from __future__ import annotations

import math

import cv2
import numpy as np

from sonarrec.records import BoolArray, FloatArray
from sonarrec.simulation.grid import PolarGrid, SquareGrid, smooth_noise
from sonarrec.simulation.scene import PlacedLandmark, PlacedObject, Scene, place_of

SILT_EDGE = 0.15  # of smooth noise of unit variance: from bare to covered


def raised_m(item: PlacedLandmark | PlacedObject, radius_m: float) -> float:
    """How far above the floor the middle of a leaning disc is."""
    return radius_m * math.sin(math.radians(item.lean_deg))


class RaisedDisc:
    """A disc whose lower edge touches the floor, where a sonar over the origin sees it.

    What is raised is as near as floor that lies nearer along the same azimuth; there it shows.
    dx_m, dy_m: of each cell of a box, from the disc's middle and along the disc. lifted_m: how far
    above the floor a thing there would have to rise to be seen as flatly as the disc is.
    """

    def __init__(
        self,
        item: PlacedLandmark | PlacedObject,
        radius_m: float,
        sonar_m: float,
        x_m: np.ndarray,
        y_m: np.ndarray,
    ) -> None:
        """sonar_m: its height. x_m, y_m: of the cells on the floor."""
        lean, towards = math.radians(item.lean_deg), math.radians(item.lean_towards_deg)
        x0, y0 = place_of(item)
        right, ahead = math.sin(towards), math.cos(towards)
        floor = np.hypot(x_m, y_m)
        range_ = np.hypot(floor, sonar_m)
        ex, ey = x_m / floor, y_m / floor
        # Along an azimuth the disc's height is rise times ground range, plus a constant.
        facing = ex * right + ey * ahead
        rise = math.tan(lean) * facing
        over = sonar_m - raised_m(item, radius_m) + math.tan(lean) * (x0 * right + y0 * ahead)
        root = np.maximum(range_**2 * (1 + rise**2) - over**2, 0)
        ground = (over * rise + np.sqrt(root)) / (1 + rise**2)
        dx, dy = ground * ex - x0, ground * ey - y0
        level = dx * right + dy * ahead
        self._height = level * math.tan(lean) + raised_m(item, radius_m)
        along = level * (1 / math.cos(lean) - 1)
        self.dx_m, self.dy_m = dx + along * right, dy + along * ahead
        self.lifted_m = sonar_m - floor * (sonar_m - self._height) / ground
        self._sine = math.sin(lean) * facing * ground + math.cos(lean) * (sonar_m - self._height)
        self._floor_sine = sonar_m
        rim = np.hypot(self.dx_m, self.dy_m) / radius_m
        # The raised edge turns its face to the sonar or away from it.
        near = -(self.dx_m * x0 + self.dy_m * y0) / (radius_m * item.ground_m)
        most = 2 * raised_m(item, radius_m)
        self._edge = np.where(rim > 0.8, near * np.clip(self._height / most, 0, 1), 0.0)

    def lit_db(self, specular_db: float) -> FloatArray:
        """How much brighter than level the disc is: Lambert's law there and back, and its edge."""
        lit = np.maximum(self._sine / self._floor_sine, 0.02)
        return np.asarray(20 * np.log10(lit) + specular_db * self._edge)


def silt_over(noise: np.ndarray, disc: BoolArray, share: float) -> np.ndarray:
    """(box) 0 to 1: how far silt covers each cell of a disc, `share` of them by half or more."""
    if not disc.any():
        return np.zeros(noise.shape, np.float32)
    most = np.quantile(noise[disc], 1 - share)
    return np.asarray(np.where(disc, 1 / (1 + np.exp((most - noise) / SILT_EDGE)), 0.0))


def ripples(scene: Scene, grid: PolarGrid | SquareGrid, bare: BoolArray) -> np.ndarray:
    """Height (m) of sand ripples on the grid; things lie level, and sand runs out at their edge.

    bare: where nothing lies. Crests are sharper than troughs, and bend.
    """
    floor = scene.floor
    towards = math.radians(floor.ripple_towards_deg)
    rng = np.random.default_rng([scene.seed, 12])
    bends = smooth_noise(rng, grid.shape, grid.cells(6 * floor.ripple_length_m))
    across = grid.x_m * np.float32(math.sin(towards)) + grid.y_m * np.float32(math.cos(towards))
    phase = across / np.float32(floor.ripple_length_m) + np.float32(floor.ripple_bends) * bends
    phase = phase * np.float32(2 * np.pi)
    height = np.float32(floor.ripple_height_m / 2) * (np.cos(phase) + 0.25 * np.cos(2 * phase))
    rows, columns = (2 * math.ceil(n / 2) + 1 for n in grid.cells(0.015))
    return np.asarray(height * cv2.blur(bare.astype(np.float32), (columns, rows)))
