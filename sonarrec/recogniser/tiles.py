"""Pictures of the floor added up on one grid, in square tiles that may wait on the disk."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from sonarrec.arrays import FloatArray, FloatImage

SIDE = 256  # pixels of a tile
Tile = tuple[int, int]
"""(column, row) of a tile, in tiles from the grid's origin; either may be negative."""


class Tiles:
    """Weighted sums of pictures. The last used tiles are kept in memory, the others on the disk.

    Use it in a `with` block, at whose end the files are removed.
    """

    def __init__(self, layers: int, most: int) -> None:
        """layers: values of a pixel. most: tiles in memory."""
        self._layers, self._most = layers, most
        self._here: dict[Tile, FloatImage] = {}  # the last used one last
        self._away: dict[Tile, Path] = {}
        self._folder: TemporaryDirectory[str] | None = None

    def __enter__(self) -> Tiles:
        return self

    def __exit__(self, *_: object) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all tiles, and remove their files."""
        self._here, self._away = {}, {}
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def __iter__(self) -> Iterator[Tile]:
        """All tiles that were written to."""
        return iter([*self._here, *self._away])

    def tile(self, tile: Tile) -> FloatImage:
        """(SIDE, SIDE, layers) of a tile, to be read and written; valid until the next call."""
        found = self._here.pop(tile, None)
        if found is None:
            path = self._away.pop(tile, None)
            found = np.zeros((SIDE, SIDE, self._layers), np.float32) if path is None else None
            if found is None:
                assert path is not None
                found = np.asarray(np.load(path), np.float32)
        self._here[tile] = found
        if len(self._here) > self._most:
            oldest = next(iter(self._here))
            self._folder = self._folder or TemporaryDirectory(prefix="sonarrec-")
            path = Path(self._folder.name, "{}_{}.npy".format(*oldest))
            np.save(path, self._here.pop(oldest))
            self._away[oldest] = path
        return found

    def has(self, tile: Tile) -> bool:
        """Whether a tile was written to."""
        return tile in self._here or tile in self._away

    def rows(self, row: int, first: int, columns: int) -> FloatImage:
        """(SIDE, columns, layers) of the tiles of one row, from a tile's column on."""
        whole = np.zeros((SIDE, columns, self._layers), np.float32)
        for n in range(-(-columns // SIDE)):
            if self.has((first + n, row)):
                part = whole[:, n * SIDE : (n + 1) * SIDE]
                part[:] = self.tile((first + n, row))[:, : part.shape[1]]
        return whole


def warped(picture: FloatImage, matrix: FloatArray) -> tuple[FloatImage, tuple[int, int]]:
    """A picture (rows, columns, layers) on the grid, and the (column, row) of its first pixel.

    matrix: (2, 3) from the picture's (column, row, 1) to the grid's (column, row).
    """
    rows, columns = picture.shape[:2]
    corners = np.array(
        [[0, 0, 1], [columns - 1, 0, 1], [0, rows - 1, 1], [columns - 1, rows - 1, 1]]
    )
    reached = corners @ matrix.T
    low, high = np.floor(reached.min(axis=0)).astype(int), np.ceil(reached.max(axis=0)).astype(int)
    moved = matrix.copy()
    moved[:, 2] -= low
    width, height = (high - low + 1).tolist()
    return np.asarray(cv2.warpAffine(picture, moved, (width, height)), np.float32), tuple(
        low.tolist()
    )


def parts(
    shape: tuple[int, ...], first: tuple[int, int]
) -> Iterator[tuple[Tile, tuple[slice, slice], tuple[slice, slice]]]:
    """The tiles under a picture on the grid: (tile, its pixels in the tile, those in the picture).

    shape: (rows, columns, ...). first: (column, row) of the picture's first pixel.
    """
    spans = []
    for begin, length in zip(first[::-1], shape[:2], strict=True):
        along = []
        for n in range(begin // SIDE, (begin + length - 1) // SIDE + 1):
            a, b = max(begin, n * SIDE), min(begin + length, (n + 1) * SIDE)
            along.append((n, slice(a - n * SIDE, b - n * SIDE), slice(a - begin, b - begin)))
        spans.append(along)
    for row, in_tile_rows, rows in spans[0]:
        for column, in_tile_columns, columns in spans[1]:
            yield (column, row), (in_tile_rows, in_tile_columns), (rows, columns)
