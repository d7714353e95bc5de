"""Where the cells of polar pictures lie on a flat floor, and a coarse grid search over motions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from sonarrec.arrays import FloatArray, FloatImage


@dataclass(frozen=True, slots=True)
class CellGrid:
    """The regular grid of slant range (rows) and bearing (columns) of polar pictures.

    shape: (rows, columns). slant, bearing: m and rad, of the first row and column. slant_step,
    bearing_step: m and rad from one cell to the next. depth: height of the sonar over the floor, m.
    """

    shape: tuple[int, int]
    slant: np.float32
    slant_step: float
    bearing: np.float32
    bearing_step: float
    depth: np.float32

    def before(
        self, right: FloatArray, ahead: FloatArray, motion: FloatArray
    ) -> tuple[FloatImage, FloatImage]:
        """(row, column) in cells, float32, at which points of the floor lay before a motion.

        right, ahead: the points after the motion, m. motion: shift to the right (m), shift ahead
        (m) and yaw (rad); the shapes of right, ahead and motion[i] broadcast.
        """
        cos, sin = np.cos(motion[2]), np.sin(motion[2])
        x = right * cos + ahead * sin + motion[0]
        y = ahead * cos - right * sin + motion[1]
        slant = np.sqrt(x * x + y * y + self.depth**2)
        row = (slant - self.slant) / np.float32(self.slant_step)
        column = (np.arctan2(x, y) - self.bearing) / np.float32(self.bearing_step)
        return row.astype(np.float32), column.astype(np.float32)


class MotionGrid:
    """Finds the best motion of a grid, at half the resolution.

    The later picture is cut into blocks. Each is correlated with the earlier picture around its own
    position. The best motion has the largest sum of the blocks' correlations at the shifts that it
    predicts.
    """

    BLOCKS = (8, 6)  # down, across
    MOST = (0.09, 0.16, math.radians(6.0))  # m to the right, m ahead, rad: to either side
    FINENESS = (0.01, 0.02)  # m between the grid's shifts; its yaws differ by two cells
    LEAST_YAW = math.radians(0.1)  # between its yaws; else a field of view in radians takes 1.8 GB

    def __init__(self, cells: CellGrid) -> None:
        rows, columns = (side // 2 for side in cells.shape)
        self._block = (rows // self.BLOCKS[0], columns // self.BLOCKS[1])
        fineness = *self.FINENESS, max(2 * cells.bearing_step, self.LEAST_YAW)
        right, ahead, yaw = (
            np.arange(-math.ceil(most / fine), math.ceil(most / fine) + 1) * fine
            for most, fine in zip(self.MOST, fineness, strict=True)
        )
        motions = np.stack(np.meshgrid(right, ahead, yaw, indexing="ij")).reshape(3, -1, 1)
        self._motions = motions[..., 0].T
        # Rows and columns of the blocks' middles, in cells of the full resolution.
        middle = [
            (np.arange(count) + 0.5) * 2 * size - 0.5
            for count, size in zip(self.BLOCKS, self._block, strict=True)
        ]
        slant = cells.slant + middle[0] * cells.slant_step
        ground = np.sqrt(np.maximum(slant**2 - cells.depth**2, 0.01 * slant**2))
        bearing = cells.bearing + middle[1] * cells.bearing_step
        ground, bearing = (a.ravel() for a in np.meshgrid(ground, bearing, indexing="ij"))
        before = cells.before(ground * np.sin(bearing), ground * np.cos(bearing), motions)
        # (motions, blocks) shifts of each block by each motion, in cells of half the resolution.
        down, across = (
            np.rint((v - m.ravel()) / 2).astype(int)
            for v, m in zip(before, np.meshgrid(*middle, indexing="ij"), strict=True)
        )
        most_down = int(min(np.abs(down).max(), rows - 1))
        most_across = int(min(np.abs(across).max(), columns - 1))
        self._reach = most_down, most_across
        # Flat indices into `best`'s correlations (blocks, high, wide), to which one more element,
        # 0, is appended for shifts beyond the picture.
        high, wide = 2 * most_down + 1, 2 * most_across + 1
        inside = (np.abs(down) <= most_down) & (np.abs(across) <= most_across)
        index = (down + most_down) * wide + across + most_across
        index += np.arange(index.shape[1]) * high * wide
        self._index = np.where(inside, index, index.shape[1] * high * wide).astype(np.int32)

    def best(self, before: FloatImage, now: FloatImage) -> FloatArray:
        """(3,) the motion, as Registration.motion, with the largest summed correlation."""
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
        filled = tuple(map(cv2.getOptimalDFTSize, size))  # padded with 0 to a fast length
        spectrum = np.fft.rfft2(windows[:rows, :columns], filled)
        spectrum *= np.fft.rfft2(parts, filled).conj()
        correlation = np.fft.irfft2(spectrum, filled)[..., : 2 * down + 1, : 2 * across + 1]
        correlation = np.append(correlation.astype(np.float32).ravel(), np.float32(0))
        return np.asarray(self._motions[int(correlation[self._index].sum(axis=1).argmax())])


@lru_cache(maxsize=2)
def motion_grid(cells: CellGrid) -> MotionGrid:
    """The grid for pictures with these cells.

    Cached, since it takes as long to make as ten frames, and many logs come from one sonar.
    """
    return MotionGrid(cells)
