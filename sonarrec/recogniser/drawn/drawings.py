"""What a set's drawings look like to a sonar, and how well a plate's picture matches each of them.

A picture is a square of `size` x `size` grey levels, sampled in the plate's own axes. A drawing may
show in it in up to eight ways (`ways`): rotated by 0, 90, 180 or 270 degrees, mirrored or not.
"""

from __future__ import annotations

import functools
from math import erf
from statistics import NormalDist

import cv2
import numpy as np

from sonarrec.arrays import FloatArray, FloatImage, IndexArray
from sonarrec.landmarks import DrawnSet

LEAST_CORRELATION = 0.3  # of neighbouring cells; below it they are drawn each by itself
RIVALS = 64  # random drawings of the set's kind of cells
FINE, COARSE = 28, 10  # samples along a picture's side
# Standard deviations of softened pictures, and how far a picture is shifted, in samples.
SOFTENED, LAGS = (1, 2), (1, 2)
LEAST_BLUR = 0.04  # halves of a plate's side: about a sample of a fine picture
BLUR_STEP = 0.03  # halves; smears that differ by less count as one
KEPT, KEPT_SINGLE = 8, 256  # smears whose drawings are kept, and single drawings
MOST_SOUGHT = 32  # drawings with which a plate is first looked for
_cumulative = np.frompyfunc(lambda z: 0.5 * (1 + erf(z / 2**0.5)), 1, 1)


@functools.cache
def points(size: int) -> tuple[FloatImage, FloatImage]:
    """(size, size) u, to the right, and v, down, of a picture's samples in halves of a side."""
    middles = ((2 * np.arange(size) + 1) / size - 1).astype(np.float32)
    u, v = np.meshgrid(middles, middles)
    return u, v


def uneven_light(size: int, range_ward: FloatArray) -> FloatImage:
    """(n, 4, size ** 2) orthonormal: level, two slopes, and the bow along the range.

    range_ward: (n, 2) direction of the range in (u, v).
    """
    slopes = _slopes(size)
    bow = (range_ward.astype(np.float32) @ slopes[1:]) ** 2
    bow -= (bow @ slopes.T) @ slopes
    bow /= np.linalg.norm(bow, axis=1, keepdims=True)
    fixed = np.broadcast_to(slopes, (len(bow), *slopes.shape))
    return np.concatenate([fixed, bow[:, None]], axis=1)


@functools.cache
def _slopes(size: int) -> FloatImage:
    """(3, size ** 2) orthonormal: level, and slopes along u and v."""
    u, v = points(size)
    rows = np.stack([np.ones_like(u), u, v]).reshape(3, -1)
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)


def levelled(pictures: FloatImage, light: FloatImage) -> FloatImage:
    """(..., n, size ** 2) pictures without uneven light, of norm 1. light: (n, 4, size ** 2)."""
    share = light @ pictures[..., None]
    residual = pictures - (share.swapaxes(-1, -2) @ light)[..., 0, :]
    norm = np.sqrt(np.einsum("...i,...i->...", residual, residual))
    return np.asarray(residual / np.maximum(norm, 1e-6)[..., None], np.float32)


def comparisons(
    pictures: FloatImage, drawings: FloatImage, light: FloatImage, range_ward: FloatArray
) -> FloatImage:
    """(n, 7) of n fine pictures, each with its drawing: their correlation as they are and
    softened, then what the rest is like, its correlations with itself one and two samples further,
    across the range and along it. A wrong drawing leaves patches, the right one fine noise.

    pictures, drawings: (n, FINE ** 2), from `levelled`. light: as there. range_ward: (n, 2), as of
    `uneven_light`.
    """
    match = (pictures * drawings).sum(axis=1)
    matches, both = [match], np.stack([pictures, drawings])
    for sigma in SOFTENED:
        blur = _blur(sigma)
        soft = np.asarray(blur @ both.reshape(2, -1, FINE, FINE) @ blur.T, np.float32)
        picture, drawing = levelled(soft.reshape(both.shape), light)
        matches.append((picture * drawing).sum(axis=1))
    rest = (pictures - match[:, None] * drawings).reshape(-1, FINE, FINE)
    power = np.maximum(_products(rest, rest), 1e-6)
    right = [_products(rest[:, :, n:], rest[:, :, :-n]) / power for n in LAGS]
    down = [_products(rest[:, n:], rest[:, :-n]) / power for n in LAGS]
    along_down = np.abs(range_ward[:, 1]) > np.abs(range_ward[:, 0])
    across, along = np.where(along_down, [right, down], [down, right])
    return np.stack([*matches, *across, *along], axis=1)


