"""The sonar's path over one log, and how its error grows along it.

Every step has an error of its own: a shift, and a rotation about the sonar's position at that time.
The rotation moves all positions that are seen later, the far ones most. Measured motion also has a
scale error, which is common to all steps. Sums over the steps give the error of a position in any
frame, or of one relative to another, in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import Diagnostics, SonarrecError, listed, number_of
from sonarrec.sonar.geometry import PoseTable
from sonarrec.stretches import MOST_LISTED, stretches_of
from sonarrec.tables.read import Kind, Table, read_table

# Standard errors that are common to all steps of measured motion, as a share of the motion. Lengths
# depend on the stated height and on a flat floor. The rotation of a standing sonar is measured
# across the beams only, with a bias towards whole beams (up to 4 % on tuning seeds).
COMMON_LENGTH, COMMON_ROTATION = 0.006, 0.03

FRAMES = "frame,timestamp_ns,dx_m,dy_m,dyaw_deg,dx_sigma_m,dy_sigma_m,dyaw_sigma_deg"
MOVED = ("dyaw_deg", "dx_m", "dy_m")
MOVED_SIGMA = ("dyaw_sigma_deg", "dx_sigma_m", "dy_sigma_m")
"""Columns of frames.csv with the measured motion since the previous frame, and its standard errors:
rotation to the right, shift to the right, shift ahead, in the axes of the previous frame."""


@dataclass(frozen=True, slots=True)
class Drift:
    """Standard error of given poses after one minute; it grows with the square root of the time."""

    position_m: float = 0.0
    """Of the position, along each axis."""
    yaw_deg: float = 0.0
    """Of the heading."""


NO_DRIFT = Drift()


@dataclass(frozen=True, slots=True, eq=False)
class SonarPath:
    """Where the sonar was in every frame of one log, or of a part of it."""

    frame: IntArray
    """(F,) numbers, rising."""
    timestamp_ns: IntArray
    stretch: IntArray
    """timestamp_ns, stretch: (F,) as in Frame."""
    pose: FloatArray
    """(F, 3) yaw (deg, positive to the right), x and y (m; to the right and ahead of a sonar whose
    yaw is 0); NaN if not known."""
    from_poses: bool
    """Whether the path comes from a table or topic of poses; else it was measured, from the first
    frame on."""
    sums: FloatArray
    """(F, 9) over the steps up to each frame, see `_sums`."""
    common: FloatArray
    """(F, 3) sums over the rotations of a measured path while the sonar stood: of the rotation
    (rad), and of the rotation times x and times y."""
    origin: FloatArray
    """(2,) the first known position. In the sums, x and y are relative to it, since squares of
    large coordinates, such as UTM's, would leave few digits."""

    @property
    def known(self) -> IntArray:
        """(n,) the frames, as indices, whose poses are known."""
        return np.flatnonzero(np.isfinite(self.pose).all(axis=1))

    def position_covariance(
        self, row: IntArray, position: FloatArray, since: IntArray | None = None
    ) -> FloatArray:
        """(n, 2, 2) covariance that the path's error adds to what is seen in some frames, m^2.

        row: (n,) indices of the frames. position: (n, 2) m. since: (n,) frames, earlier or later,
        relative to which the error counts; None: the beginning of the path.
        """
        s = self._between(row, since)
        x, y = (position - self.origin).T
        xx = s[:, 0] + s[:, 3] * y**2 - 2 * y * s[:, 5] + s[:, 8]
        xy = s[:, 1] - s[:, 3] * x * y + x * s[:, 5] + y * s[:, 4] - s[:, 7]
        yy = s[:, 2] + s[:, 3] * x**2 - 2 * x * s[:, 4] + s[:, 6]
        own = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
        if self.from_poses:
            return own
        began = np.zeros_like(row) if since is None else since
        length = COMMON_LENGTH * (self.pose[row, 1:] - self.pose[began, 1:])
        angle, at_x, at_y = (COMMON_ROTATION * (self.common[row] - self.common[began])).T
        rotated = np.column_stack([angle * y - at_y, at_x - angle * x])
        return np.asarray(own + sum(e[:, :, None] * e[:, None] for e in (length, rotated)))

    def yaw_variance(self, row: IntArray, since: IntArray | None = None) -> FloatArray:
        """(n,) variance of the heading, deg^2. The arguments are as in `position_covariance`."""
        common = self.common[row, 0] - (0 if since is None else self.common[since, 0])
        variance = self._between(row, since)[:, 3] + (COMMON_ROTATION * common) ** 2
        return np.asarray(np.degrees(np.degrees(variance)))

    def _between(self, row: IntArray, since: IntArray | None) -> FloatArray:
        """(n, 9) sums over the steps between two frames, or from the beginning of the path."""
        if since is None:
            return np.asarray(self.sums[row])
        return np.asarray(self.sums[np.maximum(row, since)] - self.sums[np.minimum(row, since)])


def path_from_poses(
    frame: IntArray, timestamp_ns: IntArray, stretch: IntArray, poses: PoseTable, drift: Drift
) -> SonarPath:
    """The path that poses give. frame, timestamp_ns, stretch: (F,).

    Drift begins at the first known pose.
    """
    pose = poses.poses_at(timestamp_ns)
    first = int(np.isfinite(pose).all(axis=1).argmax())
    minutes = np.maximum(np.diff(timestamp_ns, prepend=timestamp_ns[:1]) / 60e9, 0)
    minutes[: first + 1] = 0
    shift, rotation = minutes * drift.position_m**2, minutes * math.radians(drift.yaw_deg) ** 2
    origin = np.nan_to_num(pose[first, 1:])
    sums = _sums(pose[:, 1:] - origin, np.column_stack([shift, 0 * shift, shift]), rotation)
    return SonarPath(
        frame, timestamp_ns, stretch, pose, True, sums, np.zeros((len(frame), 3)), origin
    )


