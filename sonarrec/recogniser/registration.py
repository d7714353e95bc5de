"""Surge, sway and yaw of the sonar, registered between two polar pictures of a flat floor.

A point of the floor that now lies in a cell of range and bearing lay elsewhere before; where
follows from the motion and the height. The earlier picture is resampled to where its points should
lie now and compared with the later one; Gauss-Newton steps lead to the motion by which the two are
most alike. Where nothing is known of the motion they start at the best of a coarse grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sonarrec.geometry import floor_depth
from sonarrec.records import ByteImage, Fan, FloatArray, FloatImage

STEPS = 8  # of Gauss and Newton, at most
CONVERGED = (3e-4, 3e-4, 2e-4)  # m, m, rad
FARTHEST = (0.1, 0.1, 0.12)  # m, m, rad from the start; steps that lead beyond it are lost
# Standard errors (m, m, rad) beyond which a registration is not believed.
LOOSEST = (0.015, 0.015, math.radians(0.6))
LEAST_SHARE = 0.02  # least slope of the later picture on the earlier one
# Standard deviation of the height's change from frame to frame, m. It moves echoes along the range
# as surge does, more so the nearer they are.
HEAVE_M = 0.01
GRAIN = 4.0  # cells in a grain of speckle: they count as one observation
# (down, across) blocks of a picture, so large that their residuals are independent: larger than a
# grain of speckle, and than what leaks from beam to beam.
BLOCKS = (8, 12)
# The quick registration looks at every so many rows, in fewer blocks.
EVERY = 8
QUICK_BLOCKS = (4, 8)


@dataclass(frozen=True, slots=True)
class Registered:
    """How two pictures fit together.

    motion: (3,) how far the sonar was carried to the right and ahead (m, in the axes of the earlier
    picture), and turned to the right (rad). covariance: (3, 3). match: the pictures' correlation.
    """

    motion: FloatArray
    covariance: FloatArray
    match: float

    @property
    def sigma(self) -> FloatArray:
        """(3,) standard errors of the motion."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def loose(self) -> bool:
        """Whether its standard errors are too large for it to be believed."""
        return bool((self.sigma > LOOSEST).any())

    def translation(self, motion: FloatArray) -> float:
        """The chi-square, of 2 degrees of freedom, of a motion (3,) not being a turn alone.

        Its way (right, ahead) is taken to be as exact as this registration's.
        """
        way = motion[:2]
        return float(way @ np.linalg.solve(self.covariance[:2, :2], way))


