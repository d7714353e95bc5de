"""Joins passes into landmarks. Of landmarks that would overlap, the one declared most is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import Diagnostics
from sonarrec.landmarks import LandmarkSet
from sonarrec.mapping.passes import HEIGHT_SIGMA_M, ORIENTATION_SIGMA_DEG, Pass
from sonarrec.mapping.path import SonarPath
from sonarrec.nouns import Fan

GATE = 16.27
"""Squared Mahalanobis distance of position and orientation that 99.9 % of the passes of one
landmark do not exceed."""
GATE_POSITION = 13.82  # the same for the position alone, if an orientation is not known
ONE_DISC = 0.75
"""Passes nearer than this, in disc diameters, are of one disc: two discs cannot overlap."""

Member = tuple[int, Pass]  # a pass, with the index of its log in the map


@dataclass(frozen=True, slots=True)
class MappedLog:
    """One log of a map.

    name: of its results folder. ros_axes: whether its poses have x ahead and y to the left. folder:
    of its results.
    """

    name: str
    path: SonarPath
    passes: list[Pass]
    fan: Fan
    ros_axes: bool
    folder: Path
    diagnostics: Diagnostics = field(default_factory=Diagnostics)


@dataclass(frozen=True, slots=True)
class Landmark:
    """One landmark of the map.

    position: (2,) x, y in m. covariance: (2, 2) m^2. orientation_deg: where its first sector
    begins, counter-clockwise from the x axis; NaN if not known. orientation_sigma_deg: its standard
    error. members: the passes that give its position. others: passes at this position that claim
    another ID.
    """

    id: int
    position: FloatArray
    covariance: FloatArray
    orientation_deg: float
    orientation_sigma_deg: float
    members: list[Member]
    others: list[Member]


class _Pool:
    """All passes of one ID, p of them, sorted by log and time, as arrays (p, ...)."""

    def __init__(self, logs: Sequence[MappedLog], members: list[Member], period_deg: float) -> None:
        """period_deg: after which the symbol looks the same."""

        def column(name: str) -> FloatArray:
            return np.array([getattr(one, name) for _, one in members])

        self.members, self.period_deg = members, period_deg
        self.paths = [log.path for log in logs]
        self.log = np.array([log for log, _ in members])
        self.first, self.last = np.array([one.row[[0, -1]] for _, one in members]).T
        self.middle = column("middle")
        self.position, self.covariance = column("position"), column("covariance")
        self.lean = column("lean")
        self.orientation = column("orientation_deg")
        self.variance = column("orientation_sigma_deg") ** 2
        self.drift, self.drift_yaw = column("drift"), column("drift_yaw")

    def distance(self, i: int, others: IntArray) -> tuple[FloatArray, FloatArray]:
        """(k,) squared Mahalanobis distances from pass i to others (k,), relative to that of the
        gate, and (k,) distances in m."""
        offset = self.position[others] - self.position[i]
        covariance = self.covariance[others] + self.covariance[i]
        lean = HEIGHT_SIGMA_M * (self.lean[others] - self.lean[i])
        covariance += lean[:, :, None] * lean[:, None, :]
        variance = self.variance[others] + self.variance[i]
        path, position = self.paths[self.log[i]], self.position[others]
        own = np.repeat(self.middle[i], len(others))
        same = self.log[others] == self.log[i]
        since = self.middle[others[same]]
        covariance[same] += path.position_covariance(own[same], position[same], since)
        variance[same] += path.yaw_variance(own[same], since)
        # The errors of two logs are independent.
        covariance[~same] += path.position_covariance(own[~same], position[~same])
        covariance[~same] += self.drift[others[~same]]
        variance[~same] += self.drift_yaw[i] + self.drift_yaw[others[~same]]
        squared = np.einsum("ki,kij,kj->k", offset, np.linalg.inv(covariance), offset)
        period = self.period_deg
        rotation = self.orientation[others] - self.orientation[i]
        rotation = np.mod(rotation + period / 2, period) - period / 2
        whole = (squared + rotation**2 / variance) / GATE
        return np.where(np.isfinite(whole), whole, squared / GATE_POSITION), np.hypot(*offset.T)

    def groups(self, disc_m: float) -> list[list[int]]:
        """Group the passes into landmarks.

        Each pass in turn joins the landmark that it fits best, by its fit to the nearest pass of
        that, or begins a new one. Passes seen at the same time in two positions belong to two
        landmarks. disc_m: distance below which two passes are of one disc.
        """
        group = np.full(len(self.log), -1)
        for i in range(len(group)):
            before = np.arange(i)
            if i:
                fit, distance = self.distance(i, before)
                fit = np.where(distance < disc_m, np.minimum(fit, distance / disc_m * 0.5), fit)
                together = (self.log[:i] == self.log[i]) & (self.first[:i] <= self.last[i])
                together &= self.last[:i] >= self.first[i]
                barred = group[:i][together & (distance >= disc_m)]
                fit[np.isin(group[:i], barred)] = np.inf
                best = int(np.argmin(fit))
                if fit[best] < 1:
                    group[i] = group[best]
            if group[i] < 0:
                group[i] = group.max() + 1
        return [np.flatnonzero(group == n).tolist() for n in range(group.max() + 1)]

    def place(self, group: Sequence[int]) -> Landmark:
        """Place a landmark by its passes, weighted by their own errors and those of the path.

        Passes that share frames share their weight too (`frame_shares`). The passes of one log
        share the path's error up to the first of them; different logs share none. The error of the
        stated height, and a part of the orientation's error, are common to all passes.
        """
        parts = []
        for log, grouped in groupby(group, key=lambda i: self.log[i]):
            of_log = np.array([*grouped])
            path, row = self.paths[log], self.middle[of_log]
            first = np.repeat(row[:1], len(row))
            share = frame_shares([self.members[i][1] for i in of_log])
            positions = self.position[of_log]
            own = self.covariance[of_log] + path.position_covariance(row, positions, first)
            position, covariance, lean = _fused(
                positions, own / share[:, None, None], self.lean[of_log]
            )
            covariance = covariance + path.position_covariance(row[:1], position[None])[0]
            own_variance = self.variance[of_log] + path.yaw_variance(row, first)
            orientation, variance = _fused_orientation(
                self.orientation[of_log], own_variance / share, self.period_deg
            )
            variance += path.yaw_variance(row[:1])[0]
            parts.append((position, covariance, lean, orientation, variance))
        positions, covariances, leans, orientations, variances = map(
            np.array, zip(*parts, strict=True)
        )
        position, covariance, lean = _fused(positions, covariances, leans)
        orientation, variance = _fused_orientation(orientations, variances, self.period_deg)
        return Landmark(
            id=self.members[0][1].landmark,
            position=position,
            covariance=covariance + HEIGHT_SIGMA_M**2 * np.outer(lean, lean),
            orientation_deg=orientation,
            orientation_sigma_deg=float(np.hypot(np.sqrt(variance), ORIENTATION_SIGMA_DEG)),
            members=[self.members[i] for i in group],
            others=[],
        )


def frame_shares(passes: Sequence[Pass]) -> FloatArray:
    """(n,) weights of the passes of one landmark in one log: 1, or less if they share frames.

    Several tracks on one disc at a time see the same speckle, so they are one measurement. In each
    frame they share its weight.
    """
    rows = [one.row for one in passes]
    _, frame, tracks = np.unique(np.concatenate(rows), return_inverse=True, return_counts=True)
    ends = np.cumsum([len(row) for row in rows])[:-1]
    return np.array([parts.mean() for parts in np.split(1 / tracks[frame], ends)])


def join(logs: Sequence[MappedLog], landmark_set: LandmarkSet) -> list[Landmark]:
    """The landmarks of a map, in the order of the IDs in the set."""
    disc_m = ONE_DISC * 2 * landmark_set.radius_m
    landmarks: list[Landmark] = []
    for number, period_deg in zip(landmark_set.ids, landmark_set.periods_deg(), strict=True):
        members = [(g, p) for g, log in enumerate(logs) for p in log.passes if p.landmark == number]
        if members:
            pool = _Pool(logs, members, float(period_deg))
            landmarks += [pool.place(group) for group in pool.groups(disc_m)]
    return _one_per_position(landmarks, disc_m)


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
    finite = np.isfinite(orientation_deg)
    if not finite.any():
        return np.nan, np.nan
    weight = 1 / variance[finite]
    mean = (weight * np.exp(2j * np.pi * orientation_deg[finite] / period_deg)).sum()
    return float(np.angle(mean) / (2 * np.pi) * period_deg % period_deg), float(1 / weight.sum())


def _one_per_position(landmarks: list[Landmark], disc_m: float) -> list[Landmark]:
    """Of landmarks nearer than disc_m keep the one declared most; the rest are its `others`."""
    weight = [sum(len(p.row) * p.score for _, p in one.members) for one in landmarks]
    others: dict[int, list[Member]] = {}
    for n in sorted(range(len(landmarks)), key=lambda n: -weight[n]):
        offsets = ((k, landmarks[k].position - landmarks[n].position) for k in others)
        near = next((k for k, offset in offsets if np.hypot(*offset) < disc_m), None)
        if near is None:
            others[n] = []
        else:
            others[near] += landmarks[n].members
    return [replace(landmarks[n], others=others[n]) for n in sorted(others)]


def frames_of(members: Sequence[Member]) -> int:
    """The number of frames of some passes; one with two tracks on a landmark counts once."""
    return sum(
        len(np.unique(np.concatenate([one.row for _, one in of_log])))
        for _, of_log in groupby(sorted(members, key=itemgetter(0)), key=itemgetter(0))
    )
