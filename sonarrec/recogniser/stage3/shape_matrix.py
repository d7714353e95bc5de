"""Shape matrices (Section 3.4.2), which stage 3 and the single-frame baseline (smi.py) measure.

Brightness is sampled along concentric lines, at equally spaced angles, on the disc as it appears in
the working plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, ByteImage, FloatArray, IntArray
from sonarrec.landmarks import LandmarkSet

ANGLES = 36
STEP = 2 * np.pi / ANGLES
STEP_DEG = 360 / ANGLES
# Lines lie at the middles of equal parts of the symbol and of the ring; for the track's average
# also of the dark gap between them and of the floor just outside, whose radii are OUTER.
SYMBOL_LINES = 3
RING_LINES = 3
GAP_LINES = 2
OUTER_LINES = 2
OUTER = (1.12, 1.32)


def rounded_steps(angle_deg: FloatArray) -> tuple[IntArray, FloatArray]:
    """Angles of any shape as whole steps, and the remaining degrees, at most half a step."""
    steps = np.rint(angle_deg / STEP_DEG).astype(np.int64)
    return steps, angle_deg - steps * STEP_DEG


@dataclass(frozen=True, slots=True)
class Bands:
    """The rows of a shape matrix on each part of the disc."""

    symbol: slice
    ring: slice
    gap: slice
    """Between the two."""
    outer: slice
    """The floor just outside."""


class ShapeSampler:
    """Samples the shape matrices of many objects at once.

    radii: (L,) of the lines, in disc radii. bands: the part of the disc on which each line lies.
    """

    def __init__(self, landmarks: LandmarkSet, axes: tuple[float, float]) -> None:
        """axes: (across, along) semi-axes of the disc in pixels."""
        parts = (
            (landmarks.symbol, SYMBOL_LINES),
            (landmarks.ring, RING_LINES),
            ((landmarks.symbol[1], landmarks.ring[0]), GAP_LINES),
            (OUTER, OUTER_LINES),
        )
        ends = np.cumsum([0, *(lines for _, lines in parts)]).tolist()
        self.bands = Bands(*(slice(a, b) for a, b in pairwise(ends)))
        self.radii = np.concatenate(
            [near + (far - near) * (np.arange(n) + 0.5) / n for (near, far), n in parts]
        )
        self._axes = axes

    def __call__(
        self,
        image: ByteImage,
        inside: ByteImage,
        centres: FloatArray,
        start_rad: FloatArray,
        mean: FloatArray,
        sigma: FloatArray,
    ) -> tuple[FloatArray, BoolArray]:
        """Brightness (n, L, ANGLES) float64 and where it was seen (n, L, ANGLES) bool.

        image, inside: working image and 1 where it holds sonar data, both uint8. centres: (n, 2)
        (column, row). start_rad: (n,) direction of the first angle; angles run counter-clockwise
        seen from above. mean, sigma: (n,) mean grey level of each object's surroundings and its
        standard deviation, by which brightness is normalised, so that it does not depend on gain.
        """
        size = (len(centres), len(self.radii), ANGLES)
        if len(centres) == 0:  # OpenCV refuses empty maps
            return np.empty(size), np.empty(size, bool)
        angle = start_rad[:, None, None] + (np.arange(ANGLES) + 0.5) * STEP
        radius = self.radii[:, None]
        column = centres[:, 0, None, None] + self._axes[0] * radius * np.cos(angle)
        row = centres[:, 1, None, None] - self._axes[1] * radius * np.sin(angle)
        pixel = np.stack([column, row]).astype(np.float32).reshape(2, -1, ANGLES)
        grey = cv2.remap(image, pixel[0], pixel[1], cv2.INTER_LINEAR)
        seen = cv2.remap(inside, pixel[0], pixel[1], cv2.INTER_NEAREST)
        grey = (grey.reshape(size) - mean[:, None, None]) / sigma[:, None, None]
        return grey, seen.reshape(size).astype(bool)


def rotated_codes(landmarks: LandmarkSet) -> FloatArray:
    """(ANGLES, K, ANGLES): every ID's ideal symbol, 0 or 1, rotated by every number of steps."""
    codes = landmarks.codes((np.arange(ANGLES) + 0.5) * STEP)
    return np.stack([np.roll(codes, steps, axis=1) for steps in range(ANGLES)])
