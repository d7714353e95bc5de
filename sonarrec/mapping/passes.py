"""The passes of one log, placed on the floor. A pass is a landmark as one track declared it.

A pass counts as about one measurement, not as one per frame: a track remembers what it saw, and the
speckle of a still disc is the same from frame to frame. So a share of the errors is taken to be
common to the whole pass, and the rest to be common to SAME_FRAMES frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.files.tables import Table, line_number
from sonarrec.geometry import floor_depth, ground_range
from sonarrec.landmarks import LandmarkSet
from sonarrec.mapping.path import SonarPath
from sonarrec.records import Fan, FloatArray, IntArray, SonarrecError
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

    landmark, track: (n,). frames: (n,) number of frames with a declaration. score: (n,) mean.
    first, last, middle: (n,) indices of frames in the path. place: (n, 2) x, y in the path's axes,
    m. covariance: (n, 2, 2) of the place, without the path's error, m^2. lean: (n, 2) by how much
    the place moves per metre of error in the height. turn_deg: (n,) where the first sector begins,
    counter-clockwise from the x axis; NaN if not known. turn_sigma_deg: (n,) its standard error.
    near_m, far_m: (n,) least and largest ground range. order: (m,) indices of the estimates, sorted
    by pass. begin: (n,) where each pass begins in `order`.
    """

    landmark: IntArray
    track: IntArray
    frames: IntArray
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
    parts, strays = [np.empty((0, 10))], 0
    for first, table in estimate_tables(path, landmarks, ROWS):
        declared = np.asarray(table["method"] == method) & table["declared"]
        listed = np.isin(table["frame"], frame)
        strays += int(np.count_nonzero(declared & ~listed))
        chosen = np.flatnonzero(declared & listed)
        blank = np.full(len(table["frame"]), np.nan)

        def column(name: str, table: Table = table, blank: FloatArray = blank) -> FloatArray:
            return np.asarray(table.get(name, blank), dtype=float)

        _, _, range_m, bearing_deg = positions(table, fan)
        track = np.asarray(table.get("object", np.full(len(blank), -1)), dtype=float)
        rows = np.column_stack(
            [
                table["frame"],
                table["landmark"],
                track,
                table["score"],
                range_m,
                bearing_deg,
                column("orientation_deg"),
                column("range_sigma_m"),
                column("bearing_sigma_deg"),
                column("orientation_sigma_deg"),
            ]
        )[chosen]
        if (rows[:, 2] < 0).any():  # two landmarks of one ID could not be told apart
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
    whole = rows[:, :3].astype(np.int64)
    return DeclaredEstimates(
        row=np.searchsorted(frame, whole[:, 0]),
        landmark=whole[:, 1],
        track=whole[:, 2],
        score=rows[:, 3],
        polar=rows[:, 4:7],
        sigma=np.where(rows[:, 7:] > 0, rows[:, 7:], UNSTATED),
        strays=strays,
    )


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
    if not len(begin):
        return _passes(estimates, path, landmarks, fan, order, begin)
    # In order of first frames.
    by_time = np.argsort(estimates.row[order[begin]], kind="stable")
    length = np.diff(np.append(begin, len(order)))[by_time]
    start = np.cumsum(length) - length
    moved = np.arange(len(order)) - np.repeat(start, length) + np.repeat(begin[by_time], length)
    return _passes(estimates, path, landmarks, fan, order[moved], start)


def _passes(
    estimates: DeclaredEstimates,
    path: SonarPath,
    landmarks: LandmarkSet,
    fan: Fan,
    order: IntArray,
    begin: IntArray,
) -> Passes:
    """Place the passes. order, begin: as in Passes."""
    row, slant = estimates.row[order], estimates.polar[order, 0]
    ground = ground_range(fan, slant)
    length = np.diff(np.append(begin, len(order)))
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
    weight /= np.repeat(_sum(weight, begin), length)
    mean = _sum(weight[:, None] * place, begin)
    common = _sum(weight[:, None, None] * errors, begin)
    own = _sum(weight[:, None, None] ** 2 * (errors @ errors.transpose(0, 2, 1)), begin)
    together = np.minimum(SAME_FRAMES, length)[:, None, None]
    covariance = (
        COMMON_SHARE * common @ common.transpose(0, 2, 1)
        + (1 - COMMON_SHARE) * together * own
        + LEAST_PLACE_M**2 * np.eye(2)
    )
    turn, turn_sigma = _turns(estimates, landmarks, order, begin, yaw)
    return Passes(
        landmark=estimates.landmark[order][begin],
        track=estimates.track[order][begin],
        frames=length,
        score=_sum(estimates.score[order], begin) / length,
        first=row[begin],
        last=row[begin + length - 1],
        middle=row[begin + length // 2],
        place=mean,
        covariance=covariance,
        lean=_sum(weight[:, None] * along * (-floor_depth(fan) / ground)[:, None], begin),
        turn_deg=turn,
        turn_sigma_deg=turn_sigma,
        near_m=np.minimum.reduceat(ground, begin) if len(begin) else ground,
        far_m=np.maximum.reduceat(ground, begin) if len(begin) else ground,
        order=order,
        begin=begin,
    )


def _turns(
    estimates: DeclaredEstimates,
    landmarks: LandmarkSet,
    order: IntArray,
    begin: IntArray,
    yaw_deg: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """(n,) mean orientation on the floor, and its standard error, deg; NaN if not known.

    If a symbol looks the same after a turn of less than 360 deg, the mean lies within that turn.
    """
    length = np.diff(np.append(begin, len(order)))
    fold = 360 / periods_of(landmarks, estimates.landmark[order])
    angle = np.exp(1j * np.radians((estimates.polar[order, 2] - yaw_deg) * fold))
    sigma = estimates.sigma[order, 2]
    known = np.isfinite(angle)
    weight = np.where(known, 1 / sigma**2, 0.0)
    total = np.maximum(_sum(weight, begin), 1e-12)
    mean = _sum(weight * np.where(known, angle, 0), begin)
    fold = fold[begin] if len(begin) else fold
    together = np.minimum(SAME_FRAMES, length)
    variance = (
        COMMON_SHARE * (_sum(weight * sigma, begin) / total) ** 2
        + (1 - COMMON_SHARE) * together / total
        + LEAST_TURN_DEG**2
    )
    is_known = np.abs(mean) > 0
    turn = np.where(is_known, (np.degrees(np.angle(mean)) % 360) / fold, np.nan)
    return turn, np.where(is_known, np.sqrt(variance), np.nan)


def periods_of(landmarks: LandmarkSet, ids: IntArray) -> FloatArray:
    """(n,) `LandmarkSet.periods_deg` of these IDs (n,)."""
    return np.asarray(landmarks.periods_deg()[landmarks.indices(ids)])


def _sum(values: np.ndarray, begin: IntArray) -> np.ndarray:
    """(n, ...) sums over runs of the first axis. begin: (n,) index at which each run begins."""
    if not len(begin):
        return values[:0]
    return np.asarray(np.add.reduceat(values, begin, axis=0))
