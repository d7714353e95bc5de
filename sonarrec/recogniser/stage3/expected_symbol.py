"""The expected symbol of every ID at every rotation, smeared by the beam, and the fit to it.

At long range, or on a small disc, a beam is as wide as a sector. Seen through it, IDs differ less
than as drawn, and in other cells. A pan does not change the smear, since angles count from the line
of sight and the beam smears across it.

Symbols are fitted by generalised least squares, since the noise is correlated between neighbouring
cells: speckle (which stays with the floor as the sonar pans), patches that fade, late echoes. A
broad patch that looks like half a sector is weak evidence; a step at a sector's edge is strong.
Uneven illumination is correlated over a large part of the disc. It affects the ring and the gap as
well, so these are fitted too, with the ring's level as a free parameter.

Besides the IDs there are rivals: symbols that no ID of the set has. Two kinds of discs are none of
these: those that a rival explains better than every ID, and those of which the best ID leaves more
in broad patterns than noise would.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, FloatImage, IndexArray
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.stage3 import rounded
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, STEP, Bands, ShapeSampler

# Typical echo levels relative to the floor, and the noise, dB. Grey levels are logarithms of the
# power, which changes the shape of a smeared edge. Correlations hardly depend on these levels.
RING_DB, SYMBOL_DB, PLATE_DB, FLOOR_DB, NOISE_DB = 12.0, 10.0, -8.0, 0.0, -6.0
# Smears (sigma across the line of sight, in disc radii) are rounded to whole steps of this size,
# MOST_STEPS at most.
SMEAR_STEP = 0.04
MOST_STEPS = 10
PIXEL = 0.05  # sigma of the pixels' blur in any direction, in disc radii
# Gauss-Hermite points and weights for a standard normal distribution.
_THREE = np.sqrt(3) * np.array([-1, 0, 1])
_THREE_SHARE = np.array([1, 4, 1]) / 6
BEAM_POINT = 0.08  # largest distance of the points over which a beam is summed, in disc radii
# Variances of the noise, relative to that of the correlated noise (speckle and the like):
# CELL_NOISE_SHARE of uncorrelated noise, for a cell of mean area; ILLUMINATION_SHARE of uneven
# illumination, with its correlation length (1/e, in disc radii). On tuning seeds a cell's share of
# 0.1 does as well, and so do correlation lengths of the correlated noise of 0.3 or 0.6.
CELL_NOISE_SHARE = 0.3
ILLUMINATION_SHARE, ILLUMINATION_LENGTH = 1.0, 2.0
# Rivals have RIVAL_SECTORS sectors, each bright or dark, and differ from every ID at every rotation
# in at least LEAST_DIFFERENCE of the circle. On a partly hidden disc only the MOST_RIVALS best
# rivals are compared exactly.
RIVAL_SECTORS = 8
LEAST_DIFFERENCE = 0.12
MOST_RIVALS = 48
# A cross is a rival too: half the width of its arms, and their inner radius, in disc radii. It
# looks the same after a rotation by 90 degrees.
ARM, HUB = 0.07, 0.12
CROSS_ROTATIONS = ANGLES // 4
LEAST_SHOWN = 0.1  # share of a whole symbol's evidence; with less, correlations count as 0
# Whitened noise is as strong in broad patterns as in fine ones. Broad patterns are waves round the
# symbol of up to WAVES periods. STEADY, relative to the patterns' mean square, regularises their
# fit where few cells are seen.
WAVES = 6
STEADY = 1e-9
# The precision of hidden cells is singular if all cells of a free level are among them.
STEADY_CELLS = 1e-12
# numpy has no solver for triangles: blocks of so many rows are inverted.
BLOCK = 32
# The expected symbol itself is wrong by this share of the variation, so a smaller unexplained share
# means nothing. (0 does as well on tuning seeds, but then the result depends on the last digits
# where few cells are seen.)
MISFIT = 0.05
LEAST_STRUCTURE = 1e-3  # before the logarithm
LEAST_VARIATION = 1e-12  # of an object, whitened; less means that nothing was seen


@dataclass(frozen=True, slots=True)
class SymbolFit:
    """n symbols compared with K IDs.

    correlation: (n, ANGLES, K) with every ID at every rotation. Its square is the share of the
    whitened variation that the ID explains (generalised least squares); 0 where too little of the
    ID was seen. rival: (n,) the largest correlation with a rival. rotation: (n, K) the best
    rotation of each ID. structure: (n, K) at that rotation, the logarithm of the broad patterns'
    share of the unexplained variation, over their share of the cells: 0 for noise alone.
    """

    correlation: FloatArray
    rival: FloatArray
    rotation: IndexArray
    structure: FloatArray

    @property
    def best(self) -> FloatArray:
        """(n, K) the correlation with each ID at its best rotation."""
        index = self.rotation[:, None]
        return np.asarray(np.take_along_axis(self.correlation, index, axis=1)[:, 0])


@dataclass(frozen=True, slots=True)
class _Products:
    """Whitened inner products of n objects, over the cells that were seen.

    own: (n,) with themselves. ids: (n, ANGLES x K) with the IDs, of norm 1. rival: (n,) with the
    best rival, of norm 1. patterns: (n, P) with broad patterns. inverse: (n, P, P) inverse of the
    patterns' products with each other. hidden: of each partly seen object the hidden part of the
    IDs (h, ANGLES x K) and of the patterns (h, P), and the IDs' norms without it (ANGLES x K, 1).
    """

    own: FloatArray
    ids: FloatArray
    rival: FloatArray
    patterns: FloatArray
    inverse: FloatArray
    hidden: dict[int, tuple[FloatArray, FloatArray, FloatArray]]


@dataclass(frozen=True, slots=True)
class _Whitened:
    """P e / sqrt(e' P e) for each expected symbol e at one smear and the precision P.

    A disc's product with it, over the root of the disc's own variation, is the correlation. ids:
    (cells, ANGLES x K). broad: (ANGLES x K, P) products of the IDs with every broad pattern.
    rivals: (R, cells) in single precision, which finds the best among so many.
    """

    ids: FloatArray
    broad: FloatArray
    rivals: FloatImage


class ExpectedSymbols:
    """Compares symbols, with the gap and the ring round them, with the expected symbols of a set.

    There are T symbols: every ID at every rotation (ANGLES x K), a cross at CROSS_ROTATIONS, and
    every other rival at every rotation. lines: the lines of the shape matrix that are compared.
    """

    def __init__(
        self, landmarks: LandmarkSet, radii: FloatArray, bands: Bands, correlation_length: float
    ) -> None:
        """radii, bands: of the lines of the shape matrix, from ShapeSampler.

        correlation_length: of the noise (1/e), in disc radii.
        """
        self._landmarks = landmarks
        # The middle line stands for the ring, whose lines all show the same.
        self.lines = np.r_[bands.symbol, bands.gap, (bands.ring.start + bands.ring.stop) // 2]
        self._radii = radii[self.lines]
        self._ids = len(landmarks.ids)
        self._rivals = _rivals(landmarks)
        self._precision = _precision(self._radii, correlation_length, landmarks.ring[0])
        self._broad = _broad(self._radii, landmarks.symbol[1])
        self._whitened_broad = self._precision @ self._broad
        self._of_broad = self._broad.T @ self._whitened_broad
        self._inverse_of_broad = _steady_inverse(self._of_broad.copy())
        # Only the smears that occur in a log are computed.
        self._expected = cache(self._whitened)

    def fit(self, cells: FloatArray, seen: BoolArray, smear: FloatArray) -> SymbolFit:
        """Compare symbols with every ID and every rival.

        cells, seen: (n, lines, ANGLES). smear: (n,) the beam's sigma across the line of sight, in
        disc radii.
        """
        shape = (len(cells), len(self._precision))
        seen = seen.reshape(shape)
        values = np.where(seen, cells.reshape(shape), 0.0)
        whitened = values @ self._precision
        number = seen.sum(axis=1)
        partly = (number > 0) & (number < shape[1])
        inverse = np.broadcast_to(
            self._inverse_of_broad, (len(cells), *self._inverse_of_broad.shape)
        )
        products = _Products(
            own=(whitened * values).sum(axis=1),
            ids=np.empty((len(cells), ANGLES * self._ids)),
            rival=np.empty(len(cells)),
            patterns=whitened @ self._broad,
            inverse=inverse.copy() if partly.any() else inverse,
            hidden={},
        )
        steps = np.minimum(np.rint(smear / SMEAR_STEP), MOST_STEPS).astype(int)
        for step in set(steps.tolist()):
            of = np.flatnonzero(steps == step)
            expected = self._expected(step)
            products.ids[of] = values[of] @ expected.ids
            likely = np.ascontiguousarray((expected.rivals @ values[of].T.astype(np.float32)).T)
            best = expected.rivals[likely.argmax(axis=1)]
            products.rival[of] = (values[of] * best).sum(axis=1)
            # Objects with the same unseen cells, as one track in many frames, share the work.
            equally_seen: dict[bytes, list[int]] = {}
            for i in np.flatnonzero(partly[of]).tolist():
                equally_seen.setdefault(seen[of[i]].tobytes(), []).append(i)
            for same in equally_seen.values():
                self._leave_out(
                    ~seen[of[same[0]]], products, of[same], values, whitened, expected, likely[same]
                )
        np.maximum(products.own, LEAST_VARIATION, out=products.own)
        scale = np.sqrt(products.own)
        correlation = (products.ids / scale[:, None]).reshape(-1, ANGLES, self._ids)
        rotation = rounded(correlation).argmax(axis=1)
        structure = self._structure(products, rotation, steps, number)
        return SymbolFit(correlation, products.rival / scale, rotation, structure)

    def _leave_out(
        self,
        hidden: BoolArray,
        products: _Products,
        objects: IndexArray,
        values: FloatArray,
        whitened: FloatArray,
        expected: _Whitened,
        likely: FloatImage,
    ) -> None:
        """Restrict the products of some objects to their seen cells.

        objects: (m,) indices of those whose unseen cells are `hidden`, (cells,); these are removed
        from the precision by a Schur complement. values, whitened: (n, cells). expected: at the
        objects' smear. likely: (m, R) their products with the rivals.
        """
        rank = max(likely.shape[1] - MOST_RIVALS, 0)
        compared = likely >= np.partition(likely, rank, axis=1)[:, rank, None]
        some = np.flatnonzero(compared.any(axis=0))
        rivals = expected.rivals[some].T.astype(float)
        # Of the hidden cells, divided by a root of their precision: products are differences then.
        precision = self._precision[hidden][:, hidden]
        precision.flat[:: len(precision) + 1] *= 1 + STEADY_CELLS
        parts = self._whitened_broad, expected.ids, rivals, whitened[objects].T
        right = np.concatenate([part[hidden] for part in parts], axis=1)
        divided = _solved(np.linalg.cholesky(precision), right)
        first, last = self._broad.shape[1], -len(objects)  # columns of the symbols
        patterns, symbols, own = np.split(divided, [first, last], axis=1)
        of_own = own.T @ divided[:, :last]
        products.own[objects] -= (own * own).sum(axis=0)
        products.patterns[objects] -= of_own[:, :first]
        products.inverse[objects] = _steady_inverse(self._of_broad - patterns.T @ patterns)
        power = 1 - (symbols * symbols).sum(axis=0)
        scale = np.sqrt(np.maximum(power, LEAST_SHOWN))
        combined = np.concatenate([products.ids[objects], values[objects] @ rivals], axis=1)
        found = np.where(power > LEAST_SHOWN, (combined - of_own[:, first:]) / scale, 0.0)
        ids = ANGLES * self._ids
        products.ids[objects] = found[:, :ids]
        of_rivals = np.where(compared[:, some], found[:, ids:], 0.0)
        products.rival[objects] = of_rivals.max(axis=1, initial=0)
        hidden_part = symbols[:, :ids], patterns, scale[:ids, None]
        products.hidden.update(dict.fromkeys(objects.tolist(), hidden_part))

    def _structure(
        self, products: _Products, rotation: IndexArray, steps: IndexArray, seen: IndexArray
    ) -> FloatArray:
        """(n, K) `structure` of SymbolFit. rotation: (n, K). seen: (n,) number of cells."""
        best = rotation * self._ids + np.arange(self._ids)  # index among the IDs
        of_best = np.empty((*best.shape, products.patterns.shape[1]))
        for i, step in enumerate(steps.tolist()):
            of_best[i] = self._expected(step).broad[best[i]]
            if i in products.hidden:
                ids, patterns, norm = products.hidden[i]
                of_best[i] = (of_best[i] - ids[:, best[i]].T @ patterns) / norm[best[i]]
        explained = np.take_along_axis(products.ids, best, axis=1)
        broad = products.patterns[:, None] - explained[..., None] * of_best  # (n, K, P)
        own = products.own[:, None]
        unexplained = np.maximum(own - explained**2, 0.0) + MISFIT * own
        share = ((broad @ products.inverse) * broad).sum(axis=2) / unexplained
        share *= seen[:, None] / products.patterns.shape[1]
        return np.asarray(np.log(np.maximum(share, LEAST_STRUCTURE)))

    def _whitened(self, steps: int) -> _Whitened:
        """The whitened `expected` symbols at a smear of whole SMEAR_STEPs."""
        flat = self.expected(steps).reshape(len(self._precision), -1)
        whitened = self._precision @ flat
        whitened /= np.sqrt((flat * whitened).sum(axis=0))
        ids, rivals = np.split(whitened, [ANGLES * self._ids], axis=1)
        ids = np.ascontiguousarray(ids)
        return _Whitened(ids, ids.T @ self._broad, np.ascontiguousarray(rivals.T, np.float32))

    def expected(self, steps: int) -> FloatArray:
        """(lines, ANGLES, T) expected levels of every symbol: 0 on the plate, 1 on a bright sector.

        steps: the smear in whole SMEAR_STEPs.
        """
        discs = self._landmarks
        radius, angle, share = _points(self._radii, steps * SMEAR_STEP)
        ring = (radius >= discs.ring[0]) & (radius <= discs.ring[1])
        bare = np.where(ring, RING_DB, np.where(radius > 1, FLOOR_DB, PLATE_DB))
        power = 10 ** (bare / 10) @ share + 10 ** (NOISE_DB / 10)  # (lines, ANGLES)
        brighter = 10 ** (SYMBOL_DB / 10) - 10 ** (PLATE_DB / 10)
        lit = self._lit(radius, angle, share).reshape(*power.shape, -1)
        power = power[..., None] + brighter * lit
        return np.asarray((10 * np.log10(power) - PLATE_DB) / (SYMBOL_DB - PLATE_DB))

    def _lit(self, radius: FloatArray, angle: FloatArray, share: FloatArray) -> FloatArray:
        """(cells, T) share of each cell that lies on the bright sectors of every symbol.

        radius, angle, share: from `_points`.
        """
        inner, outer = self._landmarks.symbol
        cells = radius[..., 0].size
        within = (radius >= inner) & (radius <= outer)
        cell = np.broadcast_to(np.arange(cells).reshape(*radius.shape[:2], 1), radius.shape)[within]
        share = np.broadcast_to(share, radius.shape)[within]
        radius, angle = radius[within], angle[within]
        # Summed by direction from the disc's centre. A step and a sector are whole numbers of
        # directions, so a code is rotated by rolling it.
        sectors = np.asarray(self._landmarks.sectors, dtype=float)
        directions = math.lcm(ANGLES, RIVAL_SECTORS, sectors.shape[1])
        direction = np.mod(angle, 2 * np.pi) / (2 * np.pi) * directions
        index = cell * directions + np.minimum(direction, directions - 1).astype(int)
        by_direction = np.bincount(index, share, cells * directions).reshape(cells, directions)
        ids, rivals = (by_direction @ _rotated(c, directions).T for c in (sectors, self._rivals))
        # The cross: the points within its arms, at each of its rotations.
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        rotation = np.arange(CROSS_ROTATIONS)[:, None] * STEP
        cos, sin = np.cos(rotation), np.sin(rotation)
        off_axis = np.minimum(np.abs(x * cos + y * sin), np.abs(y * cos - x * sin))
        rotations, point = np.nonzero((off_axis < ARM) & (radius >= HUB))
        index = cell[point] * CROSS_ROTATIONS + rotations
        cross = np.bincount(index, share[point], cells * CROSS_ROTATIONS)
        return np.concatenate([ids, cross.reshape(cells, CROSS_ROTATIONS), rivals], axis=1)


@lru_cache(maxsize=4)  # two opinions on noise
def expected_symbols(landmarks: LandmarkSet, correlation_length: float) -> ExpectedSymbols:
    """The expected symbols of a set on the lines of its shape matrices.

    correlation_length: as ExpectedSymbols. Cached, so that logs and presets with one set share it.
    """
    sampler = ShapeSampler(landmarks, (1.0, 1.0))  # its lines do not depend on the axes
    return ExpectedSymbols(landmarks, sampler.radii, sampler.bands, correlation_length)


def _rivals(landmarks: LandmarkSet) -> FloatArray:
    """(R, RIVAL_SECTORS) codes, 0 or 1, that differ from every ID, without their rotations."""
    numbers = np.arange(1, 2**RIVAL_SECTORS - 1)
    codes = (numbers[:, None] >> np.arange(RIVAL_SECTORS)) & 1
    rotations = np.stack([np.roll(codes, rotation, axis=1) for rotation in range(RIVAL_SECTORS)])
    values = rotations @ (1 << np.arange(RIVAL_SECTORS))
    codes = codes[values.min(axis=0) == numbers]
    sectors = np.asarray(landmarks.sectors)
    directions = math.lcm(ANGLES, RIVAL_SECTORS, sectors.shape[1])
    ids = _rotated(sectors, directions)
    lit = np.repeat(codes, directions // RIVAL_SECTORS, axis=1)
    difference = np.abs(lit[:, None] - ids[None]).mean(axis=2).min(axis=1)
    return np.asarray(codes[difference >= LEAST_DIFFERENCE], float)


def _rotated(codes: FloatArray, directions: int) -> FloatArray:
    """(ANGLES x K, directions): all codes (K, sectors) at the first rotation, then at the next."""
    lit = np.repeat(codes, directions // codes.shape[1], axis=1)
    step = directions // ANGLES
    return np.concatenate([np.roll(lit, rotation * step, axis=1) for rotation in range(ANGLES)])


def _points(radii: FloatArray, smear: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The points whose echoes each cell mixes: distance from the centre, angle, and share.

    The first two are (lines, ANGLES, points), the share (points,). The points cover a pixel, along
    the radius and the circle so that rotations stay exact, and the beam across the line of sight.
    """
    half = math.ceil(2.4 * smear / BEAM_POINT)
    deviations = np.linspace(-2.4, 2.4, 2 * half + 1) if half else np.zeros(1)
    beam_share = np.exp(-0.5 * deviations**2)
    share = np.einsum("i,j,k->ijk", _THREE_SHARE, _THREE_SHARE, beam_share / beam_share.sum())
    angle = ((np.arange(ANGLES) + 0.5) * STEP)[:, None, None, None]  # from the line of sight
    out = radii[:, None, None, None, None] + PIXEL * _THREE[:, None, None]
    round_ = PIXEL * _THREE[:, None]
    across = out * np.sin(angle) + round_ * np.cos(angle) + smear * deviations  # to the left
    along = out * np.cos(angle) - round_ * np.sin(angle) + 0 * deviations  # the line of sight
    points = (len(radii), ANGLES, share.size)
    distance, direction = np.hypot(across, along), np.arctan2(across, along)
    return distance.reshape(points), direction.reshape(points), share.ravel()


def _broad(radii: FloatArray, symbol_to: float) -> FloatArray:
    """(cells, P) waves of up to WAVES periods round the symbol, whose radius is `symbol_to`.

    Every wave is there twice: constant along the radius, and growing with its square.
    """
    angle = (np.arange(ANGLES) + 0.5) * STEP
    within = radii < symbol_to
    patterns = [
        np.outer(np.where(within, (radii / symbol_to) ** power, 0.0), wave(periods * angle)).ravel()
        for periods in range(WAVES + 1)
        for power in (0, 2)
        for wave in ((np.cos, np.sin) if periods else (np.cos,))
    ]
    return np.stack(patterns, axis=1)


def _solved(lower: FloatArray, right: FloatArray) -> FloatArray:
    """(h, n) X of `lower` X = `right` (h, n), for a lower triangle (h, h)."""
    found = np.empty_like(right)
    for first in range(0, len(lower), BLOCK):
        rows = slice(first, first + BLOCK)
        left = right[rows] - lower[rows, :first] @ found[:first]
        found[rows] = np.linalg.inv(lower[rows, rows]) @ left
    return found


def _steady_inverse(products: FloatArray) -> FloatArray:
    """Regularised inverse of the patterns' products, which are singular if few cells are seen.

    Changes the products.
    """
    products.flat[:: len(products) + 1] += STEADY * products.trace()
    return np.linalg.inv(products)


def _precision(radii: FloatArray, correlation_length: float, ring_from: float) -> FloatArray:
    """(cells, cells) inverse covariance of the noise in the cells on lines at `radii`.

    Two levels are free parameters, that of the ring (radii above `ring_from`) and that of all other
    cells: the precision times either is 0.
    """
    angle = (np.arange(ANGLES) + 0.5) * STEP
    x, y = (np.outer(radii, way(angle)).ravel() for way in (np.cos, np.sin))
    distance = np.hypot(x[:, None] - x, y[:, None] - y)
    area = np.repeat(radii / radii.mean(), ANGLES)
    covariance = np.exp(-distance / max(correlation_length, 1e-6)) + ILLUMINATION_SHARE * np.exp(
        -distance / ILLUMINATION_LENGTH
    )
    inverse = np.linalg.inv(covariance + np.diag(CELL_NOISE_SHARE / area))
    ring = np.repeat(radii > ring_from, ANGLES)
    levels = np.column_stack([ring, ~ring]).astype(float)
    known = inverse @ levels
    return np.asarray(inverse - known @ np.linalg.solve(levels.T @ known, known.T))
