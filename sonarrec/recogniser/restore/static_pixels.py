"""Fills pixels that never change while the picture does: drawn lines and text, dead beams.

They show nothing of the floor, and stage 1 would take them for edges and rings. So before stage 1
each gets the level of the nearest pixel that does change.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, ByteImage, FloatImage, IndexArray, quantile
from sonarrec.sonar.frame import Frame
from sonarrec.sonar.geometry import fan_mask

# Only frames with a new view count. A view is new if the median change of its pixels since the
# last view exceeds CHANGED of the median difference between neighbouring pixels. A sonar
# that stands still has one view, since its whole picture may stay the same.
CHANGED = 0.7
SAMPLED = 40  # rows, and columns, that are compared to find a new view
JUDGED_AFTER = (8, 16, 64)  # views after which pixels are judged
# Frames that are read before the first one is yielded; fewer if they are large.
AHEAD, MOST_BYTES_AHEAD = 40, 2**24
# A pixel is still if its levels vary by less than STILL of what its surroundings vary by; not 0,
# since compression changes a drawn line a little. From the second judgement on, the share is FAINT
# for pixels that are always brighter than the others by MIXED: a half-transparent line over the
# floor. Pixels that touch a still one and are always brighter or darker are a line's smooth edge.
STILL, FAINT, MIXED = 0.2, 0.4, 0.2
LEAST_USUAL = 8.0  # grey levels by which the surroundings must vary, else a pixel is not judged
COARSE, SURROUNDINGS = 8, (5, 5)  # side of a block in pixels; surroundings in blocks
LEAST_COUNTED = 0.02  # share of the surroundings' pixels that is needed for a mean
LEAST_SPOT = 30  # connected pixels: fewer may be still by chance
# Pixels that stay dark are a dead beam if they run through LEAST_BEAM of the rows and are narrower
# than WIDEST pixels; else they are a shadow or lie outside the picture.
LEAST_BEAM, WIDEST = 0.35, 13
BLACK = 8  # up to this level there is no echo
# Where echoes are few, a pixel may stay dark by chance. It counts as dark only if that has at most
# this probability, estimated from the changing pixels around it.
CHANCE = 1e-3


class Unchanging:
    """Finds unchanging pixels in the frames of one log, and fills them.

    share: of the fan's pixels that are filled now, 0 to 1.
    """

    def __init__(self) -> None:
        self.share = 0.0
        self._views = 0
        self._last: npt.NDArray[np.int16] | None = None  # the sampled pixels of the last view
        self._least: ByteImage = np.empty((0, 0), np.uint8)  # of each pixel, over all views
        self._most: ByteImage = self._least
        self._lit: ByteImage = self._least  # in how many views there was an echo
        self._inside: BoolArray = np.empty((0, 0), bool)  # pixels of the fan
        self._holes: IndexArray = np.empty(0, np.intp)
        self._sources: IndexArray = self._holes  # the pixel that each is filled from

    def filled(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames of a log, with the unchanging ones of their `pixels` filled."""
        frames, waiting = iter(frames), deque[Frame]()
        for frame in frames:
            self._use(frame)
            waiting.append(frame)
            ahead = min(AHEAD, MOST_BYTES_AHEAD // frame.pixels.size)
            if len(waiting) >= ahead or self._views >= JUDGED_AFTER[1]:
                break
        while waiting:
            yield self._fill(waiting.popleft())
        for frame in frames:
            self._use(frame)
            yield self._fill(frame)

    def _fill(self, frame: Frame) -> Frame:
        if not self.share or frame.pixels.shape != self._least.shape:
            return frame
        pixels = frame.pixels.copy()
        flat = pixels.reshape(-1)
        flat[self._holes] = flat[self._sources]
        return replace(frame, pixels=pixels)

    def _use(self, frame: Frame) -> None:
        """Use a frame if its view is new; images of another size than the first do not count."""
        pixels = frame.pixels
        if self._views == JUDGED_AFTER[-1] or (self._views and pixels.shape != self._least.shape):
            return
        down, across = (max(1, side // SAMPLED) for side in pixels.shape)
        sampled = pixels[::down, ::across].astype(np.int16)
        if self._last is None:
            self._least, self._most = pixels.copy(), pixels.copy()
            self._lit = np.zeros_like(pixels)
        elif not _changed(self._last, sampled):
            return
        self._last = sampled
        self._views += 1
        cv2.min(self._least, pixels, dst=self._least)
        cv2.max(self._most, pixels, dst=self._most)
        cv2.add(self._lit, (pixels > BLACK).view(np.uint8), dst=self._lit)
        if self._views in JUDGED_AFTER:
            if self._inside.shape != pixels.shape:
                polar = frame.polar is not None
                self._inside = np.ones(pixels.shape, bool) if polar else fan_mask(frame.fan) > 0
            self._judge()

    def _judge(self) -> None:
        """Decide which pixels are filled, and from which others."""
        drawn, dark = self._unchanging_pixels()
        if not drawn.any():
            self.share = 0.0
            return
        # A line's outermost pixels are mixed with the floor.
        holes = (cv2.dilate(drawn.astype(np.uint8), np.ones((3, 3))) > 0) & ~dark
        unseen = (holes | dark).astype(np.uint8)
        _, nearest = cv2.distanceTransformWithLabels(
            unseen, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
        )
        seen = np.flatnonzero(unseen == 0)
        source = np.zeros(int(nearest.max()) + 1, np.intp)
        source[nearest.ravel()[seen]] = seen
        self._holes = np.flatnonzero(holes)
        self._sources = source[nearest.ravel()[self._holes]]
        self.share = len(self._holes) / max(int(np.count_nonzero(~dark)), 1)

    def _unchanging_pixels(self) -> tuple[BoolArray, BoolArray]:
        """(rows, columns) masks of the pixels that are drawn or dead, and of those that are outside
        the fan or in shadow."""
        inside, change = self._inside, cv2.subtract(self._most, self._least)
        usual = _local_mean(change, inside & (self._most > BLACK))
        others = inside & (change > usual / 2)
        usual = _local_mean(change, others)
        judged = inside & (usual > LEAST_USUAL)
        least = np.float32(STILL if self._views < JUDGED_AFTER[1] else FAINT) * usual
        if np.count_nonzero(judged & (change <= least)) < LEAST_SPOT:  # as in most logs
            return np.zeros_like(inside), ~inside
        middle = _local_mean(cv2.addWeighted(self._least, 0.5, self._most, 0.5, 0), others)
        margin = np.float32(MIXED) * usual
        darker, brighter = self._most < middle - margin, self._least > middle + margin
        lit = _local_mean(self._lit, others) / np.float32(self._views)
        judged &= ~(darker & (lit < 1 - CHANCE ** (1 / self._views)))  # dark by chance
        still = judged & (change <= np.float32(STILL) * usual)
        still |= judged & brighter & (change <= least)
        wide = np.ones((WIDEST, WIDEST), np.uint8)
        unlit = (~inside | darker).view(np.uint8)
        outside = ~inside | (cv2.morphologyEx(unlit, cv2.MORPH_OPEN, wide) > 0)
        still &= ~outside
        if np.count_nonzero(still) < LEAST_SPOT:
            return np.zeros_like(still), outside
        either = still | ((darker | brighter) & judged & ~outside)
        count, spot, stats, _ = cv2.connectedComponentsWithStats(either.view(np.uint8))
        size, dark = (np.bincount(spot[p], minlength=count) for p in (still, still & darker))
        full_beam = stats[:, cv2.CC_STAT_HEIGHT] >= LEAST_BEAM * len(inside)
        static = (size >= LEAST_SPOT) & ((dark < size / 2) | full_beam)
        static[0] = False  # the pixels that are in no spot
        return static[spot], outside


def _local_mean(values: npt.NDArray[Any], counts: BoolArray) -> FloatImage:
    """(rows, columns) mean, over each pixel's surroundings, of the uint8 values where `counts`.

    0 if fewer than LEAST_COUNTED count. Computed on a coarse grid, since it is smooth.
    """
    rows, columns = values.shape
    mask = counts.view(np.uint8) * np.uint8(255)
    size = (-(-columns // COARSE), -(-rows // COARSE))
    total, number = (
        cv2.blur(cv2.resize(v.astype(np.float32), size, interpolation=cv2.INTER_AREA), SURROUNDINGS)
        for v in (cv2.bitwise_and(values, mask), mask)
    )
    least = np.float32(255 * LEAST_COUNTED)
    mean = np.where(number < least, np.float32(0), total * 255 / np.maximum(number, least))
    return np.asarray(cv2.resize(mean, (columns, rows)), np.float32)


def _changed(before: npt.NDArray[np.int16], now: npt.NDArray[np.int16]) -> bool:
    """Whether two sampled pictures show different views."""
    seen = (before > 0) & (now > 0)
    both_seen = seen[:, 1:] & seen[:, :-1]
    if not both_seen.any():
        return False
    change = quantile(np.abs(now - before)[seen], 0.5)
    texture = quantile(np.abs(now[:, 1:] - now[:, :-1])[both_seen], 0.5)
    return bool(change > CHANGED * max(texture, 1.0))
