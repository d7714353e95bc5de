"""Pools the beliefs of a track's frames by a logarithmic opinion pool.

A track's picture (appearance.py) already contains the earlier frames, so the beliefs of two frames
are far from independent. Multiplying them, as a Bayesian recursion does (Eq. 5 to 8), would count
the same evidence many times. The pool, a weighted mean of log beliefs, does not.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Self

import numpy as np

from sonarrec.arrays import FloatArray

LEAST_BELIEF = 1e-2  # of a frame in the pool, so that no single frame rules out an ID for good
LEAST_FRAME_BELIEF = 1e-6  # of the reported frame, since the tables have six digits
# The reported belief is the frame's to the power FRAME_EXPONENT times the track's pool to the power
# TRACK_EXPONENT. Chosen on tuning seeds (2000 to 2007 and 2500 to 2507) for the least cost over all
# kinds of scene, where a false claim costs as much as two misses. They sum to more than 1 because
# the mean is less certain than single frames.
FRAME_EXPONENT, TRACK_EXPONENT = 0.5, 0.6


class Opinion:
    """The pool of some frames of a track.

    It belongs to a row of the tracks, and to the frames that wait for stage 3.

    log_beliefs: (K + 1,) weighted sum of the frames' log beliefs. weight: sum of the weights.
    beliefs: (K + 1,) unweighted sum of the beliefs. frames: number of frames.
    """

    def __init__(self, *parts: Self) -> None:
        """parts: opinions that it continues as one, each complete when its first frame is added."""
        self._parts = parts
        self.log_beliefs: FloatArray = np.zeros(())
        self.beliefs: FloatArray = np.zeros(())
        self.weight, self.frames = 0.0, 0

    def add(self, beliefs: FloatArray) -> None:
        """Add a frame's (K + 1,) beliefs, weighted by its index in the track and its certainty."""
        for part in self._parts:
            self.join(part)
        self._parts = ()
        self.frames += 1
        logs = np.log(np.maximum(beliefs, LEAST_BELIEF))
        # exp(-entropy) is 1 for a certain frame, 1 / (K + 1) for uniform beliefs; its square did
        # best on tuning seeds.
        weight = self.frames * float(np.exp(np.exp(logs) @ logs)) ** 2
        self.weight += weight
        self.log_beliefs = self.log_beliefs + weight * logs
        self.beliefs = self.beliefs + beliefs

    def join(self, other: Self) -> None:
        """Add the beliefs of other frames of the same object."""
        self.log_beliefs = self.log_beliefs + other.log_beliefs
        self.beliefs = self.beliefs + other.beliefs
        self.weight += other.weight
        self.frames += other.frames

    def mean(self) -> FloatArray:
        """(K + 1,) weighted mean of the log beliefs."""
        return self.log_beliefs / self.weight


def pooled(opinions: Iterable[Opinion], probabilities: FloatArray) -> FloatArray:
    """(n, K + 1) beliefs about the tracks of consecutive frames, n in all; rows sum to 1.

    opinions: (n,) of the tracks, to which the frames are added. probabilities: (n, K + 1) by the
    model from each frame's evidence; rows sum to 1.
    """
    so_far = np.empty_like(probabilities)
    for i, (opinion, beliefs) in enumerate(zip(opinions, probabilities, strict=True)):
        opinion.add(beliefs)
        so_far[i] = opinion.mean()
    beliefs = np.exp(
        FRAME_EXPONENT * np.log(np.maximum(probabilities, LEAST_FRAME_BELIEF))
        + TRACK_EXPONENT * so_far
    )
    return np.asarray(beliefs / beliefs.sum(axis=1, keepdims=True))
