"""What an `offline` preset knows in hindsight: one belief per track, for all its frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.estimates import declared
from sonarrec.recogniser.stage3_features import likeliest
from sonarrec.records import Estimate, FloatArray, FrameResult

LEAST_BORNE_OUT = 0.5  # mean belief of a track's frames in an ID from which it is spread over them
LEAST_BELIEF = 1e-2  # in a logarithm: no single frame rules an ID out for good


_Chapter = tuple[int, int]  # an object's, see Gathered


@dataclass(slots=True)
class _Opinion:
    """What the frames of a chapter of a track's life said of it, all taken together."""

    log_beliefs: FloatArray
    """(K + 1,) weighted sum over the frames of log belief."""
    beliefs_sum: FloatArray
    """(K + 1,) plain sum over the frames of belief."""
    weight: float = 0.0
    """Sum of the weights."""
    frames: int = 0
    """How many there were."""
    last_frame: int = 0
    turns: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    """By ID, when surest of it: (score, degrees from the line of sight as the track began, their
    standard error)."""

    def beliefs(self) -> FloatArray:
        """(K + 1,) weighted geometric mean of the beliefs, which sums to 1."""
        mean = np.exp(self.log_beliefs / self.weight)
        return np.asarray(mean / mean.sum())

    def join(self, other: _Opinion) -> None:
        """Take in what other frames of the same object said."""
        self.log_beliefs += other.log_beliefs
        self.beliefs_sum += other.beliefs_sum
        self.weight += other.weight
        self.frames += other.frames
        for landmark, turn in other.turns.items():
            self.turns[landmark] = max(turn, self.turns.get(landmark, turn))

    def borne_out(self, landmark_index: int) -> bool:
        """Whether its frames, each counting the same, mostly held it to be this one."""
        return bool(self.beliefs_sum[landmark_index] >= LEAST_BORNE_OUT * self.frames)


class Hindsight:
    """Revises past estimates of one method by what was learned of their tracks since.

    A track is one object, so one belief holds for all its frames: the mean of what each frame
    said, in logarithms, weighed by how many frames it had seen by then and by how sure it was. The
    last word alone would not do: as it leaves the view, or is taken for another on its return, a
    track is known badly.

    An ID that most of the frames speak against is not spread over them: these stay as they were.
    Where a track comes back with another picture, it is another object that took up its number: a
    belief holds for one chapter of a track's life.
    """

    def __init__(self, method: str, config: Config, landmarks: LandmarkSet) -> None:
        self._method = method
        self._lag = config.features.lag_frames
        self._threshold = config.features.declare
        self._ids = landmarks.ids
        # By object and chapter; the chapter that an object is in; chapters that went on in others.
        self._opinions: dict[_Chapter, _Opinion] = {}
        self._now: dict[int, int] = {}
        self._joined: dict[_Chapter, _Chapter] = {}

    def learn(self, result: FrameResult) -> None:
        """Take in a frame's estimates."""
        for estimate in result.estimates:
            if estimate.method == self._method:
                self._add(result.index, estimate)
        # No result still waiting is of an older track.
        oldest = result.index - 2 * self._lag
        self._opinions = {k: o for k, o in self._opinions.items() if o.last_frame >= oldest}
        self._joined = {k: into for k, into in self._joined.items() if into in self._opinions}
        self._now = {k: c for k, c in self._now.items() if (k, c) in self._opinions}

    def _add(self, frame: int, estimate: Estimate) -> None:
        key = (estimate.object, estimate.chapter)
        opinion = self._opinions.setdefault(key, _Opinion(*np.zeros((2, len(self._ids) + 1))))
        last = self._now.get(estimate.object, estimate.chapter)
        self._now[estimate.object] = estimate.chapter
        if last > estimate.chapter:  # what came back is what it was
            self._joined[estimate.object, last] = key
            opinion.join(self._opinions.pop((estimate.object, last)))
        opinion.frames += 1
        beliefs = np.maximum(estimate.probabilities, LEAST_BELIEF)
        # Minus the entropy: its exponential is 1 where the frame is sure, 1 / (K + 1) where it is
        # not. Squared: tuning seeds.
        weight = opinion.frames * float(np.exp(beliefs @ np.log(beliefs))) ** 2
        opinion.weight += weight
        opinion.log_beliefs += weight * np.log(beliefs)
        opinion.beliefs_sum += estimate.probabilities
        opinion.last_frame = frame
        if estimate.score > opinion.turns.get(estimate.landmark, (0.0,))[0]:
            turn = estimate.orientation_deg + _from_image(estimate)
            sigma = estimate.orientation_sigma_deg
            opinion.turns[estimate.landmark] = (estimate.score, turn, sigma)

    def revised(self, result: FrameResult) -> FrameResult:
        """A past result, learned before, as it is seen now."""
        return replace(result, estimates=tuple(self._revise(e) for e in result.estimates))

    def _revise(self, estimate: Estimate) -> Estimate:
        if estimate.method != self._method:
            return estimate
        key = (estimate.object, estimate.chapter)
        opinion = self._opinions[self._joined.get(key, key)]
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
            declared=claimed,
            orientation_deg=(turn - _from_image(estimate)) % 360,
            orientation_sigma_deg=sigma,
        )


def _from_image(estimate: Estimate) -> float:
    """Degrees from an angle in the image to one from the line of sight as the track began.

    The line of sight turns in the image with the bearing, and over the floor as the sonar is
    carried past; the object itself lies still.
    """
    return estimate.bearing_deg + estimate.sight_deg
