"""Shape matrices (Section 3.4.2): concentric lines sampled on the disc.

The measurement of stage 3, and of the paper's single-frame baseline (smi.py). Brightness is sampled
along concentric lines, at equally spaced angles, on the disc as it appears in the working plane.
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
# Lines at the middle of equal parts of the symbol and the ring; for the track's average also of
# the dark gap between them and of the floor just outside.
SYMBOL_LINES = 3
RING_LINES = 3
GAP_LINES = 2
OUTER_LINES = 2
OUTER = (1.12, 1.32)


def whole_steps(angle_deg: FloatArray) -> tuple[IntArray, FloatArray]:
    """Angles as whole steps, and the degrees that are left: at most half a step. Any shape."""
    steps = np.rint(angle_deg / STEP_DEG).astype(np.int64)
    return steps, angle_deg - steps * STEP_DEG


def _middles(band: tuple[float, float], lines: int) -> FloatArray:
    """(lines,) radii: the middles of so many equal parts of a band."""
    return band[0] + (band[1] - band[0]) * (np.arange(lines) + 0.5) / lines


@dataclass(frozen=True, slots=True)
class Bands:
    """Which rows of a shape matrix lie on which part of the disc."""

    symbol: slice
    ring: slice
    gap: slice
    """Between the two."""
    outer: slice
    """The floor just outside."""


class ShapeSampler:
    """Samples the shape matrices of many objects at once.

    radii: (L,) of the lines, as fractions of the disc's radius. bands: which line is what.
    """

    def __init__(self, landmarks: LandmarkSet, axes: tuple[float, float]) -> None:
        """axes: (across, along) semi-axes of the disc in pixels."""
        gap = (landmarks.symbol[1], landmarks.ring[0])
        parts = [
            _middles(landmarks.symbol, SYMBOL_LINES),
            _middles(landmarks.ring, RING_LINES),
            _middles(gap, GAP_LINES),
            _middles(OUTER, OUTER_LINES),
        ]
        ends = np.cumsum([0] + [len(p) for p in parts])
        self.bands = Bands(*(slice(int(a), int(b)) for a, b in pairwise(ends)))
        self.radii = np.concatenate(parts)
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
        seen from above. mean, sigma: (n,) grey level of each object's surroundings and its standard
        deviation, in which brightness is counted: so gain and grey scale drop out.
        """
        size = (len(centres), len(self.radii), ANGLES)
        if len(centres) == 0:  # OpenCV refuses empty maps
            return np.empty(size), np.empty(size, bool)
        angle = start_rad[:, None, None] + (np.arange(ANGLES) + 0.5) * STEP
        radius = self.radii[:, None]
        column = centres[:, 0, None, None] + self._axes[0] * radius * np.cos(angle)
        row = centres[:, 1, None, None] - self._axes[1] * radius * np.sin(angle)
        shape = (-1, ANGLES)
        column = column.astype(np.float32).reshape(shape)
        row = row.astype(np.float32).reshape(shape)
        grey = cv2.remap(image, column, row, cv2.INTER_LINEAR)
        seen = cv2.remap(inside, column, row, cv2.INTER_NEAREST)
        grey = (grey.reshape(size) - mean[:, None, None]) / sigma[:, None, None]
        return grey, seen.reshape(size).astype(bool)


def turned_codes(landmarks: LandmarkSet) -> FloatArray:
    """(ANGLES, K, ANGLES): every ID's ideal symbol, 0 or 1, turned by every step."""
    codes = landmarks.codes((np.arange(ANGLES) + 0.5) * STEP)
    return np.stack([np.roll(codes, turn, axis=1) for turn in range(ANGLES)])
