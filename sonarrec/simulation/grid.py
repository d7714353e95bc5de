"""The grids on which the simulator samples the floor. They do not move with the sonar.

x and y are metres along the floor, to the right and forward of its origin. The sonar stands above
the origin, or a vehicle starts there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import SonarrecError
from sonarrec.simulation.motion import Pose
from sonarrec.simulation.scene import Scene

STEP_DEG = 0.1  # azimuth between scatterers: a beam covers three or more
MARGIN_DEG = 4.0  # beyond the fan's edges, for side lobes
MARGIN_M = 0.25  # of slant range, for heave and sway; more if these are larger
MOST_CELLS = 2**24  # about a gigabyte
SQUARE_BINS = 0.9  # side of a square, in range bins
BOX = 1.4  # half the side of the box in which an object is drawn, in its radii

Cells = np.ndarray | tuple[np.ndarray, slice]
"""Where (bins, n) cells lie in a grid: flat indices, or, if each bin lies in one row, the (bins,)
rows and the columns, so that values are copied in runs."""


def smooth_noise(
    rng: np.random.Generator, shape: tuple[int, int], cells: tuple[float, float]
) -> np.ndarray:
    """float32 Gaussian noise of this shape and unit variance, smooth over about `cells`.

    cells: (rows, columns); at least half a row and half a column are taken.
    """
    coarse = tuple(max(round(n / max(c, 0.5)), 1) + 3 for n, c in zip(shape, cells, strict=True))
    values = rng.standard_normal(coarse, dtype=np.float32)
    full = cv2.resize(values, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(full / max(float(full.std()), 1e-6))


def _clipped(position: FloatArray, count: int) -> np.ndarray:
    """Positions as indices (intp) of so many cells; outside, of the first or the last."""
    return np.asarray(np.clip(position, 0, count - 1).astype(np.intp))


class PolarGrid:
    """Rows are slant ranges and columns are azimuths, from a sonar above the floor's origin.

    shape: (rows, columns). ground_m: (rows, 1) float32 ranges along the floor. x_m, y_m: (rows,
    columns) float32. floorless: (rows,) whether a row is nearer than the floor. Raises
    SonarrecError if it takes more than MOST_CELLS cells.
    """

    def __init__(self, scene: Scene) -> None:
        sonar, motion = scene.sonar, scene.motion
        self._height_m = sonar.height_m
        self._bin_m = bin_m = (sonar.range_max_m - sonar.range_min_m) / sonar.range_bins
        sway = math.hypot(motion.sway_x_m, motion.sway_y_m)
        aside = sonar.height_m * math.sin(math.radians(motion.roll_deg))
        slope = 1.5 * sonar.height_m * math.sin(math.radians(scene.floor.slope_deg))
        # The most by which what is seen at a slant range may lie in the row of another.
        margin = max(MARGIN_M, sway + motion.heave_m + slope + aside)
        self._first_m = first = max(sonar.range_min_m - margin, bin_m)
        rows = math.ceil((sonar.range_max_m + margin - first) / bin_m)
        self._reach_deg = reach = sonar.field_of_view_deg / 2 + MARGIN_DEG
        nearest = math.sqrt(max(first**2 - sonar.height_m**2, 0.25))
        reach += 4 * motion.yaw_jitter_deg + math.degrees(sway / nearest) + 1
        reach += math.degrees(aside / nearest)
        self._first_deg = motion.pan_min_deg - reach
        columns = math.ceil((motion.pan_max_deg + reach - self._first_deg) / STEP_DEG) + 1
        if rows * columns > MOST_CELLS:
            raise SonarrecError(
                f"{scene.name}: the sonar sees {rows} x {columns} cells of floor, slant range by "
                "azimuth, more than are made; fewer range_bins, or less sway or yaw_jitter_deg"
            )
        self.shape = rows, columns
        slant = first + (np.arange(rows) + 0.5) * bin_m
        self.floorless = slant <= sonar.height_m
        self._ground = np.sqrt(np.maximum(slant**2 - sonar.height_m**2, 1e-9))
        self.ground_m = self._ground[:, None].astype(np.float32)
        azimuth = np.radians(self._first_deg + np.arange(columns) * STEP_DEG)
        self.x_m = (self._ground[:, None] * np.sin(azimuth)).astype(np.float32)
        self.y_m = (self._ground[:, None] * np.cos(azimuth)).astype(np.float32)
        self._deg_per_m = math.degrees(2 / (sonar.range_min_m + sonar.range_max_m))

    def _within(self, azimuth_deg: FloatArray | float) -> FloatArray:
        """Azimuths shifted by whole turns, to within half a turn of the middle column."""
        middle = self._first_deg + (self.shape[1] - 1) * STEP_DEG / 2
        return np.asarray(azimuth_deg - 360 * np.rint((np.asarray(azimuth_deg) - middle) / 360))

    def cells(self, metres: float) -> tuple[float, float]:
        """(rows, columns) that this many metres take in the middle of the range window."""
        return metres / self._bin_m, metres * self._deg_per_m / STEP_DEG

    def box(self, ground_m: float, azimuth_deg: float, radius_m: float) -> tuple[slice, slice]:
        """The rows and columns that a circle of this radius may touch."""
        reach_m = radius_m * BOX
        near, far = np.searchsorted(self._ground, [ground_m - reach_m, ground_m + reach_m])
        if reach_m >= ground_m:
            return slice(near, far + 1), slice(0, self.shape[1])
        half = math.degrees(math.asin(reach_m / ground_m))
        azimuth_deg = float(self._within(azimuth_deg))
        left = (azimuth_deg - half - self._first_deg) / STEP_DEG
        right = (azimuth_deg + half - self._first_deg) / STEP_DEG
        return slice(near, far + 1), slice(max(math.floor(left), 0), max(math.ceil(right), 0) + 1)

    def azimuths(self, pan_deg: float) -> FloatArray:
        """(n,) azimuths of the columns in front of the sonar, deg."""
        start = math.floor((pan_deg - self._reach_deg - self._first_deg) / STEP_DEG)
        stop = math.ceil((pan_deg + self._reach_deg - self._first_deg) / STEP_DEG) + 1
        return self._first_deg + np.arange(start, stop) * STEP_DEG

    def index(self, x: FloatArray, y: FloatArray) -> np.ndarray:
        """Flat indices (intp) of the cells at these positions; outside, of the nearest cells."""
        slant = np.sqrt(x**2 + y**2 + self._height_m**2)
        azimuth = self._within(np.degrees(np.arctan2(x, y)))
        column = _clipped(np.rint((azimuth - self._first_deg) / STEP_DEG), self.shape[1])
        return np.asarray(self._row(slant) * self.shape[1] + column)

    def index_from_origin(self, ground: FloatArray, azimuth_deg: FloatArray) -> Cells:
        """The cells at ground ranges (bins, 1) from the origin and azimuths from `azimuths`."""
        row = self._row(np.hypot(ground, self._height_m))
        column = np.rint((azimuth_deg - self._first_deg) / STEP_DEG).astype(np.intp)
        if column[0] >= 0 and column[-1] < self.shape[1]:
            return row[:, 0], slice(column[0], column[-1] + 1)
        return np.asarray(row * self.shape[1] + np.clip(column, 0, self.shape[1] - 1))

    def _row(self, slant: FloatArray) -> np.ndarray:
        return _clipped(np.floor((slant - self._first_m) / self._bin_m), self.shape[0])


class SquareGrid:
    """Squares a little smaller than a range bin, over all the floor that a vehicle sees.

    shape: (rows, columns); rows are along y. x_m, y_m: (rows, columns) float32. cell_m: side of a
    square. floorless: all False. Raises SonarrecError if it takes more than MOST_CELLS cells.
    """

    def __init__(self, scene: Scene, path: Sequence[Pose]) -> None:
        sonar = scene.sonar
        self.cell_m = SQUARE_BINS * (sonar.range_max_m - sonar.range_min_m) / sonar.range_bins
        self._reach_deg = sonar.field_of_view_deg / 2 + MARGIN_DEG
        poses = np.array([(p.pan_deg, p.x_m, p.y_m) for p in path])
        edge = np.radians(poses[:, :1] + np.linspace(-self._reach_deg, self._reach_deg, 9))
        ends = [  # of what is seen along x and y
            np.hstack([middle, middle + sonar.range_max_m * component(edge)])
            for middle, component in ((poses[:, 1:2], np.sin), (poses[:, 2:], np.cos))
        ]
        self._first = x0, y0 = [end.min() - MARGIN_M for end in ends]
        columns, rows = (
            math.ceil((end.max() + MARGIN_M - first) / self.cell_m)
            for end, first in zip(ends, self._first, strict=True)
        )
        if rows * columns > MOST_CELLS:
            raise SonarrecError(
                f"{scene.name}: the vehicle sees {columns * self.cell_m:.0f} x "
                f"{rows * self.cell_m:.0f} m of floor, too much for {sonar.range_bins} range bins; "
                "fewer frames or slower"
            )
        self.shape = rows, columns
        self.floorless = np.zeros(rows, bool)
        right = (x0 + (np.arange(columns) + 0.5) * self.cell_m).astype(np.float32)
        ahead = (y0 + (np.arange(rows) + 0.5) * self.cell_m).astype(np.float32)
        self.x_m = np.broadcast_to(right, self.shape)
        self.y_m = np.broadcast_to(ahead[:, None], self.shape)

    def cells(self, metres: float) -> tuple[float, float]:
        """(rows, columns) that this many metres take."""
        return metres / self.cell_m, metres / self.cell_m

    def box(self, ground_m: float, azimuth_deg: float, radius_m: float) -> tuple[slice, slice]:
        """The rows and columns that a circle of this radius may touch."""
        azimuth, reach_m = math.radians(azimuth_deg), radius_m * BOX
        columns, rows = (
            slice(
                max(math.floor((ground_m * component(azimuth) - reach_m - first) / self.cell_m), 0),
                max(math.ceil((ground_m * component(azimuth) + reach_m - first) / self.cell_m), 0)
                + 1,
            )
            for component, first in zip((math.sin, math.cos), self._first, strict=True)
        )
        return rows, columns

    def azimuths(self, pan_deg: float) -> FloatArray:
        """(n,) azimuths in front of the sonar, deg."""
        return pan_deg + np.arange(-self._reach_deg, self._reach_deg + STEP_DEG, STEP_DEG)

    def index(self, x: FloatArray, y: FloatArray) -> np.ndarray:
        """Flat indices (intp) of the cells at these positions; outside, of the nearest cells."""
        column, row = (
            _clipped(np.floor((value - first) / self.cell_m), count)
            for value, first, count in zip((x, y), self._first, self.shape[::-1], strict=True)
        )
        return np.asarray(row * self.shape[1] + column)

    def evened(self, ground: FloatArray) -> FloatArray:
        """(bins, 1) amplitude that corrects for columns of azimuth that share a cell.

        ground: (bins, 1) m. Columns that share a scatterer add up in phase. If runs of n and n + 1
        columns share one, L in the mean, the power is too high by the mean of their squares / L.
        """
        run = self.cell_m / (np.maximum(ground, 0.05) * math.radians(STEP_DEG))
        run = np.maximum(run, 1.0)
        full = np.floor(run)
        share = run - full
        return np.asarray(np.sqrt(run / (full**2 * (1 - share) + (full + 1) ** 2 * share)))
