"""Stage 1 for plates: bright figures of a plate's size are candidates.

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
FULL_CONTRAST = 1.4  # sigmas of the frame's grey levels over the surroundings that score 1
# Inside a drawing, levels between a third and two thirds of a side differ; of those of a plate
# that is all bright or of a fish, hardly. Sigmas of the frame that count in full.
FULL_INNER = 0.25
LEAST_SEEN = 0.7  # of the window inside the fan
FINE_SHARE, BROAD_SHARE = 1 / 10, 1 / 2


class PlateScore:
    """A plate-sized window's brightness over its surroundings, where it is uneven inside."""

    def __init__(self, plane: Plane) -> None:
        side = 2 * plane.axes[0]
        self._window = tuple(max(3, round(share * side)) for share in WINDOW)
        self._sizes = tuple(max(1, round(share * side)) for share in (FINE_SHARE, BROAD_SHARE))
        inside = plane.inside.astype(np.float32)
        seen = np.asarray(cv2.blur(inside, self._window), np.float32)
        self._share = np.where(seen >= LEAST_SEEN, 1 / np.maximum(seen, 0.1), 0).astype(np.float32)

    def __call__(
        self,
        image: ByteImage,  # noqa: ARG002
        relief: FloatImage,
        sigma: float,
    ) -> ScoreMaps:
        """As of `Detector`."""
        fine, broad = (cv2.blur(relief, (size, size)) for size in self._sizes)
        inner = np.sqrt(np.maximum(self._mean((fine - broad) ** 2), 0)) / (FULL_INNER * sigma)
        score = self._mean(relief) / (FULL_CONTRAST * sigma) * np.minimum(inner, 1)
        # Of plateaus the middle is the candidate.
        score = np.maximum(score, 0).astype(np.float32)
        peaks = np.asarray(cv2.GaussianBlur(score, (0, 0), self._sizes[0]), np.float32)
        return ScoreMaps(score, peaks, score, np.full((1, 1), sigma, np.float32))

    def _mean(self, values: FloatImage) -> FloatImage:
        return np.asarray(cv2.blur(values, self._window) * self._share, np.float32)
