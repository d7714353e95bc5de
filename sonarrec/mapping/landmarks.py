"""Declared estimates become passes on the floor, and these are joined into landmarks.

A pass is a landmark as one track declared it. It counts as about one measurement, not as one per
frame: a track remembers earlier frames, and the speckle of a static disc is the same in all of
them. So a share of the errors counts as common to the whole pass, and the rest as common to
SAME_FRAMES frames.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, groupby, product
from operator import attrgetter
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import Diagnostics, SonarrecError
from sonarrec.landmarks import LandmarkSet
from sonarrec.mapping.path import SonarPath
from sonarrec.passes import pass_begins
from sonarrec.results.read import ROWS, SIGMAS, estimate_tables, positions
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import floor_depth, ground_range
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
GATE = 16.27
"""Squared Mahalanobis distance of position and orientation that 99.9 % of the passes of one
landmark do not exceed."""
GATE_POSITION = 13.82  # the same for the position alone, if an orientation is not known
ONE_DISC = 0.75
"""Passes nearer than this, in disc diameters, are of one disc: two discs cannot overlap."""
MOVED = 25.0
"""Squared Mahalanobis distance of two positions of one disc from which it was moved: 5 sigma."""
ELLIPSE_CORNERS = 48
OF_TRACK = ("frame", "landmark", "object", "score")
POLAR = ("range_m", "bearing_deg", "orientation_deg")
CHI2_95 = 5.991  # squared Mahalanobis distance that 95 % of positions in a plane do not exceed


@dataclass(frozen=True, slots=True)
class DeclaredEstimates:
    """The declared estimates of one method in one log, n of them."""

    row: IntArray
    """(n,) index of the frame in the path."""
    landmark: IntArray
    """(n,) IDs."""
    track: IntArray
    """(n,) 0 or more."""
    score: FloatArray
    """(n,)."""
    polar: FloatArray
    """(n, 3) slant range (m), bearing and orientation (deg, as in estimates.csv; NaN if not
    known)."""
    sigma: FloatArray
    """(n, 3) their standard errors."""
    rows: int
    """Number of declared estimates, with those on frames that frames.csv does not list."""


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """One pass of m estimates, placed on the floor."""

    path: SonarPath
    """Of its log."""
    landmark: int
    track: int
    score: float
    """The mean."""
    row: IntArray
    """(m,) frames as indices of the path, rising."""
    position: FloatArray
    """(2,) x, y in the path's axes, m."""
    covariance: FloatArray
    """(2, 2) of the position, without the path's error, m^2."""
    lean: FloatArray
    """(2,) derivative of the position by the sonar's height."""
    orientation_deg: float
    """Where the first sector begins, counter-clockwise from the x axis; NaN if not known."""
    orientation_sigma_deg: float
    """Its standard error."""
    near_m: float
    far_m: float
    """near_m, far_m: least and largest ground range."""

    @property
    def middle(self) -> int:
        """The frame in the middle, as an index of the path."""
        return int(self.row[len(self.row) // 2])

    @property
    def drift(self) -> FloatArray:
        """(2, 2) covariance of the position by the path's error so far, m^2."""
        row, position = np.array([self.middle]), self.position[None]
        return np.asarray(self.path.position_covariance(row, position)[0])

    @property
    def drift_yaw(self) -> float:
        """Variance of the heading by the path's error so far, deg^2."""
        return float(self.path.yaw_variance(np.array([self.middle]))[0])


def read_declared(
    path: Path, method: str, landmarks: LandmarkSet, fan: Fan, frame: IntArray
) -> DeclaredEstimates:
    """The declared estimates of a method. frame: (F,) the numbers in frames.csv, rising.

    Raises SonarrecError if the table cannot be read, or if a declared estimate has no position or
    no track.
    """
    wanted, count = OF_TRACK + POLAR + SIGMAS, 0
    parts: dict[str, list[FloatArray]] = {name: [np.empty(0)] for name in wanted}
    for first, table in estimate_tables(path, landmarks, ROWS):
        declared = np.asarray(table["method"] == method) & table["declared"]
        count += int(np.count_nonzero(declared))
        chosen = np.flatnonzero(declared & np.isin(table["frame"], frame))
        blank = np.full(len(declared), np.nan)
        columns = table | positions(table, fan)
        rows = {name: columns.get(name, blank)[chosen] for name in wanted}
        if not (rows["object"] >= 0).all():  # else two landmarks of one ID could be mixed up
            raise SonarrecError(
                f"{path}: a track needs object; not every declared row of {method} has it"
            )
        for n in np.flatnonzero(~np.isfinite(rows["range_m"] + rows["bearing_deg"]))[:1]:
            raise SonarrecError(
                f"{path} line {line_number(path, first + int(chosen[n]))}: no position: neither "
                "x_px,y_px nor range_m,bearing_deg"
            )
        for name in wanted:
            parts[name].append(rows[name])
    columns = {name: np.concatenate(of_name) for name, of_name in parts.items()}
    sigma = np.stack([columns[name] for name in SIGMAS], axis=1)
    return DeclaredEstimates(
        row=np.searchsorted(frame, columns["frame"].astype(np.int64)),
        landmark=columns["landmark"].astype(np.int64),
        track=columns["object"].astype(np.int64),
        score=columns["score"],
        polar=np.stack([columns[name] for name in POLAR], axis=1),
        sigma=np.where(sigma > 0, sigma, UNSTATED),
        rows=count,
    )


def on_path(estimates: DeclaredEstimates, first: int, path: SonarPath) -> DeclaredEstimates:
    """The estimates in the frames of a path, whose first one has this index among all."""
    row = estimates.row - first
    on_it = (row >= 0) & (row < len(path.frame))
    names = "landmark", "track", "score", "polar", "sigma"
    columns = {name: getattr(estimates, name)[on_it] for name in names}
    return replace(estimates, row=row[on_it], **columns)


def find_passes(
    estimates: DeclaredEstimates, path: SonarPath, landmarks: LandmarkSet, fan: Fan
) -> list[Pass]:
    """The passes on a path, placed on the floor, in order of their first frames.

    Estimates are left out if their frame has no pose, or if they are nearer than the floor.
    """
    ground = ground_range(fan, estimates.polar[:, 0])
    usable = np.isfinite(path.pose[estimates.row]).all(axis=1) & (ground > 0)
    order = np.lexsort([estimates.row, estimates.track, estimates.landmark])
    order = order[usable[order]]
    row, landmark, track = (v[order] for v in (estimates.row, estimates.landmark, estimates.track))
    begins = pass_begins(path.frame[row], path.stretch[row], landmark, track)
    periods_deg = dict(zip(landmarks.ids, landmarks.periods_deg().tolist(), strict=True))
    passes = [
        _placed(estimates, rows, path, periods_deg[int(estimates.landmark[rows[0]])], fan)
        for rows in np.split(order, np.flatnonzero(begins)[1:])
        if len(rows)
    ]
    return sorted(passes, key=lambda seen: int(seen.row[0]))


def _placed(
    estimates: DeclaredEstimates, chosen: IntArray, path: SonarPath, period_deg: float, fan: Fan
) -> Pass:
    """One pass on the floor: the weighted mean of its estimates (m,), with its covariance."""
    row, sigma = estimates.row[chosen], estimates.sigma[chosen]
    slant, bearing, orientation = estimates.polar[chosen].T
    ground = ground_range(fan, slant)
    yaw, x, y = path.pose[row].T
    sight = np.radians(yaw + bearing)
    along = np.column_stack([np.sin(sight), np.cos(sight)])
    across = np.column_stack([np.cos(sight), -np.sin(sight)])
    # (m, 2, 2): columns are one standard error along and across the line of sight. Ground range
    # grows with slant range by the inverse of the grazing angle's cosine.
    along_error = along * (sigma[:, 0] * slant / ground)[:, None]
    across_error = across * (ground * np.radians(sigma[:, 1]))[:, None]
    errors = np.stack([along_error, across_error], axis=-1)
    weight = 1 / (errors**2).sum(axis=(1, 2))
    weight /= weight.sum()
    common = (weight[:, None, None] * errors).sum(axis=0)
    own = (weight[:, None, None] ** 2 * (errors @ errors.transpose(0, 2, 1))).sum(axis=0)
    covariance = COMMON_SHARE * common @ common.T
    covariance += (1 - COMMON_SHARE) * min(SAME_FRAMES, len(row)) * own
    covariance += LEAST_POSITION_M**2 * np.eye(2)
    position = (weight[:, None] * (np.column_stack([x, y]) + ground[:, None] * along)).sum(axis=0)
    direction, direction_sigma = _mean_orientation(orientation - yaw, sigma[:, 2], period_deg)
    return Pass(
        path=path,
        landmark=int(estimates.landmark[chosen[0]]),
        track=int(estimates.track[chosen[0]]),
        score=float(estimates.score[chosen].mean()),
        row=row,
        position=position,
        covariance=covariance,
        lean=(weight[:, None] * along * (-floor_depth(fan) / ground)[:, None]).sum(axis=0),
        orientation_deg=direction,
        orientation_sigma_deg=direction_sigma,
        near_m=float(ground.min()),
        far_m=float(ground.max()),
    )


def _mean_orientation(
    orientation_deg: FloatArray, sigma_deg: FloatArray, period_deg: float
) -> tuple[float, float]:
    """The mean orientation on the floor, and its standard error, deg; NaN if not known.

    orientation_deg, sigma_deg: (m,). period_deg: the rotation after which the symbol looks the
    same; NaN if it does after every one. The mean is below it.
    """
    known = np.isfinite(orientation_deg / period_deg)
    direction, variance = _fused_orientation(orientation_deg, sigma_deg**2, period_deg)
    weight = 1 / sigma_deg[known] ** 2
    if not known.any():
        return direction, variance
    variance *= (1 - COMMON_SHARE) * min(SAME_FRAMES, len(orientation_deg))
    variance += COMMON_SHARE * ((weight * sigma_deg[known]).sum() / weight.sum()) ** 2
    return direction, math.sqrt(variance + LEAST_ORIENTATION_DEG**2)


@dataclass(frozen=True, slots=True)
class MappedLog:
    """One log of a map, or the part on one path."""

    name: str
    """Of its results folder."""
    path: SonarPath
    passes: list[Pass]
    fan: Fan
    ros_axes: bool
    """Whether its poses have x ahead and y to the left."""
    diagnostics: Diagnostics = field(default_factory=Diagnostics)


@dataclass(frozen=True, slots=True)
class Landmark:
    """One landmark of the map."""

    id: int
    position: FloatArray
    """(2,) x, y in m."""
    covariance: FloatArray
    """(2, 2) m^2."""
    orientation_deg: float
    """Where its first sector begins, counter-clockwise from the x axis; NaN if not known."""
    orientation_sigma_deg: float
    """Its standard error."""
    members: list[Pass]
    """The passes that give its position."""
    others: list[Pass]
    """Passes at this position that claim another ID."""

    @property
    def sigma_m(self) -> float:
        """Standard error of the position along the longest axis of its ellipse."""
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance)[-1]))


