"""The sonar's path over one log, and how its error grows along it.

Every step has an error of its own: a shift, and a turn about the sonar's place at that time. The
turn moves all places that are seen later, the far ones most. Measured motion also has an error that
is common to all steps: each is too long or too short by the same share. Sums over the steps give
the error of a place in any frame, or of one place relative to another, in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.poses import PoseTable

# Standard errors that are common to all steps of measured motion, as a share of the motion. Lengths
# depend on the stated height and on the floor being flat. The turn of a sonar that stands is
# measured across the beams only, with a bias towards whole beams (up to 4 % on tuning seeds).
COMMON_LENGTH, COMMON_TURN = 0.006, 0.03


@dataclass(frozen=True, slots=True)
class Drift:
    """Standard error of given poses after one minute; it grows with the square root of the time.

    place_m: of the place, along each axis. yaw_deg: of the heading.
    """

    place_m: float = 0.0
    yaw_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class SonarPath:
    """Where the sonar was in every frame of one log.

    frame: (F,) numbers, rising. timestamp_ns: (F,). pose: (F, 3) yaw (deg, positive to the right),
    x and y (m; to the right and ahead of a sonar whose yaw is 0); NaN if not known. from_poses:
    whether the path comes from a table or topic of poses; else it was measured, from the first
    frame on. sums: (F, 9) over the steps up to each frame, see `_sums`. common: (F, 3) sums over
    the turns of a measured path while the sonar stood: of the turn (rad), and of the turn times x
    and times y. origin: (2,) the first known place. In the sums, x and y are relative to it, since
    squares of large coordinates, such as UTM's, would leave few digits.
    """

    frame: IntArray
    timestamp_ns: IntArray
    pose: FloatArray
    from_poses: bool
    sums: FloatArray
    common: FloatArray
    origin: FloatArray

    def place_covariance(
        self, row: IntArray, place: FloatArray, since: IntArray | None = None
    ) -> FloatArray:
        """(n, 2, 2) covariance that the path's error adds to places seen in some frames, m^2.

        row: (n,) indices of the frames. place: (n, 2) m. since: (n,) frames, earlier or later,
        relative to which the error counts; None: the beginning of the path.
        """
        s = self._between(row, since)
        x, y = (place - self.origin).T
        xx = s[:, 0] + s[:, 3] * y**2 - 2 * y * s[:, 5] + s[:, 8]
        xy = s[:, 1] - s[:, 3] * x * y + x * s[:, 5] + y * s[:, 4] - s[:, 7]
        yy = s[:, 2] + s[:, 3] * x**2 - 2 * x * s[:, 4] + s[:, 6]
        own = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
        if self.from_poses:
            return own
        began = np.zeros_like(row) if since is None else since
        length = COMMON_LENGTH * (self.pose[row, 1:] - self.pose[began, 1:])
        turned = self._turned(row, began, place)[:, :2]
        return np.asarray(own + sum(e[:, :, None] * e[:, None] for e in (length, turned)))

    def _turned(self, row: IntArray, since: IntArray, place: FloatArray) -> FloatArray:
        """(n, 3) by how much COMMON_TURN moves a place (x, y in m) and turns the heading (rad).

        The arguments are as in `place_covariance`.
        """
        turn, at_x, at_y = (COMMON_TURN * (self.common[row] - self.common[since])).T
        x, y = (place - self.origin).T
        return np.column_stack([turn * y - at_y, at_x - turn * x, turn])

    def yaw_variance(self, row: IntArray, since: IntArray | None = None) -> FloatArray:
        """(n,) variance of the heading, deg^2. The arguments are as in `place_covariance`."""
        common = self.common[row, 0] - (0 if since is None else self.common[since, 0])
        variance = self._between(row, since)[:, 3] + (COMMON_TURN * common) ** 2
        return np.asarray(np.degrees(np.degrees(variance)))

    def _between(self, row: IntArray, since: IntArray | None) -> FloatArray:
        """(n, 9) sums over the steps between two frames, or from the beginning of the path."""
        if since is None:
            return np.asarray(self.sums[row])
        return np.asarray(self.sums[np.maximum(row, since)] - self.sums[np.minimum(row, since)])

    def step_covariance(self, before: int, after: int) -> FloatArray:
        """(3, 3) covariance of the pose in one frame relative to that in an earlier one.

        It is of x, y (m) and yaw (rad), in the path's axes.
        """
        place = self.pose[[after], 1:]
        s = self.sums[after] - self.sums[before]
        x, y = place[0] - self.origin
        cross = np.array([s[3] * y - s[5], -(s[3] * x - s[4])])
        rows = np.array([after]), np.array([before])
        turned = self._turned(*rows, place)[0]
        covariance = np.empty((3, 3))
        covariance[:2, :2] = self.place_covariance(rows[0], place, rows[1])[0]
        covariance[2, :2] = covariance[:2, 2] = cross + turned[:2] * turned[2]
        covariance[2, 2] = s[3] + turned[2] ** 2
        return covariance


def path_from_poses(
    frame: IntArray, timestamp_ns: IntArray, poses: PoseTable, drift: Drift
) -> SonarPath:
    """The path that poses give. frame, timestamp_ns: (F,). Drift begins at the first known pose."""
    pose = poses.at_times(timestamp_ns)
    minutes = np.diff(timestamp_ns, prepend=timestamp_ns[:1]) / 60e9
    first = int(np.isfinite(pose).all(axis=1).argmax())
    minutes[: first + 1] = 0
    shift = np.maximum(minutes, 0) * drift.place_m**2
    turn = np.maximum(minutes, 0) * math.radians(drift.yaw_deg) ** 2
    even = np.column_stack([shift, 0 * shift, shift])
    none = np.zeros((len(frame), 3))
    origin = np.nan_to_num(pose[first, 1:])
    sums = _sums(pose[:, 1:] - origin, even, turn)
    return SonarPath(frame, timestamp_ns, pose, True, sums, none, origin)


def measured_path(
    frame: IntArray, timestamp_ns: IntArray, moved: FloatArray, sigma: FloatArray
) -> SonarPath:
    """The path of a sonar whose motion was measured. It starts at 0 and ends at unknown motion.

    frame, timestamp_ns: (F,). moved: (F, 3) the motion to each frame from the one before: turn
    (deg, positive to the right), and shift to the right and ahead (m), in the axes of the sonar
    before; NaN if not known. sigma: (F, 3) their standard errors. Those of the first frame are not
    used.
    """
    moved, sigma = moved.copy(), sigma.copy()
    moved[:1] = sigma[:1] = 0
    yaw = np.cumsum(moved[:, 0])
    before = np.radians(np.concatenate([yaw[:1], yaw[:-1]]))
    cos, sin = np.cos(before), np.sin(before)
    x = np.cumsum(moved[:, 1] * cos + moved[:, 2] * sin)
    y = np.cumsum(moved[:, 2] * cos - moved[:, 1] * sin)
    pose = np.column_stack([yaw, x, y])
    right, ahead = sigma[:, 1] ** 2, sigma[:, 2] ** 2
    shift = np.column_stack(
        [
            right * cos**2 + ahead * sin**2,
            (ahead - right) * sin * cos,
            right * sin**2 + ahead * cos**2,
        ]
    )
    stood = (moved[:, 1:] == 0).all(axis=1)
    turns = np.where(stood, np.radians(moved[:, 0]), 0.0)
    at = np.column_stack([np.ones(len(x)), x, y])
    return SonarPath(
        frame,
        timestamp_ns,
        pose,
        False,
        _sums(pose[:, 1:], shift, np.radians(sigma[:, 0]) ** 2),
        np.cumsum(turns[:, None] * at, axis=0),
        np.zeros(2),
    )


def _sums(place: FloatArray, shift: FloatArray, turn: FloatArray) -> FloatArray:
    """(F, 9) running sums over the steps, for the closed forms of SonarPath.

    They are: xx, xy, yy of the shifts' covariance; the turns' variance (rad^2); and that variance
    times x, y, xx, xy, yy of the sonar's place. place: (F, 2) relative to the origin; if NaN, the
    step turns about the last known place. shift: (F, 3) and turn: (F,) variances of the step to
    each frame; 0 up to the first known place.
    """
    known = np.isfinite(place).all(axis=1)
    last = np.maximum.accumulate(np.where(known, np.arange(len(place)), 0))
    x, y = np.nan_to_num(place[last]).T
    steps = np.column_stack(
        [shift, turn, turn * x, turn * y, turn * x * x, turn * x * y, turn * y * y]
    )
    return np.asarray(np.cumsum(steps, axis=0))
