"""Hindsight of the `offline` preset: one belief for all frames of a track."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Self

import numpy as np

from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.estimates import declared
from sonarrec.recogniser.stage3 import likeliest
from sonarrec.recogniser.stage3.opinions import FRAME_EXPONENT, TRACK_EXPONENT, Opinion
from sonarrec.sonar.frame import Estimate, FrameResult

LEAST_MEAN_BELIEF = 0.5  # of a track's frames in an ID that hindsight declares
# An ID is added to frames of an episode if it was declared in at least this share of those that
# could have declared one. On recordings of other simulators .4 lost .033 of the TPR and saved no
# false claim.
LEAST_SHARE = 0.25


class _Pool(Opinion):
    """The pool of one episode of a track, and what its frames declared.

    with_evidence: number of frames in which an ID could be declared (see Beliefs). declared: in how
    many each ID was. orientations: of each ID, by the frame with its highest score: (score,
    orientation in degrees from the line of sight at the track's beginning, its standard error).
    """

    def __init__(self) -> None:
        super().__init__()
        self.with_evidence = 0
        self.declared = Counter[int]()
        self.orientations: dict[int, tuple[float, float, float]] = {}

    def learn(self, estimate: Estimate) -> None:
        """Add a frame's estimate."""
        self.add(estimate.probabilities)
        self.with_evidence += estimate.enough_evidence
        self.declared[estimate.landmark] += estimate.declared
        if estimate.score > self.orientations.get(estimate.landmark, (0.0,))[0]:
            orientation = estimate.orientation_deg + _sight_rotation(estimate)
            surest = estimate.score, orientation, estimate.orientation_sigma_deg
            self.orientations[estimate.landmark] = surest

    def join(self, other: Self) -> None:
        super().join(other)
        self.with_evidence += other.with_evidence
        self.declared += other.declared
        for landmark, surest in other.orientations.items():
            self.orientations[landmark] = max(surest, self.orientations.get(landmark, surest))


class Hindsight:
    """Revises past estimates of one method by later frames of their tracks.

    A track is one object, so one belief holds for all its frames: the pool of their beliefs (see
    Opinion). The last frame's belief would be worse, since a track is uncertain as it leaves the
    view, and wrong if it is mistaken for another as it returns.

    Frames keep their own beliefs if their mean belief in the pool's ID is below LEAST_MEAN_BELIEF.
    An ID is never declared in a frame where too little of its object is in view. A belief holds for
    one episode of a track (AppearanceMeasurement): another object may have got the track's number.

    An ID that most frames of an episode declared by themselves is taken back in none of them, since
    the mean of many frames is blurred where their motion is not quite known. An ID that too few of
    them declared (LEAST_SHARE) is added in none, else a mistake in few frames becomes one in all.

    lag: number of frames that a result waits for its revision.
    """

    def __init__(self, method: str, config: Config, landmarks: LandmarkSet) -> None:
        self._method = method
        self.lag = config.features.lag_frames
        self._threshold = config.features.declare
        self._ids = landmarks.ids
        self._frame = 0  # a count, since the numbers of a log's frames may jump
        # Of each episode of a track its pool, and the frame that was last added; of each track its
        # last episode.
        self._pools: dict[tuple[int, int], tuple[_Pool, int]] = {}
        self._episode: dict[int, int] = {}

    def learn(self, result: FrameResult) -> None:
        """Add a frame's estimates to the pools of their tracks."""
        self._frame += 1
        for estimate in result.estimates:
            if estimate.method == self._method:
                self._pool(estimate.object, estimate.episode).learn(estimate)
        # No result that still waits is of an older track.
        before = self._frame - 2 * self.lag
        for key in [key for key, (_, frame) in self._pools.items() if frame < before]:
            del self._pools[key]
            if self._episode.get(key[0]) == key[1]:
                del self._episode[key[0]]

    def _pool(self, track: int, episode: int) -> _Pool:
        """The pool of an episode, to which a frame is to be added.

        If an earlier episode is resumed (see AppearanceMeasurement), its pool and that of the
        episode it replaces become one.
        """
        pool, _ = self._pools.get((track, episode), (_Pool(), 0))
        last = self._episode.get(track, episode)
        if last > episode:
            other, frame = self._pools[track, last]
            pool.join(other)
            self._pools[track, last] = pool, frame
        self._episode[track], self._pools[track, episode] = episode, (pool, self._frame)
        return pool

    def revised(self, result: FrameResult) -> FrameResult:
        """A past result, which `learn` has had, with its tracks' beliefs by now."""
        estimates = list(result.estimates)
        own = [i for i, e in enumerate(estimates) if e.method == self._method]
        if not own:
            return result
        pools = [self._pools[estimates[i].object, estimates[i].episode][0] for i in own]
        # Each is sharpened as by `pooled`.
        beliefs = np.exp((FRAME_EXPONENT + TRACK_EXPONENT) * np.stack([p.mean() for p in pools]))
        beliefs /= beliefs.sum(axis=1, keepdims=True)
        best, scores = likeliest(beliefs)
        claimed = declared(scores, self._threshold)
        for n, (i, pool) in enumerate(zip(own, pools, strict=True)):
            if claimed[n] and pool.beliefs[best[n]] < LEAST_MEAN_BELIEF * pool.frames:
                continue
            estimate, landmark = estimates[i], self._ids[best[n]]
            if not (estimate.declared and claimed[n] and landmark == estimate.landmark):
                if estimate.declared and 2 * pool.declared[estimate.landmark] > pool.frames:
                    continue  # most frames declared what it would take back
                if claimed[n] and pool.declared[landmark] < LEAST_SHARE * pool.with_evidence:
                    continue  # too few frames declared what it would add
            rotation = _sight_rotation(estimate)
            unknown = (0.0, estimate.orientation_deg + rotation, np.nan)
            _, orientation, sigma = pool.orientations.get(landmark, unknown)
            estimates[i] = replace(
                estimate,
                probabilities=beliefs[n],
                landmark=landmark,
                score=float(scores[n]),
                declared=bool(claimed[n]) and estimate.in_view,
                orientation_deg=(orientation - rotation) % 360,
                orientation_sigma_deg=sigma,
            )
        return replace(result, estimates=tuple(estimates))


def _sight_rotation(estimate: Estimate) -> float:
    """Degrees from angles in the image to those from the line of sight at the beginning, which
    rotated in the image by the bearing, and over the floor as the sonar moved past."""
    return estimate.bearing_deg + estimate.sight_deg
