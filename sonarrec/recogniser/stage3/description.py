"""Compares an averaged shape matrix with every ID; the results are FEATURES for the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IndexArray, quantile
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.stage3.expected_symbol import SymbolFit, expected_symbols
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, Bands, rotated_codes

# Levels are in standard deviations of the grey levels around the object (see ShapeSampler). Those
# called "share" are divided by the ring's contrast over the gap. Other levels without this division
# helped in kinds of world similar to those learned from, and did harm in others.
FEATURES = (
    "correlation",  # with the ID's expected symbol and gap at the best rotation
    # Log of the share of variation that the ID leaves unexplained, less that of the best rival.
    "rival_misfit",
    # Log of the share of the unexplained variation in broad patterns, relative to that of noise.
    "structure",
    "weakest_line_step_share",  # least step from dark to bright sectors, of all lines but the first
    "bright_over_ring_share",  # bright sectors over the ring, 0 on a landmark
    "weakest_edge_share",  # least step across the edges between bright and dark sectors
    # Levels of sectors over the gap in the same direction: the darkest bright sector, the darkest
    # half of a bright sector, the brightest half of a dark sector. Late echoes and uneven
    # illumination raise the gap as much as the symbol.
    "weakest_bright",
    "weakest_bright_half_share",
    "strongest_dark_half_share",
    # The weakest quarter of the ring, over the mean of gap and floor in its directions, and over
    # the gap.
    "weakest_ring_share",
    "weakest_ring_over_gap",
    "ring_texture_share",  # standard deviation along the ring
    "existence",  # log odds that stage 2 gives
    # The first three again, by the fit under INDEPENDENT noise; for smeared pictures, their copies.
    "independent_correlation",
    "independent_rival_misfit",
    "independent_structure",
)
# Two assumptions about noise. The first: it is correlated between neighbouring cells, like speckle,
# which stays with the floor. The second: it is independent from cell to cell, like the glitter of
# single stones on bright sectors. The second fit also limits glitter: no cell counts as brighter
# than this percentile of the symbol's cells.
INDEPENDENT, GLITTER_PERCENTILE = 0.0, 80
# A picture is sharp up to the smear SHARP (the beam's standard deviation across the line of sight,
# in disc radii), and smeared from SMEARED on: discs 14 and 8 beams wide. Chosen on tuning seeds.
SHARP, SMEARED = 0.06, 0.10
BEST_FIT = 0.995  # largest correlation that counts
LEAST_CONTRAST = 0.3  # least contrast of the ring by which features are divided
# Indices of the steps next to each step, and of those two steps from it, which the smear of an edge
# hardly reaches.
BEFORE, AFTER = ((np.arange(ANGLES) + off) % ANGLES for off in (-1, 1))
FAR_BEFORE, FAR_AFTER = ((np.arange(ANGLES) + off) % ANGLES for off in (-2, 2))
# (ANGLES, ANGLES): column i is 1 over the quarter circle that begins at step i.
QUARTERS = np.stack([np.roll(np.arange(ANGLES) < ANGLES // 4, i) for i in range(ANGLES)], 1) * 1.0
# An arc of HIDDEN_STEPS or more is hidden where the ring, averaged over RING_STEPS, has less than
# HIDDEN_SHARE of its contrast on its better parts (its upper quartile).
HIDDEN_STEPS, RING_STEPS, HIDDEN_SHARE = 9, 7, 0.3
ROTATION_SIGMA = 0.12  # scale of the standard error; tuning seeds, checked by `make scenes`
LIMIT = 9.0  # largest magnitude of every feature


@dataclass(frozen=True, slots=True)
class Description:
    """n objects under each of K IDs."""

    features: FloatArray
    """(n, K, F)."""
    rotation: FloatArray
    """(n, K) the rotation that fits best, in steps."""
    rotation_sigma: FloatArray
    """(n, K) its standard error, in steps."""


@dataclass(frozen=True, slots=True)
class _BandAverages:
    """Symbol, ring, gap and the floor outside (4 bands, in this order) of n averaged matrices."""

    profiles: FloatArray
    """(4, n, ANGLES) mean over each band's lines."""
    weights: FloatArray
    """(4, n, ANGLES) how often the bands' cells were seen, weighted by their area."""
    levels: FloatArray
    """(4, n) mean over all angles."""

    @property
    def ring_over_gap(self) -> FloatArray:
        """(n,) contrast of the ring."""
        return np.asarray(self.levels[1] - self.levels[2])

    @property
    def contrast(self) -> FloatArray:
        """(n,) the ring's contrast, at least LEAST_CONTRAST, by which features are divided."""
        return np.maximum(self.ring_over_gap, LEAST_CONTRAST)