def join(logs: Sequence[MappedLog], landmark_set: LandmarkSet) -> list[Landmark]:
    """The landmarks of a map, in the order of the IDs in the set.

    Of landmarks that would overlap the one declared most is kept; the rest are its `others`. One
    that was moved is two landmarks (see `moved`).
    """
    disc_m = ONE_DISC * 2 * landmark_set.radius_m
    landmarks: list[Landmark] = []
    for number, period_deg in zip(
        landmark_set.ids, landmark_set.periods_deg().tolist(), strict=True
    ):
        passes = [seen for log in logs for seen in log.passes if seen.landmark == number]
        group = _groups(passes, period_deg, disc_m)
        for n in range(max(group, default=-1) + 1):
            members = [seen for seen, g in zip(passes, group, strict=True) if g == n]
            landmarks.append(_landmark(members, period_deg))
    others: dict[int, list[Pass]] = {}
    weight = [
        sum(len(seen.row) * seen.score for seen in landmark.members) for landmark in landmarks
    ]
    for n in sorted(range(len(landmarks)), key=lambda n: -weight[n]):
        near = (
            k for k in others if math.dist(landmarks[k].position, landmarks[n].position) < disc_m
        )
        kept = next((k for k in near if not _moved(landmarks[k], landmarks[n])), None)
        if kept is None:
            others[n] = []
        else:
            others[kept] += landmarks[n].members
    return [replace(landmarks[n], others=others[n]) for n in sorted(others)]


