"""Echoes that arrive late because they came by way of the surface."""

from __future__ import annotations

import math

import cv2
import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.simulation.scene import NO_ECHO_DB, Scene


def shifted(image: np.ndarray, rows: int) -> np.ndarray:
    """The image moved by this many rows to higher ones (lower if negative), filled with zeros."""
    rows = max(-len(image), min(rows, len(image)))
    moved = np.zeros_like(image)
    if rows >= 0:
        moved[rows:] = image[: len(image) - rows]
    else:
        moved[:rows] = image[-rows:]
    return moved


MOST_BANDS = 100
"""Bands of surface echo, at most; one more would be 300 dB below the first."""


class Multipath:
    """Echoes by way of the surface: a later, blurred copy of the scene, and bands.

    comes: whether the scene has any.
    """

    def __init__(self, scene: Scene, range_m: FloatArray) -> None:
        self._multipath, self._range_m = scene.multipath, range_m
        self._bin_m = float(range_m[1] - range_m[0])
        rng = np.random.default_rng([scene.seed, 14])
        self._phase = rng.uniform(0, 2 * np.pi, 2)
        self.comes = max(scene.multipath.copy_db, scene.multipath.band_db) > NO_ECHO_DB

    def power(self, power: np.ndarray, time_s: float) -> np.ndarray:
        """(bins, beams) mean power of the late echoes. power: (bins, beams) of the direct ones."""
        m = self._multipath
        drift = m.drift_m * np.sin(2 * np.pi * time_s / m.drift_s + self._phase)
        late = np.zeros_like(power)
        if m.copy_db > NO_ECHO_DB:
            rows = (m.delay_m + drift[0]) / self._bin_m
            late = cv2.GaussianBlur(
                power,
                (0, 0),
                # A wider blur would look the same, but take longer.
                sigmaX=min(max(m.blur_beams, 0.3), power.shape[1]),
                sigmaY=min(max(m.blur_m / self._bin_m, 0.3), power.shape[0]),
                borderType=cv2.BORDER_REPLICATE,
            )
            late = shifted(late, round(rows)) * np.float32(10 ** (m.copy_db / 10))
        if m.band_db > NO_ECHO_DB:
            further = min((self._range_m[-1] - m.band_m) / m.band_step_m, MOST_BANDS)
            number = np.arange(max(math.ceil(further) + 1, 1))
            middle = m.band_m + number * m.band_step_m + drift[1]
            band = np.exp(-0.5 * ((self._range_m[:, None] - middle) / m.band_width_m) ** 2)
            level = 10 ** ((m.band_db - 3 * number) / 10)
            late += (band @ level).astype(np.float32)[:, None]
        return late