class FloorRegistration:
    """Registers polar pictures of one shape, (rows, columns) float32, 0 where no floor is seen.

    Rows are slant ranges, columns bearings. The mean of each row and column is 0.
    """

    def __init__(
        self, fan: Fan, range_m: FloatArray, bearing_deg: FloatArray, seen: FloatImage
    ) -> None:
        """range_m: (rows,), bearing_deg: (columns,) of the cells' middles, evenly spaced.

        seen: (rows, columns) 1 where a cell shows floor, else 0.
        """
        self._seen = seen
        self._depth = depth = np.float32(floor_depth(fan))
        slant = range_m.astype(np.float32)[:, None]
        bearing = np.radians(bearing_deg).astype(np.float32)[None]
        self._slant, self._bearing = slant, bearing
        self._slant_step = float(slant[1, 0] - slant[0, 0])
        self._bearing_step = float(bearing[0, 1] - bearing[0, 0])
        # Nearer than the floor nothing is seen: any distance serves.
        self._ground = ground = np.sqrt(np.maximum(slant**2 - depth**2, 0.01 * slant**2))
        # By how many cells (down, across) a picture moves with a metre to the right, a metre
        # ahead, a radian of turn and a metre of height.
        down = np.float32(1 / self._slant_step)
        across = np.float32(1 / self._bearing_step)
        even = np.ones_like(seen)
        self._down = np.stack(
            [
                down * ground / slant * np.sin(bearing),
                down * ground / slant * np.cos(bearing),
                0 * even,
                -down * depth / slant * even,
            ]
        )
        self._across = np.stack(
            [
                across * np.cos(bearing) / ground,
                -across * np.sin(bearing) / ground,
                across * even,
                0 * even,
            ]
        )
        self._quick = slice(1, len(slant) - 1, EVERY)
        self._quick_down = self._down[:3, self._quick, 1:-1].copy()
        self._quick_across = self._across[:3, self._quick, 1:-1].copy()
        self._grid: MotionGrid | None = None

    def before(
        self, ground: FloatArray, bearing: FloatArray, motion: FloatArray
    ) -> tuple[FloatImage, FloatImage]:
        """(row, column), in cells, of where points of the floor lay before a motion.

        ground (m), bearing (rad): where they lie now; shapes broadcast with the motion's parts,
        motion[0], motion[1] and motion[2].
        """
        toward = bearing + motion[2]
        x = ground * np.sin(toward) + motion[0]
        y = ground * np.cos(toward) + motion[1]
        slant = np.sqrt(x * x + y * y + self._depth**2)
        row = (slant - self._slant[0, 0]) / np.float32(self._slant_step)
        column = (np.arctan2(x, y) - self._bearing[0, 0]) / np.float32(self._bearing_step)
        return row.astype(np.float32), column.astype(np.float32)

    def cells(self, motion: FloatArray) -> float:
        """By how many cells a picture moves, about, with a motion (3,) as Registered.motion."""
        right, ahead, turn = np.abs(motion)
        return float(max(max(right, ahead) / self._slant_step, turn / self._bearing_step))

    def refined(self, before: FloatImage, now: FloatImage, start: FloatArray) -> Registered | None:
        """The motion near `start`; None where the steps do not come to rest.

        start: (3,) as Registered.motion.
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
                return None if covariance is None else Registered(motion, covariance, fit.match)
        return None

    def searched(self, before: FloatImage, now: FloatImage) -> FloatArray:
        """(3,) the likeliest motion of a coarse grid, a start for `refined`."""
        if self._grid is None:
            self._grid = MotionGrid(self)
        return self._grid.best(before, now)

    def quick(self, before: FloatImage, now: FloatImage, turn: float) -> Registered | None:
        """The motion near a turn alone (rad): one step, for motions of a small part of a cell.

        It looks at some of the rows, and takes the height as constant. None where the pictures have
        nothing in common.
        """
        shift = np.float32(turn / self._bearing_step)
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
        return Registered(rest, inverse @ (blocks @ blocks.T) @ inverse, match)

    def _sampled_rows(self, picture: FloatImage) -> FloatImage:
        """(3, rows, columns) the rows above those of the quick registration, they, those below."""
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
    """Two pictures compared under one motion.

    slopes: (4, rows, columns) derivatives of the earlier by the motion and the height.
    """

    registration: FloorRegistration
    later: FloatImage
    residual: FloatImage
    inner: ByteImage
    slopes: FloatImage
    match: float
    heave_weight: float  # what a change of height costs, per m^2: the prior of HEAVE_M

    @classmethod
    def of(
        cls, r: FloorRegistration, before: FloatImage, now: FloatImage, motion: FloatArray
    ) -> _Fit | None:
        """None where the pictures have nothing in common."""
        row, column = r.before(r._ground, r._bearing, motion.astype(np.float32))
        earlier = np.asarray(cv2.remap(before, column, row, cv2.INTER_LINEAR), np.float32)
        seen = np.asarray(cv2.remap(r._seen, column, row, cv2.INTER_LINEAR))
        both = (seen > 0.99).view(np.uint8)
        both *= r._seen.astype(np.uint8)
        earlier *= both
        later = now * both
        power, other = (float(np.vdot(p, p)) for p in (earlier, later))
        product = float(np.vdot(earlier, later))
        if product <= LEAST_SHARE * power or power <= 0:
            return None
        share = product / power
        residual = later - np.float32(share) * earlier
        inner = np.asarray(cv2.erode(both, np.ones((3, 3), np.uint8), borderValue=0), np.uint8)
        slopes = np.float32(share) * _slopes(r, earlier, inner)
        cells = max(int(np.count_nonzero(both)), 1)
        heave_weight = float(np.vdot(residual, residual)) / cells * GRAIN / HEAVE_M**2
        match = product / math.sqrt(power * other)
        return cls(r, later, residual, inner, slopes, match, heave_weight)

    def step(self) -> FloatArray:
        """(3,) the Gauss-Newton step to a motion by which they are more alike."""
        flat = self.slopes.reshape(4, -1)
        normal = (flat @ flat.T).astype(float)
        normal[3, 3] += self.heave_weight
        normal[range(3), range(3)] += 1e-9
        return np.asarray(np.linalg.solve(normal, flat @ self.residual.ravel())[:3])

    def covariance(self) -> FloatArray | None:
        """(3, 3) of the motion, by the sandwich estimator; None where it is not determined.

        curvature^-1 scatter curvature^-1. The curvature is the product of the slopes of both
        pictures: that of one with itself would count its noise. The scatter is that of the blocks'
        scores (slope times residual).
        """
        first, second = self.slopes, _slopes(self.registration, self.later, self.inner)
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


def _slopes(r: FloorRegistration, picture: FloatImage, inner: ByteImage) -> FloatImage:
    """(4, rows, columns) derivatives of a picture by the motion and the height."""
    down = cv2.Sobel(picture, cv2.CV_32F, 0, 1, ksize=1, scale=0.5) * inner
    across = cv2.Sobel(picture, cv2.CV_32F, 1, 0, ksize=1, scale=0.5) * inner
    return np.asarray(r._down * down + r._across * across)


def _in_blocks(values: FloatImage, blocks: tuple[int, int]) -> FloatArray:
    """(n, blocks) sums over blocks of (n, rows, columns)."""
    size = values[0].size / (blocks[0] * blocks[1])
    means = [cv2.resize(v, blocks[::-1], interpolation=cv2.INTER_AREA).ravel() for v in values]
    return np.asarray(np.stack(means).astype(float) * size)


class MotionGrid:
    """Finds a motion where nothing is known of it: the best of a grid, at half the resolution.

    The later picture is cut into blocks. Each is correlated with the earlier picture around its own
    place; the grid's motions say where each block should be found.
    """

    BLOCKS = (8, 6)  # down, across
    MOST = (0.09, 0.16, math.radians(6.0))  # m to the right, m ahead, rad: to either side
    FINENESS = (0.01, 0.02)  # m, of the grid; its turns are two cells apart

    def __init__(self, registration: FloorRegistration) -> None:
        r = registration
        rows, columns = (side // 2 for side in r._seen.shape)
        self._block = (rows // self.BLOCKS[0], columns // self.BLOCKS[1])
        right, ahead, turn = (
            np.arange(-math.ceil(most / fine), math.ceil(most / fine) + 1) * fine
            for most, fine in zip(self.MOST, (*self.FINENESS, 2 * r._bearing_step), strict=True)
        )
        motions = np.stack(np.meshgrid(right, ahead, turn, indexing="ij")).reshape(3, -1, 1)
        self._motions = motions[..., 0].T
        middle = [
            (np.arange(count) + 0.5) * 2 * size - 0.5
            for count, size in zip(self.BLOCKS, self._block, strict=True)
        ]
        slant = r._slant[0, 0] + middle[0] * r._slant_step
        ground = np.sqrt(np.maximum(slant**2 - r._depth**2, 0.01 * slant**2))
        bearing = r._bearing[0, 0] + middle[1] * r._bearing_step
        ground, bearing = (a.ravel() for a in np.meshgrid(ground, bearing, indexing="ij"))
        row, column = r.before(ground, bearing, motions)
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
