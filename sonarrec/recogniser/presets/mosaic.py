"""The mosaic that the second look searches: pictures summed where they lie on the floor."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, FloatImage
from sonarrec.records import Motion

# It lies in square tiles of SIDE pixels; BLOCK_TILES along a side are searched together, and a tile
# is forgotten once all its pixels have faded to less than LEAST_KEPT frames.
SIDE, BLOCK_TILES, LEAST_KEPT = 256, 2, 1e-3
LEAST_WEIGHT = 2.0  # frames in a pixel that is searched


@dataclass(frozen=True, slots=True)
class Pose:
    """The sonar's pose over the mosaic: yaw (rad), x and y (pixels, right and ahead of yaw 0)."""

    yaw: float = 0.0
    x: float = 0.0
    y: float = 0.0

    def after(self, motion: Motion, pixel_m: float) -> Pose:
        """The pose after a motion. pixel_m: size of a pixel."""
        right, ahead = motion.right_m / pixel_m, motion.ahead_m / pixel_m
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return Pose(
            yaw=self.yaw + math.radians(motion.pan_deg),
            x=self.x + (right * cos + ahead * sin),
            y=self.y + (ahead * cos - right * sin),
        )

    def to_mosaic(self, apex: tuple[float, float]) -> FloatArray:
        """(2, 3) matrix from (column, row, 1) of a working image with this apex to the mosaic."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        rotation = np.array([[cos, -sin], [sin, cos]])
        return np.column_stack([rotation, np.array([self.x, -self.y]) - rotation @ apex])

    def to_frame(self, positions: FloatArray, apex: tuple[float, float]) -> FloatArray:
        """(n, 2) pixels of a working image with this apex, of (n, 2) pixels of the mosaic."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        rotation = np.array([[cos, sin], [-sin, cos]])
        return np.asarray((positions - (self.x, -self.y)) @ rotation.T + apex)


@dataclass(frozen=True, slots=True)
class Block:
    """A part of the mosaic, with a margin around the pixels that are its own.

    total, count: of each pixel the sum of the pictures, and the number of frames that show it.
    corner: the first pixel's position in the mosaic. own: that of the first of its own.
    """

    total: FloatImage
    count: FloatImage
    corner: tuple[int, int]
    own: tuple[int, int]

    def owns(self, positions: FloatArray) -> BoolArray:
        """(n,) whether positions in the mosaic, (n, 2), are among its own pixels."""
        end = np.array(self.own) + BLOCK_TILES * SIDE
        return np.asarray(((positions >= self.own) & (positions < end)).all(axis=1))


class Mosaic:
    """The sum of pictures on the floor, in square tiles that are made where a picture lies."""

    def __init__(self) -> None:
        # By (column, row), which may be negative: (2, SIDE, SIDE) totals and counts, as in Block.
        self._tiles = defaultdict[tuple[int, int], FloatImage](
            lambda: np.zeros((2, SIDE, SIDE), np.float32)
        )

    def add(self, picture: FloatImage, inside: FloatImage, matrix: FloatArray) -> None:
        """Add a picture where it is `inside`. matrix: (2, 3) from its pixels to the mosaic's."""
        right, bottom = inside.shape[1] - 1, inside.shape[0] - 1
        corners = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1]])
        reached = corners @ matrix.T
        low = np.floor(reached.min(axis=0)).astype(int)
        width, height = (np.ceil(reached.max(axis=0)).astype(int) - low).tolist()
        shift = matrix - [[0, 0, low[0]], [0, 0, low[1]]]
        # Pixels at the edge are interpolated with what was not seen.
        seen = np.asarray(cv2.warpAffine(inside, shift, (width, height)))
        seen = (seen > 0.99).astype(np.float32)
        # The picture in whole tiles.
        (column, row), (left, top) = (of_low.tolist() for of_low in np.divmod(low, SIDE))
        columns, rows = math.ceil((left + width) / SIDE), math.ceil((top + height) / SIDE)
        padded = np.zeros((2, rows * SIDE, columns * SIDE), np.float32)
        part = padded[:, top : top + height, left : left + width]
        part[0] = cv2.warpAffine(picture, shift, (width, height))
        part[0] *= seen
        part[1] = seen
        tiles = padded.reshape(2, rows, SIDE, columns, SIDE)
        for i in range(rows):
            for j in range(columns):
                self._tiles[column + j, row + i] += tiles[:, i, :, j]

    def blocks(self, margin: int) -> Iterator[Block]:
        """The parts of the mosaic in which enough frames show something; margin: in pixels."""
        size, empty = BLOCK_TILES * SIDE, np.zeros((2, SIDE, SIDE), np.float32)
        cut, near = slice(SIDE - margin, SIDE + size + margin), range(-1, BLOCK_TILES + 1)
        for column, row in sorted({(c // BLOCK_TILES, r // BLOCK_TILES) for c, r in self._tiles}):
            first = column * BLOCK_TILES, row * BLOCK_TILES
            around = [
                [self._tiles.get((first[0] + j, first[1] + i), empty) for j in near] for i in near
            ]
            sums = np.block(around)[:, cut, cut]
            seen = sums[1] >= LEAST_WEIGHT
            if not seen.any():
                continue
            (top, bottom), (left, right) = (
                np.flatnonzero(seen.any(axis=a))[[0, -1]] for a in (1, 0)
            )
            total, count = sums[:, top : bottom + 1, left : right + 1]
            own = column * size, row * size
            corner = own[0] - margin + int(left), own[1] - margin + int(top)
            yield Block(total, count, corner, own)

    def fade(self, share: float) -> None:
        """Weigh all pictures so far by a share; tiles in which little is left are forgotten."""
        for index, tile in list(self._tiles.items()):
            tile *= share
            if tile[1].max() < LEAST_KEPT:
                del self._tiles[index]

    def clear(self) -> None:
        self._tiles.clear()
