"""What a symbol should look like under every ID, at every rotation, as the beam smears it.

Far out, or on a small disc, a beam is as wide as a sector: seen through it, ID.1 and ID.2 differ
less, and otherwise, than as drawn. A pan leaves the smear alone, for angles count from the line of
sight and the beam smears across it.

A symbol is compared by generalised least squares. What lies over a disc unevenly (speckle, which
the floor keeps as the sonar pans, patches that fade, late echoes) is alike in neighbouring cells:
a broad patch that looks like half a sector is weak evidence, a step at a sector's edge strong.
Light and shade are alike over a good part of the disc. They show on the ring and in the gap as
well, so these take part; how bright the ring is, is left open.

Beside the IDs stand rivals: symbols that no ID of the set has. Where one of them explains a disc
better than every ID does, it is none of these.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.stage3_features import settled
from sonarrec.recogniser.stage3_features.shape_matrix import ANGLES, STEP, Bands
from sonarrec.records import BoolArray, FloatArray

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
# Variance that is a cell's own, where it stands for the mean cell's area, in that of what is alike
# in neighbouring ones. On tuning seeds 0.1 does as well, and so do cells alike over 0.3 or 0.6.
OWN = 0.3
# What light and shade vary by, in that of speckle and the like, and how far they are alike (1/e, in
# disc radii).
LIGHT, LIGHT_ALIKE = 1.0, 2.0
# Rivals have so many sectors, each bright or dark, and differ from every ID at every turn by so
# much of the circle. Where a part of a disc is hidden only so many of them are looked at again.
RIVAL_SECTORS = 8
LEAST_UNLIKE = 0.12
MOST_RIVALS = 48
# Half the width of a cross's arms, and where they begin, in disc radii. It looks the same after so
# many steps.
ARM, HUB = 0.07, 0.12
CROSS_TURNS = ANGLES // 4
LEAST_SHOWN = 0.1  # share of a whole symbol's evidence below which nothing of it has shown


class ExpectedSymbols:
    """Compares symbols, the gap and the ring round them, with what every ID of a set should show.

    T symbols take part: every ID at every turn (ANGLES x K), a cross at CROSS_TURNS, and every
    other rival at every turn. lines: which lines of the shape matrix take part.
    """

    def __init__(
        self, landmarks: LandmarkSet, radii: FloatArray, bands: Bands, alike: float
    ) -> None:
        """radii, bands: of the lines of the shape matrix, from ShapeSampler.

        alike: how far what lies unevenly over a disc is alike (1/e), in disc radii.
        """
        self._landmarks = landmarks
        # Of the ring, whose lines all show the same, the middle one.
        self.lines = np.r_[bands.symbol, bands.gap, (bands.ring.start + bands.ring.stop) // 2]
        self._radii = radii[self.lines]
        self._ids = len(landmarks.ids)
        self._rivals = _rivals(landmarks)
        self._precision = _precision(self._radii, alike, landmarks.ring[0])
        # Only the smears that a log's ranges call for are ever drawn.
        self._expected = cache(self._whitened)

    def correlation(
        self, cells: FloatArray, seen: BoolArray, smear: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(n, ANGLES, K) correlation with every ID at every rotation, (n,) best with a rival.

        That of generalised least squares: its square is the share of the (whitened) variation that
        the ID explains beyond a level. 0 where too little of the ID has shown. cells, seen: (n,
        lines, ANGLES). smear: (n,) standard deviation across the line of sight in disc radii.
        """
        shape = (len(cells), len(self._precision))
        ids = ANGLES * self._ids
        seen = seen.reshape(shape)
        values = np.where(seen, cells.reshape(shape), 0.0)
        whitened = values @ self._precision
        variation = (whitened * values).sum(axis=1)
        steps = np.minimum(np.rint(smear / SMEAR_STEP), MOST_STEPS).astype(int)
        symbols = ids + CROSS_TURNS + ANGLES * len(self._rivals)
        product = np.empty((len(cells), symbols))
        for step in set(steps.tolist()):
            of = steps == step
            product[of] = values[of] @ self._expected(step)
        for i in np.flatnonzero(seen.any(axis=1) & ~seen.all(axis=1)):
            # Unseen cells leave the precision by their Schur complement.
            expected, hidden = self._expected(int(steps[i])), np.flatnonzero(~seen[i])
            likely = settled(product[i, ids:])
            rank = max(len(likely) - MOST_RIVALS, 0)
            rivals = np.flatnonzero(likely >= np.partition(likely, rank)[rank])
            some = np.concatenate([np.arange(ids), ids + rivals])
            sides = np.column_stack([whitened[i, hidden], expected[np.ix_(hidden, some)]])
            # To multiply by the inverse takes half as long as to solve for so many sides.
            solved = np.linalg.inv(self._precision[np.ix_(hidden, hidden)]) @ sides
            variation[i] -= sides[:, 0] @ solved[:, 0]
            shown = product[i, some] - sides[:, 0] @ solved[:, 1:]
            power = 1 - (sides[:, 1:] * solved[:, 1:]).sum(axis=0)
            scale = np.sqrt(np.maximum(power, LEAST_SHOWN))
            product[i, ids:] = 0
            product[i, some] = np.where(power > LEAST_SHOWN, shown / scale, 0.0)
        scale = np.sqrt(np.maximum(variation, 1e-12))
        found = product[:, :ids] / scale[:, None]
        return found.reshape(-1, ANGLES, self._ids), product[:, ids:].max(axis=1) / scale

    def _whitened(self, steps: int) -> FloatArray:
        """(cells, T) `expected` times the precision, over the root of the product of the two.

        Of cells that are as a symbol has them the product with it is the root of their variation.
        """
        flat = self.expected(steps).reshape(len(self._precision), -1)
        whitened = self._precision @ flat
        return np.asarray(whitened / np.sqrt((flat * whitened).sum(axis=0)))

    def expected(self, steps: int) -> FloatArray:
        """(lines, ANGLES, T) what the lines show of every symbol, 0 on the plate to 1 on a symbol.

        steps: the smear in whole SMEAR_STEPs.
        """
        discs = self._landmarks
        radius, angle, share = _points(self._radii, steps * SMEAR_STEP)
        ring = (radius >= discs.ring[0]) & (radius <= discs.ring[1])
        bare = np.where(ring, RING_DB, np.where(radius > 1, FLOOR_DB, PLATE_DB))
        power = 10 ** (bare / 10) @ share + 10 ** (NOISE_DB / 10)  # (lines, ANGLES)
        # How much of each cell lies in each of so many directions of the symbol that both a step
        # and a sector are whole numbers of them: a turn is a roll of these.
        sectors = np.asarray(discs.sectors, dtype=float)
        directions = math.lcm(ANGLES, RIVAL_SECTORS, sectors.shape[1])
        direction = np.mod(angle, 2 * np.pi) / (2 * np.pi) * directions
        cell = np.broadcast_to(np.arange(power.size).reshape(*power.shape, 1), radius.shape)
        shares = np.broadcast_to(share, radius.shape)
        within = (radius >= discs.symbol[0]) & (radius <= discs.symbol[1])
        at = cell * directions + np.minimum(direction, directions - 1).astype(int)
        spread = np.bincount(at[within], shares[within], power.size * directions)
        spread = spread.reshape(power.size, directions)
        lit, rival = (spread @ _turned(codes, directions).T for codes in (sectors, self._rivals))
        within &= radius >= HUB
        x, y = (radius[within] * way(angle[within]) for way in (np.cos, np.sin))
        cos, sin = (way(np.arange(CROSS_TURNS)[:, None] * STEP) for way in (np.cos, np.sin))
        off_axis = np.minimum(np.abs(x * cos + y * sin), np.abs(y * cos - x * sin))
        turn, point = np.nonzero(off_axis < ARM)
        at = cell[within][point] * CROSS_TURNS + turn
        cross = np.bincount(at, shares[within][point], power.size * CROSS_TURNS)
        lit = np.concatenate([lit, cross.reshape(power.size, CROSS_TURNS), rival], axis=1)
        brighter = 10 ** (SYMBOL_DB / 10) - 10 ** (PLATE_DB / 10)
        power = power[..., None] + brighter * lit.reshape(*power.shape, -1)
        return np.asarray((10 * np.log10(power) - PLATE_DB) / (SYMBOL_DB - PLATE_DB))


