"""What a disc's shape matrix looks like, gathered along its track.

The paper measures each frame by itself and normalises away 'this is no landmark'. Here the grey
shape matrix is averaged in the object's own frame (angles count from the line of sight, which a
pan leaves alone) and described, under every ID, by the FEATURES that a model of its appearance
judges (appearance_model.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from sonarrec.landmarks import LandmarkSet
from sonarrec.records import FloatArray, Groups
from sonarrec.shape_matrix import ANGLES, Bands, ShapeSampler, turned_codes

# Levels are in standard deviations of the frame. Those named "share" are divided by the ring's
# contrast over the gap, which makes them free of gain and grey scale but worthless on a faint
# ring; the model has both.
FEATURES = (
    "correlation",  # of the symbol with the ID's sectors, at the best rotation
    "step",  # bright sectors over dark ones
    "step_share",
    "dark_over_gap",  # dark sectors over the gap, 0 on a landmark
    "bright_over_ring",  # bright sectors over the ring, 0 on a landmark
    "ring_over_gap",
    "ring_over_floor",  # over the floor outside
    "gap_over_floor",
    "margin",  # darkest bright sector over the brightest dark one
    "margin_share",
    "weakest_bright",  # darkest bright sector over the gap
    "strongest_dark",  # brightest dark sector over the gap, 0 on a landmark
    "texture",  # spread within the sectors
    "texture_share",
    "weakest_ring",  # weakest quarter of the ring over what lies beside it
    "weakest_ring_share",
    "ring_texture_share",  # spread along the ring
    "bright_outwards",  # bright sectors: outermost line over the innermost
    "dark_outwards",  # dark sectors: the same
    "unseen",  # share of the disc outside the fan so far
    "log_frames",  # natural logarithm of the frames gathered
    "existence",  # log odds that stage 2 gives
)
LEAST_CONTRAST = 0.3  # of the ring, in the shares
TURN_SIGMA = 0.3  # scale of the turn's standard error; tuning seeds, checked by `make scenes`
LIMIT = 9.0  # of every feature's magnitude


class TrackMatrix:
    """The running average of each track's shape matrix.

    Frames fade with a memory of `memory_frames`; a cell counts by how often it was seen.
    """

    def __init__(self, memory_frames: float, lines: int) -> None:
        self._keep = 1 - 1 / max(memory_frames, 1.0)
        self._numbers: list[int] = []
        self._sum: FloatArray = np.empty((0, lines, ANGLES))
        self._count: FloatArray = np.empty((0, lines, ANGLES))

    def step(
        self, groups: Groups, grey: FloatArray, seen: npt.NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray]:
        """Add a frame's matrices (n, L, ANGLES). Returns the averages and the counts, same shape.

        Tracks that are neither in view nor remembered are forgotten.
        """
        place = {number: i for i, number in enumerate(self._numbers)}
        numbers = [*groups.numbers.tolist(), *groups.remembered.tolist()]
        total = np.zeros((len(numbers), *self._sum.shape[1:]))
        count = np.zeros_like(total)
        known = [i for i, number in enumerate(numbers) if number in place]
        before = [place[numbers[i]] for i in known]
        total[known], count[known] = self._sum[before], self._count[before]
        now = slice(len(groups.numbers))
        total[now] = self._keep * total[now] + np.where(seen, grey, 0.0)
        count[now] = self._keep * count[now] + seen
        self._numbers, self._sum, self._count = numbers, total, count
        return total[now] / np.maximum(count[now], 1e-9), count[now]


@dataclass(frozen=True, slots=True)
class Description:
    """n objects under each of K IDs. features: (n, K, F).

    turn, turn_sigma: (n, K) the rotation that fits best and its standard error, in steps.
    """

    features: FloatArray
    turn: FloatArray
    turn_sigma: FloatArray


class Describer:
    """Describes averaged shape matrices under every ID of one landmark set."""

    def __init__(self, bands: Bands, radii: FloatArray, landmarks: LandmarkSet) -> None:
        """bands, radii: of the lines, from ShapeSampler."""
        self._bands = bands
        # A line stands for its part of the disc's area; the innermost is little more than a point.
        self._area = (radii / radii.max())[:, None]
        codes = turned_codes(landmarks)
        # As a beam sees them: sector edges smeared over a step.
        self._codes = 0.5 * codes + 0.25 * (np.roll(codes, 1, -1) + np.roll(codes, -1, -1))
        flat = self._codes.reshape(-1, ANGLES).T
        self._flat, self._flat_squared = flat.copy(), flat**2
        table = np.asarray(landmarks.sectors, dtype=bool)
        sector = ((np.arange(ANGLES) + 0.5) / ANGLES * table.shape[1]).astype(int)
        self._sectors = table
        # Towards its edges a sector runs into its neighbours.
        within = (np.arange(ANGLES) + 0.5) / ANGLES * table.shape[1] % 1
        member = sector[:, None] == np.arange(table.shape[1])
        self._member = member * np.sin(np.pi * within)[:, None]  # (ANGLES, S)

    def __call__(
        self, average: FloatArray, count: FloatArray, existence: FloatArray
    ) -> Description:
        """The FEATURES of averaged matrices (n, L, ANGLES) and their counts from TrackMatrix.

        existence: (n,) probability by stage 2.
        """
        bands = self._bands
        frames = np.maximum(count.max(axis=(1, 2)), 0.5)
        unseen = 1 - np.minimum(count, 1.0).mean(axis=(1, 2))
        count = count * self._area
        symbol, weight = _profile(average, count, bands.symbol)
        ring, ring_weight = _profile(average, count, bands.ring)
        gap, gap_weight = _profile(average, count, bands.gap)
        outer, outer_weight = _profile(average, count, bands.outer)
        ring_level = _level(ring, ring_weight)
        gap_level = _level(gap, gap_weight)
        outer_level = _level(outer, outer_weight)
        contrast = np.maximum(ring_level - gap_level, LEAST_CONTRAST)
        ring_spread = np.sqrt(_level((ring - ring_level[:, None]) ** 2, ring_weight))
        weakest = _weakest_quarter(ring - 0.5 * (gap + outer), np.minimum(ring_weight, 1.0))

        # Every ID at every rotation: weighted regression of the symbol on the turned code.
        objects, ids = len(average), self._codes.shape[1]
        total = np.maximum(weight.sum(axis=1), 1e-9)
        mean = (symbol * weight).sum(axis=1) / total
        variance = np.maximum((symbol**2 * weight).sum(axis=1) / total - mean**2, 1e-9)
        share = weight / total[:, None]
        code_mean = share @ self._flat
        code_variance = share @ self._flat_squared - code_mean**2
        covariance = (share * symbol) @ self._flat - mean[:, None] * code_mean
        known = code_variance > 0.02
        code_variance = np.maximum(code_variance, 1e-9)
        correlation = covariance / np.sqrt(variance[:, None] * code_variance)
        correlation = np.where(known, correlation, 0.0).reshape(objects, ANGLES, ids)
        turn = correlation.argmax(axis=1)  # (n, K)
        at = (np.arange(objects)[:, None], turn, np.arange(ids))
        best = correlation[at]
        shape = correlation.shape
        slope = covariance.reshape(shape)[at] / code_variance.reshape(shape)[at]
        slope = np.where(known.reshape(shape)[at], slope, 0.0)
        dark = mean[:, None] - slope * code_mean.reshape(shape)[at]
        texture = np.sqrt(np.maximum(variance[:, None] * (1 - best**2), 0))
        darkest, brightest = self._sector_extremes(symbol - gap_level[:, None], weight, turn)
        margin = np.where(np.isfinite(darkest - brightest), darkest - brightest, 0.0)
        code = self._codes[turn, np.arange(ids)]  # (n, K, ANGLES)
        bright_outwards, dark_outwards = _outwards(
            average[:, bands.symbol], count[:, bands.symbol], code
        )

        scale = contrast[:, None]
        odds = existence / (1 - existence)
        values = [
            best,
            slope,
            slope / scale,
            dark - gap_level[:, None],
            dark + slope - ring_level[:, None],
            ring_level - gap_level,
            ring_level - outer_level,
            gap_level - outer_level,
            margin,
            margin / scale,
            np.where(np.isfinite(darkest), darkest, 0.0),
            np.where(np.isfinite(brightest), brightest, 0.0),
            texture,
            texture / scale,
            weakest,
            weakest / contrast,
            ring_spread / contrast,
            bright_outwards,
            dark_outwards,
            unseen,
            np.log(frames),
            np.log(odds),
        ]
        features = np.empty((objects, ids, len(FEATURES)))
        for i, value in enumerate(values):
            features[:, :, i] = value if value.ndim == 2 else value[:, None]
        exact, bend = _summit(correlation, turn)
        # The steeper the correlation falls off, and the less of the symbol it leaves unexplained,
        # the better is the turn known (curvature of a least-squares fit).
        noise = np.sqrt(1 - np.minimum(best, 0.999) ** 2)
        turn_sigma = TURN_SIGMA * noise / np.sqrt(np.maximum(bend, 1e-4))
        return Description(np.clip(features, -LIMIT, LIMIT), exact, turn_sigma)

    def _sector_extremes(
        self, symbol: FloatArray, weight: FloatArray, turn: npt.NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray]:
        """(n, K) levels of the darkest bright and the brightest dark sector; inf, -inf: unseen."""
        unturned = (np.arange(ANGLES) + turn[..., None]) % ANGLES  # (n, K, ANGLES)
        rows = np.arange(len(symbol))[:, None, None]
        share = weight[rows, unturned] @ self._member  # (n, K, S)
        level = (symbol * weight)[rows, unturned] @ self._member / np.maximum(share, 1e-9)
        full = weight.max(axis=1)[:, None, None] * self._member.sum(axis=0)
        known = share > 0.3 * np.maximum(full, 1e-9)
        darkest = np.where(known & self._sectors, level, np.inf).min(axis=2)
        brightest = np.where(known & ~self._sectors, level, -np.inf).max(axis=2)
        return darkest, brightest


def _summit(correlation: FloatArray, turn: npt.NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """(n, K) the summit of (n, ANGLES, K) next to a whole turn, and how sharply it bends there.

    Through three samples, each the mean of three: the sector edges make the very top flat.
    """
    smooth = correlation + np.roll(correlation, 1, axis=1) + np.roll(correlation, -1, axis=1)
    at = turn[:, None]
    before, here, after = (
        np.take_along_axis(smooth, (at + off) % ANGLES, axis=1)[:, 0] / 3 for off in (-1, 0, 1)
    )
    bend = 2 * here - before - after
    part = np.where(bend > 1e-6, 0.5 * (after - before) / np.maximum(bend, 1e-6), 0.0)
    return turn + np.clip(part, -0.5, 0.5), bend


def _profile(average: FloatArray, count: FloatArray, band: slice) -> tuple[FloatArray, FloatArray]:
    """(n, ANGLES) mean over a band's lines, and how often its cells were seen."""
    weight = count[:, band]
    total = weight.sum(axis=1)
    return (average[:, band] * weight).sum(axis=1) / np.maximum(total, 1e-9), total


