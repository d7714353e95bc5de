"""Where the sonar was, from a table or a topic of the log.

Positions and headings are the sonar's own on the floor. Only differences between rows count, so
the origin and the direction of zero are free.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.nouns import Motion

GAP = 10
"""There is no pose between rows that are more than this many usual steps apart."""


@dataclass(frozen=True, slots=True)
class PoseTable:
    """The sonar's poses at rising times; between two rows they follow a straight line.

    name: in messages. source: what run.toml says of it. at: (N,) ns. pose: (N, 3) yaw in deg,
    positive to the right (clockwise seen from above) and without jumps of 360, then x and y, the
    place on the floor in m, y ahead and x to the right of a sonar whose yaw is 0. gap_ns: between
    two rows that are farther apart there is no pose. problems: a line for each row that could not
    be used. axes: the directions of x and y in the user's own table at yaw 0; in `pose` they are
    always right and ahead.
    """

    name: str
    source: Mapping[str, str]
    at: IntArray
    pose: FloatArray
    gap_ns: float
    problems: tuple[str, ...] = ()
    axes: Literal["right, ahead", "ahead, left"] = "right, ahead"

    def covers(self, time_ns: int) -> bool:
        """Whether the pose at a time is known: from the first row to the last, but not in a gap."""
        return self._at(time_ns) is not None

    def at_times(self, times_ns: IntArray) -> FloatArray:
        """(N, 3) the poses at (N,) times, in the form of `pose`; NaN if not known."""
        after = np.clip(np.searchsorted(self.at, times_ns), 1, len(self.at) - 1)
        step = (self.at[after] - self.at[after - 1]).astype(float)
        share = ((times_ns - self.at[after - 1]) / step)[:, None]
        found = self.pose[after - 1] * (1 - share) + self.pose[after] * share
        exact = (share[:, 0] == 0) | (share[:, 0] == 1)
        known = (
            (times_ns >= self.at[0]) & (times_ns <= self.at[-1]) & ((step <= self.gap_ns) | exact)
        )
        return np.where(known[:, None], found, np.nan)

    def motion(self, before_ns: int, now_ns: int) -> Motion | None:
        """How the sonar moved between two times; None if either pose is not known."""
        before, now = self._at(before_ns), self._at(now_ns)
        if before is None or now is None:
            return None
        pan_deg, right, ahead = (now - before).tolist()
        heading = math.radians(before[0])
        cos, sin = math.cos(heading), math.sin(heading)
        return Motion(pan_deg, right * cos - ahead * sin, right * sin + ahead * cos)

    def place(self, time_ns: int, right_m: float, ahead_m: float) -> tuple[float, float] | None:
        """(x, y) in m, in the table's own axes, of a place right_m to the right and ahead_m ahead.

        None if the pose is not known.
        """
        pose = self._at(time_ns)
        if pose is None:
            return None
        yaw_deg, x, y = pose.tolist()
        cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
        right, ahead = x + right_m * cos + ahead_m * sin, y - right_m * sin + ahead_m * cos
        return (ahead, -right) if self.axes == "ahead, left" else (right, ahead)

    def _at(self, time_ns: int) -> FloatArray | None:
        """(3,) the pose at a time; None if not known."""
        after = int(np.searchsorted(self.at, time_ns))
        if after == len(self.at) or time_ns < self.at[0]:
            return None
        if self.at[after] == time_ns:
            return np.asarray(self.pose[after])
        step = self.at[after] - self.at[after - 1]
        if step > self.gap_ns:
            return None
        share = (time_ns - self.at[after - 1]) / step
        return np.asarray(self.pose[after - 1] * (1 - share) + self.pose[after] * share)


def pose_table(
    name: str,
    source: Mapping[str, str],
    at: IntArray,
    yaw_deg: FloatArray,
    x_m: FloatArray,
    y_m: FloatArray,
) -> PoseTable:
    """A PoseTable of poses at two times or more, in any order; of several at one time the first
    counts."""
    at, first = np.unique(at, return_index=True)
    pose = np.column_stack([np.unwrap(yaw_deg[first], period=360), x_m[first], y_m[first]])
    return PoseTable(name, source, at, pose, GAP * float(np.median(np.diff(at))))
