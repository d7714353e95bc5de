"""What a symbol should look like through the beam, against a picture smeared pixel by pixel."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.expected_symbol import (
    FLOOR_DB,
    NOISE_DB,
    PIXEL,
    PLATE_DB,
    RING_DB,
    SMEAR_STEP,
    SYMBOL_DB,
    ExpectedSymbols,
)
from sonarrec.landmarks import load_landmarks
from sonarrec.shape_matrix import ANGLES, STEP, ShapeSampler

BASIN = load_landmarks("basin")
SAMPLER = ShapeSampler(BASIN, (12.0, 12.0))
EXPECTED = ExpectedSymbols(BASIN, SAMPLER.radii, SAMPLER.bands)
LINES = len(SAMPLER.radii)


def smeared_disc(k: int, turn: int, smear: float) -> np.ndarray:
    """(LINES, ANGLES) grey values (dB) of a landmark drawn finely and blurred in power.

    The line of sight points up the picture, the disc is turned by `turn` steps from it.
    """
    size, reach = 600, 1.7
    axis = (np.arange(size) + 0.5) / size * 2 * reach - reach
    x, y = np.meshgrid(axis, -axis)
    radius = np.hypot(x, y)
    # The landmark's own right is its first sector's beginning; here that is up, then the turn.
    away = np.arctan2(-x, y) - turn * STEP
    on = BASIN.pattern(k, radius * np.cos(away), radius * np.sin(away)) > 0.5
    ring = (radius >= BASIN.ring[0]) & (radius <= BASIN.ring[1])
    level = np.where(ring, RING_DB, np.where(on, SYMBOL_DB, PLATE_DB))
    level = np.where(radius > 1, FLOOR_DB, level)
    pixels = size / (2 * reach)
    across = np.hypot(smear, PIXEL) * pixels
    power = cv2.GaussianBlur(10 ** (level / 10), (0, 0), sigmaX=across, sigmaY=PIXEL * pixels)
    grey = 10 * np.log10(power + 10 ** (NOISE_DB / 10))
    angle = (np.arange(ANGLES) + 0.5) * STEP
    column = (-np.outer(SAMPLER.radii, np.sin(angle)) + reach) * pixels - 0.5
    row = (reach - np.outer(SAMPLER.radii, np.cos(angle))) * pixels - 0.5
    return cv2.remap(grey, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR)


def correlation(matrix: np.ndarray, smear: float) -> np.ndarray:
    """(ANGLES, K) of one matrix seen whole."""
    symbol = matrix[None, SAMPLER.bands.symbol]
    gap = matrix[None, SAMPLER.bands.gap].mean(axis=1)
    seen = np.ones((1, ANGLES), bool)
    return EXPECTED.correlation(symbol, np.ones(symbol.shape), gap, seen, np.array([smear]))[0]


@pytest.mark.parametrize("k", range(4))
@pytest.mark.parametrize("steps", [0, 2, 5])
@pytest.mark.parametrize("turn", [0, 5, 13, 22, 31])
def test_a_disc_smeared_pixel_by_pixel_is_what_is_expected(k: int, steps: int, turn: int) -> None:
    """Three points stand for a pixel's width: .96 is what that leaves at a sharp beam."""
    found = correlation(smeared_disc(k, turn, steps * SMEAR_STEP), steps * SMEAR_STEP)
    period = ANGLES // 2 if k == 1 else ANGLES
    assert found[turn, k] > 0.96
    assert found[turn, k] == pytest.approx(found.max(), abs=0.005)
    best = np.unravel_index(found.argmax(), found.shape)
    assert best[1] == k
    assert min((best[0] - turn) % period, (turn - best[0]) % period) <= 1


def test_through_a_wide_beam_the_smeared_symbol_fits_better_than_the_sharp_one() -> None:
    """A third of a disc's radius: what the smear is for."""
    for k in range(4):
        matrix = smeared_disc(k, 9, 0.3)
        knowing, naive = (correlation(matrix, smear) for smear in (0.3, 0.0))
        assert knowing[9, k] > naive[9, k] + 0.05
        assert knowing.max(axis=0).argmax() == k


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), turn=st.integers(0, ANGLES - 1))
def test_through_a_sharp_beam_turning_the_symbol_turns_the_answer(seed: int, turn: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(LINES, ANGLES))
    still, turned = correlation(matrix, 0.0), correlation(np.roll(matrix, turn, axis=1), 0.0)
    np.testing.assert_allclose(turned, np.roll(still, turn, axis=0), atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), smear=st.floats(0, 0.6))
def test_the_correlation_is_one_at_most_and_blind_to_gain_and_offset(
    seed: int, smear: float
) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(LINES, ANGLES))
    found = correlation(matrix, smear)
    assert np.abs(found).max() <= 1 + 1e-9
    np.testing.assert_allclose(correlation(3 * matrix + 7, smear), found, atol=1e-9)
