"""The `offline` preset's hindsight: one belief per track, for all its frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, FrameResult
from sonarrec.recogniser.estimates import declared
from sonarrec.recogniser.stage3 import likeliest
from sonarrec.recogniser.stage3.opinions import FRAME_EXPONENT, TRACK_EXPONENT, Opinion, Opinions

LEAST_BORNE_OUT = 0.5  # least mean belief of a track's frames in the ID that all of them are given


@dataclass
class _Opinion(Opinion):
    """An Opinion with the beliefs' plain sum and the orientations that were measured."""

    beliefs_sum: FloatArray = field(kw_only=True)
    """(K + 1,) plain sum over the frames of belief."""
    turns: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    """By ID, in the frame that was surest of it: (score, orientation in degrees from the line of
    sight as the track began, its standard error)."""

    def beliefs(self) -> FloatArray:
        """(K + 1,) pool of the frames, to the powers by which TrackBelief reports; sums to 1."""
        pool = np.exp((FRAME_EXPONENT + TRACK_EXPONENT) * self.mean())
        return np.asarray(pool / pool.sum())

    def join(self, other: Self) -> None:
        """Take in the beliefs of other frames of the same object."""
        super().join(other)
        self.beliefs_sum += other.beliefs_sum
        for landmark, turn in other.turns.items():
            self.turns[landmark] = max(turn, self.turns.get(landmark, turn))

    def borne_out(self, landmark_index: int) -> bool:
        """Whether the frames, each counting the same, mostly believed in this ID."""
        return bool(self.beliefs_sum[landmark_index] >= LEAST_BORNE_OUT * self.frames)


class Hindsight:
    """Revises past estimates of one method by what was learned of their tracks since.

    A track is one object, so one belief holds for all its frames: the pool of the beliefs in each
    (see Opinion). The last frame's belief would not do: a track is known badly as it leaves the
    view, and where it is mistaken for another on its return.

    Where most frames do not believe in the pool's ID, they stay as they were. An ID is never
    declared in a frame where too little of its object is in view. Where a track comes back with
    another picture, another object has taken up its number: so a belief holds for one chapter of a
    track alone (see Evidence).

    lag: how many frames a result waits for its revision.
    """

    def __init__(self, method: str, config: Config, landmarks: LandmarkSet) -> None:
        self._method = method
        self.lag = config.features.lag_frames
        self._threshold = config.features.declare
        self._ids = landmarks.ids
        self._opinions = Opinions(self._no_opinion)
        self._frame = 0  # counted: the numbers of a log's frames may jump

    def _no_opinion(self) -> _Opinion:
        none = np.zeros((2, len(self._ids) + 1))
        return _Opinion(none[0], beliefs_sum=none[1])

    def learn(self, result: FrameResult) -> None:
        """Take in a frame's estimates."""
        self._frame += 1
        for estimate in result.estimates:
            if estimate.method == self._method:
                self._add(self._frame, estimate)
        # No result still waiting is of an older track.
        self._opinions.forget(self._frame - 2 * self.lag)

    def _add(self, frame: int, estimate: Estimate) -> None:
        """Add one frame's estimate to the opinion of its track."""
        opinion = self._opinions.current(estimate.object, estimate.chapter, frame)
        opinion.add(estimate.probabilities)
        opinion.beliefs_sum += estimate.probabilities
        if estimate.score > opinion.turns.get(estimate.landmark, (0.0,))[0]:
            turn = estimate.orientation_deg + _from_image(estimate)
            sigma = estimate.orientation_sigma_deg
            opinion.turns[estimate.landmark] = (estimate.score, turn, sigma)

    def revised(self, result: FrameResult) -> FrameResult:
        """A past result with the beliefs of today; `learn` must have taken it in."""
        return replace(result, estimates=tuple(self._revise(e) for e in result.estimates))

    def _revise(self, estimate: Estimate) -> Estimate:
        """The estimate with its track's belief and orientation; unchanged if of another method."""
        if estimate.method != self._method:
            return estimate
        opinion = self._opinions.get(estimate.object, estimate.chapter)
        beliefs = opinion.beliefs()
        (landmark_index,), (score,) = likeliest(beliefs[None])
        claimed = bool(declared(score, self._threshold))
        if claimed and not opinion.borne_out(landmark_index):
            return estimate
        landmark = self._ids[landmark_index]
        turn, sigma = estimate.orientation_deg + _from_image(estimate), np.nan
        if landmark in opinion.turns:
            _, turn, sigma = opinion.turns[landmark]
        return replace(
            estimate,
            probabilities=beliefs,
            landmark=landmark,
            score=float(score),
            declared=claimed and estimate.in_view,
            orientation_deg=(turn - _from_image(estimate)) % 360,
            orientation_sigma_deg=sigma,
        )


def _from_image(estimate: Estimate) -> float:
    """Degrees that turn an angle in the image into one from the line of sight as the track began.

    The line of sight turns in the image with the bearing, and over the floor as the sonar is
    carried past; the object does not turn.
    """
    return estimate.bearing_deg + estimate.sight_deg
