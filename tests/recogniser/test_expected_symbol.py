"""What a symbol should look like through the beam, against a picture smeared pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.landmarks import load_landmarks
from sonarrec.recogniser.stage3.expected_symbol import (
    CELL_NOISE_SHARE,
    ILLUMINATION_LENGTH,
    ILLUMINATION_SHARE,
    LEAST_SHOWN,
    PIXEL,
    SMEAR_STEP,
    ExpectedSymbols,
    SymbolFit,
)
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, STEP, ShapeSampler
from tests.support.drawn import SECTORS, disc_pattern, smeared_matrix

BASIN = load_landmarks("basin")
SAMPLER = ShapeSampler(BASIN, (12.0, 12.0))
CORRELATION_LENGTH = 0.45
EXPECTED = ExpectedSymbols(BASIN, SAMPLER.radii, SAMPLER.bands, CORRELATION_LENGTH)
LINES = len(SAMPLER.radii)
# Of the cells that take part: where they lie, the levels that are left free, and the noise.
POSITION = (
    SAMPLER.radii[EXPECTED.lines, None] * np.exp(1j * (np.arange(ANGLES) + 0.5) * STEP)
).ravel()
LEVELS = np.stack([np.abs(POSITION) > BASIN.ring[0], np.abs(POSITION) < BASIN.ring[0]]).astype(
    float
)
DISTANCE = np.abs(POSITION[:, None] - POSITION)
COVARIANCE = (
    np.exp(-DISTANCE / CORRELATION_LENGTH)
    + ILLUMINATION_SHARE * np.exp(-DISTANCE / ILLUMINATION_LENGTH)
    + np.diag(CELL_NOISE_SHARE * SAMPLER.radii[EXPECTED.lines].mean() / np.abs(POSITION))
)


def smeared_disc(k: int, turn: int, smear: float) -> np.ndarray:
    """(LINES, ANGLES) of a landmark by its place in the set; the pixel's own width included."""
    symbol = disc_pattern(SECTORS[k + 1], turn * STEP + np.pi / 2)
    return smeared_matrix(symbol, SAMPLER.radii, ANGLES, np.hypot(smear, PIXEL))


def fit(matrix: np.ndarray, smear: float, seen: np.ndarray | None = None) -> SymbolFit:
    """Of one matrix; seen: (LINES, ANGLES) bool, whole if not given."""
    if seen is None:
        seen = np.ones(matrix.shape, bool)
    lines = EXPECTED.lines
    return EXPECTED.fit(matrix[None, lines], seen[None, lines], np.array([smear]))


def correlation(matrix: np.ndarray, smear: float, seen: np.ndarray | None = None) -> np.ndarray:
    """(ANGLES, K) of one matrix, as `fit`."""
    return fit(matrix, smear, seen).correlation[0]


@pytest.mark.parametrize("k", range(4))
@pytest.mark.parametrize(("i", "turn"), [*enumerate([0, 5, 13, 22, 31])])
def test_a_disc_smeared_pixel_by_pixel_is_what_is_expected(k: int, i: int, turn: int) -> None:
    """Three points stand for a pixel's width: .955 is what that leaves at a sharp beam.

    Each ID at each turn, each of them with every smear: those of all three together add nothing.
    """
    steps = [0, 2, 5][(k + i) % 3]
    found = correlation(smeared_disc(k, turn, steps * SMEAR_STEP), steps * SMEAR_STEP)
    period = ANGLES // 2 if k == 1 else ANGLES
    assert found[turn, k] > 0.955
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

    of = seen[EXPECTED.lines].ravel()
    for k, turn in ((0, 0), (1, 7), (2, 20), (3, 31)):
        symbol = expected_cells(k, turn, smear)
        values, shown, *levels = whitened(of, matrix[EXPECTED.lines].ravel(), symbol, *LEVELS)
        level = np.column_stack(levels)
        both = np.column_stack([level, shown])
        explained = 1 - beyond(values, both) / beyond(values, level)
        # Of an ID of which less than a tenth of the evidence has shown nothing is said.
        whole, *levels = whitened(np.ones(len(POSITION), bool), symbol, *LEVELS)
        expected = np.sign(np.linalg.lstsq(both, values, rcond=None)[0][2]) * np.sqrt(explained)
        if beyond(shown, level) <= LEAST_SHOWN * beyond(whole, np.column_stack(levels)):
            expected = 0.0
        assert found[turn, k] == pytest.approx(expected, abs=1e-6)


