"""Surge, sway and yaw of the sonar, registered between two polar pictures of a flat floor.

The motion and the sonar's height say where each cell of the later picture lay in the earlier one.
The earlier picture is resampled accordingly and compared with the later one, and Newton's steps
minimise the squared difference. Where nothing is known of the motion, the steps start at the best
motion of a coarse grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from sonarrec.arrays import FloatArray, FloatImage
from sonarrec.recogniser.motion.motion_grid import CellGrid
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import floor_depth

STEPS = 8  # at most
# The motion is found by a step of less than SMALL standard errors, or than CONVERGED (m, m, rad).
SMALL, CONVERGED = 0.4, (3e-4, 3e-4, 2e-4)
DAMPING = 0.85  # of steps, which are a sixth too long (median of a simulated vehicle's first ones)
# Cells: by the curvature no longer step is taken, since it holds within a grain of speckle or two.
LONGEST = 3.0
FARTHEST = (0.1, 0.1, 0.12)  # m, m, rad from the start; beyond it the registration has failed
# Standard errors (m, m, rad) beyond which a registration is not accepted.
LOOSEST = (0.015, 0.015, math.radians(0.6))
LEAST_SHARE = 0.02  # least regression slope of one picture on the other
# Standard deviation of the height's change from frame to frame, m. It moves echoes along the range
# as surge does, more so the nearer they are.
HEAVE_M = 0.01
# deg between the cells of a row that are compared, where a beam covers several. In each row they
# are one column further than in the row before, so that all columns count the same.
SPACING_DEG = 0.45
GRAIN = 4.0  # cells in a grain of speckle, which count as one observation
# (down, across) blocks of a picture. Their residuals count as independent: a block is larger than a
# grain of speckle, and wider than the leakage between beams.
BLOCKS = (8, 8)
# The quick registration uses every EVERY-th row, and fewer blocks.
EVERY = 8
QUICK_BLOCKS = (4, 8)


@dataclass(frozen=True, slots=True)
class Registration:
    """The motion between two pictures.

    motion: (3,) shift to the right and ahead (m, in the axes of the earlier picture), and yaw to
    the right (rad). covariance: (3, 3). match: the pictures' correlation after the motion.
    """

    motion: FloatArray
    covariance: FloatArray
    match: float

    @property
    def sigma(self) -> FloatArray:
        """(3,) standard errors of the motion, m, m and rad."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def loose(self) -> bool:
        """Whether its standard errors are too large for it to be accepted."""
        return bool((self.sigma > LOOSEST).any())

    def translation(self, motion: FloatArray) -> float:
        """The chi-square, of 2 degrees of freedom, of the translation of a motion (3,).

        The covariance is this registration's.
        """
        way = motion[:2]
        try:
            return float(way @ np.linalg.solve(self.covariance[:2, :2], way))
        except np.linalg.LinAlgError:  # identical pictures have no residual, so no covariance
            return math.inf if way.any() else 0.0


