"""Geometry of a flat floor in polar pictures: where it lies, and how it moves with the sonar."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import FloatArray, FloatImage
from sonarrec.geometry import floor_depth
from sonarrec.nouns import Fan


@dataclass(frozen=True, slots=True)
class CellPlaces:
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
        self, ground: FloatArray, bearing: FloatArray, motion: FloatArray
    ) -> tuple[FloatImage, FloatImage]:
        """(row, column) in cells, float32, at which points of the floor lay before a motion.

        ground, bearing: ground range (m) and bearing (rad) of the points after the motion. motion:
        shift to the right (m), shift ahead (m) and yaw (rad); the shapes of ground, bearing and
        motion[i] broadcast.
        """
        toward = bearing + motion[2]
        x = ground * np.sin(toward) + motion[0]
        y = ground * np.cos(toward) + motion[1]
        slant = np.sqrt(x * x + y * y + self.depth**2)
        row = (slant - self.slant) / np.float32(self.slant_step)
        column = (np.arctan2(x, y) - self.bearing) / np.float32(self.bearing_step)
        return row.astype(np.float32), column.astype(np.float32)


class FloorCells:
    """The cells of polar pictures of one shape: rows of slant range, columns of bearing.

    seen: (rows, columns) float32, 1 where a cell shows floor, else 0. slant, ground: (rows, 1)
    slant and ground range in m. bearing: (1, columns) rad. places: the grid of the cells. down,
    across: (4, rows, columns) derivatives of a point's row and column by the motion, in cells a
    metre to the right, a metre ahead, a radian of yaw and a metre of height.
    """

    def __init__(
        self, fan: Fan, range_m: FloatArray, bearing_deg: FloatArray, seen: FloatImage
    ) -> None:
        """range_m: (rows,), bearing_deg: (columns,) of the cells' middles, evenly spaced."""
        self.seen = seen
        depth = np.float32(floor_depth(fan))
        slant = range_m.astype(np.float32)[:, None]
        bearing = np.radians(bearing_deg).astype(np.float32)[None]
        self.slant, self.bearing = slant, bearing
        self.places = places = CellPlaces(
            (seen.shape[0], seen.shape[1]),
            slant[0, 0],
            float(slant[1, 0] - slant[0, 0]),
            bearing[0, 0],
            float(bearing[0, 1] - bearing[0, 0]),
            depth,
        )
        # No echo of the floor is nearer than the height, so any distance will do there.
        self.ground = ground = np.sqrt(np.maximum(slant**2 - depth**2, 0.01 * slant**2))
        down = np.float32(1 / places.slant_step)
        across = np.float32(1 / places.bearing_step)
        even = np.ones_like(seen)
        self.down = np.stack(
            [
                down * ground / slant * np.sin(bearing),
                down * ground / slant * np.cos(bearing),
                0 * even,
                -down * depth / slant * even,
            ]
        )
        self.across = np.stack(
            [
                across * np.cos(bearing) / ground,
                -across * np.sin(bearing) / ground,
                across * even,
                0 * even,
            ]
        )

    def shift(self, motion: FloatArray) -> float:
        """About how many cells a motion shifts a picture. motion: (3,) as Registration.motion."""
        right, ahead, turn = np.abs(motion)
        return float(
            max(max(right, ahead) / self.places.slant_step, turn / self.places.bearing_step)
        )