def _rivals(landmarks: LandmarkSet) -> FloatArray:
    """(R, RIVAL_SECTORS) codes, 0 or 1, that are unlike every ID: one of those that a turn or the
    light, which leaves levels open, makes the same."""
    numbers = np.arange(1, 2**RIVAL_SECTORS - 1)
    codes = (numbers[:, None] >> np.arange(RIVAL_SECTORS)) & 1
    turns = np.stack([np.roll(codes, turn, axis=1) for turn in range(RIVAL_SECTORS)])
    values = turns @ (1 << np.arange(RIVAL_SECTORS))
    codes = codes[values.min(axis=0) == numbers]
    sectors = np.asarray(landmarks.sectors)
    directions = math.lcm(ANGLES, RIVAL_SECTORS, sectors.shape[1])
    ids = _turned(sectors, directions)
    lit = np.repeat(codes, directions // RIVAL_SECTORS, axis=1)
    unlike = np.abs(lit[:, None] - ids[None]).mean(axis=2).min(axis=1)
    return np.asarray(codes[unlike >= LEAST_UNLIKE], float)


def _turned(codes: FloatArray, directions: int) -> FloatArray:
    """(ANGLES x K, directions) of codes (K, sectors): each at every turn, turn by turn."""
    lit = np.repeat(codes, directions // codes.shape[1], axis=1)
    step = directions // ANGLES
    return np.concatenate([np.roll(lit, turn * step, axis=1) for turn in range(ANGLES)])


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


def _precision(radii: FloatArray, alike: float, ring_from: float) -> FloatArray:
    """(cells, cells) inverse covariance of the cells on lines at `radii`.

    The level of all, and that of the ring, which begins at `ring_from`, are taken out.
    """
    angle = (np.arange(ANGLES) + 0.5) * STEP
    x, y = (np.outer(radii, way(angle)).ravel() for way in (np.cos, np.sin))
    apart = np.hypot(x[:, None] - x, y[:, None] - y)
    area = np.repeat(radii / radii.mean(), ANGLES)
    covariance = np.exp(-apart / max(alike, 1e-6)) + LIGHT * np.exp(-apart / LIGHT_ALIKE)
    inverse = np.linalg.inv(covariance + np.diag(OWN / area))
    ring = np.repeat(radii > ring_from, ANGLES)
    levels = np.column_stack([ring, ~ring]).astype(float)
    known = inverse @ levels
    return np.asarray(inverse - known @ np.linalg.solve(levels.T @ known, known.T))
