"""The height of the sonar above the floor, where only its tilt is stated.

The floor begins in the image where the lower edge of the vertical beam meets it. Without that, the
height could only follow from where the window lies; but users set windows much longer than the
floor that they see, and a height that is half too large loses most landmarks (`make stated`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sonarrec.arrays import ByteImage, quantile
from sonarrec.geometry import floor_depth
from sonarrec.nouns import Fan
from sonarrec.readers.guess.plausible import as_polar, levels_by_range

HALF_BEAM_DEG = 10.0  # vertical beams of imaging sonars are 14 to 28 deg wide
STEEPEST_DEG = 85.0
# The floor begins where the grey level first reaches this share of the brightest tenth's, and stays
# there over most of the next rings. Levels are logarithmic, so it is far above the noise.
LIT, RINGS, MOST_OF = 0.5, 8, 0.75
DARK = 6.0  # grey level that no floor is below
LEAST = 0.5  # of the height with which the beam's axis meets the floor in the middle of the window


def height_from_images(images: Sequence[ByteImage], fan: Fan) -> float | None:
    """The height (m), or None if the images do not show where the floor begins.

    images: the first few of a log, (fan.rows, fan.columns). fan: without a height. The result is
    between LEAST and 1 of the height that `geometry.floor_depth` assumes without images: what is
    bright near the sonar may be noise, and a window may begin beyond the nearest floor.
    """
    assert fan.height_m is None
    picture = np.mean([as_polar(image, fan) for image in images], axis=0)
    range_m, levels = levels_by_range(picture, fan)
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