def _level(profile: FloatArray, weight: FloatArray) -> FloatArray:
    """(n,) mean round the disc."""
    return np.asarray((profile * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9))


def _weakest_quarter(contrast: FloatArray, seen: FloatArray) -> FloatArray:
    """(n,) least mean of (n, ANGLES) contrast over a quarter turn of which half was seen."""
    quarter = ANGLES // 4

    def over_quarters(values: FloatArray) -> FloatArray:
        sums = np.cumsum(np.concatenate([values, values[:, :quarter]], axis=1), axis=1)
        return np.asarray(sums[:, quarter:] - sums[:, :-quarter])

    cells = over_quarters(seen)
    mean = over_quarters(contrast * seen) / np.maximum(cells, 1e-9)
    return np.asarray(np.where(cells > 0.5 * quarter, mean, LIMIT).min(axis=1))


def _outwards(
    symbol: FloatArray, count: FloatArray, code: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(n, K) outermost over innermost line of the symbol, in bright and in dark sectors.

    symbol, count: (n, lines, ANGLES). code: (n, K, ANGLES), 0 to 1.
    """
    weight = count[:, [0, -1]].transpose(0, 2, 1)  # (n, ANGLES, 2)
    value = symbol[:, [0, -1]].transpose(0, 2, 1) * weight
    bright = (code @ value) / np.maximum(code @ weight, 1e-9)
    dark = ((1 - code) @ value) / np.maximum((1 - code) @ weight, 1e-9)
    return bright[..., 1] - bright[..., 0], dark[..., 1] - dark[..., 0]


class Judge(Protocol):
    """What turns features (n, K, F) into (n, K + 1) probabilities; rows sum to 1."""

    def probabilities(self, features: FloatArray) -> FloatArray: ...


class AppearanceMeasurement:
    """The default measurement of stage 3: from each track's averaged shape matrix."""

    def __init__(
        self, memory_frames: float, sampler: ShapeSampler, landmarks: LandmarkSet, model: Judge
    ) -> None:
        self._matrix = TrackMatrix(memory_frames, len(sampler.radii))
        self._describe = Describer(sampler.bands, sampler.radii, landmarks)
        self._model = model

    def step(
        self, groups: Groups, grey: FloatArray, seen: npt.NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n, K + 1) probabilities, the (n,) turn of the likeliest ID and its error, in steps.

        grey, seen: (n, L, ANGLES) of the groups in view, from this frame.
        """
        average, count = self._matrix.step(groups, grey, seen)
        description = self._describe(average, count, groups.existence)
        probabilities = self._model.probabilities(description.features)
        best = probabilities[:, :-1].argmax(axis=1)
        at = (np.arange(len(best)), best)
        return probabilities, description.turn[at], description.turn_sigma[at]
