"""Landmark sets: what the discs look like, as data. A new set is one TOML file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import SonarrecError, UsageError
from sonarrec.tables.toml import (
    Positive,
    Share,
    Whole,
    brief,
    from_table,
    length,
    named_file,
    read_toml,
)

BUILT_IN = Path(__file__).parent / "landmark_sets"


@dataclass(frozen=True, slots=True)
class LandmarkSet:
    """Circular sector landmarks that share one radius, ring and symbol.

    radius_m: of the whole disc. ring, symbol: (inner, outer) of the bright ring and of the bright
    sectors, as fractions of the radius. ids: K distinct whole numbers. sectors: K rows of S zeros
    and ones, counter-clockwise seen from above, beginning at the landmark's orientation.
    """

    name: str
    radius_m: float
    ring: tuple[float, float]
    symbol: tuple[float, float]
    ids: tuple[int, ...]
    sectors: tuple[tuple[int, ...], ...]

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
        """(K,) the smallest turn, deg, after which each ID's symbol looks the same; mostly 360.

        NaN for a symbol that is all bright or all dark: it has no orientation.
        """
        count = len(self.sectors[0])
        turns = [
            np.nan
            if len(set(code)) == 1
            else next(n for n in range(1, count + 1) if code[n:] + code[:n] == code)
            for code in self.sectors
        ]
        return np.asarray(turns, dtype=float) * (360 / count)

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
class _Row:
    """One [[landmark]] of a file."""

    id: Whole
    sectors: Annotated[tuple[Literal[0, 1], ...], length(1, 360)]


@dataclass(frozen=True, slots=True)
class _LandmarkSetFile:
    """A landmark set as its file states it."""

    name: str
    radius_m: Positive
    ring: tuple[Share, Share]
    symbol: tuple[Share, Share]
    landmark: tuple[_Row, ...]


def load_landmarks(source: str | Path) -> LandmarkSet:
    """Read a landmark set: the name of a built-in one ("basin") or a TOML file.

    Raises UsageError if the file is missing or does not describe a landmark set.
    """
    path = named_file(source, BUILT_IN)
    if path is None:
        built_in = ", ".join(sorted(p.stem for p in BUILT_IN.glob("*.toml")))
        raise UsageError(
            f"no landmark set {brief(str(source))}: neither a file nor built in ({built_in})"
        )
    return landmarks_from_table(read_toml(path, UsageError), str(path), UsageError)


def landmarks_from_table(
    table: object, where: str, error: type[SonarrecError] = SonarrecError
) -> LandmarkSet:
    """A LandmarkSet from the keys of its TOML. where: names it in errors, which are `error`s."""
    stated = from_table(_LandmarkSetFile, table, where, error=error)
    ids = tuple(row.id for row in stated.landmark)
    sectors = tuple(row.sectors for row in stated.landmark)
    for key, (inner, outer) in (("ring", stated.ring), ("symbol", stated.symbol)):
        if inner >= outer:
            raise error(
                f"{where}: {key} must be [inner, outer] with inner < outer, not {[inner, outer]}"
            )
    if stated.symbol[1] > stated.ring[0]:
        raise error(f"{where}: the symbol must end where the ring begins, or before")
    if not ids or len(set(ids)) < len(ids):
        raise error(f"{where}: every [[landmark]] needs an id, a whole number of its own")
    if len({len(s) for s in sectors}) > 1:
        raise error(f"{where}: sectors must be equally many for every ID")
    first: dict[tuple[int, ...], int] = {}
    for number, row in zip(ids, sectors, strict=True):
        turned = min(row[n:] + row[:n] for n in range(len(row)))
        if turned in first:
            raise error(
                f"{where}: IDs {first[turned]} and {number} are the same pattern turned, "
                "so no image can tell them apart"
            )
        first[turned] = number
    return LandmarkSet(stated.name, stated.radius_m, stated.ring, stated.symbol, ids, sectors)