def _groups(passes: Sequence[Pass], period_deg: float, disc_m: float) -> list[int]:
    """For each of p passes of one ID, sorted by log and time, the number of its landmark.

    Each pass in turn joins the landmark that it fits best, by its fit to the nearest pass of that,
    or begins a new one. Passes seen at the same time in two positions belong to two landmarks, and
    so do passes at different times whose positions differ by MOVED. period_deg: after which the
    symbol looks the same. disc_m: distance below which two passes are of one disc.
    """

    def column(name: str) -> FloatArray:
        return np.array([getattr(seen, name) for seen in passes])

    position, covariance, lean = column("position"), column("covariance"), column("lean")
    orientation, variance = column("orientation_deg"), column("orientation_sigma_deg") ** 2
    middle, log = column("middle"), np.array([id(p.path) for p in passes])
    first, last = np.array([p.row[[0, -1]] for p in passes]).reshape(-1, 2).T
    drift, drift_yaw = column("drift"), column("drift_yaw")

    def fit(i: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(i,) squared Mahalanobis distances from pass i to those before, relative to that of the
        gate, (i,) those of the positions alone, and (i,) distances in m."""
        offset, path = position[:i] - position[i], passes[i].path
        total, spread = covariance[:i] + covariance[i], variance[:i] + variance[i]
        leaning = HEIGHT_SIGMA_M * (lean[:i] - lean[i])
        total += leaning[:, :, None] * leaning[:, None, :]
        same, own = log[:i] == log[i], np.repeat(middle[i], i)
        since = middle[:i][same]
        total[same] += path.position_covariance(own[same], position[:i][same], since)
        spread[same] += path.yaw_variance(own[same], since)
        # The errors of two logs are independent.
        total[~same] += path.position_covariance(own[~same], position[:i][~same])
        total[~same] += drift[:i][~same]
        spread[~same] += drift_yaw[i] + drift_yaw[:i][~same]
        squared = np.einsum("ki,kij,kj->k", offset, np.linalg.inv(total), offset)
        rotation = orientation[:i] - orientation[i]
        rotation = np.mod(rotation + period_deg / 2, period_deg) - period_deg / 2
        full = (squared + rotation**2 / spread) / GATE
        relative = np.where(np.isfinite(full), full, squared / GATE_POSITION)
        return relative, squared, np.hypot(*offset.T)

    group = np.full(len(passes), -1)
    for i in range(len(passes)):
        fits, squared, distance = fit(i)
        together = (log[:i] == log[i]) & (first[:i] <= last[i]) & (last[:i] >= first[i])
        same = (distance < disc_m) & (together | (squared <= MOVED))
        fits = np.where(same, np.minimum(fits, distance / disc_m * 0.5), fits)
        fits[np.isin(group[:i], group[:i][together & (distance >= disc_m)])] = np.inf
        joins = fits.min(initial=1) < 1
        group[i] = group[fits.argmin()] if joins else group.max() + 1
    return group.tolist()


def _moved(first: Landmark, second: Landmark) -> bool:
    """Whether two landmarks that would overlap are one that was moved: of one ID, never at once."""
    return first.id == second.id and not any(
        a.path is b.path and a.row[0] <= b.row[-1] and b.row[0] <= a.row[-1]
        for a, b in product(first.members, second.members)
    )


def moved(landmarks: Sequence[Landmark], landmark_set: LandmarkSet) -> Iterator[tuple[int, int]]:
    """Pairs of indices of landmarks that are two positions of one that was moved."""
    disc_m = ONE_DISC * 2 * landmark_set.radius_m
    for (i, first), (k, second) in combinations(enumerate(landmarks), 2):
        if _moved(first, second) and math.dist(first.position, second.position) < disc_m:
            yield i, k


def _landmark(passes: list[Pass], period_deg: float) -> Landmark:
    """The landmark of some passes, weighted by their own errors and those of the path.

    The passes of one log share the path's error up to the first of them; different logs share
    none. The error of the stated height, and a part of the orientation's error, are common to all
    passes.
    """
    parts = []
    for path, of_path in groupby(passes, key=attrgetter("path")):
        of_log = [*of_path]
        names = "middle", "position", "covariance", "lean", "orientation_deg"
        row, positions, own, lean, orientations = (
            np.array([getattr(seen, name) for seen in of_log]) for name in names
        )
        own_variance = np.array([seen.orientation_sigma_deg for seen in of_log]) ** 2
        first = np.repeat(row[:1], len(row))
        own = own + path.position_covariance(row, positions, first)
        position, covariance, lean = _fused(positions, own, lean)
        covariance = covariance + path.position_covariance(row[:1], position[None])[0]
        own_variance = own_variance + path.yaw_variance(row, first)
        orientation, variance = _fused_orientation(orientations, own_variance, period_deg)
        variance += path.yaw_variance(row[:1])[0]
        parts.append((position, covariance, lean, orientation, variance))
    positions, covariances, leans, orientations, variances = map(np.array, zip(*parts, strict=True))
    position, covariance, lean = _fused(positions, covariances, leans)
    orientation, variance = _fused_orientation(orientations, variances, period_deg)
    return Landmark(
        id=passes[0].landmark,
        position=position,
        covariance=covariance + HEIGHT_SIGMA_M**2 * np.outer(lean, lean),
        orientation_deg=orientation,
        orientation_sigma_deg=float(np.hypot(np.sqrt(variance), ORIENTATION_SIGMA_DEG)),
        members=passes,
        others=[],
    )


def _fused(
    position: FloatArray, covariance: FloatArray, lean: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted mean (2,) of independent positions (n, 2), its covariance (2, 2), mean lean (2,)."""
    weight = np.linalg.inv(covariance)
    fused = np.linalg.inv(weight.sum(axis=0))
    where, leaning = (fused @ np.einsum("nij,nj->i", weight, v) for v in (position, lean))
    return where, fused, leaning


def _fused_orientation(
    orientation_deg: FloatArray, variance: FloatArray, period_deg: float
) -> tuple[float, float]:
    """(mean direction, its variance) of independent directions (n,); NaN if none is known."""
    finite = np.isfinite(orientation_deg / period_deg)
    if not finite.any():
        return np.nan, np.nan
    weight = 1 / variance[finite]
    mean = (weight * np.exp(2j * np.pi * orientation_deg[finite] / period_deg)).sum()
    return float(np.angle(mean) / (2 * np.pi) * period_deg % period_deg), float(1 / weight.sum())


def frames_of(passes: Sequence[Pass]) -> int:
    """The number of frames of some passes; one with two tracks on a landmark counts once."""
    rows = defaultdict(list)
    for seen in passes:
        rows[seen.path].append(seen.row)
    return sum(len(np.unique(np.concatenate(of_log))) for of_log in rows.values())


def ellipse(position: FloatArray, covariance: FloatArray) -> FloatArray:
    """(n, 2) a closed line that holds a position with a probability of 95 %, counter-clockwise."""
    angle = np.linspace(0, 2 * np.pi, ELLIPSE_CORNERS + 1)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    values, axes = np.linalg.eigh(covariance)
    axes[:, 0] *= np.linalg.det(axes)  # else it may be a reflection
    half = np.sqrt(CHI2_95 * np.maximum(values, 0))
    return np.asarray(position + circle * half @ axes.T)
