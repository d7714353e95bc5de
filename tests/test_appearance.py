"""The averaged shape matrix and its judgement, by properties and drawn discs.

What the features are may change; how they must behave may not.
"""

import math
import tomllib
import warnings

import numpy as np
import pytest
from drawn import SECTORS, disc_pattern, draw_on_floor, make_fan, speckled
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.appearance import (
    BUILT_IN,
    FEATURES,
    AppearanceMeasurement,
    AppearanceModel,
    TrackMatrix,
    describe,
    load_model,
    softened_codes,
)
from sonarrec.landmarks import load_landmarks
from sonarrec.plane import Plane
from sonarrec.shape_matrix import ANGLES, STEP, ShapeSampler

BASIN = load_landmarks("basin")
FAN = make_fan(512)
PLANE = Plane(FAN, BASIN.radius_m, "floor", 15.0)
SAMPLER = ShapeSampler(BASIN, PLANE.axes)
LINES = SAMPLER.bands.outer.stop
SOFT = softened_codes(BASIN)


def numbers(*values) -> np.ndarray:
    return np.array(values, np.int64)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), memory=st.sampled_from([1.0, 5.0, 20.0]))
def test_the_average_is_the_fading_sum_over_what_was_seen(seed, memory):
    rng = np.random.default_rng(seed)
    matrix = TrackMatrix(memory, 2)
    frames = 6
    grey = rng.normal(size=(frames, 1, 2, ANGLES))
    seen = rng.random(grey.shape) < 0.7
    for g, s in zip(grey, seen, strict=True):
        average, count = matrix.step(numbers(4), g, s)
    keep = 1 - 1 / memory
    for line in range(2):
        for a in range(0, ANGLES, 7):
            weights = [keep ** (frames - 1 - t) * seen[t, 0, line, a] for t in range(frames)]
            assert count[0, line, a] == pytest.approx(sum(weights))
            if sum(weights) > 1e-6:
                mean = sum(w * grey[t, 0, line, a] for t, w in enumerate(weights)) / sum(weights)
                assert average[0, line, a] == pytest.approx(mean)


def test_tracks_keep_their_own_average_and_lost_ones_are_forgotten():
    matrix = TrackMatrix(10.0, 1)
    all_seen = np.ones((1, 1, ANGLES), bool)

    def level(value):
        return np.full((1, 1, ANGLES), float(value))

    def stacked(*values):
        return np.concatenate([level(v) for v in values]), np.repeat(all_seen, len(values), 0)

    matrix.step(numbers(1, 2, 5), *stacked(10, 20, 50))
    average, _ = matrix.step(numbers(2, 5, 6), *stacked(20, 50, 60))
    np.testing.assert_allclose(average[:, 0, 0], [20, 50, 60])
    average, count = matrix.step(numbers(1, 5), *stacked(-10, 50))
    np.testing.assert_allclose(average[:, 0, 0], [-10, 50])  # nothing of the first 1 is left
    np.testing.assert_allclose(count[:, 0, 0], [1, 1 + 0.9 + 0.81])


def random_matrices(seed: int, n: int = 3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    average = rng.normal(size=(n, LINES, ANGLES))
    count = rng.uniform(0.5, 20, average.shape)
    hidden = rng.random(average.shape) < 0.2
    return average, np.where(hidden, 0.0, count)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), turn=st.integers(0, ANGLES - 1))
