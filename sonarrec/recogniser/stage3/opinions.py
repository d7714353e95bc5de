"""Pools the beliefs of a track's frames.

A track's picture (track_matrix.py) holds earlier frames already, so the beliefs of two frames are
far from independent. To multiply them, as a Bayesian recursion does (Eq. 5 to 8), would count the
same evidence many times. A logarithmic opinion pool, a weighted mean of log beliefs, does not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.nouns import Groups
from sonarrec.recogniser.stage3 import Evidence

LEAST_BELIEF = 1e-2  # of a frame in the pool: no single frame rules an ID out for good
LEAST_NOW = 1e-6  # of the frame that is reported: the tables have six digits
# The belief that is reported is this frame's to the power FRAME_EXPONENT times the track's pool to
# the power TRACK_EXPONENT. Chosen on tuning seeds (2000 to 2007 and 2500 to 2507) for the least
# cost over all kinds, a false claim counting as two misses. They sum to more than 1 because the
# mean is less sure than single frames.
FRAME_EXPONENT, TRACK_EXPONENT = 0.5, 0.6


@dataclass
class Opinion:
    """The pool of the frames of one chapter of a track."""

    log_beliefs: FloatArray
    """(K + 1,) weighted sum over the frames of log belief."""
    weight: float = 0.0
    """Sum of the weights."""
    frames: int = 0
    """How many there were."""

    def add(self, beliefs: FloatArray) -> None:
        """Take in a frame's (K + 1,) beliefs, weighted by its place in the track and certainty."""
        self.frames += 1
        logs = np.log(np.maximum(beliefs, LEAST_BELIEF))
        # exp(-entropy) is 1 where the frame is sure, 1 / (K + 1) where it knows nothing; its square
        # did best on tuning seeds.
        weight = self.frames * float(np.exp(np.exp(logs) @ logs)) ** 2
        self.weight += weight
        self.log_beliefs += weight * logs

    def join(self, other: Self) -> None:
        """Take in the beliefs of other frames of the same object."""
        self.log_beliefs += other.log_beliefs
        self.weight += other.weight
        self.frames += other.frames

    def mean(self) -> FloatArray:
        """(K + 1,) weighted mean of the log beliefs."""
        return self.log_beliefs / self.weight


AnyOpinion = TypeVar("AnyOpinion", bound=Opinion)


class Opinions(Generic[AnyOpinion]):
    """The opinions of all tracks, chapter by chapter (see Evidence)."""

    def __init__(self, new: Callable[[], AnyOpinion]) -> None:
        self._new = new
        self._of: dict[tuple[int, int], AnyOpinion] = {}
        self._last_used: dict[tuple[int, int], int] = {}  # frame
        self._chapter: dict[int, int] = {}

    def current(self, track: int, chapter: int, frame: int) -> AnyOpinion:
        """The opinion to which a frame of a track in this chapter is to be added.

        It is new where the chapter is. Where an older chapter goes on (see TrackMatrix), its
        opinion and that of the chapter it replaces are joined into one from then on.
        """
        key = (track, chapter)
        if key not in self._of:
            self._of[key] = self._new()
        opinion = self._of[key]
        last = self._chapter.get(track, chapter)
        if last > chapter:
            opinion.join(self._of[track, last])
            self._of[track, last] = opinion
        self._chapter[track], self._last_used[key] = chapter, frame
        return opinion

    def get(self, track: int, chapter: int) -> AnyOpinion:
        """The opinion of a track in a chapter, which `current` has made before."""
        return self._of[track, chapter]

    def forget(self, before: int) -> None:
        """Drop the opinions that were last used before this frame."""
        for key in [k for k, frame in self._last_used.items() if frame < before]:
            del self._of[key], self._last_used[key]
            if self._chapter.get(key[0]) == key[1]:
                del self._chapter[key[0]]


class TrackBelief:
    """Turns the beliefs of single frames into beliefs about their tracks."""

    def __init__(self, ids: int, remember_frames: int) -> None:
        """ids: K. remember_frames: a track that was away for longer does not come back."""
        self._opinions = Opinions(lambda: Opinion(np.zeros(ids + 1)))
        self._remember = remember_frames
        self._frame = 0

    def __call__(
        self, groups: Sequence[Groups], evidence: Evidence, probabilities: FloatArray
    ) -> FloatArray:
        """(n, K + 1) beliefs in the n groups of some frames, one frame after another.

        probabilities: (n, K + 1) by each frame's picture alone. Rows of both sum to 1.
        """
        so_far = np.empty_like(probabilities)
        i = 0
        for group in groups:
            self._frame += 1
            for track in group.numbers.tolist():
                opinion = self._opinions.current(track, int(evidence.chapters[i]), self._frame)
                opinion.add(probabilities[i])
                so_far[i] = opinion.mean()
                i += 1
        self._opinions.forget(self._frame - self._remember)
        beliefs = np.exp(
            FRAME_EXPONENT * np.log(np.maximum(probabilities, LEAST_NOW)) + TRACK_EXPONENT * so_far
        )
        return np.asarray(beliefs / beliefs.sum(axis=1, keepdims=True))
