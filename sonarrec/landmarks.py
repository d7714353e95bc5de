"""Landmark sets: what the discs or plates look like, as data. A new set is one TOML file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import SonarrecError, UsageError, as_usage
from sonarrec.tables.toml import (
    Integer,
    Positive,
    Share,
    brief,
    from_table,
    length,
    named_file,
    read_toml,
)

BUILT_IN = Path(__file__).parent / "landmark_sets"
MOST_CELLS, MOST_IDS = 64, 500
"""Along the side of a drawing, whose image is reduced to at most IMAGE_CELLS; of a drawn set."""
SQUARE = "the plate is square, so is its drawing"
IMAGE_CELLS = 28
WIDEST_SIGMA = 0.15  # halves of a plate's side: beams of a larger one do not resolve its drawing
Hand = Literal["no", "yes", "either"]
PlatePose = Literal["floor", "free"]


@dataclass(frozen=True, slots=True)
class LandmarkSet:
    """Circular sector landmarks that share one radius, ring and symbol."""

    name: str
    radius_m: float
    """Of the whole disc."""
    ring: tuple[float, float]
    symbol: tuple[float, float]
    """ring, symbol: (inner, outer) of the bright ring and of the bright sectors, as fractions of
    the radius."""
    ids: tuple[int, ...]
    """K distinct whole numbers."""
    sectors: tuple[tuple[int, ...], ...]
    """K rows of S zeros and ones, counter-clockwise seen from above, beginning at the landmark's
    orientation."""

    def codes(self, angles_rad: FloatArray) -> FloatArray:
        """(K, n) ideal brightness, 0 or 1, of every ID's symbol at n angles (rad).

        Angles run counter-clockwise from the landmark's orientation.
        """
        table = np.asarray(self.sectors, dtype=float)
        sector = np.floor(np.mod(angles_rad, 2 * np.pi) / (2 * np.pi) * table.shape[1]).astype(int)
        return np.asarray(table[:, np.minimum(sector, table.shape[1] - 1)])

    def indices(self, ids: IntArray) -> IntArray:
        """(n,) indices into `ids`, of (n,) IDs that must be in the set."""
        order = np.argsort(self.ids)
        return np.asarray(order[np.searchsorted(self.ids, ids, sorter=order)])

    def pattern(self, k: int, x: FloatArray, y: FloatArray) -> FloatArray:
        """Ideal brightness, 0 or 1, of the k-th landmark at points of its unit disc.

        x, y: right and up seen from above, in radii, orientation 0; any one shape. Points outside
        the disc are 0.
        """
        radius = np.hypot(x, y)
        on = self.codes(np.arctan2(y, x).ravel())[k].reshape(radius.shape)
        ring = (radius >= self.ring[0]) & (radius <= self.ring[1])
        symbol = (radius >= self.symbol[0]) & (radius <= self.symbol[1])
        return np.asarray(np.where(ring, 1.0, np.where(symbol, on, 0.0)))

    def periods_deg(self) -> FloatArray:
        """(K,) the smallest rotation, deg, after which each ID's symbol looks the same; mostly 360.

        NaN for a symbol that is all bright or all dark: it has no orientation.
        """
        count = len(self.sectors[0])
        steps = [
            next(n for n in range(1, count + 1) if code[n:] + code[:n] == code)
            for code in self.sectors
        ]
        uniform = [len(set(code)) == 1 for code in self.sectors]
        return np.where(uniform, np.nan, np.asarray(steps, dtype=float) * (360 / count))

    def as_table(self) -> dict[str, Any]:
        """The set as plain TOML values, as load_landmarks reads them."""
        return {
            "name": self.name,
            "radius_m": self.radius_m,
            "ring": list(self.ring),
            "symbol": list(self.symbol),
            "landmark": [
                {"id": i, "sectors": list(s)} for i, s in zip(self.ids, self.sectors, strict=True)
            ],
        }


@dataclass(frozen=True, slots=True)
class DrawnSet(LandmarkSet):
    """Square plates, a drawing of rough (bright) and smooth (dark) cells on each.

    radius_m: half of a plate's side. ring, symbol, sectors: of discs alone, empty here.
    """

    cells: tuple[tuple[tuple[int, ...], ...], ...] = ()
    """K drawings, each n rows of n zeros and ones, top row first, as one reads them."""
    mirrored: Hand = "either"
    """Whether the sonar shows drawings mirrored."""
    pose: PlatePose = "free"
    """Plates lie on the floor, or are held anyhow."""

    def drawings(self) -> list[BoolArray]:
        """K arrays, (n, n): `cells`."""
        return [np.asarray(cells, bool) for cells in self.cells]

    def pattern(self, k: int, x: FloatArray, y: FloatArray) -> FloatArray:
        drawing = self.drawings()[k]
        n = len(drawing)
        row, column = (np.floor((1 - s * v) * n / 2).astype(int) for s, v in ((1, y), (-1, x)))
        within = (np.abs(x) < 1) & (np.abs(y) < 1)
        cell = drawing[row.clip(0, n - 1), column.clip(0, n - 1)]
        return np.asarray(np.where(within, cell, 0.0))

    def periods_deg(self) -> FloatArray:
        quarters = [
            next(n for n in (1, 2, 4) if np.array_equal(np.rot90(drawing, n), drawing))
            for drawing in self.drawings()
        ]
        return np.asarray(quarters, dtype=float) * 90

    def as_table(self) -> dict[str, Any]:
        rows = [["".join(map(str, row)) for row in cells] for cells in self.cells]
        return {
            "name": self.name,
            "kind": "drawn",
            "size_m": 2 * self.radius_m,
            "mirrored": self.mirrored,
            "pose": self.pose,
            "landmark": [{"id": i, "cells": c} for i, c in zip(self.ids, rows, strict=True)],
        }


@dataclass(frozen=True, slots=True)
class _Row:
    """One [[landmark]] of a file."""

    id: Integer
    sectors: Annotated[tuple[Literal[0, 1], ...], length(1, 360)]


@dataclass(frozen=True, slots=True)
class _LandmarkSetFile:
    """A landmark set as its file states it."""

    name: str
    radius_m: Positive
    ring: tuple[Share, Share]
    symbol: tuple[Share, Share]
    landmark: tuple[_Row, ...]


@dataclass(frozen=True, slots=True)
class _Drawing:
    """One [[landmark]] of a drawn set's file."""

    id: Integer
    cells: tuple[str | tuple[Literal[0, 1], ...], ...] = ()
    image: str = ""


