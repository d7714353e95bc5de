"""What of the framework's gain is due to what: its parts alone, over the same frames."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.config import preset
from sonarrec.geometry import polar_from_pixel
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, Fan, Frame
from sonarrec.recogniser.stage3.published import (
    FeatureEstimator,
    measurement_model,
    motion_model,
    update,
)
from sonarrec.recogniser.stage3.shape_matrix import ShapeSampler, turned_codes
from sonarrec.recogniser.stage3.smi import identify
from sonarrec.recogniser.three_stages import ThreeStages
from tests.studies.paper.choices import CHOSEN

CONTINUITY = "continuity"
"""Stages 1 and 2, then SMI in every frame at its own operating point."""
BAYES = "bayes"
"""Stages 1 and 3: Eq. 5 to 8 from candidates to candidates, without particles."""
LEARNED = "learned"
"""The framework with a measurement model learned on these worlds in place of Table 3."""


class Parts:
    """The paper's preset taken apart; a `Rival` of tests.support.simulated."""

    def __init__(self, fan: Fan, landmarks: LandmarkSet) -> None:
        self._config = config = preset("paper")
        self._fan = fan
        self._ids = landmarks.ids
        self._recogniser = ThreeStages(config, fan, landmarks, smi=None)
        self._bands = ShapeSampler(landmarks, (1.0, 1.0)).bands
        self._turned = turned_codes(landmarks)
        self._published = measurement_model(landmarks, fan.window_m)
        with CHOSEN.open("rb") as file:
            learned = np.array(tomllib.load(file)["learned"])
        self._learned = FeatureEstimator(config.features, learned)
        self._places: FloatArray = np.empty((0, 2))
        self._beliefs: FloatArray = np.empty((0, len(self._ids)))
        self._index = -1

    def step(self, image: np.ndarray) -> list[Estimate]:
        """The estimates of all parts in the log's next frame."""
        self._index += 1
        frame = Frame(self._index, 0, image, self._fan)
        stages = self._recogniser
        followed = stages.stage2(stages.stage1(stages.working_image(frame)))
        groups = followed.groups
        declare = self._config.features.declare
        found = identify(
            followed.evidence.brightness, followed.evidence.count > 0, self._bands, self._turned
        )
        made = self._estimates(
            CONTINUITY,
            groups.numbers,
            groups.positions,
            found.measurement(),
            found.score,
            self._config.smi.declare,
        )
        measured = found.measurement(self._config.features.least_ring)
        beliefs = self._learned.step(groups, measured)
        made += self._estimates(
            LEARNED, groups.numbers, groups.positions, beliefs, beliefs.max(axis=1), declare
        )
        single = identify(followed.grey, followed.seen, self._bands, self._turned)
        measured = single.measurement(self._config.features.least_ring)
        beliefs = self._carried(followed.candidates, measured)
        numbers = np.arange(len(beliefs))
        made += self._estimates(
            BAYES, numbers, followed.candidates, beliefs, beliefs.max(axis=1), declare
        )
        return made

    def _carried(self, places: FloatArray, measured: FloatArray) -> FloatArray:
        """(n, K) Eq. 5 to 8 from the candidates of the frame before to these."""
        predicted = np.full(measured.shape, 1 / len(self._ids))
        if len(self._places) and len(places):
            power = self._config.features.distance_power
            predicted = motion_model(places, self._places, power) @ self._beliefs
        beliefs = update(predicted, measured, self._published)
        self._places, self._beliefs = places, beliefs
        return beliefs

    def _estimates(
        self,
        method: str,
        numbers: Sequence[int] | np.ndarray,
        places: FloatArray,
        beliefs: FloatArray,
        scores: FloatArray,
        threshold: float,
    ) -> list[Estimate]:
        range_m, bearing_deg = polar_from_pixel(self._fan, *places.T)
        best = beliefs.argmax(axis=1)
        return [
            Estimate(
                method=method,
                object=int(numbers[i]),
                x_px=float(places[i, 0]),
                y_px=float(places[i, 1]),
                range_m=float(range_m[i]),
                bearing_deg=float(bearing_deg[i]),
                orientation_deg=np.nan,
                existence=np.nan,
                probabilities=np.append(beliefs[i], 0.0),
                landmark=self._ids[best[i]],
                score=float(scores[i]),
                declared=bool(scores[i] >= threshold),
            )
            for i in range(len(places))
        ]
