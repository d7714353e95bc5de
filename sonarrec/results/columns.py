"""The columns of the tables that a run writes, each stated once, and the methods in them."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from sonarrec.errors import UsageError, printable
from sonarrec.sonar.frame import FrameResult, Stamps, follows

if TYPE_CHECKING:
    from sonarrec.tables.read import Kind  # imports pandas, which a run does not need


@dataclass(frozen=True, slots=True)
class Column:
    """One column, a row of columns.csv."""

    name: str
    form: str
    """How a cell is written."""
    kind: Kind | None
    """What a cell must be when it is read back; None: the column is not read."""
    needed: bool
    """Tables of other programs must have the column too."""
    meaning: str
    """For `sonarrec help results`; columns that follow each other with one meaning are listed
    together."""


def _read() -> dict[str, tuple[Column, ...]]:
    """The columns of each table."""
    tables: dict[str, tuple[Column, ...]] = {}
    with Path(__file__).with_name("columns.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            kind: Any = row["kind"] or None
            column = Column(row["name"], row["form"], kind, bool(row["needed"]), row["meaning"])
            tables[row["table"]] = (*tables.get(row["table"], ()), column)
    return tables


_TABLES = _read()
FRAME_COLUMNS, SIGHTING_COLUMNS = _TABLES["frames"], _TABLES["sightings"]
CORNERS = tuple(c.name for c in _TABLES["corners"])
"""Columns of a plate's corners: slant range, m, and bearing, deg, of each."""
FRAMES_HEADER = "frame,timestamp_ns"
ESTIMATES_HEADER = "frame,method,range_m,bearing_deg,landmark,score,declared"
"""Headers for error messages: the fewest columns that can be scored."""


def with_columns(page: str) -> str:
    """A page of help with a table's columns in place of {frames.csv} and so on."""
    for name, columns in _TABLES.items():
        page = page.replace(f"    {{{name}.csv}}", "\n".join(_listed(columns)))
    return page


def _listed(columns: Iterable[Column]) -> Iterator[str]:
    """A line for each column, or those of one meaning, and more where the meaning is long."""
    for meaning, those in groupby(columns, key=attrgetter("meaning")):
        names = ", ".join(c.name for c in those)
        first, *rest = wrap(meaning, 65)
        if len(names) > 18:
            yield f"    {names}"
            names = ""
        yield f"    {names:<18} {first}"
        yield from (f"{'':<23}{line}" for line in rest)


def belief_names(ids: Sequence[int]) -> list[str]:
    """The names of the columns of Estimate.probabilities, in its order."""
    return [f"p_{i}" for i in ids] + ["p_none"]


def estimate_columns(ids: Sequence[int], corners: bool = False) -> tuple[Column, ...]:
    """The columns of estimates.csv for a landmark set with these IDs; corners: of drawn plates."""
    before, after = _around_beliefs(_TABLES["estimates"])
    of_id, of_none = _TABLES["estimates"][len(before) :][:2]
    beliefs = (*(replace(of_id, name=name) for name in belief_names(ids)[:-1]), of_none)
    return (*before, *beliefs, *after, *(_TABLES["corners"] if corners else ()))


def _around_beliefs(columns: Sequence[Column]) -> tuple[list[Column], list[Column]]:
    """The columns of an estimate before and after those of its probabilities."""
    of_beliefs = [n for n, c in enumerate(columns) if c.name.startswith("p_")]
    after = [c for c in columns[of_beliefs[-1] + 1 :] if c.name not in CORNERS]
    return list(columns[: of_beliefs[0]]), after


def _line(columns: Sequence[Column], blank: int = 0) -> str:
    """A template of a table's line; the last `blank` cells are empty."""
    cells = [c.form for c in columns[: len(columns) - blank]] + [""] * blank
    return ",".join(cells) + "\n"


