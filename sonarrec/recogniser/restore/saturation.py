"""Restores the grey levels of saturated pictures.

The gain was too high, so that all strong echoes are drawn at the highest level. A ring then stands
out little from the floor around it, since both reach that level. But more of the ring's pixels
reach it, and their share tells how much brighter the ring is.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from statistics import NormalDist

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatImage, IntArray
from sonarrec.recogniser.restore.static_pixels import BLACK
from sonarrec.sonar.frame import Fan, Frame
from sonarrec.sonar.geometry import fan_mask

# A picture is saturated, not merely bright, if this share of its echoes is at the highest levels in
# excess of what the levels below them suggest. JPEG spreads the highest level over a few.
LEAST_SHARE = 0.02
HIGHEST, NEXT = 4, 8  # grey levels
SAMPLED = 4  # every SAMPLED-th row and column is counted
# Standard deviation, in disc radii, of the surroundings in which saturated pixels are counted.
SURROUNDINGS = 0.065
FEWEST, MOST = 0.02, 0.99  # shares are clipped to these: beyond them the lift is uncertain
# Factor on a Gaussian's lift: speckle in decibels is skewed, and reaches less far above its mean.
OF_GAUSSIAN = 0.6
LEAST_SPREAD = 4.0  # grey levels
FEW_LEVELS = 8  # in a mask
BRIGHT = 150.0  # mean level: sonar pictures have 60 to 120, reversed ones the rest to 255


def _lifts() -> FloatImage:
    """(256,) by how much saturated pixels exceed the highest level on average, in standard
    deviations of the speckle. Index: their share in the surroundings, in 255ths."""
    normal = NormalDist()
    shares = np.clip(np.arange(256) / 255, FEWEST, MOST).tolist()
    above = [normal.inv_cdf(s) for s in shares]  # height of the mean over the highest level
    # The mean of a truncated Gaussian.
    means = [a + normal.pdf(a) / s for a, s in zip(above, shares, strict=True)]
    return OF_GAUSSIAN * np.array(means, np.float32)


LIFTS = _lifts()


class Levels:
    """Finds the saturated pictures of one log, and restores their levels.

    radius_m: of the landmarks. seen, saturated, black: numbers of pictures so far, the last of
    those without an echo; first_black: the index of the first such frame.
    """

    def __init__(self, radius_m: float) -> None:
        self._sigma_m = SURROUNDINGS * radius_m
        self._shown_of: tuple[Fan, tuple[int, ...]] | None = None
        self._shown: ByteImage = np.empty((0, 0), np.uint8)  # of the pixels counted, the fan's
        self.seen = self.saturated = self.black = 0
        self.first_black: int | None = None
        self._causes = Counter[str]()

    @property
    def cause(self) -> str:
        """What most saturated pictures suggest as its cause, or a cure."""
        ((cause, _),) = self._causes.most_common(1) or [("", 0)]
        return cause

    def restored(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames of a log; those that are saturated get restored `pixels`.

        Saturated pixels are lifted above the others, and all are scaled so that none exceeds 255.
        """
        for frame in frames:
            self.seen += 1
            up_to = self._echoes(frame)
            if not up_to[-1]:
                self.black += 1
                self.first_black = frame.index if self.first_black is None else self.first_black
            if (first := saturated_from(up_to)) is not None:
                self.saturated += 1
                self._causes[_cause(up_to)] += 1
                frame = replace(frame, pixels=self._lift(frame, first, _spread(up_to)))
            yield frame

    def _echoes(self, frame: Frame) -> IntArray:
        """(256,) cumulative histogram of the echoes in the sampled pixels within the fan."""
        if (frame.fan, frame.pixels.shape) != self._shown_of:
            self._shown_of = frame.fan, frame.pixels.shape
            shown = np.full(frame.pixels.shape, 255, np.uint8)
            if frame.polar is None:
                shown = fan_mask(frame.fan)
            self._shown = np.ascontiguousarray(shown[::SAMPLED, ::SAMPLED])
        some = np.ascontiguousarray(frame.pixels[::SAMPLED, ::SAMPLED])
        counts = cv2.calcHist([some], [0], self._shown, [256], [0, 256])
        counts[: BLACK + 1] = 0
        return counts.cumsum(dtype=np.int64)

    def _lift(self, frame: Frame, first: int, spread: float) -> ByteImage:
        """The pixels of a saturated frame, restored.

        first: the lowest saturated level. spread: standard deviation of the speckle, in levels.
        """
        fan = frame.fan
        if frame.polar is None:
            row_m = column_m = fan.metres_per_pixel
        else:
            middle_m = (fan.range_min_m + fan.range_max_m) / 2
            row_m, column_m = frame.polar.bin_m, middle_m * np.radians(frame.polar.beam_deg)
        saturated = cv2.LUT(frame.pixels, np.where(np.arange(256) < first, 0, 255).astype(np.uint8))
        # Two box filters come near a Gaussian, in an eighth of its time.
        box = _box(self._sigma_m / column_m), _box(self._sigma_m / row_m)
        share = cv2.blur(cv2.blur(saturated, box), box)
        highest = first + HIGHEST - 1
        lifted = highest + spread * LIFTS
        scale = 255 / lifted[-1]
        pixels = cv2.LUT(frame.pixels, np.rint(scale * np.arange(256)).astype(np.uint8))
        cv2.copyTo(cv2.LUT(share, np.rint(scale * lifted).astype(np.uint8)), saturated, pixels)
        return np.asarray(pixels, np.uint8)


def _box(sigma: float) -> int:
    """Side in pixels of a box filter which, applied twice, has about this standard deviation."""
    return max(3, 2 * round((math.sqrt(6 * sigma**2 + 1) - 1) / 2) + 1)


def saturated_from(up_to: IntArray) -> int | None:
    """The lowest saturated level of a picture; None if the picture is not saturated.

    up_to: (256,) cumulative histogram of its echoes.
    """
    echoes = int(up_to[-1])
    if not echoes:
        return None
    first = int(up_to.searchsorted(echoes)) - HIGHEST + 1
    if first - NEXT <= BLACK:
        return None
    below, before = int(up_to[first - NEXT - 1]), int(up_to[first - 1])
    excess = echoes - before - HIGHEST * (before - below) / NEXT
    return first if excess >= LEAST_SHARE * echoes else None


def _cause(up_to: IntArray) -> str:
    """Why a saturated picture may have its highest levels so often. up_to: as above."""
    counts = np.diff(up_to, prepend=0)
    if np.count_nonzero(counts) < FEW_LEVELS:
        return "have few grey levels, as masks have; are they pictures of the sonar?"
    bright = np.average(np.arange(256), weights=counts) > BRIGHT
    unless = ", unless they are reversed" if bright else ""
    return f"are saturated; a lower gain is better{unless}"


def _spread(up_to: IntArray) -> float:
    """Standard deviation of the speckle, in levels, from the unsaturated half below the median."""
    low, middle = up_to.searchsorted([0.16 * up_to[-1], 0.5 * up_to[-1]])
    return max(float(middle - low), LEAST_SPREAD)
