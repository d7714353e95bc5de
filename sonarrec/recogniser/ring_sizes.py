"""Whether rings of another radius fit a log clearly better than those of its landmarks.

Such a log has landmarks of another size than the set says, or a window of another length than the
geometry says. Most of them are then lost, and a few may be taken for others.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonarrec.arrays import quantile
from sonarrec.config import Candidates
from sonarrec.errors import SonarrecError
from sonarrec.landmarks import DrawnSet, LandmarkSet
from sonarrec.recogniser.plane import FloorPlane
from sonarrec.recogniser.restore.beam_width import usual_beam_width_deg
from sonarrec.recogniser.stage1 import CandidateSelector
from sonarrec.sonar.frame import Frame

KEPT = 8
"""So many frames are kept at most, spread over the log."""
LEAST_KEPT = 3
STEPS = 1.3 * 1.14 ** np.arange(7)
FACTORS = np.concatenate([1 / STEPS[::-1], STEPS])
"""Of the radius. Steps of a seventh, since a ring is a fifth of its radius wide."""
RADIUS_PX = 10.0
"""Of a disc in the pictures that are searched; stage 1 uses larger ones, and more memory."""
SHARE = 0.75
"""The best ring of a frame counts, and of the frames the best quarter: others may show none."""
# Measured on the recordings and the sample logs: rings of landmarks have a contrast of .63 or more
# at the right radius; with a radius that is wrong by 1.3 or more that of clear ones falls below.
CLEAR = 0.8
BETTER = 1.6


class RingSizes:
    """Keeps frames of a log; `other` says whether rings of another radius fit them."""

    def __init__(self, landmarks: LandmarkSet) -> None:
        self._landmarks = landmarks
        self._kept: list[Frame] = []
        self._seen, self._every, self._fitting = 0, 1, 0

    def inspect(self, frame: Frame, contrast: float = 0.0) -> None:
        """Keep a frame out of so many that no more than KEPT are held.

        contrast: the best score of its candidates, if stage 1 searched for rings.
        """
        self._fitting += contrast * BETTER >= 1
        if self._seen % self._every == 0 and not isinstance(self._landmarks, DrawnSet):
            self._kept.append(frame)
            if len(self._kept) > KEPT:
                del self._kept[1::2]
                self._every *= 2
        self._seen += 1

    def other(self) -> float | None:
        """The radius, m, at which rings are clearly there and much clearer than at that of the
        landmarks; None if there is none."""
        if self._fitting >= (1 - SHARE) * self._seen or len(self._kept) < LEAST_KEPT:
            return None  # as in most logs: that costs nothing
        if (own := self._contrast(1.0)) * BETTER >= 1:
            return None
        contrast = {factor: self._contrast(factor) for factor in FACTORS.tolist()}
        best = max(contrast, key=lambda factor: contrast[factor])
        if contrast[best] < max(CLEAR, BETTER * own):
            return None
        return float(best * self._landmarks.radius_m)

    def _contrast(self, factor: float) -> float:
        """That of the clearest rings at a multiple of the radius, 0 to 1."""
        first, config = self._kept[0], Candidates()
        landmarks = replace(self._landmarks, radius_m=factor * self._landmarks.radius_m)
        try:
            plane = FloorPlane(first.fan, landmarks.radius_m, RADIUS_PX)
        except SonarrecError:  # no floor in the window
            return 0.0
        select = CandidateSelector(config, plane, landmarks, usual_beam_width_deg(first.fan))
        scores = [select(plane.warp(f.pixels, f.polar)).scores.max(initial=0) for f in self._kept]
        return float(quantile(np.array(scores), SHARE))
