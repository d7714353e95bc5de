"""Landmark sets: what the discs look like, as data. A new set is one TOML file."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.records import FloatArray, SonarrecError

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


def load_landmarks(source: str | Path) -> LandmarkSet:
    """Read a landmark set: the name of a built-in one ("basin") or a TOML file.

    Raises SonarrecError where the file is missing or what it says cannot be a landmark set.
    """
    path = BUILT_IN / f"{source}.toml"
    if not path.is_file():
        path = Path(source)
    if not path.is_file():
        built_in = ", ".join(sorted(p.stem for p in BUILT_IN.glob("*.toml")))
        raise SonarrecError(
            f"no landmark set {str(source)!r}: neither a file nor built in ({built_in})"
        )
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SonarrecError(f"{path}: not a readable TOML file ({error})") from None
    return landmarks_from_table(document, str(path))


def landmarks_from_table(table: dict[str, Any], where: str) -> LandmarkSet:
    """A LandmarkSet from the keys of its TOML; `where` names it in errors (SonarrecError)."""
    needed = {"name", "radius_m", "ring", "symbol", "landmark"}
    if set(table) != needed:
        wrong = ", ".join(sorted(set(table) ^ needed))
        raise SonarrecError(
            f"{where}: a landmark set has exactly the keys {', '.join(sorted(needed))}; "
            f"missing or unknown: {wrong}"
        )
    try:
        ring = tuple(float(v) for v in table["ring"])
        symbol = tuple(float(v) for v in table["symbol"])
        unknown = {key for row in table["landmark"] for key in row} - {"id", "sectors"}
        rows = [(row["id"], tuple(row["sectors"])) for row in table["landmark"]]
        radius = float(table["radius_m"])
    except (TypeError, ValueError, KeyError) as error:
        raise SonarrecError(f"{where}: not a landmark set ({error!r})") from None
    if unknown:
        raise SonarrecError(f"{where}: unknown key {min(unknown)!r} in [[landmark]]")
    if not 0 < radius < math.inf:
        raise SonarrecError(f"{where}: radius_m must be above 0")
    for key, band in (("ring", ring), ("symbol", symbol)):
        if len(band) != 2 or not 0 <= band[0] < band[1] <= 1:
            raise SonarrecError(
                f"{where}: {key} must be [inner, outer] with 0 <= inner < outer <= 1"
            )
    if symbol[1] > ring[0]:
        raise SonarrecError(f"{where}: the symbol must end where the ring begins, or before")
    ids = tuple(i for i, _ in rows)
    sectors = tuple(s for _, s in rows)
    if not rows or not all(type(i) is int for i in ids) or len(set(ids)) != len(ids):
        raise SonarrecError(f"{where}: every [[landmark]] needs an id, a whole number of its own")
    count = len(sectors[0])
    if not count or not all(len(s) == count and all(v in (0, 1) for v in s) for s in sectors):
        raise SonarrecError(f"{where}: sectors must be zeros and ones, equally many for every ID")
    for i, first in enumerate(sectors):
        turns = {first[n:] + first[:n] for n in range(len(first))}
        for j in range(i):
            if sectors[j] in turns:
                raise SonarrecError(
                    f"{where}: IDs {ids[j]} and {ids[i]} are the same pattern turned, "
                    "so no image can tell them apart"
                )
    return LandmarkSet(str(table["name"]), radius, ring, symbol, ids, sectors)  # type: ignore[arg-type]