def measured_path(
    frame: IntArray,
    timestamp_ns: IntArray,
    stretch: IntArray,
    moved: FloatArray,
    sigma: FloatArray,
) -> SonarPath:
    """The path of a sonar whose motion was measured. It starts at 0 and ends at unknown motion.

    frame, timestamp_ns, stretch: (F,). moved: (F, 3) the motion to each frame from the one before,
    as in MOVED; NaN if not known. sigma: (F, 3) its standard errors. Those of the first frame are
    not used.
    """
    moved, sigma = moved.copy(), sigma.copy()
    moved[:1] = sigma[:1] = 0
    yaw = np.cumsum(moved[:, 0])
    before = np.radians(np.concatenate([yaw[:1], yaw[:-1]]))
    cos, sin = np.cos(before), np.sin(before)
    x = np.cumsum(moved[:, 1] * cos + moved[:, 2] * sin)
    y = np.cumsum(moved[:, 2] * cos - moved[:, 1] * sin)
    right, ahead = sigma[:, 1] ** 2, sigma[:, 2] ** 2
    xx, yy = right * cos**2 + ahead * sin**2, right * sin**2 + ahead * cos**2
    shift = np.column_stack([xx, (ahead - right) * sin * cos, yy])
    pose = np.column_stack([yaw, x, y])
    sums = _sums(pose[:, 1:], shift, np.radians(sigma[:, 0]) ** 2)
    rotation = np.where((moved[:, 1:] == 0).all(axis=1), np.radians(moved[:, 0]), 0.0)
    moments = np.column_stack([np.ones(len(x)), x, y])
    common = np.cumsum(rotation[:, None] * moments, axis=0)
    return SonarPath(frame, timestamp_ns, stretch, pose, False, sums, common, np.zeros(2))


def _sums(position: FloatArray, shift: FloatArray, rotation: FloatArray) -> FloatArray:
    """(F, 9) sums over the steps so far, for the closed forms of SonarPath.

    They are: xx, xy, yy of the shifts' covariance (F, 3); the rotations' variance (F,), rad^2; and
    that variance times x, y, xx, xy, yy of the last known position, relative to the origin.
    """
    known = np.isfinite(position).all(axis=1)
    last = np.maximum.accumulate(np.where(known, np.arange(len(position)), 0))
    x, y = np.nan_to_num(position[last]).T
    moments = (rotation * m for m in (1, x, y, x * x, x * y, y * y))
    return np.asarray(np.cumsum(np.column_stack([shift, *moments]), axis=0))


def read_frames(folder: Path) -> Table:
    """frames.csv of a log's results, one row for each frame number, rising.

    Raises SonarrecError if it cannot be read or if no frame was processed.
    """
    kinds: dict[str, Kind] = dict.fromkeys(("frame", "timestamp_ns", "stretch"), "whole")
    kinds |= dict.fromkeys((*MOVED, *MOVED_SIGMA), "blank or number")
    table = read_table(folder / "frames.csv", kinds, ("frame",), FRAMES)
    if not len(table["frame"]):
        raise SonarrecError(f"{folder}: no frame was processed")
    _, first = np.unique(table["frame"], return_index=True)
    rows = {name: column[first] for name, column in table.items()}
    return rows | {"stretch": stretches_of(rows)}


def measured_motion_paths(folder: Path, table: Table, diagnostics: Diagnostics) -> list[SonarPath]:
    """The paths by the measured motion. table: from `read_frames`.

    One begins with the first frame, and one with each stretch whose first step is not known: only
    poses give that, and they have no standard errors.
    Raises SonarrecError if no motion was measured.
    """
    missing = [name for name in ("dyaw_deg", "dyaw_sigma_deg") if name not in table]
    if missing or not np.isfinite(table["dyaw_deg"]).any():
        reason = ", ".join(missing) or "dyaw_deg is empty"
        raise SonarrecError(
            f"{folder}: neither poses nor measured motion ({reason} in frames.csv); "
            "run the log with --odometry, or give it here"
        )
    frame = table["frame"]
    still = np.zeros(len(frame), np.int64)
    moved, sigma = (
        np.column_stack([table.get(name, still) for name in names])
        for names in (MOVED, MOVED_SIGMA)
    )
    # Motion from poses has no standard errors.
    by_poses = np.isfinite(moved).all(axis=1) & ~np.isfinite(sigma[:, 0])
    sigma = np.where(np.isfinite(moved), np.nan_to_num(sigma), np.nan)
    times = table.get("timestamp_ns", still)
    begins = np.diff(table["stretch"], prepend=0).astype(bool) & ~by_poses
    first = np.flatnonzero(begins)
    if len(first):
        diagnostics.note(
            f"{folder}: the motion over {number_of(len(first), 'pause')} is not known; each begins "
            f"a path with axes of its own, at frame {listed(frame[first].tolist(), MOST_LISTED)}"
        )
    paths = []
    for part in map(slice, [0, *first.tolist()], [*first.tolist(), len(frame)]):
        path = measured_path(
            frame[part], times[part], table["stretch"][part], moved[part], sigma[part]
        )
        unknown = ~np.isfinite(path.pose).all(axis=1)
        if unknown.any():
            diagnostics.note(
                f"{folder}: the motion to frame {path.frame[np.argmax(unknown)]} is not known; "
                "what was seen from there on is not placed"
            )
        paths.append(path)
    return paths
