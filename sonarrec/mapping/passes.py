"""The passes of one log, placed on the floor. A pass is a landmark as one track declared it.

A pass counts as about one measurement, not as one per frame: a track remembers what it saw, and the
speckle of a still disc is the same from frame to frame. So a share of the errors is taken to be
common to the whole pass, and the rest to be common to SAME_FRAMES frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import SonarrecError
from sonarrec.files.tables import Table, line_number
from sonarrec.geometry import floor_depth, ground_range
from sonarrec.landmarks import LandmarkSet
from sonarrec.mapping.path import SonarPath
from sonarrec.nouns import Fan
from sonarrec.results.read import estimate_tables
from sonarrec.results.sightings import PASS_GAP
from sonarrec.results.stream import positions

ROWS = 20_000
"""Rows of estimates.csv that are read at a time."""
# How errors are correlated within a pass, chosen on tuning seeds of `make maps`.
COMMON_SHARE = 0.5
"""Share of the variance that is common to all frames of a pass."""
SAME_FRAMES = 6.0
"""Number of frames over which the rest of the error is the same."""
# Standard errors that come on top of those of the frames, because rings are not even and sonars
# heave. They are independent from pass to pass.
LEAST_PLACE_M = 0.003
LEAST_TURN_DEG = 1.0
TURN_SIGMA_DEG = 2.7
"""Standard error of the orientation that is common to all passes of a landmark: how its symbol
looks through the beam."""
HEIGHT_SIGMA_M = 0.015
"""Standard error of the stated height above the floor. It is common to all passes: a landmark that
is always seen from one side is shifted the same way, however often it is seen."""
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


@dataclass(frozen=True, slots=True)
class Passes:
    """All passes of one log, n of them, in order of their first frames.

    landmark, track: (n,). estimates: (n,) how many each has. score: (n,) mean.
    first, last, middle: (n,) indices of frames in the path. place: (n, 2) x, y in the path's axes,
    m. covariance: (n, 2, 2) of the place, without the path's error, m^2. lean: (n, 2) by how much
    the place moves per metre of error in the height. turn_deg: (n,) where the first sector begins,
    counter-clockwise from the x axis; NaN if not known. turn_sigma_deg: (n,) its standard error.
    near_m, far_m: (n,) least and largest ground range. order: (m,) indices of the estimates, sorted
    by pass. begin: (n,) where each pass begins in `order`.
    """

    landmark: IntArray
    track: IntArray
    estimates: IntArray
    score: FloatArray
    first: IntArray
    last: IntArray
    middle: IntArray
    place: FloatArray
    covariance: FloatArray
    lean: FloatArray
    turn_deg: FloatArray
    turn_sigma_deg: FloatArray
    near_m: FloatArray
    far_m: FloatArray
    order: IntArray
    begin: IntArray


def read_declared(
    path: Path, method: str, landmarks: LandmarkSet, fan: Fan, frame: IntArray
) -> DeclaredEstimates:
    """The declared estimates of a method. frame: (F,) the numbers in frames.csv, rising.

    Raises SonarrecError if the table cannot be read, or if a declared estimate has no place or no
    track.
    """
    parts: list[FloatArray] = [np.empty((0, 10))]
    strays = 0
    for first, table in estimate_tables(path, landmarks, ROWS):
        declared = np.asarray(table["method"] == method) & table["declared"]
        listed = np.isin(table["frame"], frame)
        strays += int(np.count_nonzero(declared & ~listed))
        chosen = np.flatnonzero(declared & listed)
        rows = _columns(table, fan)[chosen]
        if (rows[:, 2] < 0).any():  # two landmarks of one ID could not be kept apart
            raise SonarrecError(
                f"{path}: a track needs object; not every declared row of {method} has it"
            )
        without_place = ~np.isfinite(rows[:, 4:6]).all(axis=1)
        if without_place.any():
            line = line_number(path, first + int(chosen[np.argmax(without_place)]))
            raise SonarrecError(
                f"{path} line {line}: no position: neither x_px,y_px nor range_m,bearing_deg"
            )
        parts.append(rows)
    rows = np.concatenate(parts)
    number, landmark, track = rows[:, :3].astype(np.int64).T
    return DeclaredEstimates(
        row=np.searchsorted(frame, number),
        landmark=landmark,
        track=track,
        score=rows[:, 3],
        polar=rows[:, 4:7],
        sigma=np.where(rows[:, 7:] > 0, rows[:, 7:], UNSTATED),
        strays=strays,
    )


def _columns(table: Table, fan: Fan) -> FloatArray:
    """(rows, 10) of a table of estimates; NaN for what it does not state, track -1.

    The columns are frame, landmark, track, score, then slant range, bearing and orientation, then
    the standard errors of these three.
    """
    blank = np.full(len(table["frame"]), np.nan)
    _, _, range_m, bearing_deg = positions(table, fan)
    return np.column_stack(
        [
            table["frame"],
            table["landmark"],
            np.asarray(table.get("object", np.full(len(blank), -1)), dtype=float),
            table["score"],
            range_m,
            bearing_deg,
            *(
                np.asarray(table.get(name, blank), dtype=float)
                for name in (
                    "orientation_deg",
                    "range_sigma_m",
                    "bearing_sigma_deg",
                    "orientation_sigma_deg",
                )
            ),
        ]
    )


@dataclass(frozen=True, slots=True)
class _Runs:
    """The estimates of n passes, one pass after the other.

    order: (m,) indices of the estimates. begin: (n,) where each pass begins in `order`.
    """

    order: IntArray
    begin: IntArray

    @property
    def length(self) -> IntArray:
        """(n,) number of estimates in each pass."""
        return np.diff(np.append(self.begin, len(self.order)))

    def sum(self, values: np.ndarray) -> np.ndarray:
        """(n, ...) sums over each pass of (m, ...) values."""
        return self.reduced(np.add, values)

    def reduced(self, operation: np.ufunc, values: np.ndarray) -> np.ndarray:
        """(n, ...) an operation such as np.minimum over each pass of (m, ...) values."""
        if not len(self.begin):  # NumPy refuses
            return values[:0]
        return np.asarray(operation.reduceat(values, self.begin, axis=0))

    def by(self, key: IntArray) -> _Runs:
        """The passes sorted by (n,) key; those of equal key stay in order."""
        if not len(self.begin):
            return self
        rank = np.argsort(key, kind="stable")
        length = self.length[rank]
        begin = np.cumsum(length) - length
        moved = np.arange(len(self.order)) - np.repeat(begin - self.begin[rank], length)
        return _Runs(self.order[moved], begin)


def find_passes(
    estimates: DeclaredEstimates, path: SonarPath, landmarks: LandmarkSet, fan: Fan
) -> Passes:
    """The passes of a log, placed on the floor.

    Estimates are left out if their frame has no pose, or if they are nearer than the floor.
    """
    ground = ground_range(fan, estimates.polar[:, 0])
    usable = np.flatnonzero(np.isfinite(path.pose[estimates.row]).all(axis=1) & (ground > 0))
    number = path.frame[estimates.row]
    order = usable[
        np.lexsort([number[usable], estimates.track[usable], estimates.landmark[usable]])
    ]
    cut = np.ones(len(order), dtype=bool)
    same = (np.diff(estimates.landmark[order]) == 0) & (np.diff(estimates.track[order]) == 0)
    cut[1:] = ~same | (np.diff(number[order]) > PASS_GAP)
    begin = np.flatnonzero(cut)
    runs = _Runs(order, begin).by(estimates.row[order[begin]])
    return _placed(estimates, path, landmarks, fan, runs)


def _placed(
    estimates: DeclaredEstimates, path: SonarPath, landmarks: LandmarkSet, fan: Fan, runs: _Runs
) -> Passes:
    """The passes on the floor: weighted means of their estimates, with covariances."""
    order, begin, length = runs.order, runs.begin, runs.length
    row, slant = estimates.row[order], estimates.polar[order, 0]
    ground = ground_range(fan, slant)
    yaw, x, y = path.pose[row].T
    sight = np.radians(yaw + estimates.polar[order, 1])
    along = np.column_stack([np.sin(sight), np.cos(sight)])
    across = np.column_stack([np.cos(sight), -np.sin(sight)])
    place = np.column_stack([x, y]) + ground[:, None] * along
    # Ground range grows with slant range by the inverse of the grazing angle's cosine.
    errors = np.stack(
        [
            along * (estimates.sigma[order, 0] * slant / ground)[:, None],
            across * (ground * np.radians(estimates.sigma[order, 1]))[:, None],
        ],
        axis=-1,
    )
    weight = 1 / (errors**2).sum(axis=(1, 2))
    weight /= np.repeat(runs.sum(weight), length)
    turn, turn_sigma = _turns(estimates, landmarks, runs, yaw)
    return Passes(
        landmark=estimates.landmark[order][begin],
        track=estimates.track[order][begin],
        estimates=length,
        score=runs.sum(estimates.score[order]) / length,
        first=row[begin],
        last=row[begin + length - 1],
        middle=row[begin + length // 2],
        place=runs.sum(weight[:, None] * place),
        covariance=_covariance(runs, weight, errors),
        lean=runs.sum(weight[:, None] * along * (-floor_depth(fan) / ground)[:, None]),
        turn_deg=turn,
        turn_sigma_deg=turn_sigma,
        near_m=runs.reduced(np.minimum, ground),
        far_m=runs.reduced(np.maximum, ground),
        order=order,
        begin=begin,
    )


def _covariance(runs: _Runs, weight: FloatArray, errors: FloatArray) -> FloatArray:
    """(n, 2, 2) covariance of the weighted mean place of each pass, m^2.

    weight: (m,). errors: (m, 2, 2) of each estimate; columns are one standard error along and
    across the line of sight.
    """
    common = runs.sum(weight[:, None, None] * errors)
    own = runs.sum(weight[:, None, None] ** 2 * (errors @ errors.transpose(0, 2, 1)))
    together = np.minimum(SAME_FRAMES, runs.length)[:, None, None]
    return np.asarray(
        COMMON_SHARE * common @ common.transpose(0, 2, 1)
        + (1 - COMMON_SHARE) * together * own
        + LEAST_PLACE_M**2 * np.eye(2)
    )


def _turns(
    estimates: DeclaredEstimates, landmarks: LandmarkSet, runs: _Runs, yaw_deg: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(n,) mean orientation on the floor, and its standard error, deg; NaN if not known.

    yaw_deg: (m,) of the sonar. If a symbol looks the same after a turn of less than 360 deg, the
    mean lies within that turn.
    """
    fold = 360 / periods_of(landmarks, estimates.landmark[runs.order])
    angle = np.exp(1j * np.radians((estimates.polar[runs.order, 2] - yaw_deg) * fold))
    sigma = estimates.sigma[runs.order, 2]
    known = np.isfinite(angle)
    weight = np.where(known, 1 / sigma**2, 0.0)
    total = np.maximum(runs.sum(weight), 1e-12)
    mean = runs.sum(weight * np.where(known, angle, 0))
    together = np.minimum(SAME_FRAMES, runs.length)
    variance = (
        COMMON_SHARE * (runs.sum(weight * sigma) / total) ** 2
        + (1 - COMMON_SHARE) * together / total
        + LEAST_TURN_DEG**2
    )
    is_known = np.abs(mean) > 0
    turn = np.where(is_known, (np.degrees(np.angle(mean)) % 360) / fold[runs.begin], np.nan)
    return turn, np.where(is_known, np.sqrt(variance), np.nan)


def periods_of(landmarks: LandmarkSet, ids: IntArray) -> FloatArray:
    """(n,) `LandmarkSet.periods_deg` of these IDs (n,)."""
    return np.asarray(landmarks.periods_deg()[landmarks.indices(ids)])
