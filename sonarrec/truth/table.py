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
from sonarrec.tables.outputs import replaced
from sonarrec.tables.read import (
    NONE,
    POSITION_KINDS,
    Kind,
    line_number,
    position_pair,
    read_header,
    read_table,
)

TRUTH_FILE = "gt.csv"  # beside a log, as such or as NAME.gt.csv: its truth
HEADER = "frame,landmark,x_px,y_px,visible"
TRACKED, FILLED_IN = "tracked", "interpolated"
"""In the column `source` of a proposal: what its rows are."""
_KINDS: dict[str, Kind] = {
    "frame": "whole",
    "timestamp_ns": "whole",
    "landmark": "whole or none",
    "visible": "blank or number",
    "orientation_deg": "blank or number",
    "log": "text",
    "source": "blank or text",
    **POSITION_KINDS,
}


@dataclass(frozen=True, slots=True)
class TruthTable:
    """gt.csv as read: R rows."""

    path: Path
    key: str
    """The column that names the frame: "frame" or "timestamp_ns"."""
    at: IntArray
    """(R,) its values."""
    landmark: IntArray
    """(R,) IDs; NONE for an object that is no landmark of the set: a stranger."""
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
    """Columns that are not read, if positions or `visible` are missing: perhaps they are these."""
    timestamp_ns: IntArray | None
    """(R,) times beside frame numbers; None without."""

    def rows_of(self, name: str, *, strangers: bool = False) -> IntArray:
        """(n,) the rows on a log that name a landmark, or those on strangers; rising."""
        wanted = (self.landmark == NONE) == strangers
        return np.flatnonzero(wanted if self.log is None else wanted & (self.log == name))

    def name_of(self, names: Sequence[str]) -> str:
        """The name by which the log column calls a log; the first if it names none.

        names: that its results may have, the most precise last (`folders.possible_names`).
        """
        if self.log is None:
            return names[0]
        named = set(self.log.unique())
        return next((name for name in reversed(names) if name in named), names[0])

    def not_read_text(self) -> str:
        """A note on the columns that are not read."""
        return f"{self.path}: columns {', '.join(self.not_read)} are not read"

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

    Raises SonarrecError on wrong columns and on a cell that is no number.
    """
    table = read_table(path, _KINDS, ("landmark",), HEADER)
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
    read = {"track", *_KINDS} - ({*POSITION_KINDS} if position is None else set())
    complete = position is not None and "visible" in table
    unread = [] if complete or not rows else read_header(path, HEADER)
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
        not_read=tuple(name for name in unread if name and name not in read),
        timestamp_ns=table.get("timestamp_ns") if key == "frame" else None,
    )


def repeated_rows(table: TruthTable) -> IntArray:
    """(n, 2) pairs of equal rows, rising; (0, 2) if there are no positions.

    One ID may be in view twice, but not twice in one position.
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
