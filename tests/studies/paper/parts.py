"""What of the framework's gain is due to what: its parts alone, over the same frames."""

from __future__ import annotations

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.config import preset
from sonarrec.geometry import polar_from_pixel
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, Fan, Frame
from sonarrec.recogniser.stage3.shape_matrix import ShapeSampler, rotated_codes
from sonarrec.recogniser.stage3.smi import identify
from sonarrec.recogniser.three_stages import FRAMEWORK, SMI, ThreeStages

CONTINUITY = "continuity"
"""Stages 1 and 2, then SMI in every frame at its own operating point."""


class Parts:
    """The paper's preset, whole and taken apart."""

    def __init__(self, fan: Fan, landmarks: LandmarkSet) -> None:
        self._config = config = preset("paper")
        self._fan, self._ids = fan, landmarks.ids
        names = f"{FRAMEWORK}:paper", f"{SMI}:paper"
        self._stages = ThreeStages(config, fan, landmarks, None, *names)
        self._bands = ShapeSampler(landmarks, (1.0, 1.0)).bands
        self._codes = rotated_codes(landmarks)

    def step(self, frame: Frame) -> list[Estimate]:
        """The estimates of SMI, the framework and its parts in the log's next frame."""
        stages, config = self._stages, self._config
        image = stages.working_image(frame)
        after = stages.stage2(frame, image, stages.stage1(image))
        made = list(stages.stage3([after])[0].estimates)
        held = identify(
            after.evidence.brightness, after.evidence.count > 0, self._bands, self._codes
        )
        q, declare = held.measurement(), config.smi.declare
        made += self._estimates(CONTINUITY, after.groups.positions, q, held.score, declare)
        return made

    def _estimates(
        self,
        method: str,
        places: FloatArray,
        beliefs: FloatArray,
        scores: FloatArray,
        threshold: float,
    ) -> list[Estimate]:
        range_m, bearing_deg = polar_from_pixel(self._fan, *places.T)
        return [
            Estimate(
                method=method,
                object=i,
                x_px=float(places[i, 0]),
                y_px=float(places[i, 1]),
                range_m=float(range_m[i]),
                bearing_deg=float(bearing_deg[i]),
                orientation_deg=np.nan,
                existence=np.nan,
                probabilities=np.append(beliefs[i], 0.0),
                landmark=self._ids[beliefs[i].argmax()],
                score=float(scores[i]),
                declared=bool(scores[i] >= threshold),
            )
            for i in range(len(places))
        ]
