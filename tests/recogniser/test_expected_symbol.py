"""What a symbol should look like through the beam, against a picture smeared pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.landmarks import load_landmarks
from sonarrec.recogniser.stage3_features.expected_symbol import (
    LEAST_SHOWN,
    LIGHT,
    LIGHT_ALIKE,
    OWN,
    PIXEL,
    SMEAR_STEP,
    ExpectedSymbols,
)
from sonarrec.recogniser.stage3_features.shape_matrix import ANGLES, STEP, ShapeSampler
from tests.support.drawn import SECTORS, cross_pattern, disc_pattern, smeared_matrix

BASIN = load_landmarks("basin")
SAMPLER = ShapeSampler(BASIN, (12.0, 12.0))
ALIKE = 0.45
EXPECTED = ExpectedSymbols(BASIN, SAMPLER.radii, SAMPLER.bands, ALIKE)
LINES = len(SAMPLER.radii)


def smeared_disc(k: int, turn: int, smear: float) -> np.ndarray:
    """(LINES, ANGLES) of a landmark by its place in the set; the pixel's own width included."""
    symbol = disc_pattern(SECTORS[k + 1], turn * STEP + np.pi / 2)
    return smeared_matrix(symbol, SAMPLER.radii, ANGLES, np.hypot(smear, PIXEL))


def correlation(matrix: np.ndarray, smear: float, seen: np.ndarray | None = None) -> np.ndarray:
    """(ANGLES, K) of one matrix; seen: (LINES, ANGLES) bool, whole if not given."""
    return correlations(matrix, smear, seen)[0]


def correlations(
    matrix: np.ndarray, smear: float, seen: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """The same, and the best with a rival."""
    if seen is None:
        seen = np.ones(matrix.shape, bool)
    lines = EXPECTED.lines
    cells = matrix[None, lines], seen[None, lines]
    ids, rival = EXPECTED.correlation(*cells, np.array([smear]))
    return ids[0], float(rival[0])


@pytest.mark.parametrize("k", range(4))
@pytest.mark.parametrize("steps", [0, 2, 5])
@pytest.mark.parametrize("turn", [0, 5, 13, 22, 31])
def test_a_disc_smeared_pixel_by_pixel_is_what_is_expected(k: int, steps: int, turn: int) -> None:
    """Three points stand for a pixel's width: .955 is what that leaves at a sharp beam."""
    found = correlation(smeared_disc(k, turn, steps * SMEAR_STEP), steps * SMEAR_STEP)
    period = ANGLES // 2 if k == 1 else ANGLES
    assert found[turn, k] > 0.955
    assert found[turn, k] == pytest.approx(found.max(), abs=0.005)
    best = np.unravel_index(found.argmax(), found.shape)
    assert best[1] == k
    assert min((best[0] - turn) % period, (turn - best[0]) % period) <= 1


@pytest.mark.parametrize("steps", [0, 2, 5])
@pytest.mark.parametrize("turn_deg", [0, 20, 33, 45, 71])
def test_a_cross_smeared_pixel_by_pixel_is_the_one_expected(steps: int, turn_deg: int) -> None:
    """And no ID looks like it. Between whole steps of 10 deg a sharp one fits a little less.

    A beam of a fifth of the radius leaves two broad arms of it, or none: nearer to an ID.
    """
    smear = steps * SMEAR_STEP
    pattern = cross_pattern(np.radians(turn_deg))
    seen = smeared_matrix(pattern, SAMPLER.radii, ANGLES, np.hypot(smear, PIXEL))
    ids, cross = correlations(seen, smear)
    assert cross > 0.89
    assert ids.max() < cross - (0.25 if steps < 2 else 0.08)


def test_through_a_wide_beam_the_smeared_symbol_fits_better_than_the_sharp_one() -> None:
    """A third of a disc's radius: what the smear is for."""
    for k in range(4):
        matrix = smeared_disc(k, 9, 0.3)
        knowing, naive = (correlation(matrix, smear) for smear in (0.3, 0.0))
        assert knowing[9, k] > naive[9, k] + 0.05
        assert knowing.max(axis=0).argmax() == k


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), turn=st.integers(0, ANGLES - 1))
def test_through_a_sharp_beam_turning_the_symbol_turns_the_answer(seed: int, turn: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(LINES, ANGLES))
    still, turned = correlation(matrix, 0.0), correlation(np.roll(matrix, turn, axis=1), 0.0)
    np.testing.assert_allclose(turned, np.roll(still, turn, axis=0), atol=1e-9)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), smear=st.floats(0, 0.6))
