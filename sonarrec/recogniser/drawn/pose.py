"""Fits a plate's pose: where the corners of its drawing lie in the working image.

An imaging sonar shows a small tilted plate as an affine picture. A pose is six numbers, column and
row of the middle, then the matrix from (u, v), in halves of the plate's side, to pixels, row by
row. Its larger singular value is half a side; the other is shorter where the plate is tilted.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, FloatImage, IntArray
from sonarrec.landmarks import PlatePose
from sonarrec.recogniser.drawn.drawings import (
    COARSE,
    FINE,
    Drawing,
    Drawings,
    levelled,
    points,
    shown,
    uneven_light,
)
from sonarrec.recogniser.plane import Plane

# Foreshortening, and the plate's rotation in the image, of the poses that are tried first.
SHORTENED = {"free": (1.0, 0.78, 0.6, 0.42), "floor": (1.0,)}
TURNED_DEG, AXIS_DEG = range(-40, 50, 10), (-25, 0, 25)
REACH = (
    4  # coarse samples, each way, over which the middle is looked for; NEAR: from frame to frame
)
NEAR = 2
STARTS = 6  # of the poses tried, those that are refined
# Singular values over half a side: least and most of the larger, least of the smaller.
BOUNDS = {"free": (0.88, 1.14, 0.28), "floor": (0.92, 1.08, 0.92)}
SWITCH = 0.015  # by how much another ID must match better from frame to frame, to be taken instead
ROUNDS, NEAR_ROUNDS = 12, 6  # of refinement
MOST_STEP = 0.15  # halves of a side, in one round
RIDGE = 1e-2  # share of the mean curvature: holds what a drawing says nothing of


@dataclass(frozen=True, slots=True)
class Fit:
    """A pose, and the drawing that fits there."""

    pose: FloatArray
    """(6,)"""
    match: float
    """Correlation of the picture with the drawing."""
    row: int
    way: int
    """The drawing's, as in Drawings."""
    picture: FloatImage
    """(FINE, FINE) at the pose."""
    lead: float = 0.0
    """By how much it matches better than the next best drawing, that at its own best pose."""


