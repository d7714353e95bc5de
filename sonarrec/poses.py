"""Where the sonar was, told by a table: `sonarrec run --odometry`.

Positions and headings are the sonar's own on the floor. Only differences between rows count, so
the origin and the direction of zero are free.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sonarrec.records import FloatArray, Motion, SonarrecError

HEADER = "timestamp,yaw,x,y"
# Between rows, in the median: 10,000 s are hours and 10,000 ns a hundredth of a millisecond.
NANOSECONDS_FROM = 10_000
# Longer than so many times the usual time between rows, nobody measured in between.
GAP = 10


@dataclass(frozen=True, slots=True)
class PoseTable:
    """The sonar's poses at rising times; between two rows they follow a straight line.

    name: in messages. source: what run.toml says of it. at: (N,) ns. yaw_deg: (N,) heading,
    positive to the right (clockwise seen from above), without jumps of 360. x_m, y_m: (N,) place
    on the floor, y ahead and x to the right of a sonar whose yaw is 0.
    """

    name: str
    source: Mapping[str, str]
    at: npt.NDArray[np.int64]
    yaw_deg: FloatArray
    x_m: FloatArray
    y_m: FloatArray

    def covers(self, time_ns: int) -> bool:
        """Whether the pose at a time is told: not before the first row, after the last or in a gap
        of more than GAP times the usual step."""
        after = int(np.searchsorted(self.at, time_ns))
        if after == len(self.at) or time_ns < self.at[0]:
            return False
        if self.at[after] == time_ns:
            return True
        steps = np.diff(self.at)
        return bool(steps[after - 1] <= GAP * np.median(steps))

    def motion(self, before_ns: int, now_ns: int) -> Motion | None:
        """How the sonar moved between two times; None where either is not covered."""
        if not (self.covers(before_ns) and self.covers(now_ns)):
            return None
        # Whole nanoseconds since 1970 do not fit a float; since the first row they do.
        times = np.array([before_ns, now_ns]) - self.at[0]
        yaw, x, y = (
            np.interp(times, self.at - self.at[0], column)
            for column in (self.yaw_deg, self.x_m, self.y_m)
        )
        heading = math.radians(yaw[0])
        right, ahead = x[1] - x[0], y[1] - y[0]
        return Motion(
            pan_deg=float(yaw[1] - yaw[0]),
            right_m=float(right * math.cos(heading) - ahead * math.sin(heading)),
            ahead_m=float(right * math.sin(heading) + ahead * math.cos(heading)),
        )


def pose_table(
    name: str,
    source: Mapping[str, str],
    at: npt.NDArray[np.int64],
    yaw_deg: FloatArray,
    x_m: FloatArray,
    y_m: FloatArray,
) -> PoseTable:
    """A PoseTable of poses in any order; of several at one time the first counts."""
    at, first = np.unique(at, return_index=True)
    yaw_deg = np.unwrap(yaw_deg[first], period=360)
    return PoseTable(name, source, at, yaw_deg, x_m[first], y_m[first])


def read_poses(path: Path) -> PoseTable:
    """Read a CSV table with a header such as HEADER; x and y together or not at all.

    timestamp_ns is in nanoseconds; timestamp is in seconds, or in nanoseconds where its rows are
    NANOSECONDS_FROM or more apart in the median. Rows may come in any order; of several at one
    time the first counts. Raises SonarrecError where the table cannot be used.
    """
    # With pandas, which only runs with such a table need.
    from sonarrec.evaluation.tables import Kind, read_table

    kinds: dict[str, Kind] = dict.fromkeys(("timestamp", "yaw", "x", "y"), "number")
    table = read_table(path, {"timestamp_ns": "whole", **kinds}, ("yaw",), HEADER)
    if "timestamp_ns" in table:
        at = table["timestamp_ns"]
    elif "timestamp" in table:
        at = table["timestamp"]
    else:
        raise SonarrecError(
            f"{path}: wrong columns, neither timestamp nor timestamp_ns; "
            f"expected a header such as {HEADER}"
        )
    if ("x" in table) != ("y" in table):
        raise SonarrecError(f"{path}: x and y go together; give both or neither")
    steps = np.diff(np.unique(at))
    if not len(steps):
        raise SonarrecError(f"{path}: a motion needs rows at two times or more")
    if "timestamp_ns" not in table:
        seconds = np.median(steps) < NANOSECONDS_FROM
        at = np.rint(at * 1e9 if seconds else at).astype(np.int64)
    still = np.zeros(len(at))
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    return pose_table(
        path.name,
        {"name": path.name, "sha256": digest},
        at,
        table["yaw"],
        table.get("x", still),
        table.get("y", still),
    )
