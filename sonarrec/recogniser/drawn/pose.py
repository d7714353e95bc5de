"""Fits a plate's pose: where the corners of its drawing lie in the working image.

An imaging sonar shows a small tilted plate as an affine picture. A pose is six numbers, column and
row of the middle, then the matrix from (u, v), in halves of the plate's side, to pixels, row by
row. Its larger singular value is half a side; the other is shorter where the plate is tilted.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from math import dist

import cv2
import numpy as np

from sonarrec.arrays import FloatArray, FloatImage, IndexArray, IntArray
from sonarrec.landmarks import PlatePose
from sonarrec.recogniser.drawn.drawings import (
    COARSE,
    FINE,
    Drawings,
    comparisons,
    levelled,
    points,
    shown,
    uneven_light,
)
from sonarrec.recogniser.drawn.model import PlateModel
from sonarrec.recogniser.plane import Plane

# Foreshortening, and the plate's rotation in the image, of the poses that are tried first.
SHORTENED = {"free": (1.0, 0.78, 0.6, 0.42), "floor": (1.0,)}
ROTATIONS_DEG, AXIS_DEG = range(-45, 45, 15), (-25, 0, 25)
# Coarse samples, each way, over which the middle is looked for; NEAR: from frame to frame.
REACH, NEAR = 6, 2
# Of the poses tried, those that are refined a little, and wholly; of a drawing, SAME at most, with
# SEPARATION halves of a side or more between their middles.
STARTS, BEST, SAME, SEPARATION = 12, 4, 2, 0.3
# Singular values over half a side: least and most of the larger, least of the smaller.
BOUNDS = {"free": (0.88, 1.14, 0.28), "floor": (0.92, 1.08, 0.92)}
EXPLAINED = 1.5  # halves of a side: what lies nearer to a plate's middle is no other plate
FIRST_ROUNDS, ROUNDS, NEAR_ROUNDS = 3, 7, 6  # of refinement
MOST_STEP = 0.15  # halves of a side, in one round
RIDGE = 1e-2  # share of the mean curvature: holds what a drawing says nothing of


@dataclass(frozen=True, slots=True)
class Fit:
    """A pose, and the drawing that fits there."""

    pose: FloatArray
    """(6,)"""
    compared: FloatImage
    """(7,) of the picture with the drawing."""
    row: int
    way: int
    """The drawing's, as in Drawings."""
    picture: FloatImage
    """(FINE, FINE) at the pose."""
    odds: float
    """Log odds that the drawing is there, by this picture alone."""

    @property
    def match(self) -> float:
        """Correlation of the picture with the drawing."""
        return float(self.compared[0])