def test_noise_alone_has_no_structure_and_a_symbol_of_no_id_has() -> None:
    """Of 200 draws of the noise the broad patterns have their share within 10 %, for 26 squares of
    normal numbers are spread by 28 %, their mean over 200 by 2 %; and MISFIT is 5 %. Wedges in
    twelfths of the circle are no rivals: what the nearest ID leaves of them shows."""
    rng = np.random.default_rng(7)
    seen = np.ones((200, len(EXPECTED.lines), ANGLES), bool)
    drawn = np.linalg.cholesky(COVARIANCE) @ rng.normal(size=(len(POSITION), 200))
    noise = drawn.T.reshape(seen.shape)
    alone = EXPECTED.fit(20 * noise, seen, np.zeros(200)).structure
    assert np.exp(alone).mean() == pytest.approx(1, abs=0.1)
    wedges = smeared_matrix(
        disc_pattern((1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0), np.pi / 2), SAMPLER.radii, ANGLES, PIXEL
    )[EXPECTED.lines]
    right = EXPECTED.fit(
        expected_cells(0, 3, 0.0).reshape(wedges.shape) + 0.1 * noise, seen, np.zeros(200)
    )
    other = EXPECTED.fit(wedges + 0.1 * noise, seen, np.zeros(200))
    assert np.median(right.structure[:, 0]) < 0.3
    assert np.median(other.structure.min(axis=1)) > 1


def expected_cells(k: int, turn: int, smear: float) -> np.ndarray:
    """(cells,) what an ID by its place in the set shows at a turn."""
    shown = EXPECTED.expected(round(smear / SMEAR_STEP))[..., : ANGLES * 4]
    return shown.reshape(-1, ANGLES, 4)[:, turn, k]


def whitened(of: np.ndarray, *cells: np.ndarray) -> np.ndarray:
    """Of each element of `cells` those that `of` tells, by a Cholesky factor of their noise."""
    factor = np.linalg.cholesky(COVARIANCE[np.ix_(of, of)])
    return np.linalg.solve(factor, np.column_stack(cells)[of]).T


def without(values: np.ndarray, of: np.ndarray) -> np.ndarray:
    """What of whitened values the columns of `of` do not explain."""
    return values - of @ np.linalg.lstsq(of, values, rcond=None)[0]


def beyond(values: np.ndarray, of: np.ndarray) -> float:
    """Its sum of squares."""
    return float(np.sum(without(values, of) ** 2))


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
    assert independent.fit(cells, seen, smear).correlation.max() > 0.35
    assert correlation(patch, 0.1).max() < 0.25
    for k in range(4):
        found = correlation(smeared_disc(k, 9, 0.1) + 0.5 * patch, 0.1)
        assert found.max() > 0.85
        assert found.max(axis=0).argmax() == k


@pytest.mark.parametrize("hidden", [slice(5, 6), slice(0, 5), slice(1, 6)])
def test_a_symbol_without_its_ring_or_within_its_ring_alone_has_an_answer(hidden: slice) -> None:
    """All cells of a free level are hidden: nothing of the noise's precision tells them apart."""
    lines = np.zeros((len(EXPECTED.lines), ANGLES), bool)
    lines[hidden] = True
    seen = np.ones((LINES, ANGLES), bool)
    seen[EXPECTED.lines] = ~lines
    found = fit(smeared_disc(2, 7, 0.05), 0.05, seen)
    assert np.isfinite([found.best, found.structure]).all()
    if hidden.start == 5:
        assert found.correlation[0].max(axis=0).argmax() == 2
        assert found.rotation[0, 2] in (6, 7, 8)
