"""The columns of the tables that a run writes, each stated once, and the methods in them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

from sonarrec.errors import UsageError, printable
from sonarrec.nouns import FrameResult, Stamps, follows

if TYPE_CHECKING:
    from sonarrec.tables.read import Kind  # imports pandas, which a run does not need


@dataclass(frozen=True, slots=True)
class Column:
    """One column.

    form: how a cell is written. kind: what a cell must be when it is read back; None: the column
    is not read. needed: tables of other programs must have the column too.
    """

    name: str
    form: str
    kind: Kind | None = None
    needed: bool = False


_NUMBER: tuple[Column, Column] = (
    Column("frame", "%d", "whole", needed=True),
    Column("timestamp_ns", "%d"),
)
FRAME_COLUMNS = (
    Column("frame", "%d", "whole", needed=True),
    Column("timestamp_ns", "%d", "whole"),
    Column("candidates", "%d"),
    Column("tracks", "%d"),
    Column("log_time_ns", "%s"),
    Column("publish_time_ns", "%s"),
    Column("header_stamp_ns", "%s"),
    Column("dx_m", "%.5f"),
    Column("dy_m", "%.5f"),
    Column("dyaw_deg", "%.4f"),
    Column("dx_sigma_m", "%.5f"),
    Column("dy_sigma_m", "%.5f"),
    Column("dyaw_sigma_deg", "%.4f"),
)
_BEFORE_BELIEFS = (
    Column("method", "%s", "text", needed=True),
    Column("object", "%d", "label"),
    Column("x_px", "%.2f", "blank or place"),
    Column("y_px", "%.2f", "blank or place"),
    Column("range_m", "%.4f", "blank or place"),
    Column("bearing_deg", "%.3f", "blank or place"),
    Column("orientation_deg", "%.1f", "blank or number"),
    Column("existence", "%.4f", "blank or number"),
)
_AFTER_BELIEFS = (
    Column("landmark", "%d", "whole", needed=True),
    Column("score", "%.6f", "number", needed=True),
    Column("declared", "%d", "flag", needed=True),
    Column("range_sigma_m", "%.4f", "blank or number"),
    Column("bearing_sigma_deg", "%.3f", "blank or number"),
    Column("orientation_sigma_deg", "%.1f", "blank or number"),
)
"""Their names, and those of _BEFORE_BELIEFS, are those of an Estimate's fields."""
CORNERS = tuple(f"{axis}{k}" for k in range(1, 5) for axis in "rb")
"""Columns of a plate's corners: slant range, m, and bearing, deg, of each."""
SIGHTING_COLUMNS = (
    Column("method", "%s"),
    Column("landmark", "%d"),
    Column("track", "%d"),
    Column("first_frame", "%d"),
    Column("last_frame", "%d"),
    Column("start_ns", "%d"),
    Column("end_ns", "%d"),
    Column("frames_declared", "%d"),
    Column("mean_score", "%.6f"),
    Column("best_score", "%.6f"),
    Column("range_m", "%.4f"),
    Column("bearing_deg", "%.3f"),
    Column("orientation_deg", "%.1f"),
    Column("range_sigma_m", "%.4f"),
    Column("bearing_sigma_deg", "%.3f"),
    Column("orientation_sigma_deg", "%.1f"),
    Column("x_m", "%.4f"),
    Column("y_m", "%.4f"),
)
"""The fields of a Sighting."""
FRAMES_HEADER = "frame,timestamp_ns"
ESTIMATES_HEADER = "frame,method,range_m,bearing_deg,landmark,score,declared"
"""Headers for error messages: the fewest columns that can be scored."""


def belief_names(ids: Sequence[int]) -> list[str]:
    """The names of the columns of Estimate.probabilities, in its order."""
    return [f"p_{i}" for i in ids] + ["p_none"]


def estimate_columns(ids: Sequence[int], corners: bool = False) -> tuple[Column, ...]:
    """The columns of estimates.csv for a landmark set with these IDs; corners: of drawn plates."""
    return (
        *(*_NUMBER, *_BEFORE_BELIEFS),
        *(Column(name, "%.6f", "share") for name in belief_names(ids)),
        *_AFTER_BELIEFS,
        *(
            Column(name, "%.4f" if name[0] == "r" else "%.3f", "blank or number")
            for name in CORNERS[: 8 * corners]
        ),
    )


def _line(columns: Sequence[Column], blank: int = 0) -> str:
    """A template of a table's line; the last `blank` cells are empty."""
    cells = [c.form for c in columns[: len(columns) - blank]] + [""] * blank
    return ",".join(cells) + "\n"


_STILL, _MOVED, _MEASURED = (_line(FRAME_COLUMNS, blank) for blank in (6, 3, 0))


def frame_line(result: FrameResult, stamps: Stamps) -> str:
    """The line of frames.csv; the motion is empty if there is none, its errors if poses gave it."""
    times = ("" if t is None else t for t in (stamps.log, stamps.publish, stamps.header))
    cells = (result.index, result.timestamp_ns, result.candidates, result.tracks, *times)
    motion = result.motion
    if motion is None:
        return _STILL % cells
    moved = motion.right_m, motion.ahead_m, motion.pan_deg
    if not motion.pan_sigma_deg:
        return _MOVED % (*cells, *moved)
    sigmas = motion.right_sigma_m, motion.ahead_sigma_m, motion.pan_sigma_deg
    return _MEASURED % (*cells, *moved, *sigmas)


class EstimateLines:
    """Makes the lines of estimates.csv, each by one template: a call for every cell takes four
    times as long."""

    def __init__(self, columns: Sequence[Column]) -> None:
        """columns: from `estimate_columns`."""
        self._corners = columns[-1].name == CORNERS[-1]
        self._seen, self._unseen = _line(columns), _line(columns, len(CORNERS) * self._corners)
        self._before = attrgetter(*(c.name for c in _BEFORE_BELIEFS[1:]))
        self._after = attrgetter(*(c.name for c in _AFTER_BELIEFS))

    def __call__(self, result: FrameResult) -> str:
        """The lines of a frame's estimates."""
        lines, before, after = [], self._before, self._after
        for e in result.estimates:
            cells = (
                *(result.index, result.timestamp_ns, text_cell(e.method), *before(e)),
                *(*e.probabilities.tolist(), *after(e)),
            )
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
    there = in_order(methods)
    for method in wanted:
        if method not in there:
            raise UsageError(
                printable(f"{where}: no method {method!r}; there is {', '.join(there)}")
            )
    return tuple(dict.fromkeys(wanted)) or there


def leading(methods: Iterable[str]) -> str:
    """The method that is shown where one is: the first in order; the framework if there is none."""
    return next(iter(in_order(methods)), OF_ONE_PRESET[0])