@dataclass(frozen=True, slots=True)
class _DrawnSetFile:
    """A set of drawn plates as its file states it."""

    name: str
    kind: str
    size_m: Positive
    landmark: tuple[_Drawing, ...] = ()
    cells: tuple[str, ...] = ()
    codes: str = ""
    """cells, codes: words in hex, whose bits stand in the cells marked ?, for IDs from 0 on."""
    family: str = ""
    ids: tuple[Integer, ...] | None = None
    """family, ids: those of a built-in set."""
    mirrored: Hand = "either"
    pose: PlatePose = "free"


def load_landmarks(source: str | Path, named_in: str | Path = "") -> LandmarkSet:
    """Read a landmark set.

    Parameters
    ----------
    source : str or Path
        The name of a built-in set, such as "basin", a TOML file, or the run.toml of a run.
    named_in : str or Path, optional
        The file that names `source`: a relative path may begin in its folder.

    Returns
    -------
    LandmarkSet
        Lengths in metres; a DrawnSet for plates.

    Raises
    ------
    UsageError
        The file is missing, or does not describe a landmark set.
    """
    path = named_file(source, BUILT_IN) or named_file(Path(named_in).parent / source, BUILT_IN)
    if path is None:
        built_in = ", ".join(sorted(p.stem for p in BUILT_IN.glob("*.toml")))
        raise UsageError(
            f"no landmark set {brief(str(source))}: neither a file nor built in ({built_in})"
        )
    with as_usage():
        table = read_toml(path)
        if "program" in table and "landmarks" in table:  # the set of an earlier run
            table = table["landmarks"]
        return landmarks_from_table(table, str(path))


