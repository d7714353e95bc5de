"""Surge, sway and yaw of the sonar, registered between two polar pictures of a flat floor.

The motion and the sonar's height say where each cell of the later picture lay in the earlier one.
The earlier picture is resampled accordingly and compared with the later one, and Gauss-Newton
steps minimise the squared difference. Where nothing is known of the motion, the steps start at the
best motion of a coarse grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, FloatImage
from sonarrec.geometry import floor_depth
from sonarrec.recogniser.motion.motion_grid import CellPlaces
from sonarrec.records import Fan

STEPS = 8  # Gauss-Newton steps, at most
CONVERGED = (3e-4, 3e-4, 2e-4)  # m, m, rad
FARTHEST = (0.1, 0.1, 0.12)  # m, m, rad from the start; beyond it the registration has failed
# Standard errors (m, m, rad) beyond which a registration is not accepted.
LOOSEST = (0.015, 0.015, math.radians(0.6))
LEAST_SHARE = 0.02  # least regression slope of the later picture on the earlier one
# Standard deviation of the height's change from frame to frame, m. It moves echoes along the range
# as surge does, more so the nearer they are.
HEAVE_M = 0.01
GRAIN = 4.0  # cells in a grain of speckle, which count as one observation
# (down, across) blocks of a picture. Their residuals count as independent: a block is larger than a
# grain of speckle, and wider than the leakage between beams.
BLOCKS = (8, 12)
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


class FloorRegistration:
    """Registers polar pictures (rows, columns), float32, 0 where no floor is seen.

    The mean of each row and each column must be 0. seen: (rows, columns) float32, 1 where a cell
    shows floor, else 0. places: the grid of the cells. ground: (rows, 1) ground range in m.
    bearing: (1, columns) rad. down, across: (4, rows, columns) derivatives of a point's row and
    column by the motion, in cells a metre to the right, a metre ahead, a radian of yaw and a metre
    of height.
    """

    def __init__(
        self, fan: Fan, range_m: FloatArray, bearing_deg: FloatArray, seen: FloatImage
    ) -> None:
        """range_m: (rows,), bearing_deg: (columns,) of the cells' middles, evenly spaced."""
        self.seen = seen
        depth = np.float32(floor_depth(fan))
        slant = range_m.astype(np.float32)[:, None]
        self.bearing = bearing = np.radians(bearing_deg).astype(np.float32)[None]
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
        down, across = np.float32(1 / places.slant_step), np.float32(1 / places.bearing_step)
        even, sin, cos = np.ones_like(seen), np.sin(bearing), np.cos(bearing)
        along = down * ground / slant
        of_row = [along * sin, along * cos, 0 * even, -down * depth / slant * even]
        of_column = [across * cos / ground, -across * sin / ground, across * even, 0 * even]
        self.down, self.across = np.stack(of_row), np.stack(of_column)
        self._quick = slice(1, len(slant) - 1, EVERY)
        self._quick_down = self.down[:3, self._quick, 1:-1].copy()
        self._quick_across = self.across[:3, self._quick, 1:-1].copy()

    def cells(self, motion: FloatArray) -> float:
        """About how many cells a motion shifts a picture. motion: (3,) as Registration.motion."""
        right, ahead, turn = np.abs(motion)
        metres = max(right, ahead) / self.places.slant_step
        return float(max(metres, turn / self.places.bearing_step))

    def refined(
        self, before: FloatImage, now: FloatImage, start: FloatArray
    ) -> Registration | None:
        """The motion near `start`; None where the steps do not converge.

        start: (3,) as Registration.motion.
        """
        motion = np.array(start, dtype=float)
        for _ in range(STEPS):
            fit = _Fit.of(self, before, now, motion)
            if fit is None:
                return None
            step = fit.step()
            motion += step
            if (np.abs(motion - start) > FARTHEST).any():
                return None
            if (np.abs(step) < CONVERGED).all():
                covariance = fit.covariance()
                return None if covariance is None else Registration(motion, covariance, fit.match)
        return None

    def quick(self, before: FloatImage, now: FloatImage, turn: float) -> Registration | None:
        """A single Gauss-Newton step from a yaw of `turn` (rad), for motions of a part of a cell.

        It uses every EVERY-th row, and takes the height as constant. None where the pictures do not
        correlate.
        """
        shift = np.float32(turn / self.places.bearing_step)
        earlier, later = (self._sampled_rows(p) for p in (before, now))
        flat = earlier.reshape(-1, earlier.shape[-1])
        turned = np.asarray(
            cv2.warpAffine(
                flat,
                np.array([[1, 0, shift], [0, 1, 0]], np.float32),
                flat.shape[::-1],
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            ),
            np.float32,
        ).reshape(earlier.shape)
        one, other = turned[1, :, 1:-1], later[1, :, 1:-1]
        power = float(np.vdot(one, one))
        product = float(np.vdot(one, other))
        if product <= LEAST_SHARE * power or power <= 0:
            return None
        slopes = [self._slope(p) for p in (turned, later)]
        share = np.float32(product / power)
        first, second = (s.reshape(3, -1) for s in slopes)
        curvature = (first @ second.T).astype(float) * float(share)
        curvature = (curvature + curvature.T) / 2
        residual = other - share * one
        score = slopes[0] * residual
        blocks = _in_blocks(score, QUICK_BLOCKS)
        if np.linalg.det(curvature) <= 0:
            return None
        inverse = np.linalg.inv(curvature)
        if inverse.diagonal().min() <= 0:
            return None
        rest = inverse @ blocks.sum(axis=1)
        rest[2] += turn
        match = product / math.sqrt(power * float(np.vdot(other, other)))
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


