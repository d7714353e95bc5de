"""What a track's frames say of it, taken together.

A track's picture (track_matrix.py) holds earlier frames already: what two frames say is far from
independent, and to multiply their beliefs, as a Bayesian recursion would (Eq. 5 to 8), claims the
same evidence many times over. A logarithmic opinion pool does not: it is a weighted mean of log
beliefs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import numpy as np

from sonarrec.recogniser.stage3_features import Gathered
from sonarrec.records import FloatArray, Groups

LEAST_BELIEF = 1e-2  # in a logarithm: no single frame rules an ID out for good
LEAST_NOW = 1e-6  # the same, in what this frame says of itself: the digits that the tables have
# Powers of this frame's belief and of its track's so far in the belief that is reported: near a fit
# to tuning seeds (2000 to 2007 and 2500 to 2507), where they had the least cost, as for
# features.declare. That they sum to more than 1 makes up for the mean being less sure than frames.
NOW, SO_FAR = 0.5, 0.6


@dataclass(slots=True)
class Opinion:
    """The pool of what frames said of one chapter of a track's life."""

    log_beliefs: FloatArray
    """(K + 1,) weighted sum over the frames of log belief."""
    weight: float = 0.0
    """Sum of the weights."""
    frames: int = 0
    """How many there were."""

    def add(self, beliefs: FloatArray) -> None:
        """Take in a frame's (K + 1,) beliefs.

        It weighs by how many frames it had seen and by how sure it is.
        """
        self.frames += 1
        logs = np.log(np.maximum(beliefs, LEAST_BELIEF))
        # The mean of the logs is minus the entropy: its exponential is 1 where the frame is sure,
        # 1 / (K + 1) where it is not. Squared: tuning seeds.
        weight = self.frames * float(np.exp(np.exp(logs) @ logs)) ** 2
        self.weight += weight
        self.log_beliefs += weight * logs

    def join(self, other: Self) -> None:
        """Take in what other frames of the same object said."""
        self.log_beliefs += other.log_beliefs
        self.weight += other.weight
        self.frames += other.frames

    def mean(self) -> FloatArray:
        """(K + 1,) weighted mean of the log beliefs."""
        return self.log_beliefs / self.weight


AnyOpinion = TypeVar("AnyOpinion", bound=Opinion)


class Opinions(Generic[AnyOpinion]):
    """The opinions of all tracks, chapter by chapter (see Gathered)."""

    def __init__(self, new: Callable[[], AnyOpinion]) -> None:
        self._new = new
        self._of: dict[tuple[int, int], AnyOpinion] = {}
        self._chapter: dict[int, int] = {}

    def now(self, track: int, chapter: int) -> AnyOpinion:
        """The opinion that a frame adds to, of a track that is in a chapter now.

        Where an older chapter goes on, what came back is what it was: the two share one opinion.
        """
        key = (track, chapter)
        opinion = self._of.setdefault(key, self._new())
        last = self._chapter.get(track, chapter)
        if last > chapter:
            opinion.join(self._of[track, last])
            self._of[track, last] = opinion
        self._chapter[track] = chapter
        return opinion

    def of(self, track: int, chapter: int) -> AnyOpinion:
        """The opinion of a track in a chapter that `now` was asked for."""
        return self._of[track, chapter]

    def keep(self, wanted: Callable[[int, AnyOpinion], bool]) -> None:
        """Forget all others. wanted: of a track and its opinion."""
        self._of = {key: o for key, o in self._of.items() if wanted(key[0], o)}
        self._chapter = {k: c for k, c in self._chapter.items() if (k, c) in self._of}


class TrackBelief:
    """From what frames say by themselves to what is believed of their tracks."""

    def __init__(self, ids: int) -> None:
        self._opinions = Opinions(lambda: Opinion(np.zeros(ids + 1)))

    def __call__(
        self, groups: Sequence[Groups], gathered: Gathered, probabilities: FloatArray
    ) -> FloatArray:
        """(n, K + 1) beliefs in the n groups of some frames, at least one, one after another.

        probabilities: (n, K + 1) by each frame's picture alone. Rows of both sum to 1.
        """
        so_far = np.empty_like(probabilities)
        i = 0
        for group in groups:
            for track in group.numbers.tolist():
                opinion = self._opinions.now(track, int(gathered.chapters[i]))
                opinion.add(probabilities[i])
                so_far[i] = opinion.mean()
                i += 1
        there = {*groups[-1].numbers.tolist(), *groups[-1].remembered.tolist()}
        self._opinions.keep(lambda track, _: track in there)
        beliefs = np.exp(NOW * np.log(np.maximum(probabilities, LEAST_NOW)) + SO_FAR * so_far)
        return np.asarray(beliefs / beliefs.sum(axis=1, keepdims=True))
