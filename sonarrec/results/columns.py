"""The columns of the three tables, each name once, and the methods that stand in them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from sonarrec.nouns import Estimate, FrameResult, Stamps

if TYPE_CHECKING:
    from sonarrec.tables.read import Kind  # imports pandas, which a run does not need
from pathlib import Path

from sonarrec.errors import UsageError, printable
from sonarrec.nouns import follows

Part = TypeVar("Part")


@dataclass(frozen=True, slots=True)
class Column(Generic[Part]):
    """One column.

    cell: makes the cell from a frame's result and the part of it that the row is about.
    kind: what a cell must be when it is read back; None: the column is not read. needed: tables of
    other programs must have the column too.
    """

    name: str
    cell: Callable[[FrameResult, Part], object]
    kind: Kind | None = None
    needed: bool = False


FRAME_COLUMNS: tuple[Column[Stamps], ...] = (
    Column("frame", lambda r, _: r.index, "whole", needed=True),
    Column("timestamp_ns", lambda r, _: r.timestamp_ns, "whole"),
    Column("candidates", lambda r, _: r.candidates),
    Column("tracks", lambda r, _: r.tracks),
    Column("log_time_ns", lambda _, s: s.log),
    Column("publish_time_ns", lambda _, s: s.publish),
    Column("header_stamp_ns", lambda _, s: s.header),
    Column("dx_m", lambda r, _: _motion_text(r, "right_m", 5)),
    Column("dy_m", lambda r, _: _motion_text(r, "ahead_m", 5)),
    Column("dyaw_deg", lambda r, _: _motion_text(r, "pan_deg", 4)),
    Column("dx_sigma_m", lambda r, _: _motion_sigma_text(r, "right_sigma_m", 5)),
    Column("dy_sigma_m", lambda r, _: _motion_sigma_text(r, "ahead_sigma_m", 5)),
    Column("dyaw_sigma_deg", lambda r, _: _motion_sigma_text(r, "pan_sigma_deg", 4)),
)
FRAMES_HEADER = "frame,timestamp_ns"
ESTIMATES_HEADER = "frame,method,range_m,bearing_deg,landmark,score,declared"
"""Headers for error messages: the fewest columns that can be scored."""


def estimate_columns(ids: Sequence[int], corners: bool = False) -> tuple[Column[Estimate], ...]:
    """The columns of estimates.csv for a landmark set with these IDs; corners: of drawn plates."""
    return (
        Column("frame", lambda r, _: r.index, "whole", needed=True),
        Column("timestamp_ns", lambda r, _: r.timestamp_ns),
        Column("method", lambda _, e: e.method, "text", needed=True),
        Column("object", lambda _, e: e.object, "label"),
        Column("x_px", lambda _, e: f"{e.x_px:.2f}", "blank or place"),
        Column("y_px", lambda _, e: f"{e.y_px:.2f}", "blank or place"),
        Column("range_m", lambda _, e: f"{e.range_m:.4f}", "blank or place"),
        Column("bearing_deg", lambda _, e: f"{e.bearing_deg:.3f}", "blank or place"),
        Column("orientation_deg", lambda _, e: f"{e.orientation_deg:.1f}", "blank or number"),
        Column("existence", lambda _, e: f"{e.existence:.4f}", "blank or number"),
        *(_belief(name, k) for k, name in enumerate(belief_names(ids))),
        Column("landmark", lambda _, e: e.landmark, "whole", needed=True),
        Column("score", lambda _, e: f"{e.score:.6f}", "number", needed=True),
        Column("declared", lambda _, e: int(e.declared), "flag", needed=True),
        Column("range_sigma_m", lambda _, e: f"{e.range_sigma_m:.4f}", "blank or number"),
        Column("bearing_sigma_deg", lambda _, e: f"{e.bearing_sigma_deg:.3f}", "blank or number"),
        Column(
            "orientation_sigma_deg",
            lambda _, e: f"{e.orientation_sigma_deg:.1f}",
            "blank or number",
        ),
        *(_corner(k, n) for k in range(4 * corners) for n in range(2)),
    )


def _motion_text(result: FrameResult, name: str, digits: int) -> str:
    """A component of the motion since the previous frame; empty if there is none."""
    return "" if result.motion is None else f"{getattr(result.motion, name):.{digits}f}"


def _motion_sigma_text(result: FrameResult, name: str, digits: int) -> str:
    """A standard error of the motion; empty if poses give the motion."""
    motion = result.motion
    return "" if motion is None or not motion.pan_sigma_deg else _motion_text(result, name, digits)


def belief_names(ids: Sequence[int]) -> list[str]:
    """The names of the columns of Estimate.probabilities, in its order."""
    return [f"p_{i}" for i in ids] + ["p_none"]


def _belief(name: str, k: int) -> Column[Estimate]:
    return Column(name, lambda _, e: f"{e.probabilities[k]:.6f}", "share")


CORNERS = tuple(f"{axis}{k}" for k in range(1, 5) for axis in "rb")
"""Columns of a plate's corners: slant range, m, and bearing, deg, of each."""


def _corner(k: int, n: int) -> Column[Estimate]:
    digits = 3 + (n == 0)

    def cell(_: FrameResult, e: Estimate) -> str:
        return "" if e.corners is None else f"{e.corners[k, n]:.{digits}f}"

    return Column(CORNERS[2 * k + n], cell, "blank or number")


def kinds(columns: Iterable[Column[Part]]) -> dict[str, Kind]:
    """The columns that are read back, with the kind of their cells."""
    return {c.name: c.kind for c in columns if c.kind is not None}


def needed(columns: Iterable[Column[Part]]) -> tuple[str, ...]:
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