class _SectorMeans:
    """Means over `parts` equal sectors of the circle, at every rotation."""

    def __init__(self, parts: int) -> None:
        position = (np.arange(ANGLES) + 0.5) / ANGLES * parts
        # A sector's edges count less, since the beam mixes them with the neighbours.
        member = position.astype(int)[:, None] == np.arange(parts)
        member = member * np.sin(np.pi * (position % 1))[:, None]  # (ANGLES, parts)
        self._cells = member.sum(axis=0)
        # (ANGLES, ANGLES x parts)
        rotated = np.stack([np.roll(member, step, axis=0) for step in range(ANGLES)], axis=1)
        self._member = rotated.reshape(ANGLES, -1)

    def levels(
        self, symbol: FloatArray, weight: FloatArray, rotation: IndexArray
    ) -> tuple[FloatArray, BoolArray]:
        """Mean level of every sector at every ID's rotation, and whether enough of it was seen.

        symbol, weight: (n, ANGLES). rotation: (n, K). Both results are (n, K, parts).
        """
        shape = (*symbol.shape, len(self._cells))
        at_rotation = np.arange(len(rotation))[:, None], rotation
        share = (weight @ self._member).reshape(shape)[at_rotation]
        level = ((symbol * weight) @ self._member).reshape(shape)[at_rotation]
        full = weight.max(axis=1)[:, None, None] * self._cells
        return level / np.maximum(share, 1e-9), share > 0.3 * np.maximum(full, 1e-9)


