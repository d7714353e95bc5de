"""Reads, checks and writes gt.csv."""

from __future__ import annotations

import csv
import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import SonarrecError
from sonarrec.files.outputs import replaced
from sonarrec.files.tables import (
    POSITION_KINDS,
    Kind,
    line_number,
    position_pair,
    read_header,
    read_table,
)

HEADER = "frame,landmark,x_px,y_px,visible"
TRACKED, FILLED_IN = "tracked", "interpolated"
"""In the column `source` of a proposal: what its rows are."""
_PIXELS = "x_px,y_px (pixels of the fan image)"
_POLAR = "range_m,bearing_deg (slant range in m; deg, positive to the right)"
_LOOK_ALIKE = {
    _PIXELS: (
        *("x", "y", "u", "v", "col", "row", "column", "px", "py", "cx", "cy", "xc", "yc"),
        *("x_pixel", "y_pixel", "x_pixels", "y_pixels", "pixel_x", "pixel_y", "xpx", "ypx"),
        *("x_center", "y_center", "center_x", "center_y", "x_centre", "y_centre", "centre_x"),
        "centre_y",
    ),
    _POLAR: (
        *("range", "r", "rho", "slant_range", "slant_range_m", "range_metres", "range_meters"),
        *("distance", "distance_m", "rangem", "bearing", "bearing_rad", "bearing_degrees"),
        *("azimuth", "azimuth_deg", "theta", "angle", "angle_deg", "x_m", "y_m", "z_m"),
    ),
}
"""Names in lower case that other programs use for positions, by the names expected here."""
_OTHER_ALIKE = {
    "visible": ("visible", "visibility", "vis"),
    "orientation_deg": ("orientation_deg", "orientation"),
    "log": ("log",),
}
"""The same for columns that are optional, but change what the truth means."""


@dataclass(frozen=True, slots=True)
class TruthTable:
    """gt.csv as read: R rows."""

    path: Path
    key: str
    """The column that names the frame: "frame" or "timestamp_ns"."""
    at: IntArray
    """(R,) its values."""
    landmark: IntArray
    """(R,) IDs."""
    visible: FloatArray
    """(R,) share of the disc, 0 to 1."""
    log: Any
    """(R,) names; None without the column."""
    position: tuple[str, FloatArray, FloatArray] | None
    """As tables.position_pair gives it; None without positions."""
    pixels: tuple[FloatArray, FloatArray] | None
    """(R,) column and row beside a position by range and bearing, NaN where blank; None without."""
    orientation: FloatArray | None
    """(R,) deg, NaN where blank; None without the column."""
    proposed: BoolArray
    """(R,) whether `truth propose` wrote the row, by the column `source`."""
    not_read: tuple[str, ...]
    """Columns that look like positions, `visible` and so on, but are not read."""

    def rows_of(self, name: str) -> IntArray:
        """(n,) the rows on a log, rising."""
        if self.log is None:
            return np.arange(len(self.at))
        return np.flatnonzero(self.log == name)

    def name_of(self, names: Sequence[str]) -> str:
        """The name by which the log column calls a log; the first if it names none.

        names: that its results may have, the most precise last (`folders.possible_names`).
        """
        if self.log is None:
            return names[0]
        named = set(self.log.unique())
        return next((name for name in reversed(names) if name in named), names[0])

    def digest_of(self, rows: IntArray) -> str:
        """A digest of the content of some rows; copies of a truth have the same."""
        kind, *position = self.position or (None,)
        digest = hashlib.sha256(f"{self.key} {kind}".encode())
        for column in (self.at, self.landmark, self.visible, *position, self.orientation):
            if column is not None:
                digest.update(column[rows].tobytes())
        return digest.hexdigest()


def read_truth(path: Path) -> TruthTable:
    """Read gt.csv (see HEADER). It may have no row; scoring refuses that.

    Raises SonarrecError on wrong columns, an invalid cell or a repeated row.
    """
    table = read_rows(path)
    wrong = (table.visible < 0) | (table.visible > 1)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise SonarrecError(
            f"{path} line {line_number(path, row)}: visible is the share of the disc in view, "
            f"0 to 1, not {table.visible[row]:g}"
        )
    repeated = repeated_rows(table)
    if len(repeated):
        first, second = repeated[0]
        raise SonarrecError(
            f"{path} line {line_number(path, second)}: repeats line {line_number(path, first)} "
            f"(same {table.key}, landmark and position); delete one of them"
        )
    return table


