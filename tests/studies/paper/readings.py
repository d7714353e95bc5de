"""Readings of what the paper leaves open, over the frames of the paper's preset.

`as printed` takes every formula as it is printed; each other reading undoes one choice of the
preset. All share its SMI, its seed of the particles and its least score (`features.declare`), which
was chosen for the preset alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sonarrec.arrays import ByteImage
from sonarrec.config import Candidates, Config, with_table
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.three_stages import DiscStages
from sonarrec.sonar.frame import Estimate, Fan, Frame, Selection

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
