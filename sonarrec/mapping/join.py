"""Joins passes into landmarks. Where landmarks would overlap, only the one claimed most is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.landmarks import LandmarkSet
from sonarrec.mapping.passes import (
    HEIGHT_SIGMA_M,
    TURN_SIGMA_DEG,
    DeclaredEstimates,
    Passes,
    periods_of,
)
from sonarrec.mapping.path import SonarPath
from sonarrec.nouns import Fan

GATE = 16.27
"""Squared Mahalanobis distance of place and orientation that 99.9 % of the passes of one landmark
do not exceed."""
GATE_PLACE = 13.82
"""The same for the place alone, if an orientation is not known."""
ONE_DISC = 0.75
"""Passes nearer than this, in disc diameters, are of one disc: two discs cannot overlap."""


@dataclass(frozen=True, slots=True)
class MappedLog:
    """One log of a map.

    name: of its results folder. declared: its declared estimates, to which its passes refer.
    ros_axes: whether its poses have x ahead and y to the left.
    """

    name: str
    path: SonarPath
    declared: DeclaredEstimates
    passes: Passes
    fan: Fan
    ros_axes: bool

    def rows_of(self, k: int) -> IntArray:
        """(n,) the frames, as indices of the path, of the estimates of its k-th pass."""
        begin = self.passes.begin[k]
        estimates = self.passes.order[begin : begin + self.passes.estimates[k]]
        return self.declared.row[estimates]


@dataclass(frozen=True, slots=True)
class Landmark:
    """One landmark of the map.

    place: (2,) x, y in m. covariance: (2, 2) m^2. turn_deg: where its first sector begins,
    counter-clockwise from the x axis; NaN if not known. turn_sigma_deg: its standard error.
    members: (log, pass) indices of the passes that it was placed by. others: the same of passes
    that lie on it but claim another ID.
    """

    id: int
    place: FloatArray
    covariance: FloatArray
    turn_deg: float
    turn_sigma_deg: float
    members: tuple[tuple[int, int], ...]
    others: tuple[tuple[int, int], ...] = ()


@dataclass(slots=True)
class _Pool:
    """All passes of all logs, p of them, sorted by log and time; as in Passes, p in place of n.

    log, index: which pass of which log it is. period: deg, after which the symbol looks the same.
    """

    logs: Sequence[MappedLog]
    log: IntArray
    index: IntArray
    landmark: IntArray
    period: FloatArray
    rows: IntArray  # (p, 2) first and last frame, as indices of the path
    middle: IntArray
    place: FloatArray
    covariance: FloatArray
    lean: FloatArray
    turn: FloatArray
    variance: FloatArray  # of the turn
    drift: FloatArray  # (p, 2, 2) what its log's path adds, from where that begins
    drift_turn: FloatArray  # (p,) deg^2

    def distance(self, i: int, others: IntArray) -> tuple[FloatArray, FloatArray]:
        """How far pass i is from others (k,).

        Returns (k,) squared Mahalanobis distances, divided by that of the gate, and (k,) metres.
        """
        apart = self.place[others] - self.place[i]
        covariance = self.covariance[others] + self.covariance[i]
        lean = HEIGHT_SIGMA_M * (self.lean[others] - self.lean[i])
        covariance += lean[:, :, None] * lean[:, None, :]
        turned = self.variance[others] + self.variance[i]
        path, place = self.logs[self.log[i]].path, self.place[others]
        mine = np.repeat(self.middle[i], len(others))
        same = self.log[others] == self.log[i]
        theirs = self.middle[others[same]]
        covariance[same] += path.place_covariance(mine[same], place[same], theirs)
        turned[same] += path.yaw_variance(mine[same], theirs)
        # Errors of two logs have nothing in common.
        covariance[~same] += path.place_covariance(mine[~same], place[~same])
        covariance[~same] += self.drift[others[~same]]
        turned[~same] += self.drift_turn[i] + self.drift_turn[others[~same]]
        squared = np.einsum("ki,kij,kj->k", apart, np.linalg.inv(covariance), apart)
        period = self.period[i]
        turn = np.mod(self.turn[others] - self.turn[i] + period / 2, period) - period / 2
        whole = (squared + turn**2 / turned) / GATE
        return np.where(np.isfinite(whole), whole, squared / GATE_PLACE), np.hypot(*apart.T)

    def together(self, i: int, others: IntArray) -> BoolArray:
        """(k,) whether pass i and others were seen at the same time."""
        first, last = self.rows[i]
        return np.asarray(
            (self.log[others] == self.log[i])
            & (self.rows[others, 0] <= last)
            & (self.rows[others, 1] >= first)
        )


def frame_shares(log: MappedLog, passes: Sequence[int]) -> FloatArray:
    """(n,) how much each of these passes of one landmark counts: 1, or less if they share frames.

    Where several tracks lie on one disc at a time, they see the same speckle of it, and are no
    more than one measurement. Each then counts by its part of each frame.
    """
    rows = [log.rows_of(k) for k in passes]
    _, frame, tracks = np.unique(np.concatenate(rows), return_inverse=True, return_counts=True)
    ends = np.cumsum([len(r) for r in rows])[:-1]
    return np.array([parts.mean() for parts in np.split(1 / tracks[frame], ends)])


def join(logs: Sequence[MappedLog], landmark_set: LandmarkSet) -> list[Landmark]:
    """The landmarks of a map, in the order of the IDs in the set."""
    pool = _pool(logs, landmark_set)
    if not len(pool.log):
        return []
    groups: list[list[int]] = []
    for number in landmark_set.ids:
        groups += _of_one_id(pool, np.flatnonzero(pool.landmark == number), landmark_set.radius_m)
    landmarks = [_place_group(pool, group) for group in groups]
    return _one_at_a_place(logs, landmarks, ONE_DISC * 2 * landmark_set.radius_m)


def _pool(logs: Sequence[MappedLog], landmarks: LandmarkSet) -> _Pool:
    def row(name: str) -> np.ndarray:
        return np.concatenate([getattr(log.passes, name) for log in logs])

    count = [len(log.passes.landmark) for log in logs]
    ids = row("landmark")
    return _Pool(
        logs=logs,
        log=np.repeat(np.arange(len(logs)), count),
        index=np.concatenate([np.arange(n) for n in count]),
        landmark=ids,
        period=periods_of(landmarks, ids),
        rows=np.column_stack([row("first"), row("last")]),
        middle=row("middle"),
        place=row("place"),
        covariance=row("covariance"),
        lean=row("lean"),
        turn=row("turn_deg"),
        variance=row("turn_sigma_deg") ** 2,
        drift=np.concatenate(
            [log.path.place_covariance(log.passes.middle, log.passes.place) for log in logs]
        ),
        drift_turn=np.concatenate([log.path.yaw_variance(log.passes.middle) for log in logs]),
    )


def _of_one_id(pool: _Pool, passes: IntArray, radius_m: float) -> list[list[int]]:
    """Group the passes (n,) of one ID into landmarks.

    Each pass in turn joins the landmark that it fits best, or begins a new one. Its fit is that to
    the nearest pass of the landmark. Passes seen at the same time in two places belong to two
    landmarks.
    """
    disc = ONE_DISC * 2 * radius_m
    member = np.full(len(passes), -1)
    count = 0
    for n, i in enumerate(passes.tolist()):
        before = passes[:n]
        if n:
            fit, apart = pool.distance(i, before)
            fit = np.where(apart < disc, np.minimum(fit, apart / disc * 0.5), fit)
            barred = member[:n][pool.together(i, before) & (apart >= disc)]
            fit[np.isin(member[:n], barred)] = np.inf
            best = int(np.argmin(fit))
            if fit[best] < 1:
                member[n] = member[best]
        if member[n] < 0:
            member[n], count = count, count + 1
    return [passes[member == k].tolist() for k in range(count)]


def _place_group(pool: _Pool, group: Sequence[int]) -> Landmark:
    """Place a landmark by its passes, weighted by their own errors and those of the path.

    Passes that share frames share their weight too.
    The passes of one log share the path's error up to the first of them; different logs share none.
    The error of the stated height, and a part of the orientation's error, are common to all passes.
    """
    parts = []
    for log in np.unique(pool.log[group]).tolist():
        of_log = np.array([i for i in group if pool.log[i] == log])
        path, row = pool.logs[log].path, pool.middle[of_log]
        first = np.repeat(row[:1], len(row))
        share = frame_shares(pool.logs[log], pool.index[of_log].tolist())
        own = pool.covariance[of_log] + path.place_covariance(row, pool.place[of_log], first)
        place, covariance, lean = _fused(
            pool.place[of_log], own / share[:, None, None], pool.lean[of_log]
        )
        covariance = covariance + path.place_covariance(row[:1], place[None])[0]
        own_turn = pool.variance[of_log] + path.yaw_variance(row, first)
        turn, variance = _fused_turn(pool.turn[of_log], own_turn / share, pool.period[group[0]])
        variance += path.yaw_variance(row[:1])[0]
        parts.append((place, covariance, lean, turn, variance))
    places, covariances, leans, turned, variances = map(np.array, zip(*parts, strict=True))
    place, covariance, lean = _fused(places, covariances, leans)
    covariance = covariance + HEIGHT_SIGMA_M**2 * np.outer(lean, lean)
    turn, variance = _fused_turn(turned, variances, pool.period[group[0]])
    return Landmark(
        id=int(pool.landmark[group[0]]),
        place=place,
        covariance=covariance,
        turn_deg=turn,
        turn_sigma_deg=float(np.hypot(np.sqrt(variance), TURN_SIGMA_DEG)),
        members=tuple((int(pool.log[i]), int(pool.index[i])) for i in group),
    )


def _fused(
    place: FloatArray, covariance: FloatArray, lean: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The weighted mean (2,) of independent places, its covariance (2, 2), and the mean lean (2,).

    place, lean: (n, 2). covariance: (n, 2, 2).
    """
    weight = np.linalg.inv(covariance)
    together = np.linalg.inv(weight.sum(axis=0))
    return (
        together @ np.einsum("nij,nj->i", weight, place),
        together,
        together @ np.einsum("nij,nj->i", weight, lean),
    )


