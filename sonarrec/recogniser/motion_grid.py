"""A coarse search for the sonar's motion, where nothing is known of it."""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np

from sonarrec.recogniser.floor_cells import CellPlaces
from sonarrec.records import FloatArray, FloatImage


class MotionGrid:
    """Finds a motion where nothing is known of it: the best of a grid, at half the resolution.

    The later picture is cut into blocks. Each is correlated with the earlier picture around its own
    place; the grid's motions say where each block should be found.
    """

    BLOCKS = (8, 6)  # down, across
    MOST = (0.09, 0.16, math.radians(6.0))  # m to the right, m ahead, rad: to either side
    FINENESS = (0.01, 0.02)  # m, of the grid; its turns are two cells apart

    def __init__(self, cells: CellPlaces) -> None:
        rows, columns = (side // 2 for side in cells.shape)
        self._block = (rows // self.BLOCKS[0], columns // self.BLOCKS[1])
        right, ahead, turn = (
            np.arange(-math.ceil(most / fine), math.ceil(most / fine) + 1) * fine
            for most, fine in zip(self.MOST, (*self.FINENESS, 2 * cells.bearing_step), strict=True)
        )
        motions = np.stack(np.meshgrid(right, ahead, turn, indexing="ij")).reshape(3, -1, 1)
        self._motions = motions[..., 0].T
        middle = [
            (np.arange(count) + 0.5) * 2 * size - 0.5
            for count, size in zip(self.BLOCKS, self._block, strict=True)
        ]
        slant = cells.slant + middle[0] * cells.slant_step
        ground = np.sqrt(np.maximum(slant**2 - cells.depth**2, 0.01 * slant**2))
        bearing = cells.bearing + middle[1] * cells.bearing_step
        ground, bearing = (a.ravel() for a in np.meshgrid(ground, bearing, indexing="ij"))
        row, column = cells.before(ground, bearing, motions)
        at = [
            np.rint((v - m.ravel()) / 2).astype(int)
            for v, m in zip((row, column), np.meshgrid(*middle, indexing="ij"), strict=True)
        ]
        self._reach = tuple(
            int(min(np.abs(a).max(), side - 1)) for a, side in zip(at, (rows, columns), strict=True)
        )
        high, wide = (2 * n + 1 for n in self._reach)
        inside = (np.abs(at[0]) <= self._reach[0]) & (np.abs(at[1]) <= self._reach[1])
        place = (at[0] + self._reach[0]) * wide + at[1] + self._reach[1]
        place += np.arange(place.shape[1]) * high * wide
        self._place = np.where(inside, place, place.shape[1] * high * wide).astype(np.int32)

    def best(self, before: FloatImage, now: FloatImage) -> FloatArray:
        """(3,) the motion by which the blocks are most alike."""
        earlier, later = (
            cv2.resize(p, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for p in (before, now)
        )
        (high, wide), (down, across) = self._block, self._reach
        wider = np.pad(earlier, ((down, down), (across, across)))
        size = (high + 2 * down, wide + 2 * across)
        windows = np.lib.stride_tricks.sliding_window_view(wider, size)[::high, ::wide]
        rows, columns = self.BLOCKS
        parts = later[: rows * high, : columns * wide].reshape(rows, high, columns, wide)
        parts = parts.swapaxes(1, 2)
        spectrum = np.fft.rfft2(windows[:rows, :columns]) * np.fft.rfft2(parts, size).conj()
        found = np.fft.irfft2(spectrum, size)[..., : 2 * down + 1, : 2 * across + 1]
        alike = np.append(found.astype(np.float32).ravel(), np.float32(0))
        return np.asarray(self._motions[int(alike[self._place].sum(axis=1).argmax())])


@lru_cache(maxsize=2)
def motion_grid(cells: CellPlaces) -> MotionGrid:
    """The grid for pictures with these cells.

    Cached: making it takes as long as ten frames, and many logs are of one sonar.
    """
    return MotionGrid(cells)