class PoseFitter:
    """Fits the poses of plates in working images of one plane."""

    def __init__(
        self,
        drawings: Drawings,
        plane: Plane,
        pose: PlatePose,
        beam_sigma: float,
        model: PlateModel,
    ) -> None:
        """beam_sigma: standard deviation of the beams, rad."""
        self.drawings, self.plane, self._beam = drawings, plane, beam_sigma
        self.model = model
        self._half, self._bounds = plane.axes[0], BOUNDS[pose]
        self._inside = plane.inside.astype(np.float32)
        self._tried = self._half * np.array(
            [
                _rotation(axis) @ np.diag([1, short]) @ _rotation(rotation - axis)
                for short in SHORTENED[pose]
                for axis in AXIS_DEG[: 3 if short < 1 else 1]
                for rotation in ROTATIONS_DEG
            ]
        )

    def search(
        self, image: FloatImage, positions: FloatArray, others: Sequence[Sequence[FloatArray]]
    ) -> list[Fit]:
        """The likeliest fits of any drawing, in any pose, with their middles near n positions.

        positions: (n, 2). others: of each, poses of plates that are known: it does not lie on
        these.
        """
        candidates = self.candidates(image, positions, others)
        return [max(fits, key=lambda fit: fit.odds) for fits in candidates]

    def candidates(
        self, image: FloatImage, positions: FloatArray, others: Sequence[Sequence[FloatArray]]
    ) -> list[list[Fit]]:
        """Some of the best fits at each position, as of `search`."""
        if not len(positions):
            return []
        # All are refined together: a step costs little more for many poses than for one.
        starts = [
            self._starts(image, position, known)
            for position, known in zip(positions, others, strict=True)
        ]
        poses, rows, ways = (np.concatenate(part) for part in zip(*starts, strict=True))
        fits = self._refined(image, poses, (rows, ways), FIRST_ROUNDS)
        parts = np.split(np.arange(len(fits)), np.cumsum([len(start[0]) for start in starts])[:-1])
        best = [sorted(part, key=lambda n: -fits[n].odds)[:BEST] for part in parts]
        chosen = np.concatenate(best)
        poses = np.array([fits[n].pose for n in chosen])
        refined = iter(self._refined(image, poses, (rows[chosen], ways[chosen]), ROUNDS))
        return [list(islice(refined, len(part))) for part in best]

    def _starts(
        self, image: FloatImage, position: FloatArray, others: Sequence[FloatArray]
    ) -> tuple[FloatArray, IndexArray, IndexArray]:
        """Of the drawings that match best near a position some of the best poses: (n, 6) poses,
        (n,) rows and (n,) ways of the drawings."""
        sight = self.plane.line_of_sight(position[None])[0] - np.pi / 2
        matrices = _rotation(float(np.degrees(sight))) @ self._tried
        poses = np.concatenate(
            [np.tile(position, (len(matrices), 1)), matrices.reshape(-1, 4)], axis=1
        )
        smear = self.smear(poses[0])
        rows = self.drawings.seen(COARSE, (max(smear), max(smear)))[self.drawings.sought]
        ways = np.array(self.drawings.ways)
        templates = np.stack([shown(rows, way) for way in ways], axis=1)
        match, middles, way = self._shifted(image, poses, templates, REACH)
        for other in others:
            match[self.halves_off(other, middles) < EXPLAINED] = -1
        chosen: list[tuple[int, int]] = []
        chosen_middles: list[list[list[float]]] = [
            [] for _ in rows
        ]  # of each drawing, the chosen middles
        middle = middles.tolist()
        for index in np.argsort(-match, axis=None).tolist():
            i, k = divmod(index, len(rows))
            is_new = all(dist(middle[i][k], p) > SEPARATION * self._half for p in chosen_middles[k])
            if len(chosen_middles[k]) < SAME and is_new:
                chosen.append((i, k))
                chosen_middles[k].append(middle[i][k])
            if len(chosen) == min(STARTS, SAME * len(rows)):
                break
        i, k = np.array(chosen).T
        starts = np.concatenate([middles[i, k], poses[i, 2:]], axis=1)
        return starts, self.drawings.sought[k], ways[way[i, k]]

    def near(self, image: FloatImage, last: Sequence[Fit]) -> list[Fit]:
        """Of each plate the fit of the same drawing with a pose near that of the frame before."""
        if not last:
            return []
        before = np.array([fit.pose for fit in last])
        moved = before.copy()
        for n, (fit, smear) in enumerate(zip(last, self.smears(before), strict=True)):
            coarse = self.drawings.seen_one(fit.row, fit.way, COARSE, (max(smear), max(smear)))
            template = coarse[None, None]
            moved[n, :2] = self._shifted(image, before[n, None], template, NEAR)[1][0, 0]
        drawings = np.array([(fit.row, fit.way) for fit in last] * 2).T
        poses = np.concatenate([moved, before])
        fits = self._refined(image, poses, (drawings[0], drawings[1]), NEAR_ROUNDS)
        pairs = zip(fits[: len(last)], fits[len(last) :], strict=True)
        return [max(pair, key=lambda fit: fit.odds) for pair in pairs]

    def matches(self, picture: FloatImage, pose: FloatArray) -> FloatImage:
        """(rows, ways) of a picture with all drawings at a pose; as of Drawings."""
        return self.drawings.matches(picture, self.range_ward(pose[None])[0], self.smear(pose))

    def range_ward(self, poses: FloatArray) -> FloatArray:
        """(n, 2) direction in (u, v) in which the range grows, at n poses."""
        offset = poses[:, :2] - self.plane.apex
        along = np.linalg.solve(poses[:, 2:].reshape(-1, 2, 2), offset[..., None])[..., 0]
        return np.asarray(along / np.hypot(*along.T)[:, None])

    def smear(self, pose: FloatArray) -> tuple[float, float]:
        """Standard deviations along u and v of an echo at a pose, in halves of the plate's side."""
        return self.smears(pose[None])[0]

    def smears(self, poses: FloatArray) -> list[tuple[float, float]]:
        """As `smear`, of n poses."""
        along = poses[:, :2] - self.plane.apex
        distance = np.hypot(*along.T)[:, None]
        along = along / distance
        across = along[:, ::-1] * (-1, 1)
        inverse = np.linalg.inv(poses[:, 2:].reshape(-1, 2, 2))
        # A pixel is about as long as what interpolation smears.
        axes = [across * np.hypot(self._beam * distance, 0.5), 0.5 * along]
        wide = inverse @ np.stack(axes, axis=2)
        return [(u, v) for u, v in np.hypot(*wide.transpose(2, 0, 1)).tolist()]

    def corners(self, pose: FloatArray) -> FloatArray:
        """(4, 2) pixels of the corners: of the picture's top left, then clockwise."""
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return np.asarray(pose[:2] + square @ pose[2:].reshape(2, 2).T)

    def share_inside(self, pose: FloatArray) -> float:
        """Share of a plate at a pose that lies inside the fan."""
        return float(_sampled(self._inside, pose[None], COARSE).mean())

    def halves_off(self, pose: FloatArray, pixels: FloatArray) -> FloatArray:
        """(...) distance of (..., 2) pixels from a plate's middle, in halves of its side there."""
        (a, b), (c, d) = np.linalg.inv(pose[2:].reshape(2, 2))
        x, y = pixels[..., 0] - pose[0], pixels[..., 1] - pose[1]
        return np.asarray(np.maximum(np.abs(a * x + b * y), np.abs(c * x + d * y)))

    def _shifted(
        self, image: FloatImage, poses: FloatArray, templates: FloatImage, reach: int
    ) -> tuple[FloatArray, FloatArray, IndexArray]:
        """For each of n poses and K drawings the best match over shifts of the middle and ways:
        (n, K) how well it matches, (n, K, 2) where the middle is then, and (n, K) which way.

        templates: (K, ways, COARSE, COARSE).
        """
        n, side, (k, ways) = len(poses), 2 * reach + 1, templates.shape[:2]
        wide = _sampled(image, poses, COARSE, reach)
        light = uneven_light(COARSE, np.array([[0.0, 1.0]]))
        flat = levelled(templates.reshape(k * ways, -1), light)
        windows = np.lib.stride_tricks.sliding_window_view(wide, (COARSE, COARSE), axis=(1, 2))
        windows = windows.transpose(0, 3, 4, 1, 2).reshape(n, COARSE**2, side**2)
        of_light = light[0] @ windows
        squares, in_light = (np.einsum("nij,nij->nj", x, x) for x in (windows, of_light))
        left = squares - in_light
        match = flat @ windows
        match /= np.sqrt(np.maximum(left, 1))[:, None]
        match = match.reshape(n, k, ways * side**2)
        best = match.argmax(axis=2)
        way, shift = np.divmod(best, side**2)
        offset = (np.stack(np.divmod(shift, side)[::-1], axis=2) - reach) * (2 / COARSE)
        middles = poses[:, None, :2] + offset @ poses[:, 2:].reshape(n, 2, 2).transpose(0, 2, 1)
        return np.take_along_axis(match, best[..., None], axis=2)[..., 0], middles, way

    def _refined(
        self,
        image: FloatImage,
        poses: FloatArray,
        chosen: tuple[IntArray, IntArray],
        rounds: int,
    ) -> list[Fit]:
        """Fits of n drawings, by their rows and ways, from n poses on.

        By inverse compositional Gauss-Newton steps.
        """
        n, (rows, ways) = len(poses), chosen
        poses = self._within(poses)
        range_ward = self.range_ward(poses)
        light = uneven_light(FINE, range_ward)
        templates = np.stack(
            [
                self.drawings.seen_one(row, way, FINE, smear)
                for smear, row, way in zip(
                    self.smears(poses), rows.tolist(), ways.tolist(), strict=True
                )
            ]
        )
        flat = levelled(templates.reshape(n, -1), light)
        steps = _steps(flat, light)
        for _ in range(rounds):
            pictures = levelled(_sampled(image, poses, FINE).reshape(n, -1), light)
            match = np.maximum((pictures * flat).sum(axis=1), 0.3)
            step = (steps @ (pictures / match[:, None])[..., None])[..., 0]
            step = step.clip(-MOST_STEP, MOST_STEP)
            matrix = poses[:, 2:].reshape(n, 2, 2) @ np.linalg.inv(
                np.eye(2) + step[:, 2:].reshape(n, 2, 2)
            )
            middle = poses[:, :2] - (matrix @ step[:, :2, None])[..., 0]
            poses = self._within(np.concatenate([middle, matrix.reshape(n, 4)], axis=1))
        pictures = _sampled(image, poses, FINE)
        level = levelled(pictures.reshape(n, -1), light)
        compared = comparisons(level, flat, light, range_ward)
        odds = self.model.of_pictures(compared)
        return [
            Fit(poses[i], compared[i], int(rows[i]), int(ways[i]), pictures[i], odds[i])
            for i in range(n)
        ]

    def _within(self, poses: FloatArray) -> FloatArray:
        """(n, 6) poses with singular values that a plate can have."""
        low, high, least = (self._half * bound for bound in self._bounds)
        a, b, c, d = poses[:, 2:].T
        # A matrix is a scaled rotation and a scaled mirroring, here as complex numbers; its
        # singular values are the sum and the difference of their sizes, which is below 0 where
        # the whole is mirrored.
        rotated, mirrored = (a + d + 1j * (c - b)) / 2, (a - d + 1j * (c + b)) / 2
        sizes = np.abs(rotated), np.abs(mirrored)
        larger = (sizes[0] + sizes[1]).clip(low, high)
        smaller = np.minimum(np.abs(sizes[0] - sizes[1]).clip(least), larger)
        smaller = np.copysign(smaller, sizes[0] - sizes[1])
        rotated *= (larger + smaller) / 2 / np.maximum(sizes[0], 1e-9)
        mirrored *= (larger - smaller) / 2 / np.maximum(sizes[1], 1e-9)
        right, down = rotated + mirrored, rotated - mirrored
        return np.stack([*poses[:, :2].T, right.real, -down.imag, right.imag, down.real], axis=1)