def _fused_turn(
    turn_deg: FloatArray, variance: FloatArray, period_deg: float
) -> tuple[float, float]:
    """(mean direction, its variance) of independent directions (n,); NaN if none is known."""
    finite = np.isfinite(turn_deg)
    if not finite.any():
        return np.nan, np.nan
    weight = 1 / variance[finite]
    mean = (weight * np.exp(2j * np.pi * turn_deg[finite] / period_deg)).sum()
    return float(np.angle(mean) / (2 * np.pi) * period_deg % period_deg), float(1 / weight.sum())


def _one_at_a_place(
    logs: Sequence[MappedLog], landmarks: list[Landmark], disc_m: float
) -> list[Landmark]:
    """Keep one landmark where several overlap: the one claimed most. The rest are its `others`.

    disc_m: distance below which landmarks overlap.
    """
    passes = [log.passes for log in logs]
    weight = [
        sum(passes[g].estimates[k] * passes[g].score[k] for g, k in m.members) for m in landmarks
    ]
    others: dict[int, list[tuple[int, int]]] = {}
    for n in sorted(range(len(landmarks)), key=lambda n: -weight[n]):
        near = [k for k in others if np.hypot(*(landmarks[k].place - landmarks[n].place)) < disc_m]
        if near:
            others[near[0]] += landmarks[n].members
        else:
            others[n] = []
    return [replace(landmarks[n], others=tuple(others[n])) for n in sorted(others)]