def landmarks_from_table(table: object, where: str) -> LandmarkSet:
    """A LandmarkSet from the keys of its TOML. where: names it in errors (SonarrecError)."""
    if isinstance(table, dict) and table.get("kind", "disc") != "disc":
        return _drawn_from_table(table, where)
    if isinstance(table, dict):
        table = {key: value for key, value in table.items() if key != "kind"}
    stated = from_table(_LandmarkSetFile, table, where)
    ids = tuple(row.id for row in stated.landmark)
    sectors = tuple(row.sectors for row in stated.landmark)
    for key, (inner, outer) in (("ring", stated.ring), ("symbol", stated.symbol)):
        if inner >= outer:
            raise SonarrecError(f"{where}: {key} must be [inner, outer], not {[inner, outer]}")
    if stated.symbol[1] > stated.ring[0]:
        raise SonarrecError(f"{where}: the symbol must end where the ring begins, or before")
    if len({len(s) for s in sectors}) > 1:
        raise SonarrecError(f"{where}: sectors must be equally many for every ID")
    patterns = [min(row[n:] + row[:n] for n in range(len(row))) for row in sectors]
    _check_distinct(ids, patterns, "pattern rotated", where)
    return LandmarkSet(stated.name, stated.radius_m, stated.ring, stated.symbol, ids, sectors)


def _check_distinct(ids: Sequence[int], patterns: Sequence[object], same: str, where: str) -> None:
    """Raise SonarrecError if two IDs, or the patterns of two IDs, are equal.

    same: names in the message what is equal.
    """
    if not ids or len(set(ids)) < len(ids):
        raise SonarrecError(f"{where}: every [[landmark]] needs an id, a whole number of its own")
    first: dict[object, int] = {}
    for number, pattern in zip(ids, patterns, strict=True):
        if (other := first.setdefault(pattern, number)) != number:
            raise SonarrecError(
                f"{where}: IDs {other} and {number} are the same {same}, so no image can "
                "distinguish them"
            )


def _drawn_from_table(table: dict[str, Any], where: str) -> DrawnSet:
    """A DrawnSet, as landmarks_from_table."""
    if table["kind"] != "drawn":
        raise SonarrecError(f'{where}: kind must be "disc" or "drawn", not {brief(table["kind"])}')
    stated = from_table(_DrawnSetFile, table, where)
    rows = stated.landmark or _of_codes(stated, where)
    ids = tuple(row.id for row in rows)
    drawings = [_drawing(row, where) for row in rows]
    if stated.family:
        built_in = (BUILT_IN / f"{stated.family}.toml").is_file()
        family = load_landmarks(stated.family) if built_in else None
        if ids or not isinstance(family, DrawnSet):
            raise SonarrecError(
                f"{where}: family names a built-in drawn set, in place of any [[landmark]]"
            )
        ids = family.ids if stated.ids is None else stated.ids
        if unknown := set(ids) - set(family.ids):
            raise SonarrecError(f"{where}: {stated.family} has no ID {min(unknown)}")
        drawings = [family.drawings()[k] for k in family.indices(np.asarray(ids))]
    elif stated.ids is not None:
        raise SonarrecError(f"{where}: ids chooses among those of a family, and none is named")
    if len(ids) > MOST_IDS:
        raise SonarrecError(
            f"{where}: {len(ids)} IDs, more than {MOST_IDS}; state those that are used"
        )
    for number, drawing in zip(ids, drawings, strict=True):
        if drawing.all() or not drawing.any():
            raise SonarrecError(f"{where}: the drawing of ID {number} is all of one kind")
    hand, half, none = stated.mirrored, stated.size_m / 2, (0.0, 0.0)
    patterns = [(len(d), min(view.tobytes() for view in views(d, hand))) for d in drawings]
    how = "rotated or mirrored (state mirrored)" if hand == "either" else "rotated"
    _check_distinct(ids, patterns, f"drawing {how}", where)
    cells = tuple(tuple(map(tuple, d.astype(int).tolist())) for d in drawings)
    return DrawnSet(stated.name, half, none, none, ids, (), cells, hand, stated.pose)


