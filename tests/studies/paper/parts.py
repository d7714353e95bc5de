"""What of the framework's gain is due to what: its parts alone, over the same frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.stage3.shape_matrix import ShapeSampler, identify, rotated_codes
from sonarrec.recogniser.three_stages import FRAMEWORK, SMI, DiscStages
from sonarrec.sonar.frame import Estimate, Fan, Frame, Selection
from sonarrec.sonar.geometry import polar_from_pixel

CONTINUITY = "continuity"
"""Stages 1 and 2, then SMI in every frame at its own operating point."""
ONE = "_one_claim"
"""A method with this in its name claims an ID at most once in a frame: where it is surest."""


class Parts:
    """The paper's preset, whole and taken apart."""

    def __init__(self, config: Config, fan: Fan, landmarks: LandmarkSet) -> None:
        """config: the paper's preset, with the seed of its particles."""
        self._fan, self._ids, self._declare = fan, landmarks.ids, config.smi.declare
        self.stages = DiscStages(
            config, fan, landmarks, method=f"{FRAMEWORK}:paper", smi=f"{SMI}:paper"
        )
        self._bands = ShapeSampler(landmarks, (1.0, 1.0)).bands
        self._codes = rotated_codes(landmarks)

    def step(self, frame: Frame, image: ByteImage, selection: Selection) -> list[Estimate]:
        """The estimates of SMI, the framework and its parts in the log's next frame."""
        after = self.stages.stage2(frame, image, selection)
        made = list(self.stages.stage3([after])[0].estimates)
        smi = [e for e in made if e.method.startswith(SMI)]
        tracks = after.tracks
        held = identify(tracks["grey"], tracks["seen"], self._bands, self._codes)
        continuity = self._estimates(tracks["position"], held.measurement(), held.score)
        return [*made, *once(smi), *continuity, *once(continuity)]

    def _estimates(
        self, places: FloatArray, beliefs: FloatArray, scores: FloatArray
    ) -> list[Estimate]:
        polar = np.stack(polar_from_pixel(self._fan, *places.T), axis=-1)
        made = []
        for i, (belief, score) in enumerate(zip(beliefs, scores.tolist(), strict=True)):
            place = *places[i].tolist(), *polar[i].tolist(), np.nan, np.nan
            said = np.append(belief, 0.0), self._ids[belief.argmax()], score
            made.append(Estimate(CONTINUITY, i, *place, *said, score >= self._declare))
        return made


def once(estimates: Sequence[Estimate]) -> list[Estimate]:
    """A method's estimates in one frame; of each ID all but the surest get score 0, as where the
    framework compares, and are not declared."""
    best = {e.landmark: e for e in sorted(estimates, key=lambda e: e.score)}
    lost = {"score": 0.0, "declared": False}
    return [
        replace(e, method=e.method + ONE, **({} if best[e.landmark] is e else lost))
        for e in estimates
    ]
