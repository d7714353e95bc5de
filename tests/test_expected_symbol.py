"""What a symbol should look like through the beam, against a picture smeared pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import SECTORS, smeared_matrix
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.expected_symbol import PIXEL, SMEAR_STEP, ExpectedSymbols
from sonarrec.landmarks import load_landmarks
from sonarrec.shape_matrix import ANGLES, STEP, ShapeSampler

BASIN = load_landmarks("basin")
SAMPLER = ShapeSampler(BASIN, (12.0, 12.0))
EXPECTED = ExpectedSymbols(BASIN, SAMPLER.radii, SAMPLER.bands)
LINES = len(SAMPLER.radii)


def smeared_disc(k: int, turn: int, smear: float) -> np.ndarray:
    """(LINES, ANGLES) of a landmark by its place in the set; the pixel's own width included."""
    sectors = SECTORS[k + 1]
    return smeared_matrix(sectors, turn * STEP, SAMPLER.radii, ANGLES, np.hypot(smear, PIXEL))


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
