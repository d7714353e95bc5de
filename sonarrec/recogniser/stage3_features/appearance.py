"""What a disc's shape matrix looks like, gathered along its track.

The paper measures each frame by itself and normalises away 'this is no landmark'. Here the grey
shape matrix is averaged in the object's own frame (angles count from the line of sight, which a
pan leaves alone), described under every ID (description.py), and judged by a model of what
landmarks look like (model.py).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from sonarrec.config import Features
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.stage3_features.description import Describer
from sonarrec.recogniser.stage3_features.shape_matrix import ShapeSampler
from sonarrec.records import FloatArray


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
