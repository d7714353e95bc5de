"""What a disc's shape matrix looks like, gathered along its track, and what that makes it.

The paper measures each frame by itself and normalises away 'this is no landmark'. Here the grey
shape matrix is averaged in the object's own frame (angles count from the line of sight, which a
pan leaves alone), described by a few contrasts, and judged by a small log-linear model whose
hypotheses are every ID and 'none of these'.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from sonarrec.landmarks import LandmarkSet
from sonarrec.records import FloatArray
from sonarrec.shape_matrix import ANGLES, STEP, Bands, turned_codes

BUILT_IN = Path(__file__).parent / "models" / "appearance.toml"

FEATURES = (
    "constant",
    "correlation",  # of the symbol with the ID's sectors, at the best rotation
    "correlation_squared",
    "step",  # bright sectors over dark ones, in ring contrasts
    "step_squared",
    "floor_level",  # dark sectors over the gap, in ring contrasts
    "floor_level_squared",
    "margin",  # darkest bright sector over the brightest dark one
    "texture",  # spread within sectors
    "ring_contrast",  # ring over gap, in speckle sigmas
    "ring_over_floor",  # ring over the floor outside, in speckle sigmas
    "ring_coverage",  # weakest quarter of the ring, in ring contrasts
    "ring_texture",  # spread along the ring, in ring contrasts
    "unseen",  # share of the disc outside the fan so far
    "few_frames",  # 1 / frames gathered
)


class TrackMatrix:
    """The running average of each track's shape matrix.

    Frames fade with a memory of `memory_frames`; a cell counts by how often it was seen.
    """

    def __init__(self, memory_frames: float, lines: int) -> None:
        self._keep = 1 - 1 / max(memory_frames, 1.0)
        self._numbers = np.empty(0, np.int64)
        self._sum: FloatArray = np.empty((0, lines, ANGLES))
        self._count: FloatArray = np.empty((0, lines, ANGLES))

    def step(
        self, numbers: npt.NDArray[np.int64], grey: FloatArray, seen: npt.NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray]:
        """Add a frame's matrices (n, L, ANGLES). Returns the averages and the counts, same shape.

        Tracks that are no longer named are forgotten.
        """
        total = np.zeros_like(grey)
        count = np.zeros_like(grey)
        known = np.isin(numbers, self._numbers)
        before = np.searchsorted(self._numbers, numbers[known])
        total[known] = self._keep * self._sum[before]
        count[known] = self._keep * self._count[before]
        total += np.where(seen, grey, 0.0)
        count += seen
        self._numbers, self._sum, self._count = numbers, total, count
        return total / np.maximum(count, 1e-9), count


@dataclass(frozen=True, slots=True)
class Description:
    """Features of n objects under each of K IDs: (n, K, F), and the best turns (n, K) in steps."""

    features: FloatArray
    turn: npt.NDArray[np.intp]


def describe(
    average: FloatArray,
    count: FloatArray,
    bands: Bands,
    landmarks: LandmarkSet,
    turned: FloatArray,
) -> Description:
    """The FEATURES of averaged matrices (n, L, ANGLES) under every ID of the set.

    turned: from softened_codes.
    """
    weight = count[:, bands.symbol].sum(axis=1)
    symbol = _mean(average, count, bands.symbol)
    ring = _mean(average, count, bands.ring)
    gap = _mean(average, count, bands.gap)
    outer = _mean(average, count, bands.outer)
    ring_weight = count[:, bands.ring].sum(axis=1)

    def level(profile: FloatArray, weights: FloatArray) -> FloatArray:
        return np.asarray((profile * weights).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-9))

    ring_level = level(ring, ring_weight)
    gap_level = level(gap, count[:, bands.gap].sum(axis=1))
    outer_level = level(outer, count[:, bands.outer].sum(axis=1))
    contrast = np.maximum(ring_level - gap_level, 0.05)
    quarter = ANGLES // 4
    around = np.arange(ANGLES)[:, None] + np.arange(quarter)
    surroundings = 0.5 * (gap + outer)
    seen_part = np.minimum(ring_weight, 1.0)
    coverage = ((ring - surroundings) * seen_part)[:, around % ANGLES].sum(axis=2)
    coverage /= np.maximum(seen_part[:, around % ANGLES].sum(axis=2), 1e-9)
    coverage = np.where(seen_part[:, around % ANGLES].mean(axis=2) > 0.5, coverage, np.inf)
    weakest = np.minimum(coverage.min(axis=1) / contrast, 1.5)
    ring_texture = np.sqrt(level((ring - ring_level[:, None]) ** 2, ring_weight)) / contrast

    # Every ID at every rotation: weighted correlation of the symbol with the turned code.
    total = np.maximum(weight.sum(axis=1), 1e-9)[:, None, None]
    mean = (symbol * weight).sum(axis=1)[:, None, None] / total
    variance = (symbol**2 * weight).sum(axis=1)[:, None, None] / total - mean**2
    code_mean = np.einsum("na,tka->ntk", weight, turned) / total
    code_square = np.einsum("na,tka->ntk", weight, turned**2) / total
    cross = np.einsum("na,tka->ntk", weight * symbol, turned) / total
    covariance = cross - mean * code_mean
    code_variance = np.maximum(code_square - code_mean**2, 1e-9)
    correlation = covariance / np.sqrt(np.maximum(variance, 1e-9) * code_variance)
    correlation = np.where(code_square - code_mean**2 > 0.02, correlation, 0.0)
    turn = correlation.argmax(axis=1)  # (n, K)
    objects, ids = np.ogrid[: len(average), : turned.shape[1]]
    best = correlation[objects, turn, ids]
    slope = covariance[objects, turn, ids] / code_variance[objects, turn, ids]
    dark = mean[:, 0] - slope * code_mean[objects, turn, ids]
    scale = contrast[:, None]
    step = slope / scale
    floor_level = (dark - gap_level[:, None]) / scale
    residual = np.sqrt(np.maximum(variance[:, 0] * (1 - best**2), 0)) / scale
    margin = _sector_margin(symbol, weight, landmarks, turn) / scale

    def spread_over_ids(value: FloatArray) -> FloatArray:
        return np.repeat(value[:, None], turned.shape[1], axis=1)

    frames = count.max(axis=(1, 2))
    unseen = 1 - np.minimum(count, 1.0).mean(axis=(1, 2))
    features = np.stack(
        [
            np.ones_like(best),
            best,
            best**2,
            np.clip(step, -1, 3),
            np.clip(step, -1, 3) ** 2,
            np.clip(floor_level, -2, 2),
            np.clip(floor_level, -2, 2) ** 2,
            np.clip(margin, -2, 2),
            np.clip(residual, 0, 2),
            spread_over_ids(np.clip(ring_level - gap_level, -1, 4)),
            spread_over_ids(np.clip(ring_level - outer_level, -1, 4)),
            spread_over_ids(np.clip(weakest, -1, 1.5)),
            spread_over_ids(np.clip(ring_texture, 0, 2)),
            spread_over_ids(unseen),
            spread_over_ids(1 / np.maximum(frames, 1.0)),
        ],
        axis=2,
    )
    return Description(features, turn)


def _mean(average: FloatArray, count: FloatArray, band: slice) -> FloatArray:
    """(n, ANGLES) mean over a band's lines, by how often each cell was seen."""
    weight = count[:, band]
    return np.asarray(
        (average[:, band] * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9)
    )


