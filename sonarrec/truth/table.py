"""Reads, checks and writes gt.csv."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import SonarrecError
from sonarrec.tables import composed
from sonarrec.tables.outputs import write_csv, writing
from sonarrec.tables.read import (
    NONE,
    POSITION_KINDS,
    Kind,
    line_number,
    mistaken_columns,
    position_pair,
    read_header,
    read_table,
)

TRUTH_FILE = "gt.csv"  # next to a log, as such or as NAME.gt.csv: its truth
HEADER = "frame,landmark,x_px,y_px,visible"
_SECONDS = ("time", "time_s", "t", "t_s", "timestamp", "timestamp_s", "stamp", "seconds", "sec")
"""Names, in lower case, that other programs give to times."""
_OF_RESULTS = (
    {"method", "declared"},
    {"method", "frames_declared"},
    {"method", "protocol"},
    {"frame", "candidates", "tracks"},
)
"""Columns that tell the tables of `run` and `evaluate`."""
TRACKED, FILLED_IN = "tracked", "interpolated"
"""In the column `source` of a proposal: what its rows are."""
_KINDS: dict[str, Kind] = {
    "frame": "whole",
    "timestamp_ns": "whole",
    "landmark": "landmark",
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
    """The column that names the frame, "frame" or "timestamp_ns"."""
    keys: IntArray
    """(R,) its values."""
    landmark: IntArray
    """(R,) IDs; NONE for an object that is no landmark of the set: a stranger."""
    visible: FloatArray
    """(R,) share of the disc, 0 to 1."""
    log: Any
    """(R,) names."""
    position: tuple[str, FloatArray, FloatArray] | None
    """As tables.position_pair gives it."""
    pixel: FloatArray | None
    """(R, 2) column and row, NaN where blank, if position is in metres and deg and the table has
    both."""
    orientation: FloatArray | None
    """(R,) deg, NaN where blank. All are None without their columns."""
    proposed: BoolArray
    """(R,) whether `truth propose` wrote the row, by the column `source`."""
    unread: tuple[tuple[str, str], ...]
    """Other columns, and the one that each may stand for, which the table lacks; empty: none."""

    def rows_of(self, name: str, *, strangers: bool = False) -> IntArray:
        """(n,) the rows on a log that name a landmark, or those on strangers; rising."""
        wanted = (self.landmark == NONE) == strangers
        if self.log is None:
            return np.flatnonzero(wanted)
        ours = [composed(text) == composed(name) for text in self.log.categories]
        return np.flatnonzero(wanted & np.isin(self.log.codes, np.flatnonzero(ours)))

    def name_of(self, names: Sequence[str]) -> str:
        """The name by which the log column calls a log; the first if it names none.

        names: that its results may have, the most precise last (`folders.possible_names`).
        """
        named = set() if self.log is None else {composed(name) for name in self.log.unique()}
        return next((name for name in reversed(names) if composed(name) in named), names[0])


def read_truth(path: Path) -> TruthTable:
    """Read gt.csv (see HEADER). It may have no row; scoring refuses that.

    Raises SonarrecError on wrong columns, an invalid cell or a repeated row.
    """
    table = read_rows(path)
    for row in np.flatnonzero((table.visible < 0) | (table.visible > 1))[:1]:
        raise SonarrecError(
            f"{path} line {line_number(path, row)}: visible is the share of the disc in view, "
            f"0 to 1, not {table.visible[row]:g}"
        )
    for first, second in repeated_rows(table)[:1]:
        raise SonarrecError(
            f"{path} line {line_number(path, second)}: repeats line {line_number(path, first)} "
            f"(same {table.key}, landmark and position); delete one of them"
        )
    return table


def read_rows(path: Path) -> TruthTable:
    """Read gt.csv without checks of its rows: `visible` of any value, repeated rows.

    Raises SonarrecError on wrong columns and on a cell that is no number.
    """
    others, header = list[str](), {*read_header(path, HEADER)}
    if any(columns <= header for columns in _OF_RESULTS):
        raise SonarrecError(
            f"{path}: a table of results, not of truth; `sonarrec truth propose` makes a truth "
            "from results, which a person corrects"
        )
    table = read_table(path, _KINDS, ("landmark",), HEADER, others)
    key = "frame" if "frame" in table else "timestamp_ns"
    if key not in table:
        seconds = next((name for name in others if name.lower() in _SECONDS), None)
        how = f"expected a header such as {HEADER}"
        for name, near in mistaken_columns(others, [*_KINDS], {"frame", "timestamp_ns"}):
            how += f"; rename {name} to {near}" if near else ""
        if seconds is not None:
            how = f"multiply {seconds} by 1e9 if it is in seconds, and call it timestamp_ns"
        raise SonarrecError(f"{path}: wrong columns, neither frame nor timestamp_ns; {how}")
    rows, position = len(table["landmark"]), position_pair(path, table)
    # Of two ways to say the same, one suffices.
    spare = {*table, "frame", "timestamp_ns", *(POSITION_KINDS if position else ())}
    visible, source = table.get("visible", np.ones(rows)), table.get("source")
    has_both = position is not None and position[0] == "polar" and {"x_px", "y_px"} <= set(table)
    return TruthTable(
        path=path,
        key=key,
        keys=table[key],
        landmark=table["landmark"],
        visible=np.where(np.isnan(visible), 1.0, visible),
        log=table.get("log"),
        position=position,
        pixel=np.column_stack([table["x_px"], table["y_px"]]) if has_both else None,
        orientation=table.get("orientation_deg"),
        proposed=np.zeros(rows, bool) if source is None else source.isin((TRACKED, FILLED_IN)),
        unread=(*mistaken_columns(others, (*_KINDS, "track"), {*_KINDS} - spare),),
    )


def read_cells(path: Path) -> tuple[list[str], list[list[str]]]:
    """The header of a table that `read_rows` reads, and the texts of each of its rows."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = csv.reader(file, skipinitialspace=True)
        header, *filled = (row for row in rows if len(row) > 1 or "".join(row).strip())
    return header, [row + [""] * (len(header) - len(row)) for row in filled]


def repeated_rows(table: TruthTable) -> IntArray:
    """(n, 2) pairs of equal rows, rising; (0, 2) if there are no positions.

    One ID may be in view twice, but not twice in one position.
    """
    if table.position is None:
        return np.empty((0, 2), dtype=np.int64)
    log = np.zeros(len(table.keys)) if table.log is None else table.log.codes
    cells = (table.position[2], table.position[1], table.landmark, table.keys, log)
    order = np.lexsort(cells)
    same = np.all([cell[order][1:] == cell[order][:-1] for cell in cells], axis=0)
    pairs = np.sort(np.column_stack([order[:-1][same], order[1:][same]]), axis=1)
    return np.asarray(pairs[np.argsort(pairs[:, 1])], dtype=np.int64)


def check_new(path: Path) -> None:
    """Raise SonarrecError if a file exists, since a person may have corrected it by hand."""
    if os.path.lexists(path):
        raise SonarrecError(f"{path}: exists already and is left as it is; choose another --out")


def write_truth(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a new gt.csv, all of it or nothing. Raises SonarrecError if it exists or that fails."""
    check_new(path)
    with writing(path):
        write_csv(path, header, rows)