class PoseFitter:
    """Fits the poses of plates in working images of one plane."""

    def __init__(
        self, drawings: Drawings, plane: Plane, pose: PlatePose, beam_sigma: float
    ) -> None:
        """beam_sigma: standard deviation of the beams, rad."""
        self._drawings, self._plane, self._beam = drawings, plane, beam_sigma
        self._half, self._bounds = plane.axes[0], BOUNDS[pose]
        self._tried = self._half * np.array(
            [
                _rotation(axis) @ np.diag([1, short]) @ _rotation(turn - axis)
                for short in SHORTENED[pose]
                for axis in AXIS_DEG[: 3 if short < 1 else 1]
                for turn in TURNED_DEG
            ]
        )

    def search(self, image: FloatImage, place: FloatArray) -> Fit:
        """The best fit of any drawing with its middle near (2,) a place, whatever its pose."""
        sight = self._plane.line_of_sight(place[None])[0] - np.pi / 2
        matrices = _rotation(float(np.degrees(sight))) @ self._tried
        poses = np.concatenate(
            [np.tile(place, (len(matrices), 1)), matrices.reshape(-1, 4)], axis=1
        )
        smear = self.smear(poses[0])
        rows = self._drawings.seen(COARSE, (max(smear), max(smear)))[self._drawings.sought]
        ways = self._drawings.ways
        templates = np.concatenate([shown(rows, way) for way in ways])
        match, middles, which = self._shifted(image, poses, templates, REACH)
        # The best pose of each of the best drawings: refinement tells what looks alike.
        order = np.argsort(-match)
        first = np.unique(which[order] % len(rows), return_index=True)[1]
        order = order[np.sort(np.concatenate([first, np.arange(2)]))][:STARTS]
        poses = poses[order]
        poses[:, :2] = middles[order]
        of_row, of_way = which[order] % len(rows), which[order] // len(rows)
        chosen = self._drawings.sought[of_row], np.array(ways)[of_way]
        fit = max(self._refined(image, poses, chosen, ROUNDS), key=lambda fit: fit.match)
        # At the pose of one drawing another may match, and better still at its own.
        return self._duel(image, fit.pose[None], *self.best_two(fit), ROUNDS, least=0.0)

    def near(self, image: FloatImage, last: Fit, other: Drawing | None) -> Fit:
        """The fit of the same drawing with a pose near that of the frame before.

        other: (row, way) of the drawing that it is compared with, from a pose of its own.
        """
        smear = self.smear(last.pose)
        row = self._drawings.seen(COARSE, (max(smear), max(smear)))[last.row]
        pose = last.pose[None].copy()
        _, middles, _ = self._shifted(image, pose, shown(row, last.way)[None], NEAR)
        pose[0, :2] = middles[0]
        own = (last.row, last.way)
        poses = np.concatenate([pose, last.pose[None]])
        return self._duel(image, poses, own, other, NEAR_ROUNDS, least=SWITCH)

    def best_two(self, fit: Fit) -> tuple[Drawing, Drawing]:
        """The ID that the picture of a fit matches best, and of the best of all other
        drawings, rivals among them."""
        found = self._drawings.matches(fit.picture, self.range_ward(fit.pose), self.smear(fit.pose))
        return self._drawings.best_two(found)

    def _duel(
        self,
        image: FloatImage,
        poses: FloatArray,
        own: Drawing,
        other: Drawing | None,
        rounds: int,
        least: float,
    ) -> Fit:
        """The best fit of a drawing from some poses on, and its lead over that of another.

        The other's, if that is an ID and leads by `least`.
        """
        n, both = len(poses), [own] if other is None else [own, other]
        rows, ways = np.repeat(np.array(both), n, axis=0).T
        fits = self._refined(image, np.concatenate([poses] * len(both)), (rows, ways), rounds)
        first, *second = (
            max(fits[i : i + n], key=lambda fit: fit.match) for i in range(0, len(fits), n)
        )
        if not second:
            return first
        lead = first.match - second[0].match
        if lead < -least and second[0].row < self._drawings.count:
            return replace(second[0], lead=-lead)
        return replace(first, lead=lead)

    def range_ward(self, pose: FloatArray) -> FloatArray:
        """(2,) direction in (u, v) in which the range grows."""
        away = pose[:2] - self._plane.apex
        along = np.linalg.solve(pose[2:].reshape(2, 2), away)
        return np.asarray(along / np.hypot(*along))

    def smear(self, pose: FloatArray) -> tuple[float, float]:
        """Standard deviations along u and v of an echo at a pose, in halves of the plate's side."""
        away = pose[:2] - self._plane.apex
        distance = np.hypot(*away)
        along, across = away / distance, np.array([-away[1], away[0]]) / distance
        inverse = np.linalg.inv(pose[2:].reshape(2, 2))
        # A pixel is about as long as what interpolation smears.
        wide = inverse @ np.stack([across * np.hypot(self._beam * distance, 0.5), 0.5 * along], 1)
        across_sigma, down_sigma = np.hypot(*wide.T).tolist()
        return across_sigma, down_sigma

    def corners(self, pose: FloatArray) -> FloatArray:
        """(4, 2) pixels of the corners: of the picture's top left, then clockwise."""
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return np.asarray(pose[:2] + square @ pose[2:].reshape(2, 2).T)

    def sampled(self, image: ByteImage, pose: FloatArray) -> FloatImage:
        """(COARSE, COARSE) an image of the plane at a pose."""
        pictures = _sampled(image.astype(np.float32), pose[None], COARSE)
        return np.asarray(pictures[0], np.float32)

    def _shifted(
        self, image: FloatImage, poses: FloatArray, templates: FloatImage, reach: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """For each of n poses the best match over shifts of its middle: (n,) how well it matches,
        (n, 2) where the middle is then, and (n,) the index of the template."""
        n, side = len(poses), 2 * reach + 1
        wide = _sampled(image, poses, COARSE, reach)
        light = uneven_light(COARSE, np.array([[0.0, 1.0]]))[0]
        flat = templates.reshape(len(templates), -1)
        flat = levelled(flat, light[None])
        windows = np.lib.stride_tricks.sliding_window_view(wide, (COARSE, COARSE), axis=(1, 2))
        windows = windows.reshape(n * side**2, COARSE**2)
        product = windows @ np.concatenate([flat, light]).T
        squares = np.einsum("ij,ij->i", windows, windows)
        left = squares - (product[:, len(flat) :] ** 2).sum(axis=1)
        match = product[:, : len(flat)].max(axis=1) / np.sqrt(np.maximum(left, 1))
        shift = match.reshape(n, -1).argmax(axis=1)
        index = np.arange(n) * side**2 + shift
        offset = (np.stack(np.divmod(shift, side)[::-1], axis=1) - reach) * (2 / COARSE)
        middles = poses[:, :2] + (poses[:, 2:].reshape(n, 2, 2) @ offset[..., None])[..., 0]
        return match[index], middles, product[index, : len(flat)].argmax(axis=1)

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
        light = uneven_light(FINE, np.array([self.range_ward(p) for p in poses]))
        templates = np.stack(
            [
                shown(self._drawings.seen(FINE, self._turned(p, way))[row], way)
                for p, row, way in zip(poses, rows, ways, strict=True)
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
        match = (levelled(pictures.reshape(n, -1), light) * flat).sum(axis=1)
        return [
            Fit(poses[i], float(match[i]), int(rows[i]), int(ways[i]), pictures[i])
            for i in range(n)
        ]

    def _turned(self, pose: FloatArray, way: int) -> tuple[float, float]:
        """The smear in the drawing's own axes."""
        across, down = self.smear(pose)
        return (down, across) if way % 2 else (across, down)

    def _within(self, poses: FloatArray) -> FloatArray:
        """(n, 6) poses with singular values that a plate can have."""
        low, high, least = (self._half * bound for bound in self._bounds)
        u, values, v = np.linalg.svd(poses[:, 2:].reshape(-1, 2, 2))
        larger = values[:, 0].clip(low, high)
        smaller = np.minimum(values[:, 1].clip(least), larger)
        matrix = (u * np.stack([larger, smaller], axis=1)[:, None]) @ v
        return np.concatenate([poses[:, :2], matrix.reshape(-1, 4)], axis=1)


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
    found = cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(found, np.float32).reshape(len(poses), side, side)


def _steps(flat: FloatImage, light: FloatImage) -> FloatImage:
    """(n, 6, FINE ** 2) what turns a picture over its match into the way to go: by how much it is
    shifted, then by how much it is stretched, against its drawing. flat: (n, FINE ** 2)."""
    n = len(flat)
    pictures = flat.reshape(n, FINE, FINE)
    down, right = (np.asarray(np.gradient(pictures, 2 / FINE, axis=a), np.float32) for a in (1, 2))
    u, v = points(FINE)
    slopes = np.stack([right, down, right * u, right * v, down * u, down * v], axis=1)
    slopes = slopes.reshape(n, 6, -1)
    fixed = np.concatenate([light, flat[:, None]], axis=1)
    slopes = slopes - (slopes @ fixed.transpose(0, 2, 1)) @ fixed
    curvature = slopes @ slopes.transpose(0, 2, 1)
    mean = np.trace(curvature, axis1=1, axis2=2)[:, None, None] / 6
    return np.asarray(np.linalg.solve(curvature + RIDGE * mean * np.eye(6), slopes), np.float32)