def _products(pictures: FloatImage, others: FloatImage) -> FloatImage:
    """(n,) sums of the products of n pictures' samples."""
    return np.asarray(np.einsum("nij,nij->n", pictures, others))


@functools.cache
def _blur(sigma: int) -> FloatImage:
    """(FINE, FINE) what softens the columns of a fine picture."""
    return np.asarray(cv2.GaussianBlur(np.eye(FINE), (1, 8 * sigma + 1), sigma), np.float32)


def shown(drawing: FloatImage, way: int) -> FloatImage:
    """(..., n, n) drawings as they show: rotated by way % 4 quarters, mirrored from way 4 on."""
    return np.rot90(drawing[..., ::-1] if way >= 4 else drawing, way % 4, axes=(-2, -1))


def as_drawn(picture: FloatImage, way: int) -> FloatImage:
    """The inverse of `shown`."""
    rotated = np.rot90(picture, -(way % 4), axes=(-2, -1))
    return rotated[..., ::-1] if way >= 4 else rotated


class Drawings:
    """The drawings of a set and their rivals; rows: K IDs, then RIVALS."""

    def __init__(self, landmarks: DrawnSet) -> None:
        drawings = [d.astype(np.float32) for d in landmarks.drawings()]
        self.count = len(drawings)
        self.ways = {"no": range(4), "yes": range(4, 8), "either": range(8)}[landmarks.mirrored]
        self._cells = drawings + _rivals(drawings)
        # Families have hundreds: these stand for all of them until the pose is known.
        step = max(1, -(-self.count // MOST_SOUGHT))
        self.sought = np.arange(0, self.count, step)
        self._smeared_kept = functools.lru_cache(KEPT)(self._smeared)
        self._one_kept = functools.lru_cache(KEPT_SINGLE)(self._smeared_one)

    def seen(self, size: int, smear: tuple[float, float]) -> FloatImage:
        """(rows, size, size) brightness of all drawings through beam and pulse.

        smear: standard deviations of a point along u and v, in halves of a side.
        """
        return self._smeared_kept(size, *_stepped(smear))

    def seen_one(self, row: int, way: int, size: int, smear: tuple[float, float]) -> FloatImage:
        """(size, size) of one drawing as it shows in a picture; the rest as of `seen`."""
        return self._one_kept(row, way, size, *_stepped(smear))

    def _smeared(self, size: int, across: float, down: float) -> FloatImage:
        made = np.empty((len(self._cells), size, size), np.float32)
        sides = np.array([len(cells) for cells in self._cells])
        for n in set(sides.tolist()):
            cells = np.stack([c for c in self._cells if len(c) == n])
            made[sides == n] = _spread(size, n, down) @ cells @ _spread(size, n, across).T
        return made

    def _smeared_one(self, row: int, way: int, size: int, across: float, down: float) -> FloatImage:
        cells = shown(self._cells[row], way)
        n = len(cells)
        return np.asarray(_spread(size, n, down) @ cells @ _spread(size, n, across).T)

    def matches(
        self, picture: FloatImage, range_ward: FloatArray, smear: tuple[float, float]
    ) -> FloatImage:
        """(rows, ways) correlations of a fine picture with all drawings, without uneven light.

        range_ward: (2,), as of `uneven_light`. smear: as of `seen`.
        """
        size = len(picture)
        light = uneven_light(size, range_ward[None])
        flat = levelled(picture.reshape(1, -1), light)[0].reshape(size, size)
        planes = light[0].reshape(-1, size, size)
        matches = np.empty((len(self._cells), len(self.ways)), np.float32)
        for odd in (0, 1):
            rows = self.seen(size, smear[::-1] if odd else smear).reshape(len(self._cells), -1)
            columns = [i for i, way in enumerate(self.ways) if way % 2 == odd]
            both = [as_drawn(np.concatenate([flat[None], planes]), self.ways[i]) for i in columns]
            product = rows @ np.concatenate(both).reshape(-1, size**2).T
            product = product.reshape(len(rows), len(columns), -1)
            left = (rows**2).sum(axis=1)[:, None] - (product[..., 1:] ** 2).sum(axis=2)
            matches[:, columns] = product[..., 0] / np.sqrt(np.maximum(left, 1e-6))
        return matches


def _stepped(smear: tuple[float, float]) -> tuple[float, float]:
    """The smear that stands for this and for all that differ by less than BLUR_STEP."""
    across, down = (
        max(round(max(s, LEAST_BLUR) / BLUR_STEP) * BLUR_STEP, LEAST_BLUR) for s in smear
    )
    return across, down


@functools.lru_cache(64)
def _spread(size: int, cells: int, sigma: float) -> FloatImage:
    """(size, cells) how much of each cell's brightness a sample gets, along one axis."""
    middles = (2 * np.arange(size) + 1) / size - 1
    edges = 2 * np.arange(cells + 1) / cells - 1
    below = _cumulative((edges - middles[:, None]) / sigma).astype(np.float32)
    return np.asarray(np.diff(below, axis=1))


def _rivals(drawings: list[FloatImage]) -> list[FloatImage]:
    """Random drawings of the set's kind: a cell is as often bright as in the set, nearly, where it
    has many IDs, and as often like its neighbour."""
    rng = np.random.default_rng(0)
    rivals: list[FloatImage] = []
    sides = [len(d) for d in drawings]
    for n in sorted(set(sides)):
        same = np.stack([d for d in drawings if len(d) == n])
        often = (same.sum(axis=0) + 2 * same.mean()) / (len(same) + 2)
        count = -(-RIVALS * len(same) // len(drawings))
        limit = np.vectorize(NormalDist().inv_cdf)(np.clip(often, 0.01, 0.99))
        made = _grainy(rng, count, n, _grain(same)) < limit
        rivals += [*made.astype(np.float32)]
    return rivals[:RIVALS]


def _grain(drawings: FloatImage) -> float:
    """The sigma, in cells, of smoothed noise whose sign changes as often from cell to cell."""
    across, down = drawings[:, :, 1:] == drawings[:, :, :-1], drawings[:, 1:] == drawings[:, :-1]
    correlation = np.sin(np.pi * (np.concatenate([across.ravel(), down.ravel()]).mean() - 0.5))
    return (
        0.5 / float(np.sqrt(-np.log(correlation))) if LEAST_CORRELATION < correlation < 1 else 0.0
    )


def _grainy(rng: np.random.Generator, count: int, n: int, sigma: float) -> FloatArray:
    """(count, n, n) noise of deviation 1, smoothed."""
    noise = rng.standard_normal((count, n, n))
    if sigma:
        noise = np.stack([cv2.GaussianBlur(picture, (0, 0), sigma) for picture in noise])
    return np.asarray(noise / noise.std())


def best(matches: FloatImage) -> tuple[IndexArray, FloatImage]:
    """(rows,) column of the way in which each drawing matches best, and (rows,) how well."""
    column = matches.argmax(axis=1)
    return column, matches[np.arange(len(column)), column]
