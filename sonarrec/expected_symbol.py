"""What a symbol should look like under every ID, at every rotation, as the beam smears it.

Far out, or on a small disc, a beam is as wide as a sector: seen through it, ID.1 and ID.2 differ
less, and otherwise, than as drawn. A pan leaves the smear alone, for angles count from the line of
sight and the beam smears across it.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sonarrec.landmarks import LandmarkSet
from sonarrec.records import FloatArray
from sonarrec.shape_matrix import ANGLES, STEP, Bands

# Typical echo levels in dB over the floor, and the noise beneath: they say how the logarithm of the
# picture bends a smeared edge. Correlations hardly depend on them.
RING_DB, SYMBOL_DB, PLATE_DB, FLOOR_DB, NOISE_DB = 12.0, 10.0, -8.0, 0.0, -6.0
# Smears (standard deviation across the line of sight, in disc radii) are rounded to this.
SMEAR_STEP = 0.04
MOST_STEPS = 10
# What one pixel takes in, in any direction: standard deviation in disc radii.
PIXEL = 0.05
# Points and weights that stand for a Gaussian of standard deviation 1 (Gauss and Hermite's).
_THREE = np.sqrt(3) * np.array([-1, 0, 1])
_THREE_SHARE = np.array([1, 4, 1]) / 6
BEAM_POINT = 0.08  # a beam is summed over points no farther apart than this, in disc radii
LEAST_SPREAD = 0.1  # variance of an expected symbol over what was seen, in that over the whole


class _Expected(NamedTuple):
    """(2, cells, ANGLES x K) of the symbol's cells as they are and counted from the gap.

    0 on the plate to 1 on a symbol. squared: the same. least: (2, 1, ANGLES x K) variance over
    the cells seen below which nothing of the symbol has shown.
    """

    flat: FloatArray
    squared: FloatArray
    least: FloatArray


class ExpectedSymbols:
    """Compares symbols with what every ID of a set should show."""

    def __init__(self, landmarks: LandmarkSet, radii: FloatArray, bands: Bands) -> None:
        """radii, bands: of the lines of the shape matrix, from ShapeSampler."""
        self._landmarks = landmarks
        self._symbol = radii[bands.symbol]
        self._gap = radii[bands.gap]
        self._ids = len(landmarks.ids)
        # Only the smears that a log's ranges call for are ever drawn.
        self._expected = cache(self._draw)

    def correlation(
        self,
        symbol: FloatArray,
        weight: FloatArray,
        gap: FloatArray,
        gap_seen: npt.NDArray[np.bool_],
        smear: FloatArray,
    ) -> FloatArray:
        """(n, ANGLES, K) correlation with every ID at every rotation: mean of plain and local.

        symbol, weight: (n, lines, ANGLES) and how often each cell was seen. gap, gap_seen: (n,
        ANGLES), what the local symbol is counted from. smear: (n,) in disc radii.
        """
        shape = (2, len(symbol), symbol.shape[1] * ANGLES)
        values = np.stack([symbol, symbol - gap[:, None]]).reshape(shape)
        weights = np.stack([weight, weight * gap_seen[:, None]]).reshape(shape)
        steps = np.minimum(np.rint(smear / SMEAR_STEP), MOST_STEPS).astype(int)
        found = np.zeros((len(symbol), ANGLES * self._ids))
        for step in set(steps.tolist()):
            of = steps == step
            plain, local = _correlate(values[:, of], weights[:, of], self._expected(step))
            found[of] = 0.5 * (plain + local)
        return found.reshape(-1, ANGLES, self._ids)

    def _draw(self, steps: int) -> _Expected:
        """What the symbol should show, smeared by `steps`."""
        symbol = self._look(self._symbol, steps)
        gap = self._look(self._gap, steps).mean(axis=0, keepdims=True)
        shape = (2, -1, symbol.shape[-1])
        flat = np.stack([symbol, symbol - gap]).reshape(shape)
        return _Expected(flat, flat**2, LEAST_SPREAD * flat.var(axis=1, keepdims=True))

    def _look(self, radii: FloatArray, steps: int) -> FloatArray:
        """(lines, ANGLES, ANGLES x K) what lines at `radii` show of every ID at every turn."""
        discs = self._landmarks
        radius, angle, share = _points(radii, steps * SMEAR_STEP)
        ring = (radius >= discs.ring[0]) & (radius <= discs.ring[1])
        bare = np.where(ring, RING_DB, np.where(radius > 1, FLOOR_DB, PLATE_DB))
        power = 10 ** (bare / 10) @ share + 10 ** (NOISE_DB / 10)  # (lines, ANGLES)
        # How much of each cell lies in each of so many directions of the symbol that both a step
        # and a sector are whole numbers of them: a turn is a roll of these.
        sectors = np.asarray(discs.sectors, dtype=float)
        directions = ANGLES * sectors.shape[1]
        direction = np.mod(angle, 2 * np.pi) / (2 * np.pi) * directions
        cell = np.arange(power.size).reshape(*power.shape, 1)
        within = (radius >= discs.symbol[0]) & (radius <= discs.symbol[1])
        at = cell * directions + np.minimum(direction, directions - 1).astype(int)
        shares = np.broadcast_to(share, radius.shape)[within]
        spread = np.bincount(at[within], shares, power.size * directions)
        codes = np.repeat(sectors, ANGLES, axis=1)
        turned = [np.roll(codes, turn * sectors.shape[1], axis=1) for turn in range(ANGLES)]
        lit = spread.reshape(power.size, directions) @ np.concatenate(turned).T
        brighter = 10 ** (SYMBOL_DB / 10) - 10 ** (PLATE_DB / 10)
        power = power[..., None] + brighter * lit.reshape(*power.shape, -1)
        return np.asarray((10 * np.log10(power) - PLATE_DB) / (SYMBOL_DB - PLATE_DB))


def _points(radii: FloatArray, smear: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where the echoes in each cell come from: distance from the centre, angle, and share.

    The first two (lines, ANGLES, points), the share (points,). Over a pixel along the radius and
    round the disc, so that turns stay exact, and over the beam across the line of sight.
    """
    half = math.ceil(2.4 * smear / BEAM_POINT)
    deviations = np.linspace(-2.4, 2.4, 2 * half + 1) if half else np.zeros(1)
    beam_share = np.exp(-0.5 * deviations**2)
    share = np.einsum("i,j,k->ijk", _THREE_SHARE, _THREE_SHARE, beam_share / beam_share.sum())
    angle = ((np.arange(ANGLES) + 0.5) * STEP)[:, None, None, None]  # from the line of sight
    out = radii[:, None, None, None, None] + PIXEL * _THREE[:, None, None]
    round_ = PIXEL * _THREE[:, None]
    aside = out * np.sin(angle) + round_ * np.cos(angle) + smear * deviations  # to the left
    away = out * np.cos(angle) - round_ * np.sin(angle) + 0 * deviations
    points = (len(radii), ANGLES, share.size)
    return (
        np.hypot(aside, away).reshape(points),
        np.arctan2(aside, away).reshape(points),
        share.ravel(),
    )


def _correlate(values: FloatArray, weight: FloatArray, expected: _Expected) -> FloatArray:
    """(2, n, ANGLES x K) weighted correlation of (2, n, cells) values with what is expected."""
    share = weight / np.maximum(weight.sum(axis=2, keepdims=True), 1e-9)
    weighted = share * values
    mean = weighted.sum(axis=2, keepdims=True)
    variance = np.maximum((weighted * values).sum(axis=2, keepdims=True) - mean**2, 1e-9)
    centre = share @ expected.flat
    spread = share @ expected.squared - centre**2
    covariance = weighted @ expected.flat - mean * centre
    known = spread > expected.least
    return np.asarray(known * covariance / np.sqrt(variance * np.maximum(spread, 1e-9)))