def read_rows(path: Path) -> TruthTable:
    """Read gt.csv without checks of its rows: `visible` of any value, repeated rows.

    Raises SonarrecError on wrong columns, on a cell that is no number, or if columns look like
    positions but none can be read.
    """
    kinds: dict[str, Kind] = {
        "frame": "whole",
        "timestamp_ns": "whole",
        "landmark": "whole",
        "visible": "blank or number",
        "orientation_deg": "blank or number",
        "log": "text",
        "source": "blank or text",
    }
    table = read_table(path, kinds | POSITION_KINDS, ("landmark",), HEADER)
    key = "frame" if "frame" in table else "timestamp_ns"
    if key not in table:
        raise SonarrecError(
            f"{path}: wrong columns, neither frame nor timestamp_ns; "
            f"expected a header such as {HEADER}"
        )
    rows = len(table["landmark"])
    visible = table.get("visible", np.ones(rows))
    position = position_pair(path, table)
    pixels = None
    if position is not None and position[0] == "polar" and {"x_px", "y_px"} <= table.keys():
        pixels = table["x_px"], table["y_px"]
    proposed = np.zeros(rows, dtype=bool)
    if "source" in table:
        proposed = np.asarray(table["source"].isin((TRACKED, FILLED_IN)))
    return TruthTable(
        path=path,
        key=key,
        at=table[key],
        landmark=table["landmark"],
        visible=np.where(np.isnan(visible), 1.0, visible),
        log=table.get("log"),
        position=position,
        pixels=pixels,
        orientation=table.get("orientation_deg"),
        proposed=proposed,
        not_read=_not_read(path, position is not None),
    )


def _not_read(path: Path, placed: bool) -> tuple[str, ...]:
    """Columns with other names than those that are read, but similar ones.

    placed: whether there are positions. Raises SonarrecError if there are none, but columns that
    look like them.
    """
    header = read_header(path, HEADER)
    positions = _look_alike(header)
    if positions and not placed:
        columns = "; ".join(f"{', '.join(n)}: expected {right}" for right, n in positions.items())
        raise SonarrecError(
            f"{path}: no position can be read from the columns {columns}; both columns of one pair "
            "are needed. Rename them, or drop them to score protocol paper alone"
        )
    others = (
        name
        for right, names in _OTHER_ALIKE.items()
        for name in header
        if right not in header and name.lower() in names
    )
    return (*(name for names in positions.values() for name in names), *others)


def _look_alike(header: Sequence[str]) -> dict[str, list[str]]:
    """Columns that look like positions and are not read, by what they should be called."""
    found: dict[str, list[str]] = {}
    for right, names in _LOOK_ALIKE.items():
        pair = right.partition(" ")[0].split(",")
        # One of a pair is of no use; a pair left blank is no mistake.
        read = pair if all(name in header for name in pair) else []
        alike = [n for n in header if n.lower().replace(" ", "_") in (*names, *pair)]
        found[right] = [n for n in alike if n not in read]
    return {right: names for right, names in found.items() if names}


def repeated_rows(table: TruthTable) -> IntArray:
    """(n, 2) pairs of equal rows, rising; (0, 2) if there are no positions.

    One ID may be in view twice, but not twice in one place.
    """
    if table.position is None:
        return np.empty((0, 2), dtype=np.int64)
    log = np.zeros(len(table.at)) if table.log is None else table.log.codes
    cells = (table.position[2], table.position[1], table.landmark, table.at, log)
    order = np.lexsort(cells)
    same = np.ones(max(len(order) - 1, 0), dtype=bool)
    for cell in cells:
        same &= np.diff(cell[order]) == 0
    first = np.flatnonzero(same)
    pairs = np.sort(np.column_stack([order[first], order[first + 1]]), axis=1)
    return np.asarray(pairs[np.argsort(pairs[:, 1])], dtype=np.int64)


def write_truth(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a new gt.csv, all of it or nothing. Raises SonarrecError if it exists or that fails.

    An existing file is never replaced, since a person may have corrected it by hand.
    """
    try:
        if os.path.lexists(path):
            raise FileExistsError
        with replaced(path) as new:
            with new.open("x", newline="", encoding="utf-8") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(header)
                writer.writerows(rows)
            if os.path.lexists(path):  # made meanwhile
                raise FileExistsError
    except FileExistsError:
        raise SonarrecError(
            f"{path}: exists already and is left as it is; choose another --out"
        ) from None
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be written ({error.strerror})") from None