def test_turning_a_disc_turns_the_answer_and_leaves_the_features(seed, turn):
    average, count = random_matrices(seed)
    still = describe(average, count, SAMPLER.bands, BASIN, SOFT)
    turned = describe(
        np.roll(average, turn, axis=2), np.roll(count, turn, axis=2), SAMPLER.bands, BASIN, SOFT
    )
    # ID.2 is the same after half a turn, where the two turns tie.
    np.testing.assert_allclose(turned.features, still.features, atol=1e-6)
    off = (turned.turn - still.turn - turn) % np.array([ANGLES, ANGLES // 2, ANGLES, ANGLES])
    assert (off == 0).all()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_what_was_never_seen_does_not_matter_and_order_does_not(seed):
    average, count = random_matrices(seed)
    known = describe(average, count, SAMPLER.bands, BASIN, SOFT)
    other = np.where(count == 0, 77.0, average)
    np.testing.assert_allclose(
        describe(other, count, SAMPLER.bands, BASIN, SOFT).features, known.features, atol=1e-9
    )
    order = np.array([2, 0, 1])
    again = describe(average[order], count[order], SAMPLER.bands, BASIN, SOFT)
    np.testing.assert_allclose(again.features, known.features[order], atol=1e-12)
    np.testing.assert_array_equal(again.turn, known.turn[order])


def test_nothing_seen_at_all_and_no_objects_give_numbers_and_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for shape in [(1, LINES, ANGLES), (0, LINES, ANGLES)]:
            found = describe(np.zeros(shape), np.zeros(shape), SAMPLER.bands, BASIN, SOFT)
            assert found.features.shape == (shape[0], 4, len(FEATURES))
            assert np.isfinite(found.features).all()


def test_softened_codes_move_light_across_sector_edges_only():
    hard = np.array([[SECTORS[k][a // 9] for a in range(ANGLES)] for k in SECTORS], float)
    np.testing.assert_allclose(SOFT[0].mean(axis=1), hard.mean(axis=1))
    inner = np.arange(ANGLES) % 9
    inside = (inner > 0) & (inner < 8)
    np.testing.assert_allclose(SOFT[0][:, inside], hard[:, inside])
    for turn in (1, 8, 30):
        np.testing.assert_allclose(SOFT[turn], np.roll(SOFT[0], turn, axis=1))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([0.1, 1.0, 5.0]))
def test_probabilities_are_the_softmax_written_out(seed, scale):
    rng = np.random.default_rng(seed)
    weights = scale * rng.normal(size=len(FEATURES))
    features = rng.normal(size=(2, 4, len(FEATURES)))
    p = AppearanceModel(weights).probabilities(features)
    np.testing.assert_allclose(p.sum(axis=1), 1)
    for n in range(2):
        odds = [math.exp(sum(features[n, k] * weights)) for k in range(4)] + [1.0]
        np.testing.assert_allclose(p[n], np.array(odds) / sum(odds), rtol=1e-9)


def test_huge_logits_do_not_overflow():
    features = np.zeros((2, 4, len(FEATURES)))
    features[0, 2, 0], features[1, :, 0] = 5000, -5000
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        p = AppearanceModel(np.eye(len(FEATURES))[0]).probabilities(features)
    np.testing.assert_allclose(p, [[0, 0, 1, 0, 0], [0, 0, 0, 0, 1]], atol=1e-12)


def test_the_built_in_model_weighs_exactly_the_features():
    table = tomllib.loads(BUILT_IN.read_text())["weights"]
    assert set(table) == set(FEATURES)
    assert np.isfinite(load_model().weights).all()


def averaged(pattern, seed: int, frames: int = 16, range_m: float = 2.1, bearing_deg: float = 3.0):
    """Probabilities and turn after some frames of one speckled disc on its dark plate."""
    rng = np.random.default_rng(seed)
    measure = AppearanceMeasurement(20.0, SAMPLER.bands, BASIN, load_model())
    disc, seen = draw_on_floor(FAN, range_m, bearing_deg, BASIN.radius_m, pattern)
    plate, _ = draw_on_floor(
        FAN, range_m, bearing_deg, BASIN.radius_m, lambda x, y: (np.hypot(x, y) <= 1) * 1.0
    )
    centre = np.stack(PLANE.from_polar(np.array([range_m]), np.array([bearing_deg])), axis=-1)
    sight = PLANE.line_of_sight(centre)
    for _ in range(frames):
        image = PLANE.warp(speckled(disc, seen, rng, dark=plate))
        grey, visible = SAMPLER(image, PLANE.inside, centre, sight)
        p, turn = measure.step(numbers(1), grey, visible)
    return p[0], float(sight[0] + turn[0] * STEP)


@pytest.mark.parametrize("landmark", sorted(SECTORS))
@pytest.mark.parametrize("turn_deg", [20, 137, 291])
def test_a_landmark_is_known_by_its_id_and_orientation(landmark, turn_deg):
    p, orientation = averaged(disc_pattern(SECTORS[landmark], math.radians(turn_deg)), turn_deg)
    assert p.argmax() == landmark - 1
    assert p[landmark - 1] > 0.5
    symmetry = 180 if landmark == 2 else 360
    off = (math.degrees(orientation) - turn_deg + symmetry / 2) % symmetry - symmetry / 2
    assert abs(off) < 11


@pytest.mark.parametrize("seed", range(3))
def test_a_blank_and_a_filled_disc_are_none_of_these(seed):
    """PAPER's trap: to the single frame they are more ID.1 and more ID.4 than those themselves."""
    blank, _ = averaged(disc_pattern((0, 0, 0, 0)), seed)
    filled, _ = averaged(lambda x, y: (np.hypot(x, y) <= 1) * 1.0, seed)
    floor, _ = averaged(lambda x, _: 0 * x, seed)
    for p in (blank, filled, floor):
        assert p.argmax() == 4
        assert p[4] > 0.5
