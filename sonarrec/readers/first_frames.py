"""The first frames of a log, with which its stated geometry can be compared."""

from __future__ import annotations

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.records import Fan, Frame

FRAMES = 5
"""So many are added up. Each costs one addition of an image."""


class FirstFrames:
    """Adds up the first fan images of a log."""

    def __init__(self) -> None:
        self.fan: Fan | None = None
        self._sum: FloatArray | None = None
        self._frames = 0

    def add(self, frame: Frame) -> None:
        """Add a frame. Polar ones, and all after the first FRAMES, are ignored."""
        if self._frames == FRAMES or frame.polar is not None:
            return
        if self._sum is None:
            self.fan, self._sum = frame.fan, np.zeros(frame.pixels.shape, np.float32)
        self._sum += frame.pixels
        self._frames += 1

    @property
    def mean(self) -> FloatArray | None:
        """(rows, columns) grey levels; None without fan images."""
        return None if self._sum is None else self._sum / self._frames
