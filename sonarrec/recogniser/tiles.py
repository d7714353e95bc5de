"""Sums of pictures on one grid on the floor, in square tiles that may be moved to the disk."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from sonarrec.arrays import FloatArray, FloatImage

SIDE = 256  # pixels of a tile
Tile = tuple[int, int]
"""(column, row) of a tile, counted from the grid's origin; either may be negative."""


class Tiles:
    """Weighted sums of pictures. The last used tiles are kept in memory, the others on the disk.

    Use it in a `with` block, at whose end the files are removed.
    """

    def __init__(self, layers: int, most: int) -> None:
        """layers: values of a pixel. most: tiles in memory."""
        self._layers, self._most = layers, most
        self._in_memory: dict[Tile, FloatImage] = {}  # the last used one last
        self._on_disk: dict[Tile, Path] = {}
        self._folder: TemporaryDirectory[str] | None = None

    def __enter__(self) -> Tiles:
        return self

    def __exit__(self, *_: object) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all tiles, and remove their files."""
        self._in_memory, self._on_disk = {}, {}
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def __iter__(self) -> Iterator[Tile]:
        """All tiles that were written to."""
        return iter([*self._in_memory, *self._on_disk])

    def tile(self, tile: Tile) -> FloatImage:
        """(layers, SIDE, SIDE) of a tile, to be read and written; valid until the next call."""
        found = self._in_memory.pop(tile, None)
        if found is None and (path := self._on_disk.pop(tile, None)) is not None:
            found = np.asarray(np.load(path), np.float32)
        elif found is None:
            found = np.zeros((self._layers, SIDE, SIDE), np.float32)
        self._in_memory[tile] = found
        if len(self._in_memory) > self._most:
            oldest = next(iter(self._in_memory))
            self._folder = self._folder or TemporaryDirectory(prefix="sonarrec-")
            path = Path(self._folder.name, "{}_{}.npy".format(*oldest))
            np.save(path, self._in_memory.pop(oldest))
            self._on_disk[oldest] = path
        return found

    def rows(self, row: int, first: int, columns: int) -> FloatImage:
        """(layers, SIDE, columns) of the tiles of one row, from a tile's column on."""
        whole = np.zeros((self._layers, SIDE, columns), np.float32)
        for n in range(-(-columns // SIDE)):
            tile = (first + n, row)
            if tile in self._in_memory or tile in self._on_disk:
                part = whole[..., n * SIDE : (n + 1) * SIDE]
                part[:] = self.tile(tile)[..., : part.shape[2]]
        return whole


def placement(
    yaw: float, position: FloatArray, apex: tuple[float, float], scale: float = 1.0
) -> FloatArray:
    """(2, 3) from the pixels of a floor plane's working image to those of a grid, for `warped`.

    yaw (rad), position (2,): of the sonar; x and y in grid pixels, y against the rows. apex: of the
    image. scale: grid pixels per pixel of the image.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    rotation = scale * np.array([[cos, -sin], [sin, cos]])
    return np.column_stack([rotation, position * (1, -1) - rotation @ apex])


def warped(
    layers: Sequence[FloatImage], matrix: FloatArray
) -> tuple[list[FloatImage], tuple[int, int]]:
    """A picture's layers, each (rows, columns), on the grid; the (column, row) of the first pixel.

    matrix: (2, 3) from the picture's (column, row, 1) to the grid's (column, row).
    """
    right, bottom = layers[0].shape[1] - 1, layers[0].shape[0] - 1
    reached = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1]]) @ matrix.T
    low, high = np.floor(reached.min(axis=0)).astype(int), np.ceil(reached.max(axis=0)).astype(int)
    moved = matrix.copy()
    moved[:, 2] -= low
    (column, row), (width, height) = low.tolist(), (high - low + 1).tolist()
    on_grid = [np.asarray(cv2.warpAffine(x, moved, (width, height)), np.float32) for x in layers]
    return on_grid, (column, row)


def parts(
    shape: tuple[int, int], first: tuple[int, int]
) -> Iterator[tuple[Tile, tuple[slice, slice], tuple[slice, slice]]]:
    """The tiles under a picture on the grid: (tile, its pixels in the tile, those in the picture).

    shape: (rows, columns). first: (column, row) of the picture's first pixel.
    """
    spans = []
    for begin, length in zip(first[::-1], shape, strict=True):
        along = []
        for n in range(begin // SIDE, (begin + length - 1) // SIDE + 1):
            a, b = max(begin, n * SIDE), min(begin + length, (n + 1) * SIDE)
            along.append((n, slice(a - n * SIDE, b - n * SIDE), slice(a - begin, b - begin)))
        spans.append(along)
    for row, in_tile_rows, rows in spans[0]:
        for column, in_tile_columns, columns in spans[1]:
            yield (column, row), (in_tile_rows, in_tile_columns), (rows, columns)
