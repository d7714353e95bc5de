"""Stage 1 for plates: bright or uneven figures of a plate's size are candidates.

No drawing is compared with the whole image; that a figure holds one, stage 2 finds out.
"""

from __future__ import annotations

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatImage
from sonarrec.recogniser.plane import Plane
from sonarrec.recogniser.stage1 import ScoreMaps

# Sides of the window, in sides of a plate: along the range a tilted one is shorter.
WINDOW = (0.9, 0.65)
LEAST_SEEN = 0.7  # of the window inside the fan
# A drawing's levels differ between a tenth and half of a side. So many sigmas of the frame's grey
# levels, with those by which the whole is brighter than its surroundings, score 1; plates have .7
# to 1.9.
FULL_CONTRAST = 1.7
FINE_SHARE, BROAD_SHARE = 1 / 10, 1 / 2


class PlateScore:
    """How uneven a plate-sized window is inside, and how bright over its surroundings."""

    def __init__(self, plane: Plane) -> None:
        side = 2 * plane.axes[0]
        self._window = tuple(max(3, round(share * side)) for share in WINDOW)
        self._sizes = tuple(max(1, round(share * side)) for share in (FINE_SHARE, BROAD_SHARE))
        inside = plane.inside.astype(np.float32)
        seen = np.asarray(cv2.blur(inside, self._window), np.float32)
        self._share = np.where(seen >= LEAST_SEEN, 1 / np.maximum(seen, 0.1), 0).astype(np.float32)

    def __call__(self, _: ByteImage, relief: FloatImage, sigma: float) -> ScoreMaps:
        """As of `Detector`."""
        fine, broad = (cv2.blur(relief, (size, size)) for size in self._sizes)
        inner = np.maximum(self._mean((fine - broad) ** 2), 0)
        bright = np.maximum(self._mean(relief), 0)
        score = np.sqrt(inner + bright**2) / np.float32(FULL_CONTRAST * sigma)
        # Of plateaus the middle is the candidate.
        peaks = np.asarray(cv2.GaussianBlur(score, (0, 0), self._sizes[0]), np.float32)
        return ScoreMaps(score, peaks, score, np.full((1, 1), sigma, np.float32))

    def _mean(self, values: FloatImage) -> FloatImage:
        return np.asarray(cv2.blur(values, self._window) * self._share, np.float32)
