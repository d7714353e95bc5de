"""The height of the sonar above the floor, where only its tilt is stated.

The floor begins in the image where the lower edge of the vertical beam meets it. Without that, the
height could only follow from where the window lies; but users set windows much longer than the
floor that they see, and a height that is half too large loses most landmarks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, quantile
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import floor_depth, pixel_from_polar

HALF_BEAM_DEG = 10.0  # vertical beams of imaging sonars are 14 to 28 deg wide
STEEPEST_DEG = 85.0
# The floor begins where the grey level first reaches this share of the brightest tenth's, and stays
# there over most of the next rings. Levels are logarithmic, so it is far above the noise.
LIT, RINGS, MOST_OF = 0.5, 8, 0.75
DARK = 6.0  # grey level that no floor is below
LEAST = 0.5  # of the height with which the beam's axis meets the floor in the middle of the window

_RINGS, _BEAMS = 96, 64  # of a polar picture of the fan


def height_from_images(images: Sequence[ByteImage], fan: Fan) -> float | None:
    """The height (m), or None if the images do not show where the floor begins. images: the first
    few of a log, (fan.rows, fan.columns). fan: without a height. The result is between LEAST and 1
    of the height that `geometry.floor_depth` assumes without images: what is bright near the sonar
    may be noise, and a window may begin beyond the nearest floor."""
    assert fan.height_m is None
    range_m, levels = _levels_by_range(images, fan)
    bright = float(quantile(levels, 0.9)) if levels.size else 0.0
    if bright < DARK:
        return None
    lit = np.append(levels >= LIT * bright, np.ones(RINGS - 1, bool))  # it may begin far out
    stays = np.convolve(lit, np.full(RINGS, 1 / RINGS), "valid") >= MOST_OF
    begins_m = float(range_m[int(np.argmax(lit[: len(levels)] & stays))])
    edge_deg = min(fan.tilt_deg + HALF_BEAM_DEG, STEEPEST_DEG)
    highest = floor_depth(fan)
    height = min(max(begins_m * math.sin(math.radians(edge_deg)), LEAST * highest), highest)
    return float(f"{height:.3g}") or None


def _levels_by_range(images: Sequence[ByteImage], fan: Fan) -> tuple[FloatArray, FloatArray]:
    """(n,) slant ranges (m) that the images show, and (n,) median grey levels there."""
    ring, beam = (np.arange(_RINGS) + 0.5) / _RINGS, (np.arange(_BEAMS) + 0.5) / _BEAMS
    range_m = fan.range_min_m + ring * fan.window_m
    bearings = fan.bearing_min_deg + beam * (fan.bearing_max_deg - fan.bearing_min_deg)
    column, row = (
        np.rint(pixel).astype(int) for pixel in pixel_from_polar(fan, range_m[:, None], bearings)
    )
    inside = (column >= 0) & (column < fan.columns) & (row >= 0) & (row < fan.rows)
    cells = np.clip(row, 0, fan.rows - 1), np.clip(column, 0, fan.columns - 1)
    polar = np.where(inside, np.mean([image[cells] for image in images], axis=0), np.nan)
    is_shown = inside.any(axis=1)
    # Sorting puts NaN last. nanmedian would load numpy.ma, and nanquantile goes row by row.
    ordered, count = np.sort(polar[is_shown], axis=1), np.count_nonzero(inside[is_shown], axis=1)
    rows = np.arange(len(ordered))
    lower, upper = ordered[rows, (count - 1) // 2], ordered[rows, count // 2]
    return range_m[is_shown], upper - (upper - lower) / 2