class Describer:
    """Describes averaged shape matrices under every ID of one landmark set."""

    def __init__(
        self, bands: Bands, radii: FloatArray, landmarks: LandmarkSet, correlation_length: float
    ) -> None:
        """bands, radii: from ShapeSampler. correlation_length: as in ExpectedSymbols."""
        self._starts = [b.start for b in (bands.symbol, bands.ring, bands.gap, bands.outer)]
        self._step_lines = slice(bands.symbol.start + 1, bands.symbol.stop)
        # A line is weighted by the area that it covers; the innermost covers hardly any.
        self._area = (radii / radii.max())[:, None]
        codes = rotated_codes(landmarks)
        # As a beam sees them: sector edges smeared over a step.
        self._codes = 0.5 * codes + 0.25 * (codes[..., BEFORE] + codes[..., AFTER])
        self._expected = expected_symbols(landmarks, correlation_length)
        self._independent = expected_symbols(landmarks, INDEPENDENT)
        self._symbol = bands.symbol
        # 1 at the two steps that flank a rise counter-clockwise, -1 at those of a fall.
        self._edges = codes[..., AFTER] - codes[..., BEFORE]
        self._sectors = np.asarray(landmarks.sectors, dtype=bool)
        self._halves = np.repeat(self._sectors, 2, axis=1)
        self._in_sector, self._in_half = (_SectorMeans(n * self._sectors.shape[1]) for n in (1, 2))

    def __call__(
        self, average: FloatArray, count: FloatArray, existence: FloatArray, smear: FloatArray
    ) -> Description:
        """The FEATURES of averaged matrices (n, L, ANGLES) and their counts from TrackMatrix.

        existence: (n,) probability by stage 2. smear: (n,) the beam's standard deviation across the
        line of sight, in disc radii.
        """
        count = count * self._area
        bands = self._bands(average, count)
        lines = self._expected.lines
        cells, seen = average[:, lines], count[:, lines] > 0
        fit = self._expected.fit(cells, seen, smear)
        # Beams correlate the cells of smeared pictures: there the second fit is the first.
        second, unsmeared = _of_fit(fit), smear < SMEARED
        if unsmeared.any():
            symbol = average[unsmeared][:, self._symbol]
            brightest = _brightest(symbol, count[unsmeared][:, self._symbol])
            limited = np.minimum(cells[unsmeared], brightest)
            found = _of_fit(self._independent.fit(limited, seen[unsmeared], smear[unsmeared]))
            second = {name: _replaced(of, unsmeared, found[name]) for name, of in second.items()}
        rotation, best = fit.rotation, fit.best  # (n, K)
        # (n, K), or (n,) if equal for every ID
        values = {
            **_of_fit(fit),
            **{f"independent_{name}": value for name, value in second.items()},
            **self._of_symbol(average, count, bands, rotation),
            **_of_ring(bands),
            "existence": np.log(existence / (1 - existence)),
        }
        features = np.empty((*rotation.shape, len(FEATURES)))
        for i, name in enumerate(FEATURES):
            value = values[name]
            features[:, :, i] = value if value.ndim == 2 else value[:, None]
        exact, rotation_sigma = _exact_rotation(fit.correlation, rotation, best)
        return Description(np.clip(features, -LIMIT, LIMIT), exact, rotation_sigma)

    def hidden(self, average: FloatArray, count: FloatArray) -> BoolArray:
        """(n, ANGLES) the directions in which something covers the disc, as its ring shows.

        average, count: (n, L, ANGLES), from TrackMatrix.
        """
        _, ring, gap, outer = self._bands(average, count * self._area).profiles
        around = np.arange(ANGLES)[:, None] + np.arange(RING_STEPS) - RING_STEPS // 2
        # A ring may be as dark as the floor, or wide beams may brighten the gap. So the ring is
        # compared with the darker of the gap, and the mean of gap and floor.
        contrast = ring - np.minimum(gap, 0.5 * (gap + outer))
        contrast = contrast[:, around % ANGLES].mean(axis=2)
        better = np.maximum(quantile(contrast.T, 0.75), LEAST_CONTRAST)
        weak = contrast < HIDDEN_SHARE * better[:, None]
        # An opening: what is covered by windows of HIDDEN_STEPS that lie within weak arcs.
        window = (np.arange(ANGLES)[:, None] + np.arange(HIDDEN_STEPS)) % ANGLES
        begins = weak[:, window].all(axis=2)
        covered = begins[:, (np.arange(ANGLES)[:, None] - np.arange(HIDDEN_STEPS)) % ANGLES]
        return np.asarray(covered.any(axis=2) & ~weak.all(axis=1, keepdims=True))

    def _bands(self, average: FloatArray, count: FloatArray) -> _BandAverages:
        """The matrices' bands: the mean over each one's lines, and how often cells were seen."""
        weights = np.add.reduceat(count, self._starts, axis=1).swapaxes(0, 1)
        profiles = np.add.reduceat(average * count, self._starts, axis=1).swapaxes(0, 1)
        profiles = profiles / np.maximum(weights, 1e-9)
        return _BandAverages(profiles, weights, _level(profiles, weights))

    def _of_symbol(
        self, average: FloatArray, count: FloatArray, bands: _BandAverages, rotation: IndexArray
    ) -> dict[str, FloatArray]:
        """The features of the symbol, each (n, K), under each ID at its best rotation (n, K).

        average, count: (n, L, ANGLES), the count weighted by the cells' area.
        """
        symbol, _, gap, _ = bands.profiles
        weight, _, gap_weight, _ = bands.weights
        ids = np.arange(rotation.shape[1])
        symbol_over_gap = symbol - bands.levels[2][:, None]
        dark, step = _regress(
            np.concatenate([symbol_over_gap[:, None], average[:, self._step_lines]], axis=1),
            np.concatenate([weight[:, None], count[:, self._step_lines]], axis=1),
            self._codes[rotation, ids],
        )
        over_gap, known = symbol - gap, weight * (gap_weight > 0)
        sector, sector_seen = self._in_sector.levels(over_gap, known, rotation)
        half, half_seen = self._in_half.levels(over_gap, known, rotation)
        share = 1 / bands.contrast[:, None]
        return {
            "weakest_line_step_share": step[..., 1:].min(axis=-1) * share,
            "bright_over_ring_share": ((dark + step)[..., 0] - bands.ring_over_gap[:, None])
            * share,
            "weakest_edge_share": _weakest_edge(symbol, weight, self._edges[rotation, ids]) * share,
            "weakest_bright": _least(sector, sector_seen & self._sectors),
            "weakest_bright_half_share": _least(half, half_seen & self._halves) * share,
            "strongest_dark_half_share": -_least(-half, half_seen & ~self._halves) * share,
        }


def _of_fit(fit: SymbolFit) -> dict[str, FloatArray]:
    """The features of a fit, each (n, K)."""
    return {
        "correlation": fit.best,
        "rival_misfit": np.log(_unexplained(fit.best) / _unexplained(fit.rival)[:, None]),
        "structure": fit.structure,
    }


def _replaced(values: FloatArray, rows: BoolArray, by: FloatArray) -> FloatArray:
    """The values with some rows replaced."""
    values = values.copy()
    values[rows] = by
    return values


def _brightest(symbol: FloatArray, count: FloatArray) -> FloatArray:
    """(n, 1, 1) the GLITTER_PERCENTILE of the seen cells of (n, L, ANGLES); infinite if none is."""
    cells = symbol.shape[1] * ANGLES
    values = np.sort(np.where(count > 0, symbol, np.inf).reshape(len(symbol), cells), axis=1)
    last = np.maximum((count > 0).sum(axis=(1, 2)) - 1, 0)
    index = np.rint(last * GLITTER_PERCENTILE / 100).astype(int)
    return np.asarray(values[np.arange(len(values)), index][:, None, None])


