"""A table of the sonar's poses: `sonarrec run --odometry`."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.errors import SonarrecError
from sonarrec.geometry import PoseTable, pose_table

if TYPE_CHECKING:
    from sonarrec.tables.read import Table

POSES_FILE = "poses.csv"
"""Poses beside a log (or NAME.poses.csv), used if the user gives none."""
HEADER = "timestamp,yaw,x,y"
LOOK_ALIKE = (
    *("x", "y", "x_m", "y_m", "px", "py", "pos_x", "pos_y", "position_x", "position_y"),
    *("east", "north", "east_m", "north_m", "easting", "northing"),
    *("lat", "lon", "latitude", "longitude"),
)
"""Names, in lower case, that other programs give to positions. They are refused: without x and y
the sonar would be taken to turn in one place."""
# How the unit of a column `timestamp` is recognised: rows of a steady pan may be half a minute
# apart, and nobody writes 2,000 a second. Steps in between must be milliseconds or microseconds.
SECONDS_BELOW = 50
NANOSECONDS_FROM = 500_000


def read_poses(path: Path) -> PoseTable:
    """Read a CSV table with a header such as HEADER. x and y must both be there, or neither.

    timestamp_ns is in nanoseconds. timestamp is in ISO 8601 with its UTC offset, in seconds if the
    median step from row to row is less than SECONDS_BELOW, or in nanoseconds if it is
    NANOSECONDS_FROM or more. Rows may be in any order; of several rows at one time the first
    counts. Raises SonarrecError if the table cannot be used.
    """
    # Not at the top, because it loads pandas, which few runs need.
    from sonarrec.tables.read import Kind, read_header, read_table

    kinds: dict[str, Kind] = dict.fromkeys(("yaw", "x", "y"), "place")
    kinds |= {"timestamp_ns": "whole", "timestamp": "time"}
    table = read_table(path, kinds, ("yaw",), HEADER)
    _check_columns(path, table, read_header(path, HEADER))
    times_ns = _times_ns(path, table)
    still = np.zeros(len(times_ns))
    try:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    return pose_table(
        path.name,
        {"name": path.name, "sha256": digest},
        times_ns,
        table["yaw"],
        table.get("x", still),
        table.get("y", still),
    )


def _check_columns(path: Path, table: Table, header: Sequence[str]) -> None:
    """Raise SonarrecError if there are no times, or positions that cannot be read."""
    if not {"timestamp", "timestamp_ns"} & table.keys():
        raise SonarrecError(
            f"{path}: wrong columns, neither timestamp nor timestamp_ns; "
            f"expected a header such as {HEADER}"
        )
    if ("x" in table) != ("y" in table):
        raise SonarrecError(f"{path}: x and y go together; give both or neither")
    alike = [name for name in header if name.lower() in LOOK_ALIKE]
    if "x" not in table and alike:
        raise SonarrecError(
            f"{path}: no position can be read from the columns {', '.join(alike)}: expected x,y "
            "in metres (sonarrec help poses); rename them, or drop them if the sonar only turns"
        )


def _times_ns(path: Path, table: Table) -> IntArray:
    """(rows,) times in ns. Raises SonarrecError if they are all one, or in another unit."""
    times: np.ndarray = table["timestamp_ns" if "timestamp_ns" in table else "timestamp"]
    steps = np.diff(np.unique(times))
    if not len(steps):
        raise SonarrecError(f"{path}: a motion needs rows at two times or more")
    if "timestamp_ns" in table:
        return np.asarray(times, np.int64)
    step = float(np.median(steps))
    if SECONDS_BELOW <= step < NANOSECONDS_FROM:
        raise SonarrecError(
            f"{path}: timestamp must be seconds or nanoseconds; rows {step:g} apart are "
            "neither (milliseconds or microseconds?); name nanoseconds timestamp_ns"
        )
    times = np.rint(times * 1e9 if step < SECONDS_BELOW else times)
    if np.abs(times).max() >= 2**63:
        raise SonarrecError(
            f"{path}: timestamp must be seconds or nanoseconds; these are neither (milliseconds?)"
        )
    return np.asarray(times, np.int64)
