"""Pools the beliefs of a track's frames by a logarithmic opinion pool.

A track's picture (track_matrix.py) already contains the earlier frames, so the beliefs of two
frames are far from independent. Multiplying them, as a Bayesian recursion does (Eq. 5 to 8), would
count the same evidence many times. The pool, a weighted mean of log beliefs, does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.recogniser.stage3 import Evidence
from sonarrec.records import Groups

LEAST_BELIEF = 1e-2  # of a frame in the pool, so that no single frame rules out an ID for good
LEAST_FRAME_BELIEF = 1e-6  # of the reported frame, since the tables have six digits
# The reported belief is the frame's to the power FRAME_EXPONENT times the track's pool to the power
# TRACK_EXPONENT. Chosen on tuning seeds (2000 to 2007 and 2500 to 2507) for the least cost over all
# kinds of scene, where a false claim costs as much as two misses. They sum to more than 1 because
# the mean is less certain than single frames.
FRAME_EXPONENT, TRACK_EXPONENT = 0.5, 0.6


@dataclass
class Opinion:
    """The pool of the frames of one episode of a track."""

    log_beliefs: FloatArray
    """(K + 1,) weighted sum of the frames' log beliefs."""
    beliefs_sum: FloatArray
    """(K + 1,) unweighted sum of the frames' beliefs."""
    weight: float = 0.0
    """Sum of the weights."""
    frames: int = 0
    """Number of frames."""
    with_evidence: int = 0
    """By hindsight, in how many frames an ID could be declared (see Beliefs)."""
    declared: dict[int, int] = field(default_factory=dict)
    """By hindsight, in how many frames each ID was declared."""
    orientations: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    """By hindsight, for each ID, by the frame with its highest score: (score, orientation in
    degrees from the line of sight at the track's beginning, its standard error)."""

    def add(self, beliefs: FloatArray) -> None:
        """Add a frame's (K + 1,) beliefs, weighted by its index in the track and its certainty."""
        self.frames += 1
        logs = np.log(np.maximum(beliefs, LEAST_BELIEF))
        # exp(-entropy) is 1 for a certain frame, 1 / (K + 1) for uniform beliefs; its square did
        # best on tuning seeds.
        weight = self.frames * float(np.exp(np.exp(logs) @ logs)) ** 2
        self.weight += weight
        self.log_beliefs += weight * logs
        self.beliefs_sum += beliefs

    def join(self, other: Opinion) -> None:
        """Add the beliefs of other frames of the same object."""
        self.log_beliefs += other.log_beliefs
        self.weight += other.weight
        self.frames += other.frames
        self.with_evidence += other.with_evidence
        self.beliefs_sum += other.beliefs_sum
        for landmark, frames in other.declared.items():
            self.declared[landmark] = self.declared.get(landmark, 0) + frames
        for landmark, surest in other.orientations.items():
            self.orientations[landmark] = max(surest, self.orientations.get(landmark, surest))

    def mean(self) -> FloatArray:
        """(K + 1,) weighted mean of the log beliefs."""
        return self.log_beliefs / self.weight


class Opinions:
    """The opinions of all tracks on K IDs, episode by episode (see Evidence)."""

    def __init__(self, ids: int) -> None:
        """ids: K."""
        self._size = ids + 1
        self._of: dict[tuple[int, int], Opinion] = {}
        self._last_used: dict[tuple[int, int], int] = {}  # frame
        self._episode: dict[int, int] = {}

    def current(self, track: int, episode: int, frame: int) -> Opinion:
        """The opinion of a track in this episode, to which a frame is to be added.

        A new episode has a new opinion. If an earlier episode is resumed (see TrackMatrix), its
        opinion and that of the episode it replaces become one.
        """
        key = (track, episode)
        if key not in self._of:
            self._of[key] = Opinion(np.zeros(self._size), np.zeros(self._size))
        opinion = self._of[key]
        last = self._episode.get(track, episode)
        if last > episode:
            opinion.join(self._of[track, last])
            self._of[track, last] = opinion
        self._episode[track], self._last_used[key] = episode, frame
        return opinion

    def get(self, track: int, episode: int) -> Opinion:
        """The opinion of a track in an episode, which `current` has returned before."""
        return self._of[track, episode]

    def drop_before(self, before: int) -> None:
        """Drop the opinions that were last used before this frame."""
        for key in [k for k, frame in self._last_used.items() if frame < before]:
            del self._of[key], self._last_used[key]
            if self._episode.get(key[0]) == key[1]:
                del self._episode[key[0]]


class TrackBelief:
    """Converts the beliefs of single frames to beliefs about their tracks."""

    def __init__(self, ids: int, remember_frames: int) -> None:
        """ids: K. remember_frames: frames out of view after which a track is forgotten."""
        self._opinions = Opinions(ids)
        self._remember = remember_frames
        self._frame = 0

    def __call__(
        self, groups: Sequence[Groups], evidence: Evidence, probabilities: FloatArray
    ) -> FloatArray:
        """(n, K + 1) beliefs about the n groups of consecutive frames; rows sum to 1.

        probabilities: (n, K + 1) by the model from each frame's evidence; rows sum to 1.
        """
        so_far = np.empty_like(probabilities)
        i = 0
        for group in groups:
            self._frame += 1
            for track in group.numbers.tolist():
                opinion = self._opinions.current(track, int(evidence.episodes[i]), self._frame)
                opinion.add(probabilities[i])
                so_far[i] = opinion.mean()
                i += 1
        self._opinions.drop_before(self._frame - self._remember)
        beliefs = np.exp(
            FRAME_EXPONENT * np.log(np.maximum(probabilities, LEAST_FRAME_BELIEF))
            + TRACK_EXPONENT * so_far
        )
        return np.asarray(beliefs / beliefs.sum(axis=1, keepdims=True))