class Picture:
    """A polar picture, prepared for registration. grey: (rows, columns) float32.

    The mean of each row and each column must be 0, and so must cells that show no floor.
    """

    def __init__(self, grey: FloatImage, inner: FloatImage) -> None:
        """inner: (rows, columns) float32, 1 where the derivatives are of floor that is seen."""
        self.grey, self._inner = grey, inner

    @cached_property
    def layers(self) -> FloatImage:
        """(rows, columns, 4): grey, its derivatives down and across, and `inner`."""
        down = cv2.Sobel(self.grey, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
        across = cv2.Sobel(self.grey, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
        return np.asarray(cv2.merge([self.grey, down, across, self._inner]), np.float32)


class FloorRegistration:
    """Registers polar pictures of (rows, columns) cells. grid: where the cells lie."""

    def __init__(
        self, fan: Fan, range_m: FloatArray, bearing_deg: FloatArray, seen: FloatImage
    ) -> None:
        """range_m: (rows,), bearing_deg: (columns,) of the cells' middles, evenly spaced. seen:
        (rows, columns) float32, 1 where a cell shows floor, else 0."""
        rows, columns = seen.shape
        depth = np.float32(floor_depth(fan))
        slant = range_m.astype(np.float32)[:, None]
        bearing = np.radians(bearing_deg).astype(np.float32)[None]
        self.grid = grid = CellGrid(
            (rows, columns),
            slant[0, 0],
            float(slant[1, 0] - slant[0, 0]),
            bearing[0, 0],
            float(bearing[0, 1] - bearing[0, 0]),
            depth,
        )
        self._cell = np.array([grid.slant_step, grid.slant_step, grid.bearing_step])
        self._inner = np.asarray(cv2.erode(seen, np.ones((3, 3)), borderValue=0), np.float32)
        # No echo of the floor is nearer than the height, so any distance will do there.
        ground = np.sqrt(np.maximum(slant**2 - depth**2, 0.01 * slant**2))
        # (4, rows, columns) derivatives of a point's row and column by the motion, in cells a metre
        # to the right, a metre ahead, a radian of yaw and a metre of height.
        down, across = np.float32(1 / grid.slant_step), np.float32(1 / grid.bearing_step)
        even, sin, cos = np.ones_like(seen), np.sin(bearing), np.cos(bearing)
        along = down * ground / slant
        of_row = [along * sin, along * cos, 0 * even, -down * depth / slant * even]
        of_column = [across * cos / ground, -across * sin / ground, across * even, 0 * even]
        row_by, column_by = np.stack(of_row), np.stack(of_column)
        self._quick = slice(1, rows - 1, EVERY)
        self._quick_down = row_by[:3, self._quick, 1:-1].copy()
        self._quick_across = column_by[:3, self._quick, 1:-1].copy()
        # The cells compared, (rows, n): flat indices, positions on the floor (m), derivatives.
        every = max(1, round(math.radians(SPACING_DEG) / grid.bearing_step))
        row, column = np.indices((rows, columns // every))
        self._cells = row * columns + column * every + row % every
        self._grain = GRAIN / every  # of them
        self._x, self._y = ((ground * way).take(self._cells) for way in (sin, cos))
        self._down, self._across = (
            by.reshape(4, -1).take(self._cells, axis=1) for by in (row_by, column_by)
        )

    def picture(self, grey: FloatImage) -> Picture:
        """Of grey levels (rows, columns), float32."""
        return Picture(grey, self._inner)

    def cells(self, motion: FloatArray) -> float:
        """About how many cells a motion shifts a picture. motion: (3,) as Registration.motion."""
        return float((np.abs(motion) / self._cell).max())

    def refined(self, before: Picture, now: Picture, start: FloatArray) -> Registration | None:
        """The motion near `start`; None where the steps do not converge.

        start: (3,) as Registration.motion.
        """
        motion: FloatArray = np.array(start, dtype=float)
        last: FloatArray = np.zeros(3)
        later = self._compared(now.layers.reshape(-1, 4).take(self._cells, axis=0))
        for _ in range(STEPS):
            row, column = self.grid.before(self._x, self._y, motion.astype(np.float32))
            moved = np.asarray(cv2.remap(before.layers, column, row, cv2.INTER_LINEAR), np.float32)
            fit = _Fit.of(self._compared(moved, later.shown), later, self._grain)
            if fit is None:
                return None
            step = fit.newton()
            is_near = step is not None and self.cells(step) <= LONGEST
            if step is None or not is_near:
                step = fit.gauss_newton()
            # Differences of whole cells make the slopes too small, and the steps too long. Where a
            # step went too far, the one back must not.
            step *= DAMPING
            if np.dot(last / self._cell, step / self._cell) < 0:
                step /= 2
            motion += step
            last = step
            if (np.abs(motion - start) > FARTHEST).any():
                return None
            if is_near and fit.is_small(step):
                return Registration(motion, fit.covariance(), fit.match)
        return None

    def _compared(self, layers: FloatImage, within: FloatImage | None = None) -> _Cells:
        """layers: (rows, n, 4), as Picture.layers, at the cells compared. within: (rows, n)."""
        grey, down, across, inner = cv2.split(layers)
        shown = np.asarray(cv2.threshold(inner, 0.99, 1, cv2.THRESH_BINARY)[1], np.float32)
        if within is not None:
            shown *= within
        down *= shown
        across *= shown
        compared = np.empty((5, *shown.shape), np.float32)
        # A yaw moves no row, and a height no column.
        np.multiply(self._down[:2], down, out=compared[:2])
        compared[:2] += self._across[:2] * across
        np.multiply(self._across[2], across, out=compared[2])
        np.multiply(self._down[3], down, out=compared[3])
        np.multiply(grey, shown, out=compared[4])
        return _Cells(compared, shown)

    def quick(self, before: Picture, now: Picture, yaw: float) -> Registration | None:
        """A single Gauss-Newton step from a yaw (rad), for motions of a part of a cell.

        It uses every EVERY-th row, and takes the height as constant. None where the pictures do not
        correlate.
        """
        shift = np.float32(yaw / self.grid.bearing_step)
        earlier, later = (self._sampled_rows(p.grey) for p in (before, now))
        flat = earlier.reshape(-1, earlier.shape[-1])
        rotated = np.asarray(
            cv2.warpAffine(
                flat,
                np.array([[1, 0, shift], [0, 1, 0]], np.float32),
                flat.shape[::-1],
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            ),
            np.float32,
        ).reshape(earlier.shape)
        early, late = rotated[1, :, 1:-1], later[1, :, 1:-1]
        power = float(np.vdot(early, early))
        product = float(np.vdot(early, late))
        if product <= LEAST_SHARE * power or power <= 0:
            return None
        slopes = [self._slope(p) for p in (rotated, later)]
        share = np.float32(product / power)
        first, second = (s.reshape(3, -1) for s in slopes)
        curvature = (first @ second.T).astype(float) * float(share)
        curvature = (curvature + curvature.T) / 2
        residual = late - share * early
        score = slopes[0] * residual
        blocks = _in_blocks(score, QUICK_BLOCKS)
        if np.linalg.det(curvature) <= 0:
            return None
        inverse = np.linalg.inv(curvature)
        if inverse.diagonal().min() <= 0:
            return None
        rest = inverse @ blocks.sum(axis=1)
        rest[2] += yaw
        match = product / math.sqrt(power * float(np.vdot(late, late)))
        return Registration(rest, inverse @ (blocks @ blocks.T) @ inverse, match)

    def _sampled_rows(self, picture: FloatImage) -> FloatImage:
        """(3, rows, columns): the quick registration's rows, with those above and those below."""
        stop = self._quick.stop
        return np.stack([picture[k : stop - 1 + k : EVERY] for k in range(3)])

    def _slope(self, rows: FloatImage) -> FloatImage:
        """(3, rows, columns - 2) derivative of the quick registration's rows by the motion.

        rows: from `_sampled_rows`.
        """
        down = rows[2, :, 1:-1] - rows[0, :, 1:-1]
        across = rows[1, :, 2:] - rows[1, :, :-2]
        return np.asarray(0.5 * (self._quick_down * down + self._quick_across * across))


class _Cells(NamedTuple):
    """The cells of a picture that are compared, 0 where they are not shown."""

    layers: FloatImage
    """(5, rows, n) derivatives by the motion and the height; grey."""
    shown: FloatImage
    """(rows, n) 1 or 0."""


@dataclass(frozen=True, slots=True)
class _Fit:
    """Two pictures, each scaled to a power of 1, compared under one motion.

    pictures: the earlier and the later one. scales: of each. score: (4,) mean of both products of
    slopes and residual. curvature: (4, 4) the slopes of one picture times those of the other, since
    a picture's product with itself would include its noise. noise: variance of the score, as a
    share of the curvature.
    """

    pictures: tuple[_Cells, _Cells]
    scales: tuple[np.float32, np.float32]
    score: FloatArray
    curvature: FloatArray
    noise: float
    match: float

    @classmethod
    def of(cls, earlier: _Cells, later: _Cells, grain: float) -> _Fit | None:
        """None where the pictures do not correlate.

        earlier: shown only where the later one is. grain: compared cells in a grain of speckle.
        """
        early, late = earlier.layers[4:], later.layers[4:] * earlier.shown
        both = _products(earlier.layers, later.layers)  # (5, 5), of cells that both show
        own = _products(earlier.layers, early)[:, 0], _products(later.layers, late)[:, 0]
        powers, product = (float(own[0][4]), float(own[1][4])), float(both[4, 4])
        if product <= LEAST_SHARE * max(powers) or product <= 0:
            return None
        scales = np.float32(1 / math.sqrt(powers[0])), np.float32(1 / math.sqrt(powers[1]))
        first, second = map(float, scales)
        match = min(product * first * second, 1.0)
        # Slopes times residuals: of the later picture on the earlier one, and the other way round.
        score = first * (second * both[:4, 4] - match * first * own[0][:4])
        score += second * (match * second * own[1][:4] - first * both[4, :4])
        curvature = first * second * (both[:4, :4] + both[:4, :4].T) / 2
        noise = grain * (1 / match - match) / int(np.count_nonzero(earlier.shown))
        curvature[3, 3] += noise / HEAVE_M**2
        return cls((earlier, later), scales, score / 2, curvature, noise, match)

    def newton(self) -> FloatArray | None:
        """(3,) the step of the motion by the curvature; None where that is not of a minimum."""
        if np.linalg.eigvalsh(self.curvature)[0] <= 0:
            return None
        return np.asarray(np.linalg.solve(self.curvature, self.score)[:3])

    def gauss_newton(self) -> FloatArray:
        """(3,) the step by the earlier picture's slopes alone, whose noise makes it too short."""
        slopes = self.scales[0] * self.pictures[0].layers[:4]
        normal = self.match * _products(slopes, slopes)
        normal[3, 3] += self.noise / HEAVE_M**2
        normal[range(3), range(3)] += 1e-9
        return np.asarray(np.linalg.solve(normal, self.score)[:3])

    def is_small(self, step: FloatArray) -> bool:
        """Whether a step (3,) by the curvature is so small that the motion is found."""
        sigma = np.sqrt(self.noise * np.linalg.inv(self.curvature).diagonal()[:3])
        return bool((np.abs(step) < np.maximum(SMALL * sigma, CONVERGED)).all())

    def covariance(self) -> FloatArray:
        """(3, 3) of the motion, by the sandwich estimator: curvature^-1 scatter curvature^-1.

        The scatter is the covariance of the blocks' scores.
        """
        (earlier, later), (first, second) = self.pictures, self.scales
        early, late = first * earlier.layers[4], second * later.layers[4] * earlier.shown
        match = np.float32(self.match)
        scores = earlier.layers[:4] * (first * (late - match * early))
        scores += later.layers[:4] * (second * (match * late - early))
        blocks = _in_blocks(scores, BLOCKS) / 2
        scatter = blocks @ blocks.T
        scatter[3, 3] += (self.noise / HEAVE_M) ** 2
        inverse = np.linalg.inv(self.curvature)
        return np.asarray((inverse @ scatter @ inverse)[:3, :3])


def _products(some: FloatImage, others: FloatImage) -> FloatArray:
    """(n, m) sums over all cells of products of (n, rows, columns) and (m, rows, columns)."""
    return (some.reshape(len(some), -1) @ others.reshape(len(others), -1).T).astype(float)


def _in_blocks(values: FloatImage, blocks: tuple[int, int]) -> FloatArray:
    """(n, blocks) sums over blocks of (n, rows, columns)."""
    size = values[0].size / (blocks[0] * blocks[1])
    means = [cv2.resize(v, blocks[::-1], interpolation=cv2.INTER_AREA).ravel() for v in values]
    return np.asarray(np.stack(means).astype(float) * size)