@dataclass(frozen=True, slots=True)
class _Fit:
    """Two pictures (rows, columns) compared under one motion.

    later: the later picture where both show floor, else 0. residual: later less the earlier one,
    which is resampled by the motion and scaled to fit. inner: 1 where derivatives can be taken.
    slopes: (4, rows, columns) derivatives of the earlier one by the motion and the height.
    """

    floor: FloorRegistration
    later: FloatImage
    residual: FloatImage
    inner: ByteImage
    slopes: FloatImage
    match: float
    heave_weight: float  # weight of the prior on a change of height (HEAVE_M), per m^2

    @classmethod
    def of(
        cls, floor: FloorRegistration, before: FloatImage, now: FloatImage, motion: FloatArray
    ) -> _Fit | None:
        """Compare two pictures under a motion (3,); None where they do not correlate."""
        row, column = floor.places.before(floor.ground, floor.bearing, motion.astype(np.float32))
        earlier = np.asarray(cv2.remap(before, column, row, cv2.INTER_LINEAR), np.float32)
        seen = np.asarray(cv2.remap(floor.seen, column, row, cv2.INTER_LINEAR))
        both = (seen > 0.99).view(np.uint8)
        both *= floor.seen.astype(np.uint8)
        earlier *= both
        later = now * both
        power, other = (float(np.vdot(p, p)) for p in (earlier, later))
        product = float(np.vdot(earlier, later))
        if product <= LEAST_SHARE * power or power <= 0:
            return None
        share = product / power
        residual = later - np.float32(share) * earlier
        inner = np.asarray(cv2.erode(both, np.ones((3, 3), np.uint8), borderValue=0), np.uint8)
        slopes = np.float32(share) * _slopes(floor, earlier, inner)
        cells = max(int(np.count_nonzero(both)), 1)
        heave_weight = float(np.vdot(residual, residual)) / cells * GRAIN / HEAVE_M**2
        match = product / math.sqrt(power * other)
        return cls(floor, later, residual, inner, slopes, match, heave_weight)

    def step(self) -> FloatArray:
        """(3,) the Gauss-Newton step of the motion."""
        flat = self.slopes.reshape(4, -1)
        normal = (flat @ flat.T).astype(float)
        normal[3, 3] += self.heave_weight
        normal[range(3), range(3)] += 1e-9
        return np.asarray(np.linalg.solve(normal, flat @ self.residual.ravel())[:3])

    def covariance(self) -> FloatArray | None:
        """(3, 3) of the motion, by the sandwich estimator; None where it is not determined.

        It is curvature^-1 scatter curvature^-1. The curvature multiplies the slopes of one picture
        by those of the other, since a picture's product with itself would include its noise. The
        scatter is the covariance of the blocks' scores (slope times residual).
        """
        first, second = self.slopes, _slopes(self.floor, self.later, self.inner)
        curvature = (first.reshape(4, -1) @ second.reshape(4, -1).T).astype(float)
        curvature = (curvature + curvature.T) / 2
        curvature[3, 3] += self.heave_weight
        if np.linalg.eigvalsh(curvature)[0] <= 0:
            return None
        blocks = _in_blocks(first * self.residual, BLOCKS)
        scatter = blocks @ blocks.T
        scatter[3, 3] += (self.heave_weight * HEAVE_M) ** 2
        inverse = np.linalg.inv(curvature)
        return np.asarray((inverse @ scatter @ inverse)[:3, :3])


def _slopes(floor: FloorRegistration, picture: FloatImage, inner: ByteImage) -> FloatImage:
    """(4, rows, columns) derivatives of a picture by the motion and the height."""
    down = cv2.Sobel(picture, cv2.CV_32F, 0, 1, ksize=1, scale=0.5) * inner
    across = cv2.Sobel(picture, cv2.CV_32F, 1, 0, ksize=1, scale=0.5) * inner
    return np.asarray(floor.down * down + floor.across * across)


def _in_blocks(values: FloatImage, blocks: tuple[int, int]) -> FloatArray:
    """(n, blocks) sums over blocks of (n, rows, columns)."""
    size = values[0].size / (blocks[0] * blocks[1])
    means = [cv2.resize(v, blocks[::-1], interpolation=cv2.INTER_AREA).ravel() for v in values]
    return np.asarray(np.stack(means).astype(float) * size)
