"""What a disc's shape matrix looks like, gathered along its track.

The paper measures each frame by itself and normalises away 'this is no landmark'. Here the grey
shape matrix is averaged in the object's own frame (angles count from the line of sight, which a
pan leaves alone), described under every ID (appearance_features.py), and judged by a model of what
landmarks look like (appearance_model.py).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from sonarrec.appearance_features import Describer
from sonarrec.config import Features
from sonarrec.landmarks import LandmarkSet
from sonarrec.records import FloatArray, Groups
from sonarrec.shape_matrix import ANGLES, ShapeSampler


class TrackMatrix:
    """The running average of each track's shape matrix.

    Frames fade with a memory of `memory_frames`; a cell counts by how often it was seen.
    """

    def __init__(self, memory_frames: float, lines: int) -> None:
        self._keep = 1 - 1 / max(memory_frames, 1.0)
        self._numbers: list[int] = []
        self._sum: FloatArray = np.empty((0, lines, ANGLES))
        self._count: FloatArray = np.empty((0, lines, ANGLES))

    def step(
        self, groups: Groups, grey: FloatArray, seen: npt.NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray]:
        """Add a frame's matrices (n, L, ANGLES). Returns the averages and the counts, same shape.

        Tracks that are neither in view nor remembered are forgotten.
        """
        place = {number: i for i, number in enumerate(self._numbers)}
        numbers = [*groups.numbers.tolist(), *groups.remembered.tolist()]
        total = np.zeros((len(numbers), *self._sum.shape[1:]))
        count = np.zeros_like(total)
        known = [i for i, number in enumerate(numbers) if number in place]
        before = [place[numbers[i]] for i in known]
        total[known], count[known] = self._sum[before], self._count[before]
        now = slice(len(groups.numbers))
        total[now] = self._keep * total[now] + np.where(seen, grey, 0.0)
        count[now] = self._keep * count[now] + seen
        self._numbers, self._sum, self._count = numbers, total, count
        return total[now] / np.maximum(count[now], 1e-9), count[now]


class Judge(Protocol):
    """What turns features (n, K, F) into (n, K + 1) probabilities; rows sum to 1."""

    def probabilities(self, features: FloatArray) -> FloatArray: ...


class AppearanceMeasurement:
    """The default measurement of stage 3: from each track's averaged shape matrix."""

    def __init__(
        self, config: Features, sampler: ShapeSampler, landmarks: LandmarkSet, model: Judge
    ) -> None:
        self._describe = Describer(
            sampler.bands, sampler.radii, landmarks, alike=config.alike_radii
        )
        self._model = model

    def __call__(
        self, average: FloatArray, count: FloatArray, existence: FloatArray, smear: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n, K + 1) probabilities, the (n,) turn of the likeliest ID and its error, in steps.

        average, count: (n, L, ANGLES) from TrackMatrix. existence, smear: (n,) as Describer.
        """
        description = self._describe(average, count, existence, smear)
        probabilities = self._model.probabilities(description.features)
        best = probabilities[:, :-1].argmax(axis=1)
        at = (np.arange(len(best)), best)
        return probabilities, description.turn[at], description.turn_sigma[at]
