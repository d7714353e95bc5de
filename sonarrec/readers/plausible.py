"""Checks whether a log's fan images contradict their stated geometry; reports clear cases only."""

from __future__ import annotations

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.geometry import fan_mask, pixel_from_polar
from sonarrec.records import Fan, Frame
from sonarrec.sonar import Sonar

FRAMES = 5
"""Number of first frames that are used. Each costs one addition of an image."""

_BACKGROUND = 6.0  # grey levels about the commonest one that hold no echo
# Share of pixels outside of the stated fan that hold echoes, measured on the sample logs and on
# recordings of others: .42 or more if the fan is wrong, at most .03 if it is right.
_OUTSIDE = 0.15
_FILLED = 0.6  # the same share, if the picture is no fan at all
_CUT = 0.2  # share of the stated fan that lies outside of the picture


class Plausibility:
    """Adds up the first frames of a log; `contradictions` says what their mean contradicts."""

    def __init__(self) -> None:
        self._fan: Fan | None = None
        self._sum: FloatArray | None = None
        self._frames = 0

    def inspect(self, frame: Frame) -> None:
        """Add a frame. Polar ones, and all after the first FRAMES, are ignored."""
        if self._frames == FRAMES or frame.polar is not None:
            return
        if self._sum is None:
            self._fan, self._sum = frame.fan, np.zeros(frame.pixels.shape, np.float32)
        self._sum += frame.pixels
        self._frames += 1

    def contradictions(self, sonar: Sonar) -> list[str]:
        """A line, with the keys to look at, if there are echoes outside of the stated fan, or if it
        exceeds the picture; none without fan images. sonar: the geometry as stated."""
        if self._sum is None or self._fan is None:
            return []
        picture, fan = self._sum / self._frames, self._fan
        outside = fan_mask(fan) == 0
        share = _echoes(picture[outside])
        if share > _OUTSIDE and np.mean(outside) > _OUTSIDE / 10:
            text = f"{share:.0%} of the picture outside of the stated fan holds echoes"
            if _echoes(picture[::-1][outside]) < _OUTSIDE / 3:
                option = f"--range-order {sonar.other_range_order}"
                return [f"{text}, but none once it is upside down: try {option}"]
            if share > _FILLED:
                return [f"{text} (is it polar, --layout polar?)"]
            keys = "range_min_m, range_max_m, field_of_view_deg, apex_px and metres_per_pixel"
            return [f"{text} (unless it is text or a panel, look at {keys})"]
        cut = _share_cut(fan)
        if cut > _CUT:
            return [
                f"{cut:.0%} of the stated fan lies outside of the picture, {fan.columns} x "
                f"{fan.rows} pixels (is it polar, --layout polar? else look at metres_per_pixel "
                "and apex_px)"
            ]
        return []


def _echoes(grey: FloatArray) -> float:
    """Share of pixels that differ from the commonest grey level: 0 for an even background."""
    if not grey.size:
        return 0.0
    background = np.bincount(np.rint(grey).astype(int).ravel(), minlength=256).argmax()
    return float(np.mean(np.abs(grey - background) > _BACKGROUND))


def _share_cut(fan: Fan) -> float:
    """Share of a fan that lies outside of its picture, by range and bearing."""
    range_m = np.linspace(fan.range_min_m, fan.range_max_m, 98)[1:-1, None]
    bearings = np.linspace(fan.bearing_min_deg, fan.bearing_max_deg, 66)[1:-1]
    column, row = pixel_from_polar(fan, range_m, bearings)
    return float(np.mean((column < -1) | (column > fan.columns) | (row < -1) | (row > fan.rows)))