def softened_codes(landmarks: LandmarkSet) -> FloatArray:
    """(ANGLES, K, ANGLES) turned codes as a beam sees them, sector edges smeared over a step."""
    codes = turned_codes(landmarks)
    return np.asarray(
        0.5 * codes + 0.25 * np.roll(codes, 1, axis=-1) + 0.25 * np.roll(codes, -1, axis=-1)
    )


def _sector_margin(
    symbol: FloatArray, weight: FloatArray, landmarks: LandmarkSet, turn: npt.NDArray[np.intp]
) -> FloatArray:
    """(n, K) darkest sector that should be bright less the brightest that should be dark."""
    table = np.asarray(landmarks.sectors, dtype=bool)  # (K, S)
    sectors = table.shape[1]
    centre = (np.arange(ANGLES) + 0.5) * STEP
    sector = np.floor(centre / (2 * np.pi) * sectors).astype(int)
    member = (sector[None] == np.arange(sectors)[:, None]).astype(float)  # (S, ANGLES)
    unturned = (np.arange(ANGLES) + turn[..., None]) % ANGLES  # (n, K, ANGLES)
    rows = np.arange(len(symbol))[:, None, None]
    share = weight[rows, unturned] @ member.T  # (n, K, S)
    level = (symbol * weight)[rows, unturned] @ member.T / np.maximum(share, 1e-9)
    full = weight.max(axis=1)[:, None, None] * member.sum(axis=1)
    known = share > 0.3 * np.maximum(full, 1e-9)
    darkest = np.where(known & table, level, np.inf).min(axis=2)
    brightest = np.where(known & ~table, level, -np.inf).max(axis=2)
    margin = darkest - brightest
    return np.where(np.isfinite(margin), margin, 0.0)


class Judge(Protocol):
    """What turns features (n, K, F) into (n, K + 1) probabilities; rows sum to 1."""

    def probabilities(self, features: FloatArray) -> FloatArray: ...


@dataclass(frozen=True, slots=True)
class AppearanceModel:
    """Log-linear model: log odds of an ID against 'none of these' = weights . features.

    weights: (F,) in the order of FEATURES.
    """

    weights: FloatArray

    def probabilities(self, features: FloatArray) -> FloatArray:
        """(n, K + 1): every ID, then 'none of these'; rows sum to 1. features: (n, K, F)."""
        logits = np.concatenate([features @ self.weights, np.zeros((len(features), 1))], axis=1)
        logits -= logits.max(axis=1, keepdims=True)
        odds = np.exp(logits)
        return np.asarray(odds / odds.sum(axis=1, keepdims=True))


def load_model(path: Path = BUILT_IN) -> AppearanceModel:
    """The model in a TOML file (default: the built-in one)."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))["weights"]
    return AppearanceModel(np.array([float(table[name]) for name in FEATURES]))


class AppearanceMeasurement:
    """The default measurement of stage 3: from each track's averaged shape matrix."""

    def __init__(
        self, memory_frames: float, bands: Bands, landmarks: LandmarkSet, model: Judge
    ) -> None:
        self._matrix = TrackMatrix(memory_frames, bands.outer.stop)
        self._bands = bands
        self._landmarks = landmarks
        self._turned = softened_codes(landmarks)
        self._model = model

    def step(
        self, numbers: npt.NDArray[np.int64], grey: FloatArray, seen: npt.NDArray[np.bool_]
    ) -> tuple[FloatArray, npt.NDArray[np.intp]]:
        """(n, K + 1) probabilities and the (n,) turn of the likeliest ID, in steps.

        numbers: (n,) of the tracks, rising. grey, seen: (n, L, ANGLES) from this frame.
        """
        average, count = self._matrix.step(numbers, grey, seen)
        description = describe(average, count, self._bands, self._landmarks, self._turned)
        probabilities = self._model.probabilities(description.features)
        best = probabilities[:, :-1].argmax(axis=1)
        return probabilities, description.turn[np.arange(len(best)), best]
