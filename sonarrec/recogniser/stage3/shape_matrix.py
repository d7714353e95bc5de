"""Shape matrices (Section 3.4.2), and the identification of single frames by them (SMI).

Brightness is sampled along concentric lines, at equally spaced angles, on the disc as it appears in
the working plane. SMI is the paper's baseline.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, ByteImage, FloatArray, IndexArray, IntArray
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.stage3 import Beliefs

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


@dataclass(frozen=True, slots=True)
class Identification:
    """The result of SMI for n objects."""

    similarity: FloatArray
    """(n, K) share of the symbol's cells that agree with each ID, at `rotation`."""
    rotation: IndexArray
    """(n,) steps: the rotation, common to all IDs, with the largest similarity."""
    ring: FloatArray
    """(n,) share of ring cells that are bright."""

    def measurement(self, least_ring: float = 0.0) -> FloatArray:
        """(n, K) q of Eq. 8: the similarities divided by their sum.

        least_ring: q is uniform if a smaller share of the ring is bright, since without a circle
        the symbol means nothing.
        """
        total = self.similarity.sum(axis=1, keepdims=True)
        uniform = np.full_like(self.similarity, 1 / self.similarity.shape[1])
        circle = (self.ring >= least_ring)[:, None]
        np.divide(self.similarity, total, out=uniform, where=(total > 0) & circle)
        return uniform

    @property
    def score(self) -> FloatArray:
        """(n,) largest similarity times the bright share of the ring."""
        return np.asarray(self.similarity.max(axis=1) * self.ring)

    @property
    def beliefs(self) -> Beliefs:
        """The measurement as the belief; 'none of these' has 0."""
        return without_none(self.measurement(), self.rotation)


def without_none(probabilities: FloatArray, rotation: IndexArray) -> Beliefs:
    """Beliefs (n, K) of a method without 'none of these' or standard errors of rotations (n,)."""
    n = len(rotation)
    with_none = np.column_stack([probabilities, np.zeros(n)])
    return Beliefs(with_none, rotation.astype(float), np.full(n, np.nan), np.ones(n, bool))


def identify(grey: FloatArray, seen: BoolArray, bands: Bands, codes: FloatArray) -> Identification:
    """Shape-matrix identification of n sampled objects.

    grey, seen: (n, L, ANGLES) from ShapeSampler. codes: from rotated_codes. A cell is bright above
    Otsu's threshold of its own disc's ring and symbol cells. Cells outside the fan do not count.
    """
    disc = np.concatenate([grey[:, bands.symbol], grey[:, bands.ring]], axis=1)
    disc_seen = np.concatenate([seen[:, bands.symbol], seen[:, bands.ring]], axis=1)
    cells = (len(grey), disc.shape[1] * ANGLES)
    level = otsu_levels(disc.reshape(cells), disc_seen.reshape(cells))
    bright = grey > level[:, None, None]
    weight = seen[:, bands.symbol].sum(axis=1)
    on = (bright & seen)[:, bands.symbol].sum(axis=1)
    # Cells agree if they are bright where the code is 1, or dark where it is 0. Their number is
    # on . code + off . (1 - code): one matrix product for all rotations and IDs.
    off = weight - on
    agreeing = (on - off).astype(float) @ codes.reshape(-1, ANGLES).T + off.sum(axis=1)[:, None]
    total = np.maximum(weight.sum(axis=1), 1)[:, None]
    fit = (agreeing / total).reshape(-1, *codes.shape[:2])
    rotation = fit.max(axis=2).argmax(axis=1)
    ring_seen = seen[:, bands.ring].sum(axis=(1, 2))
    ring = (bright & seen)[:, bands.ring].sum(axis=(1, 2)) / np.maximum(ring_seen, 1)
    return Identification(fit[np.arange(len(grey)), rotation], rotation, ring)


def otsu_levels(values: FloatArray, seen: BoolArray) -> FloatArray:
    """(n,) Otsu's threshold of each row of (n, m) values, over the cells that were seen.

    The threshold maximises the variance between the two classes, over the row's sorted values.
    """
    order = np.argsort(np.where(seen, values, np.inf), axis=1)
    ranked = np.take_along_axis(np.where(seen, values, 0.0), order, axis=1)
    count = seen.sum(axis=1)
    below = np.arange(1, values.shape[1])
    above = np.maximum(count[:, None] - below, 0)
    cumulative = np.cumsum(ranked, axis=1)
    low = cumulative[:, :-1] / below
    high = (cumulative[:, -1:] - cumulative[:, :-1]) / np.maximum(above, 1)
    between = np.where(above > 0, below * above * (high - low) ** 2, -1.0)
    best = between.argmax(axis=1)
    rows = np.arange(len(values))
    above_best = np.minimum(best + 1, values.shape[1] - 1)
    return np.asarray((ranked[rows, best] + ranked[rows, above_best]) / 2)
