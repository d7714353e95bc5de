"""How far the sonar panned between two frames, read off the frames themselves.

Speckle is frozen to the floor while a sonar pans, so two frames are one polar picture moved along
the bearing; where the two match best is the pan.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.plane import Plane
from sonarrec.records import ByteImage, FloatArray

RANGES = 128
BEARINGS = 192
# Of the field of view: how much of two frames must overlap for their match to be believed.
LEAST_OVERLAP = 0.4


class PanEstimator:
    """Pan between consecutive working images by correlation along the bearing."""

    def __init__(self, plane: Plane) -> None:
        fan = plane.fan
        self._step_deg = (fan.bearing_max_deg - fan.bearing_min_deg) / BEARINGS
        bearing = fan.bearing_min_deg + (np.arange(BEARINGS) + 0.5) * self._step_deg
        margin = 0.5 * fan.window_m / RANGES
        range_m = np.linspace(fan.range_min_m + margin, fan.range_max_m - margin, RANGES)
        column, row = plane.from_polar(range_m[:, None], bearing[None])
        self._column = column.astype(np.float32)
        self._row = row.astype(np.float32)
        seen = cv2.remap(plane.inside, self._column, self._row, cv2.INTER_NEAREST)
        self._seen = np.asarray(seen, dtype=np.float32)
        self._cells = np.maximum(self._seen.sum(axis=1, keepdims=True), 1)
        shift = np.arange(2 * BEARINGS)
        shift = np.where(shift < BEARINGS, shift, shift - 2 * BEARINGS)
        self._shift = shift
        self._tried = np.abs(shift) <= (1 - LEAST_OVERLAP) * BEARINGS
        self._before: tuple[npt.NDArray[np.complexfloating], FloatArray] | None = None

    def step(self, image: ByteImage) -> tuple[float, float]:
        """(pan in deg since the last image, correlation there, 0 to 1).

        The pan is positive where the sonar turned right, so that objects moved to the left.
        (0, 0) for the first image and for a blank one.
        """
        polar = np.asarray(cv2.remap(image, self._column, self._row, cv2.INTER_LINEAR), np.float32)
        polar *= self._seen
        # What does not turn with the floor would match at no shift: the fall-off with range is in
        # the mean of each range bin, the gain of each beam in the mean of each beam.
        polar -= polar.sum(axis=1, keepdims=True) / self._cells
        polar *= self._seen
        polar -= polar.mean(axis=0)
        polar *= self._seen
        spectrum = np.fft.rfft(polar, 2 * BEARINGS, axis=1)
        energy = np.concatenate([[0.0], np.cumsum((polar**2).sum(axis=0, dtype=float))])
        before, self._before = self._before, (spectrum, energy)
        if before is None:
            return 0.0, 0.0
        # product[s] = sum over cells of now[b] * before[b + s]: s > 0 is a turn to the right.
        product = np.fft.irfft((np.conj(spectrum) * before[0]).sum(axis=0), 2 * BEARINGS)
        low = np.clip(-self._shift, 0, BEARINGS)
        high = np.clip(BEARINGS - self._shift, 0, BEARINGS)
        now_energy = energy[high] - energy[low]
        before_energy = before[1][BEARINGS - low] - before[1][BEARINGS - high]
        scale = np.sqrt(np.maximum(now_energy * before_energy, 1e-9))
        match = np.where(self._tried, product / scale, -1.0)
        best = int(match.argmax())
        left, right = match[best - 1], match[(best + 1) % len(match)]
        bend = left - 2 * match[best] + right
        part = 0.5 * (left - right) / bend if bend < 0 else 0.0
        return (
            float((self._shift[best] + np.clip(part, -0.5, 0.5)) * self._step_deg),
            float(np.clip(match[best], 0, 1)),
        )
