"""What of the framework's gain is due to what: its parts alone, and readings of what the paper
leaves open, over the same frames.

`as printed` takes every formula as it is printed; each other reading undoes one choice of the
preset. All share its SMI, its seed of the particles and its least score (`features.declare`), which
was chosen for the preset alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.config import Candidates, Config, with_table
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


Table = Mapping[str, Mapping[str, Any]]

AS_PRINTED: dict[str, Table] = {
    "`hit_power` 1: P_hit is the map itself": {"continuity": {"hit_power": 1.0}},
    "`least_in_view` 0: only its spread ends a group": {"continuity": {"least_in_view": 0.0}},
    "`distance_power` 1: 1/d in Eq. 5": {"features": {"distance_power": 1.0}},
    "`least_ring` 0: no test of the circle": {"features": {"least_ring": 0.0}},
}
"""The formulas as they are printed, where the preset has another reading."""
READINGS: dict[str, Table] = {
    "as printed: the next four together": {
        section: {k: v for table in AS_PRINTED.values() for k, v in table.get(section, {}).items()}
        for section in ("continuity", "features")
    },
    **AS_PRINTED,
    "`p_hit` normalised: over the group": {"continuity": {"p_hit": "normalised"}},
    "`count_strikes` in_a_row": {"continuity": {"count_strikes": "in_a_row"}},
    "`edge_gain` none": {"candidates": {"edge_gain": "none"}},
    "`new_belief` neighbours: by Eq. 5": {"features": {"new_belief": "neighbours"}},
    "`motion_model` association: no Eq. 5": {"features": {"motion_model": "association"}},
    "`decide` threshold: no comparison": {"features": {"decide": "threshold"}},
}
"""What differs from the preset."""


class Readings:
    """All readings, side by side."""

    def __init__(self, config: Config, fan: Fan, landmarks: LandmarkSet) -> None:
        """config: the paper's preset, with the seed of its particles."""
        self._candidates = config.candidates
        self._stages: list[tuple[Candidates, DiscStages]] = []
        for name, table in READINGS.items():
            reading = with_table(config, table, name)
            stages = DiscStages(reading, fan, landmarks, method=name, smi=None)
            self._stages.append((reading.candidates, stages))

    def step(self, frame: Frame, image: ByteImage, selection: Selection) -> list[Estimate]:
        """The estimates of each in the log's next frame. selection: the preset's."""
        selected = {self._candidates: selection}
        found: list[Estimate] = []
        for candidates, stages in self._stages:
            if candidates not in selected:
                selected[candidates] = stages.stage1(image)
            tracked = stages.stage2(frame, image, selected[candidates])
            found.extend(stages.stage3([tracked])[0].estimates)
        return found