def _rotation(deg: float) -> FloatArray:
    """(2, 2) counter-clockwise as one sees the image."""
    cos, sin = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return np.array([[cos, sin], [-sin, cos]])


@functools.cache
def _grid(size: int, reach: int) -> FloatImage:
    """(3, side ** 2) rows of 1, u and v; a picture's samples, and `reach` more all round."""
    middles = (2 * np.arange(-reach, size + reach) + 1) / size - 1
    u, v = np.meshgrid(middles, middles)
    return np.stack([np.ones_like(u), u, v]).reshape(3, -1).astype(np.float32)


def _sampled(image: FloatImage, poses: FloatArray, size: int, reach: int = 0) -> FloatImage:
    """(n, size, size) pictures at n poses; reach: by how many samples they are wider all round."""
    side = size + 2 * reach
    affine = poses[:, [[0, 2, 3], [1, 4, 5]]].astype(np.float32)
    column, row = np.ascontiguousarray((affine @ _grid(size, reach)).transpose(1, 0, 2))
    values = cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(values, np.float32).reshape(len(poses), side, side)


def _steps(flat: FloatImage, light: FloatImage) -> FloatImage:
    """(n, 6, FINE ** 2) what turns a picture over its match into the way to go: by how much it is
    shifted, then by how much it is stretched, against its drawing. flat: (n, FINE ** 2)."""
    n = len(flat)
    pictures, slope = flat.reshape(n, FINE, FINE), _slope()
    right, down = (x.reshape(n, -1) for x in (pictures @ slope.T, slope @ pictures))
    u, v = (x.ravel() for x in points(FINE))
    slopes = np.stack([right, down, right * u, right * v, down * u, down * v], axis=1)
    fixed = np.concatenate([light, flat[:, None]], axis=1)
    slopes = slopes - (slopes @ fixed.transpose(0, 2, 1)) @ fixed
    curvature = slopes @ slopes.transpose(0, 2, 1)
    mean = np.trace(curvature, axis1=1, axis2=2)[:, None, None] / 6
    # Inverses of so few rows cost a tenth of what solving for all the columns does.
    inverse = np.linalg.inv(curvature + RIDGE * mean * np.eye(6))
    return np.asarray(inverse @ slopes, np.float32)


@functools.cache
def _slope() -> FloatImage:
    """(FINE, FINE) what gives the slope of a fine picture's columns, per half of a side."""
    return np.asarray(np.gradient(np.eye(FINE), 2 / FINE, axis=0), np.float32)