def _of_codes(stated: _DrawnSetFile, where: str) -> tuple[_Drawing, ...]:
    """The drawings that `cells` and `codes` state."""
    bits = sum(row.count("?") for row in stated.cells)
    digits, words = -(-bits // 4), stated.codes.split()
    if any(not re.fullmatch(f"[0-9a-f]{{{digits}}}", w) or int(w, 16) >> bits for w in words):
        raise SonarrecError(
            f"{where}: codes must be hex words of {digits} digits, for {bits} cells with ?"
        )
    drawings = []
    for number, word in enumerate(words):
        bit = iter(f"{int(word, 16):0{bits}b}")
        rows = tuple("".join(next(bit) if c == "?" else c for c in row) for row in stated.cells)
        drawings.append(_Drawing(number, rows))
    return tuple(drawings)


def views(drawing: BoolArray, mirrored: Hand) -> list[BoolArray]:
    """The drawing at every rotation by 90 degrees and in each hand in which it may show."""
    hands = {"no": [drawing], "yes": [drawing[:, ::-1]], "either": [drawing, drawing[:, ::-1]]}
    return [np.rot90(hand, quarters) for hand in hands[mirrored] for quarters in range(4)]


def _drawing(row: _Drawing, where: str) -> BoolArray:
    """(n, n) cells of a [[landmark]]."""
    if bool(row.cells) == bool(row.image):
        raise SonarrecError(f"{where}: ID {row.id} needs cells, or an image, and not both")
    if row.image:
        return _drawing_of_image(Path(where).parent / row.image, where)
    rows = [[*map(str, line)] for line in row.cells]
    is_even = len({len(line) for line in rows}) == 1 and rows[0]
    if not is_even or any(cell not in "01" for line in rows for cell in line):
        raise SonarrecError(f"{where}: cells of ID {row.id} must be rows of 0 and 1, equally long")
    if len(rows) != len(rows[0]):
        raise SonarrecError(
            f"{where}: ID {row.id} has {len(rows)} rows of {len(rows[0])} cells; {SQUARE}"
        )
    if len(rows) > MOST_CELLS:
        raise SonarrecError(f"{where}: ID {row.id} has more than {MOST_CELLS} cells along a side")
    return np.asarray(np.array(rows) == "1")


def _drawing_of_image(path: Path, where: str) -> BoolArray:
    """The cells of a picture: one a pixel where it is small, else IMAGE_CELLS along its side."""
    import cv2  # not for commands that read no picture

    if not path.is_file():
        raise SonarrecError(f"{where}: image {path}: no such file")
    try:
        picture = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, ValueError, cv2.error):
        picture = None
    if picture is None:
        raise SonarrecError(f"{where}: image {path}: not a picture that can be read, such as a PNG")
    grey = np.asarray(picture, np.uint8)
    if grey.shape[0] != grey.shape[1]:
        size = f"{grey.shape[1]} x {grey.shape[0]} pixels"
        raise SonarrecError(f"{where}: image {path} has {size}; {SQUARE}")
    if len(grey) > IMAGE_CELLS:
        grey = np.asarray(cv2.resize(grey, (IMAGE_CELLS,) * 2, interpolation=cv2.INTER_AREA))
    return np.asarray(grey > (int(grey.min()) + int(grey.max())) / 2)