def test_the_correlation_is_one_at_most_and_blind_to_gain_and_offset(
    seed: int, smear: float
) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(LINES, ANGLES))
    found = correlation(matrix, smear)
    assert np.abs(found).max() <= 1 + 1e-9
    np.testing.assert_allclose(correlation(3 * matrix + 7, smear), found, atol=1e-9)


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), hidden=st.integers(0, ANGLES - 4), smear=st.floats(0, 0.4))
def test_it_is_the_correlation_of_generalised_least_squares(
    seed: int, hidden: int, smear: float
) -> None:
    """Its square: how much of what the levels of the ring and of the rest leave unexplained an ID
    explains, cells unseen left out, by fits to values whitened with a Cholesky factor of their
    covariance."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(LINES, ANGLES)) + smeared_disc(seed % 4, seed % ANGLES, smear)
    seen = np.roll(np.arange(ANGLES) >= hidden, seed % ANGLES) & np.ones((LINES, 1), bool)
    seen[SAMPLER.bands.symbol.start, :5] = False
    found = correlation(matrix, smear, seen)

    radii, angle = SAMPLER.radii[EXPECTED.lines], (np.arange(ANGLES) + 0.5) * STEP
    place = (radii[:, None] * np.exp(1j * angle)).ravel()
    apart = np.abs(place[:, None] - place)
    covariance = np.exp(-apart / ALIKE) + LIGHT * np.exp(-apart / LIGHT_ALIKE)
    ring = np.repeat(radii > BASIN.ring[0], ANGLES)
    covariance += np.diag(OWN * radii.mean() / np.abs(place))
    of = seen[EXPECTED.lines].ravel()
    factor = np.linalg.cholesky(covariance[np.ix_(of, of)])
    flat = EXPECTED.expected(round(smear / SMEAR_STEP))[..., : ANGLES * 4]
    flat = flat.reshape(-1, ANGLES, 4)
    for k, turn in ((0, 0), (1, 7), (2, 20), (3, 31)):
        columns = [matrix[EXPECTED.lines].ravel(), ring, ~ring, flat[:, turn, k]]
        values, *levels, symbol = np.linalg.solve(factor, np.column_stack(columns)[of]).T
        level = np.column_stack(levels)
        rest = values - level @ np.linalg.lstsq(level, values, rcond=None)[0]
        both = np.column_stack([level, symbol])
        fit = np.linalg.lstsq(both, values, rcond=None)[0]
        explained = 1 - np.sum((values - both @ fit) ** 2) / np.sum(rest**2)
        # Of an ID of which less than a tenth of the evidence has shown nothing is said.
        whole = np.linalg.solve(np.linalg.cholesky(covariance), np.column_stack(columns)[:, 1:]).T
        if beyond(symbol, level) > LEAST_SHOWN * beyond(whole[2], whole[:2].T):
            expected = np.sign(fit[2]) * np.sqrt(explained)
        else:
            expected = 0.0
        assert found[turn, k] == pytest.approx(expected, abs=1e-6)


def beyond(symbol: np.ndarray, level: np.ndarray) -> float:
    """What of a whitened symbol the levels (cells, 2) do not explain: sum of squares."""
    rest = symbol - level @ np.linalg.lstsq(level, symbol, rcond=None)[0]
    return float(rest @ rest)


def test_a_disc_not_seen_says_nothing() -> None:
    seen = np.zeros((LINES, ANGLES), bool)
    np.testing.assert_array_equal(correlation(smeared_disc(0, 0, 0.1), 0.1, seen), 0)


@pytest.mark.parametrize("way", [0.0, 1.0, 2.0, 4.0])
def test_a_broad_patch_is_no_symbol_and_a_symbol_under_it_is_one(way: float) -> None:
    """A late echo over half a disc: cells taken for independent see most of an ID in it."""
    angle = (np.arange(ANGLES) + 0.5) * STEP
    place = SAMPLER.radii[:, None] * np.exp(1j * angle)
    patch = np.exp(-0.5 * np.abs(place - 0.4 * np.exp(1j * way)) ** 2 / 0.35**2)
    cells = patch[None, EXPECTED.lines]
    seen, smear = np.ones(cells.shape, bool), np.array([0.1])
    independent = ExpectedSymbols(BASIN, SAMPLER.radii, SAMPLER.bands, 0.0)
    assert independent.correlation(cells, seen, smear)[0].max() > 0.35
    assert correlation(patch, 0.1).max() < 0.25
    for k in range(4):
        found = correlation(smeared_disc(k, 9, 0.1) + 0.5 * patch, 0.1)
        assert found.max() > 0.85
        assert found.max(axis=0).argmax() == k