def _of_ring(bands: _BandAverages) -> dict[str, FloatArray]:
    """The features of the ring, each (n,)."""
    _, ring, gap, outer = bands.profiles
    _, weight, gap_weight, _ = bands.weights
    spread = np.sqrt(_level((ring - bands.levels[1][:, None]) ** 2, weight))
    seen = np.minimum(weight, 1.0)
    return {
        "weakest_ring_share": _weakest_quarter(ring - 0.5 * (gap + outer), seen) / bands.contrast,
        "weakest_ring_over_gap": _weakest_quarter(ring - gap, seen * (gap_weight > 0)),
        "ring_texture_share": spread / bands.contrast,
    }


def _unexplained(correlation: FloatArray) -> FloatArray:
    """Unexplained share of the variation. Fits better than BEST_FIT differ only by chance."""
    return np.asarray(1 - np.clip(correlation, 0, BEST_FIT) ** 2)


def _least(level: FloatArray, among: BoolArray) -> FloatArray:
    """Least level over the last axis where `among`; 0 where nothing is."""
    least = np.where(among, level, np.inf).min(axis=-1)
    return np.where(np.isfinite(least), least, 0.0)


def _exact_rotation(
    correlation: FloatArray, rotation: IndexArray, best: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(n, K) the sub-step rotation, and its standard error, in steps.

    correlation: (n, ANGLES, K). rotation, best: (n, K) the whole step of its maximum, and that
    maximum. The sub-step rotation is the vertex of a parabola through three samples. Each sample is
    a mean over three steps, since sector edges flatten the maximum.
    """
    near = (rotation + np.arange(-2, 3)[:, None, None]) % ANGLES  # (5, n, K)
    values = correlation[np.arange(len(rotation))[:, None], near, np.arange(rotation.shape[1])]
    before, here, after = ((values[i] + values[i + 1] + values[i + 2]) / 3 for i in range(3))
    bend = 2 * here - before - after
    part = np.where(bend > 1e-6, 0.5 * (after - before) / np.maximum(bend, 1e-6), 0.0)
    # As in any least-squares fit: the residual noise over the root of the curvature.
    sigma = ROTATION_SIGMA * np.sqrt(1 - np.minimum(best, 0.999) ** 2)
    return rotation + np.clip(part, -0.5, 0.5), sigma / np.sqrt(np.maximum(bend, 1e-4))


def _regress(
    symbol: FloatArray, weight: FloatArray, code: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(n, K, L) level of the dark sectors, and step to the bright ones.

    By weighted regression of every line of the symbol (n, L, ANGLES) on the codes (n, K, ANGLES).
    """
    share = weight / np.maximum(weight.sum(axis=2, keepdims=True), 1e-9)
    share = share.swapaxes(1, 2)
    weighted = share * symbol.swapaxes(1, 2)
    mean = weighted.sum(axis=1)[:, None]  # (n, 1, L)
    code_mean = code @ share
    code_variance = code**2 @ share - code_mean**2
    covariance = code @ weighted - mean * code_mean
    # The step is unknown if no edge between bright and dark was seen.
    step = np.where(code_variance > 0.02, covariance / np.maximum(code_variance, 1e-9), 0.0)
    return mean - step * code_mean, step


def _weakest_edge(symbol: FloatArray, weight: FloatArray, edges: FloatArray) -> FloatArray:
    """(n, K) least rise of (n, ANGLES) profiles across edges (n, K, ANGLES); 0 if none was seen."""
    rise = symbol[:, FAR_AFTER] - symbol[:, FAR_BEFORE]
    seen = (weight[:, FAR_AFTER] > 0) & (weight[:, FAR_BEFORE] > 0)
    edges = edges * seen[:, None]
    return _least(rise[:, None] * edges, edges != 0)


def _level(profile: FloatArray, weight: FloatArray) -> FloatArray:
    """Weighted mean over all angles, the last axis."""
    return np.asarray((profile * weight).sum(axis=-1) / np.maximum(weight.sum(axis=-1), 1e-9))


def _weakest_quarter(contrast: FloatArray, seen: FloatArray) -> FloatArray:
    """(n,) least mean contrast of all quarter circles of which more than half was seen.

    contrast, seen: (n, ANGLES). LIMIT if of every quarter half or less was seen.
    """
    cells = seen @ QUARTERS
    mean = (contrast * seen) @ QUARTERS / np.maximum(cells, 1e-9)
    return np.asarray(np.where(cells > 0.5 * ANGLES / 4, mean, LIMIT).min(axis=1))