def line_of(columns: Sequence[Column], values: Mapping[str, Any]) -> str:
    """The line of a table by the names of its columns; what is missing, None or NaN is empty."""
    cells = []
    for column in columns:
        value = values.get(column.name)
        known = value is not None and not (isinstance(value, float) and math.isnan(value))
        cells.append(column.form % value if known else "")
    return ",".join(cells) + "\n"


def frame_line(result: FrameResult, stamps: Stamps) -> str:
    """The line of frames.csv; the motion is empty if there is none, its errors if poses gave it."""
    values: dict[str, Any] = {
        "frame": result.index,
        "timestamp_ns": result.timestamp_ns,
        "stretch": result.stretch,
        "candidates": result.candidates,
        "tracks": result.tracks,
        "log_time_ns": stamps.log,
        "publish_time_ns": stamps.publish,
        "header_stamp_ns": stamps.header,
    }
    if (motion := result.motion) is not None:
        values |= {"dx_m": motion.right_m, "dy_m": motion.ahead_m, "dyaw_deg": motion.pan_deg}
        if motion.pan_sigma_deg:
            values |= {
                "dx_sigma_m": motion.right_sigma_m,
                "dy_sigma_m": motion.ahead_sigma_m,
                "dyaw_sigma_deg": motion.pan_sigma_deg,
            }
    return line_of(FRAME_COLUMNS, values)


class EstimateLines:
    """Makes the lines of estimates.csv, each by one template: a call for every cell takes four
    times as long."""

    def __init__(self, columns: Sequence[Column]) -> None:
        """columns: from `estimate_columns`."""
        self._corners = columns[-1].name == CORNERS[-1]
        self._seen, self._unseen = _line(columns), _line(columns, len(CORNERS) * self._corners)
        before, after = _around_beliefs(columns)  # they are named as an Estimate's fields
        self._before = attrgetter(*(c.name for c in before[3:]))  # after frame, time and method
        self._after = attrgetter(*(c.name for c in after))

    def __call__(self, result: FrameResult) -> str:
        """The lines of a frame's estimates."""
        lines, before, after = [], self._before, self._after
        for e in result.estimates:
            of_frame = result.index, result.timestamp_ns, text_cell(e.method)
            cells = (*of_frame, *before(e), *e.probabilities.tolist(), *after(e))
            if self._corners and e.corners is not None:
                lines.append(self._seen % (*cells, *e.corners.ravel().tolist()))
            else:
                lines.append(self._unseen % cells)
        return "".join(lines)


@cache
def text_cell(text: str) -> str:
    """A text as a cell, quoted where it must be."""
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\r\n') else text


def kinds(columns: Iterable[Column]) -> dict[str, Kind]:
    """The columns that are read back, with the kind of their cells."""
    return {c.name: c.kind for c in columns if c.kind is not None}


def needed(columns: Iterable[Column]) -> tuple[str, ...]:
    """The columns without which a table cannot be used."""
    return tuple(c.name for c in columns if c.needed)


OF_ONE_PRESET = ("framework", "smi")
"""The methods of a run of one preset, even if one of them has no estimate."""


def in_order(methods: Iterable[str]) -> tuple[str, ...]:
    """Each method once: the framework's, then other programs', then those without tracks."""

    def rank(method: str) -> tuple[bool, bool, str]:
        return not follows(method), method.partition(":")[0] != OF_ONE_PRESET[0], method

    return tuple(sorted(set(methods), key=rank))


def chosen(methods: Iterable[str], wanted: Sequence[str], where: str | Path) -> tuple[str, ...]:
    """The wanted methods as they were named; all in order if none is wanted.

    where: what holds them, for the message. Raises UsageError if one is missing.
    """
    known = in_order(methods)
    for method in wanted:
        if method not in known:
            raise UsageError(
                printable(f"{where}: no method {method!r}; there is {', '.join(known)}")
            )
    return tuple(dict.fromkeys(wanted)) or known


def leading(methods: Iterable[str]) -> str:
    """The method that is shown where one is: the first in order; the framework if there is none."""
    return next(iter(in_order(methods)), OF_ONE_PRESET[0])
