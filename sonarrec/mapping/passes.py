"""The passes of one log, placed on the floor. A pass is a landmark as one track declared it.

A pass counts as about one measurement, not as one per frame: a track remembers earlier frames, and
the speckle of a static disc is the same in all of them. So a share of the errors counts as common
to the whole pass, and the rest as common to SAME_FRAMES frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import SonarrecError
from sonarrec.geometry import floor_depth, ground_range
from sonarrec.landmarks import LandmarkSet
from sonarrec.mapping.path import SonarPath
from sonarrec.nouns import Fan
from sonarrec.results.read import estimate_tables
from sonarrec.results.sightings import PASS_GAP, ROWS
from sonarrec.results.stream import SIGMAS, positions
from sonarrec.tables.read import line_number

# How errors are correlated within a pass, chosen on tuning seeds.
COMMON_SHARE = 0.5  # share of the variance that is common to all frames of a pass
SAME_FRAMES = 6.0  # number of frames over which the rest of the error is the same
# Standard errors in addition to those of the frames, since rings are uneven and sonars heave. They
# are independent from pass to pass.
LEAST_POSITION_M = 0.003
LEAST_ORIENTATION_DEG = 1.0
ORIENTATION_SIGMA_DEG = 2.7
"""Standard error of the orientation that is common to all passes of a landmark, since the beam
smears its symbol."""
HEIGHT_SIGMA_M = 0.015
"""Standard error of the stated height above the floor. It is common to all passes: however often a
landmark is seen from one side, its shift is the same."""
UNSTATED = (0.03, 0.5, 10.0)
"""Standard errors for methods that state none: slant range (m), bearing and orientation (deg)."""


@dataclass(frozen=True, slots=True)
class DeclaredEstimates:
    """The declared estimates of one method in one log, n of them.

    row: (n,) index of the frame in the path. landmark: (n,) IDs. track: (n,) 0 or more. score:
    (n,). polar: (n, 3) slant range (m), bearing and orientation (deg, as in estimates.csv; NaN if
    not known). sigma: (n, 3) their standard errors. strays: number of further declared estimates,
    on frames that frames.csv does not list.
    """

    row: IntArray
    landmark: IntArray
    track: IntArray
    score: FloatArray
    polar: FloatArray
    sigma: FloatArray
    strays: int


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """One pass of m estimates, placed on the floor.

    score: the mean. row: (m,) frames as indices of the path, rising. polar, sigma: (m, 3) as in
    DeclaredEstimates. position: (2,) x, y in the path's axes, m. covariance: (2, 2) of the
    position, without the path's error, m^2. lean: (2,) derivative of the position by the sonar's
    height. orientation_deg: where the first sector begins, counter-clockwise from the x axis; NaN
    if not known. orientation_sigma_deg: its standard error. near_m, far_m: least and largest ground
    range. drift, drift_yaw: covariance (2, 2) of the position, m^2, and variance of the heading,
    deg^2, by the path's error so far.
    """

    landmark: int
    track: int
    score: float
    row: IntArray
    polar: FloatArray
    sigma: FloatArray
    position: FloatArray
    covariance: FloatArray
    lean: FloatArray
    orientation_deg: float
    orientation_sigma_deg: float
    near_m: float
    far_m: float
    drift: FloatArray
    drift_yaw: float

    @property
    def middle(self) -> int:
        """The frame in the middle, as an index of the path."""
        return int(self.row[len(self.row) // 2])


def read_declared(
    path: Path, method: str, landmarks: LandmarkSet, fan: Fan, frame: IntArray
) -> DeclaredEstimates:
    """The declared estimates of a method. frame: (F,) the numbers in frames.csv, rising.

    Raises SonarrecError if the table cannot be read, or if a declared estimate has no position or
    no track.
    """
    parts: list[FloatArray] = [np.empty((0, 10))]
    strays = 0
    for first, table in estimate_tables(path, landmarks, ROWS):
        declared = np.asarray(table["method"] == method) & table["declared"]
        listed = np.isin(table["frame"], frame)
        strays += int(np.count_nonzero(declared & ~listed))
        chosen = np.flatnonzero(declared & listed)
        blank = np.full(len(declared), np.nan)
        names = ("frame", "landmark", "object", "score")
        measured = [table.get(name, blank) for name in ("orientation_deg", *SIGMAS)]
        columns = [*(table.get(n, blank) for n in names), *positions(table, fan)[2:], *measured]
        rows = np.column_stack(columns)[chosen]
        if not (rows[:, 2] >= 0).all():  # two landmarks of one ID could not be kept apart
            raise SonarrecError(
                f"{path}: a track needs object; not every declared row of {method} has it"
            )
        lacking = ~np.isfinite(rows[:, 4:6]).all(axis=1)
        if lacking.any():
            line = line_number(path, first + int(chosen[np.argmax(lacking)]))
            raise SonarrecError(
                f"{path} line {line}: no position: neither x_px,y_px nor range_m,bearing_deg"
            )
        parts.append(rows)
    rows = np.concatenate(parts)
    number, landmark, track = rows[:, :3].astype(np.int64).T
    sigma, row = np.where(rows[:, 7:] > 0, rows[:, 7:], UNSTATED), np.searchsorted(frame, number)
    return DeclaredEstimates(row, landmark, track, rows[:, 3], rows[:, 4:7], sigma, strays)


def find_passes(
    estimates: DeclaredEstimates, path: SonarPath, landmarks: LandmarkSet, fan: Fan
) -> list[Pass]:
    """The passes of a log, placed on the floor, in order of their first frames.

    Estimates are left out if their frame has no pose, or if they are nearer than the floor.
    """
    ground = ground_range(fan, estimates.polar[:, 0])
    usable = np.isfinite(path.pose[estimates.row]).all(axis=1) & (ground > 0)
    order = np.lexsort([estimates.row, estimates.track, estimates.landmark])
    order = order[usable[order]]
    landmark, track = estimates.landmark[order], estimates.track[order]
    gap = np.diff(path.frame[estimates.row[order]])
    ends = (np.diff(landmark) != 0) | (np.diff(track) != 0) | (gap > PASS_GAP)
    periods_deg = dict(zip(landmarks.ids, landmarks.periods_deg().tolist(), strict=True))
    passes = [
        _placed(estimates, one, path, periods_deg[int(estimates.landmark[one[0]])], fan)
        for one in np.split(order, np.flatnonzero(ends) + 1)
        if len(one)
    ]
    return sorted(passes, key=lambda found: int(found.row[0]))


def _placed(
    estimates: DeclaredEstimates, chosen: IntArray, path: SonarPath, period_deg: float, fan: Fan
) -> Pass:
    """One pass on the floor: the weighted mean of its estimates (m,), with its covariance."""
    row, polar, sigma = estimates.row[chosen], estimates.polar[chosen], estimates.sigma[chosen]
    slant, bearing, orientation = polar.T
    ground = ground_range(fan, slant)
    yaw, x, y = path.pose[row].T
    sight = np.radians(yaw + bearing)
    along = np.column_stack([np.sin(sight), np.cos(sight)])
    across = np.column_stack([np.cos(sight), -np.sin(sight)])
    # (m, 2, 2): columns are one standard error along and across the line of sight. Ground range
    # grows with slant range by the inverse of the grazing angle's cosine.
    errors = np.stack(
        [
            along * (sigma[:, 0] * slant / ground)[:, None],
            across * (ground * np.radians(sigma[:, 1]))[:, None],
        ],
        axis=-1,
    )
    weight = 1 / (errors**2).sum(axis=(1, 2))
    weight /= weight.sum()
    common = (weight[:, None, None] * errors).sum(axis=0)
    own = (weight[:, None, None] ** 2 * (errors @ errors.transpose(0, 2, 1))).sum(axis=0)
    covariance = COMMON_SHARE * common @ common.T
    covariance += (1 - COMMON_SHARE) * min(SAME_FRAMES, len(row)) * own
    covariance += LEAST_POSITION_M**2 * np.eye(2)
    position = (weight[:, None] * (np.column_stack([x, y]) + ground[:, None] * along)).sum(axis=0)
    direction, direction_sigma = _mean_orientation(orientation - yaw, sigma[:, 2], period_deg)
    middle = row[[len(row) // 2]]
    return Pass(
        landmark=int(estimates.landmark[chosen[0]]),
        track=int(estimates.track[chosen[0]]),
        score=float(estimates.score[chosen].mean()),
        row=row,
        polar=polar,
        sigma=sigma,
        position=position,
        covariance=covariance,
        lean=(weight[:, None] * along * (-floor_depth(fan) / ground)[:, None]).sum(axis=0),
        orientation_deg=direction,
        orientation_sigma_deg=direction_sigma,
        near_m=float(ground.min()),
        far_m=float(ground.max()),
        drift=path.position_covariance(middle, position[None])[0],
        drift_yaw=float(path.yaw_variance(middle)[0]),
    )


def _mean_orientation(
    orientation_deg: FloatArray, sigma_deg: FloatArray, period_deg: float
) -> tuple[float, float]:
    """The mean orientation on the floor, and its standard error, deg; NaN if not known.

    orientation_deg, sigma_deg: (m,). period_deg: the rotation after which the symbol looks the
    same; NaN if it does after every one. The mean is below it.
    """
    angle = np.exp(1j * np.radians(orientation_deg * (360 / period_deg)))
    known = np.isfinite(angle)
    weight = 1 / sigma_deg[known] ** 2
    mean = (weight * angle[known]).sum()
    if abs(mean) == 0:
        return np.nan, np.nan
    total = weight.sum()
    variance = (
        COMMON_SHARE * ((weight * sigma_deg[known]).sum() / total) ** 2
        + (1 - COMMON_SHARE) * min(SAME_FRAMES, len(orientation_deg)) / total
        + LEAST_ORIENTATION_DEG**2
    )
    direction = (np.degrees(np.angle(mean)) % 360) * period_deg / 360
    return float(direction), float(np.sqrt(variance))
