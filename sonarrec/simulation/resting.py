"""How objects rest on the simulated floor: leaning, under silt, and on rippled sand."""

from __future__ import annotations

import math

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, FloatArray
from sonarrec.simulation.grid import PolarGrid, SquareGrid, smooth_noise
from sonarrec.simulation.scene import PlacedLandmark, PlacedObject, Scene, position_of

SILT_EDGE = 0.15  # width of the edge between bare and covered, in units of the smooth noise


def raised_m(item: PlacedLandmark | PlacedObject, radius_m: float) -> float:
    """Height of the middle of a leaning disc above the floor, m."""
    return radius_m * math.sin(math.radians(item.lean_deg))


class RaisedDisc:
    """A leaning disc, as a sonar above the floor's origin sees it. Its lower edge is on the floor.

    A raised point has the same slant range as a nearer point of the floor, so it shows there.
    dx_m, dy_m: for each cell of a box, the point of the disc that shows there, from the disc's
    middle and along the disc. lifted_m: how tall an object standing in the cell would have to be,
    for the sonar to see its top at the same depression as the disc.
    """

    def __init__(
        self,
        item: PlacedLandmark | PlacedObject,
        radius_m: float,
        sonar_m: float,
        x_m: np.ndarray,
        y_m: np.ndarray,
    ) -> None:
        """sonar_m: the sonar's height. x_m, y_m: the cells' positions on the floor."""
        lean, towards = math.radians(item.lean_deg), math.radians(item.lean_towards_deg)
        x0, y0 = position_of(item)
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
        self._sonar_m = sonar_m
        rim = np.hypot(self.dx_m, self.dy_m) / radius_m
        # The raised edge faces the sonar or faces away from it.
        near = -(self.dx_m * x0 + self.dy_m * y0) / (radius_m * item.ground_m)
        most = 2 * raised_m(item, radius_m)
        self._edge = np.where(rim > 0.8, near * np.clip(self._height / most, 0, 1), 0.0)

    def lit_db(self, specular_db: float) -> FloatArray:
        """By how much the disc is brighter than if it lay level, dB.

        Lambert's law, for the way there and back; the edge that faces the sonar is brighter.
        """
        lit = np.maximum(self._sine / self._sonar_m, 0.02)
        return np.asarray(20 * np.log10(lit) + specular_db * self._edge)


def silt_over(noise: np.ndarray, disc: BoolArray, share: float) -> np.ndarray:
    """(box) 0 to 1: by how much silt covers each cell of a disc.

    share: of the cells, those that are at least half covered.
    """
    if not disc.any():
        return np.zeros(noise.shape, np.float32)
    most = np.quantile(noise[disc], 1 - share)
    return np.asarray(np.where(disc, 1 / (1 + np.exp((most - noise) / SILT_EDGE)), 0.0))


def ripples(scene: Scene, grid: PolarGrid | SquareGrid, bare: BoolArray) -> np.ndarray:
    """Height (m) of sand ripples in each cell of the grid.

    bare: the cells without an object. Objects lie level, and the ripples fade out at their edges.
    Crests bend, and are sharper than troughs.
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
