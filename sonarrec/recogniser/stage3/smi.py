"""Shape-matrix identification (SMI) of single frames (Section 3.4.2), the paper's baseline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IndexArray
from sonarrec.recogniser.stage3 import Beliefs
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, Bands


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
