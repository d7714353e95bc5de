"""The averaged shape matrix and its judgement, by properties and drawn discs.

What the features are may change; how they must behave may not.
"""

import dataclasses
import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.config import Features
from sonarrec.errors import UsageError
from sonarrec.landmarks import load_landmarks
from sonarrec.recogniser.plane import FloorPlane
from sonarrec.recogniser.stage3.appearance import AppearanceMeasurement
from sonarrec.recogniser.stage3.description import FEATURES, LIMIT, Describer
from sonarrec.recogniser.stage3.model import AppearanceModel, built_in_model, read_model
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, STEP, STEP_DEG, ShapeSampler
from sonarrec.recogniser.stage3.track_matrix import TrackMatrix
from tests.support.drawn import (
    SECTORS,
    disc_pattern,
    make_fan,
    smeared_matrix,
    speckled_disc,
    surroundings,
    whole_disc,
)
from tests.support.groups import groups

BASIN = load_landmarks("basin")
FAN = make_fan(512)
PLANE = FloorPlane(FAN, BASIN.radius_m, 15.0)
SAMPLER = ShapeSampler(BASIN, PLANE.axes)
LINES = len(SAMPLER.radii)
DESCRIBE = Describer(SAMPLER.bands, SAMPLER.radii, BASIN, correlation_length=0.45)
SURE = np.full(3, 0.9)  # that the objects exist
SHARP = np.zeros(3)  # beams that smear nothing


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), memory=st.sampled_from([1.0, 5.0, 20.0]))
def test_the_average_is_the_fading_sum_over_what_was_seen(seed, memory):
    rng = np.random.default_rng(seed)
    matrix = TrackMatrix(memory, 2)
    frames = 6
    grey = rng.normal(size=(frames, 1, 2, ANGLES))
    seen = rng.random(grey.shape) < 0.7
    for g, s in zip(grey, seen, strict=True):
        found = matrix.step(groups(4), g, s)
    average, count = found.brightness, found.count
    assert found.frames.tolist() == [frames]
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

    matrix.step(groups(1, 2, 5), *stacked(10, 20, 50))
    found = matrix.step(groups(2, 5, 6), *stacked(20, 50, 60))
    np.testing.assert_allclose(found.brightness[:, 0, 0], [20, 50, 60])
    found = matrix.step(groups(1, 5), *stacked(-10, 50))
    # Nothing of the first 1 is left.
    np.testing.assert_allclose(found.brightness[:, 0, 0], [-10, 50])
    np.testing.assert_allclose(found.count[:, 0, 0], [1, 1 + 0.9 + 0.81])
    assert found.frames.tolist() == [1, 3]


@pytest.mark.parametrize("same", [True, False])
def test_a_track_that_comes_back_earns_what_it_was_by_looking_the_same(same):
    """Half of the old frames count at once where it does, and never where it does not."""
    matrix = TrackMatrix(10.0, 1)
    picture = np.sin(np.arange(ANGLES))[None, None]
    other = np.cos(2 * np.arange(ANGLES))[None, None]
    seen, nothing = np.ones((1, 1, ANGLES), bool), np.empty((0, 1, ANGLES))
    for _ in range(4):
        before = matrix.step(groups(3), picture, seen)
    for _ in range(50):
        matrix.step(groups(remembered=[3]), nothing, nothing)
    now, count = (picture if same else other), (0.5 * before.count if same else 0.0)
    for i in range(4):
        found = matrix.step(groups(3), now, seen)
        count = 1 + (count if i == 0 else 0.9 * count)
        np.testing.assert_allclose(found.brightness, now)
        np.testing.assert_allclose(found.count, count)
        assert found.frames.tolist() == [i + (3 if same else 1)]
        # Another picture is another episode of the track's life.
        assert (found.episodes == before.episodes).all() == same


def test_what_looks_somewhat_the_same_goes_on_in_its_old_episode_after_three_frames():
    matrix = TrackMatrix(10.0, 1)
    angle = np.arange(ANGLES) * 2 * np.pi / ANGLES
    picture = np.sin(angle)[None, None]
    alike = (0.6 * np.sin(angle) + 0.8 * np.cos(3 * angle))[None, None]  # correlation .6
    seen, nothing = np.ones((1, 1, ANGLES), bool), np.empty((0, 1, ANGLES))
    first = matrix.step(groups(3), picture, seen).episodes.tolist()
    matrix.step(groups(remembered=[3]), nothing, nothing)
    again = [matrix.step(groups(3), alike, seen).episodes.tolist() for _ in range(4)]
    assert again[0] == again[1] > first
    assert again[2] == again[3] == first


def test_what_is_passed_is_averaged_as_it_lies():
    """Each frame's matrix counts from a line of sight that has turned by a step and more."""
    matrix = TrackMatrix(20.0, 1)
    picture = np.random.default_rng(3).normal(size=(1, 1, ANGLES))
    seen = np.ones((1, 1, ANGLES), bool)
    seen[..., 5] = False  # on the object, not in the matrix
    for turned in (0, 1, 2, 4, 40, -3):
        by = -turned  # as the line of sight turns one way, the object turns the other beneath it
        found = matrix.step(
            groups(7, sight_deg=[turned * STEP_DEG + 0.3 * STEP_DEG]),
            np.roll(picture, by, axis=2),
            np.roll(seen, by, axis=2),
        )
        shown = np.roll(seen, by, axis=2)
        np.testing.assert_allclose(found.brightness[shown], np.roll(picture, by, axis=2)[shown])
        assert (found.count[~shown] == 0).all()


def random_matrices(seed: int, n: int = 3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    average = rng.normal(size=(n, LINES, ANGLES))
    count = rng.uniform(0.5, 20, average.shape)
    hidden = rng.random(average.shape) < 0.2
    return average, np.where(hidden, 0.0, count)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), turn=st.integers(0, ANGLES - 1))
def test_turning_a_disc_turns_the_answer_and_leaves_the_features(seed, turn):
    average, count = random_matrices(seed)
    still = DESCRIBE(average, count, SURE, SHARP)
    turned = DESCRIBE(np.roll(average, turn, axis=2), np.roll(count, turn, axis=2), SURE, SHARP)
    # ID.2 is the same after half a turn, where the two turns tie.
    # Of rivals, where cells are hidden, only the likeliest are compared in full.
    rival = np.array(["rival_misfit" in name for name in FEATURES])
    np.testing.assert_allclose(turned.features[..., ~rival], still.features[..., ~rival], atol=1e-6)
    np.testing.assert_allclose(turned.features[..., rival], still.features[..., rival], atol=0.05)
    period = np.array([ANGLES, ANGLES // 2, ANGLES, ANGLES])
    off = (turned.rotation - still.rotation - turn + period / 2) % period - period / 2
    np.testing.assert_allclose(off, 0, atol=1e-6)


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_what_was_never_seen_does_not_matter_and_order_does_not(seed):
    average, count = random_matrices(seed)
    known = DESCRIBE(average, count, SURE, SHARP)
    other = np.where(count == 0, 77.0, average)
    np.testing.assert_allclose(
        DESCRIBE(other, count, SURE, SHARP).features, known.features, atol=1e-9
    )
    order = np.array([2, 0, 1])
    again = DESCRIBE(average[order], count[order], SURE, SHARP)
    np.testing.assert_allclose(again.features, known.features[order], atol=1e-12)
    np.testing.assert_allclose(again.rotation, known.rotation[order])


def test_nothing_seen_at_all_and_no_objects_give_numbers_and_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for shape in [(1, LINES, ANGLES), (0, LINES, ANGLES)]:
            found = DESCRIBE(np.zeros(shape), np.zeros(shape), SURE[: shape[0]], SHARP[: shape[0]])
            assert found.features.shape == (shape[0], 4, len(FEATURES))
            assert np.isfinite(found.features).all()


def drawn_matrix(landmark: int, turn: int, bright=2.0, dark=-1.0, floor=0.0) -> np.ndarray:
    """(1, LINES, ANGLES) of a perfect landmark: ring and bright sectors, plate, floor outside."""
    matrix = np.full((1, LINES, ANGLES), floor)
    on = np.array([SECTORS[landmark][a // 9] for a in range(ANGLES)], bool)
    matrix[:, SAMPLER.bands.symbol] = np.roll(np.where(on, bright, dark), turn)
    matrix[:, SAMPLER.bands.gap] = dark
    matrix[:, SAMPLER.bands.ring] = bright
    return matrix


@pytest.mark.parametrize("landmark", sorted(SECTORS))
def test_the_features_of_a_perfect_landmark_by_hand(landmark):
    found = DESCRIBE(
        drawn_matrix(landmark, 7), np.full((1, LINES, ANGLES), 8.0), SURE[:1], SHARP[:1]
    )
    named = dict(zip(FEATURES, found.features[0, landmark - 1], strict=True))
    expected = {
        # The ring is 3 over the gap. The edges are sharp, and two steps to either side of
        # them the sectors are themselves.
        "weakest_edge_share": 1,
        "weakest_bright": 3,
        "weakest_bright_half_share": 1,
        "strongest_dark_half_share": 0,
        "weakest_ring_share": (2 - 0.5 * (-1 + 0)) / 3,
        "weakest_ring_over_gap": 3,
        "ring_texture_share": 0,
        "existence": math.log(9),
    }
    for name, value in expected.items():
        assert named[name] == pytest.approx(value, abs=1e-6), name
    # A picture's pixels smear the edges; what is expected has that in it.
    symbol = disc_pattern(SECTORS[landmark], 7 * STEP + math.pi / 2)
    seen = smeared_matrix(symbol, SAMPLER.radii, ANGLES, 0.05)
    count = np.full((1, LINES, ANGLES), 8.0)
    smeared = DESCRIBE(seen[None] / 9, count, SURE[:1], SHARP[:1]).features[0, landmark - 1]
    assert smeared[FEATURES.index("correlation")] > 0.95
    assert named["weakest_line_step_share"] == pytest.approx(1, abs=0.1)
    assert named["bright_over_ring_share"] == pytest.approx(0, abs=0.07)
    best = found.features[0, :, FEATURES.index("correlation")].argmax()
    assert best == landmark - 1
    turn = found.rotation[0, landmark - 1] % (18 if landmark == 2 else 36)
    assert turn == pytest.approx(7, abs=1e-6)


def described(matrix: np.ndarray, landmark: int = 1) -> dict[str, float]:
    """The features under an ID of a matrix that was seen eight times."""
    found = DESCRIBE(matrix, np.full(matrix.shape, 8.0), SURE[:1], SHARP[:1])
    return dict(zip(FEATURES, found.features[0, landmark - 1].tolist(), strict=True))


@pytest.mark.parametrize("landmark", sorted(SECTORS))
def test_light_that_lies_over_symbol_and_gap_alike_leaves_the_local_features(landmark):
    """A late echo that fills a dark sector, and fades round it."""
    clear = drawn_matrix(landmark, 0)
    dark = (31.5 - np.arange(ANGLES)) * STEP  # from the middle of the last sector, dark in all IDs
    hazy = clear + 1.5 * (1 + np.cos(dark))
    before, after = (described(matrix, landmark) for matrix in (clear, hazy))
    for name in ("weakest_bright", "weakest_bright_half_share", "strongest_dark_half_share"):
        assert after[name] == pytest.approx(before[name], abs=1e-9), name


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.floats(1, 20),
    level=st.floats(-100, 100),
    id_=st.integers(1, 4),
)
def test_neither_contrast_nor_brightness_of_a_picture_matters(seed, scale, level, id_):
    """Grey levels depend on the sonar's gain, and on what else is in view."""
    picture = drawn_matrix(id_, 0) + np.random.default_rng(seed).normal(0, 0.5, (1, LINES, ANGLES))
    before, after = (described(matrix, id_) for matrix in (picture, scale * picture + level))
    for name in ("weakest_bright", "weakest_ring_over_gap"):  # in grey levels
        before[name] = float(np.clip(scale * before[name], -LIMIT, LIMIT))
    assert after == pytest.approx(before, abs=1e-6)


def test_one_missing_ring_quarter_shows_in_the_weakest():
    matrix = drawn_matrix(1, 0)
    matrix[:, SAMPLER.bands.ring, 20:29] = 0.0  # as dark as the floor
    contrast = 3 - 2 * 9 / ANGLES  # of the whole ring over the gap
    assert described(matrix)["weakest_ring_share"] == pytest.approx((0 - 0.5 * (-1 + 0)) / contrast)


@pytest.mark.parametrize("landmark", sorted(SECTORS))
def test_glitter_costs_the_independent_opinion_less(landmark):
    """One in eight of the bright cells is thrice as bright as the others."""
    clear = drawn_matrix(landmark, 0)
    stones = np.random.default_rng(landmark).random(clear.shape) < 0.125
    glittering = np.where((clear == 2.0) & stones, 6.0, clear)
    before, after = described(clear, landmark), described(glittering, landmark)
    for name in ("correlation", "rival_misfit"):
        lost = abs(after[name] - before[name])
        assert abs(after[f"independent_{name}"] - before[f"independent_{name}"]) < 0.5 * lost


@pytest.mark.parametrize(("steps", "hides"), [(5, False), (15, True), (ANGLES, False)])
def test_an_arc_without_ring_is_hidden_but_no_gap_and_no_disc_without_a_ring(steps, hides):
    matrix = drawn_matrix(1, 0)
    arc = np.arange(4, 4 + steps) % ANGLES
    matrix[:, :, arc] = 0.0  # the floor
    hidden = DESCRIBE.hidden(matrix, np.full(matrix.shape, 8.0))[0]
    assert hidden.any() == hides
    if hides:
        assert hidden[arc[3:-3]].all()
        assert not np.delete(hidden, np.arange(1, 7 + steps)).any()


def test_a_ring_as_dark_as_the_floor_hides_nothing():
    matrix = drawn_matrix(1, 0, bright=0.0, dark=-2.0)
    matrix[:, SAMPLER.bands.ring, :18] = -0.3  # the floor's own unevenness
    assert not DESCRIBE.hidden(matrix, np.full(matrix.shape, 8.0)).any()


def curves(rng: np.random.Generator, scale: float = 1.0) -> AppearanceModel:
    # As `fit` places them: a file tells knots apart that differ by 0.01.
    knots = tuple(np.unique(rng.normal(size=rng.integers(1, 6)).round(2)) for _ in FEATURES)
    return AppearanceModel(
        rng.normal(size=2), knots, tuple(scale * rng.normal(size=(2, len(k))) for k in knots)
    )


def by_hand(x: float, at, values) -> float:
    """The curve at x, one straight piece at a time."""
    if x <= at[0]:
        return values[0]
    for left, right, a, b in zip(at, at[1:], values, values[1:], strict=False):
        if x <= right:
            return a + (b - a) * (x - left) / (right - left)
    return values[-1]


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([0.1, 1.0, 5.0]))
def test_probabilities_are_the_softmax_of_the_curves_written_out(seed, scale):
    """Of sharp pictures, of smeared ones, and of one a quarter of the way between."""
    rng = np.random.default_rng(seed)
    model = curves(rng, scale)
    features = rng.normal(size=(5, 4, len(FEATURES)))
    p = model.probabilities(features, np.array([0.0, 0.06, 0.07, 0.10, 0.3]))
    np.testing.assert_allclose(p.sum(axis=1), 1)
    for n, share in enumerate((0, 0, 0.25, 1, 1)):
        odds = [1.0]
        for k in range(4):
            sharp, smeared = (
                model.bias[of]
                + sum(
                    by_hand(x, at, values[of])
                    for x, at, values in zip(features[n, k], model.knots, model.values, strict=True)
                )
                for of in (0, 1)
            )
            odds.insert(-1, math.exp((1 - share) * sharp + share * smeared))
        np.testing.assert_allclose(p[n], np.array(odds) / sum(odds), rtol=1e-9)


def test_huge_log_odds_do_not_overflow():
    ends = np.array([-LIMIT, LIMIT])
    still = [np.zeros((2, 2))] * (len(FEATURES) - 1)
    steep = np.array([[-5e3, 5e3]] * 2)
    model = AppearanceModel(np.zeros(2), (ends,) * len(FEATURES), (steep, *still))
    features = np.zeros((2, 4, len(FEATURES)))
    features[0, 2, 0], features[1, :, 0] = LIMIT, -LIMIT
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        p = model.probabilities(features, np.zeros(2))
    np.testing.assert_allclose(p, [[0, 0, 1, 0, 0], [0, 0, 0, 0, 1]], atol=1e-12)


def test_a_model_survives_its_file(tmp_path):
    model = curves(np.random.default_rng(3))
    path = tmp_path / "model.toml"
    path.write_text(model.as_toml())
    again = read_model(path).model
    features = np.random.default_rng(4).normal(size=(5, 4, len(FEATURES)))
    for smear in (np.zeros(5), np.ones(5)):
        np.testing.assert_allclose(
            again.log_odds(features, smear),
            model.log_odds(features, smear),
            atol=0.02 * len(FEATURES),
        )


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("bias = 1.0", "smeared_bias"),
        ("bias = 1.0\nsmeared_bias = 1.0", "correlation"),
        ("not toml", "not a readable TOML file"),
        (None, "No such file"),
    ],
)
def test_a_file_that_is_no_model_is_told_in_one_line(tmp_path, text, told):
    path = tmp_path / "model.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UsageError, match=told) as fault:
        read_model(path)
    assert "\n" not in str(fault.value)


def test_knots_that_do_not_rise_are_refused(tmp_path):
    text = built_in_model().as_toml()
    path = tmp_path / "model.toml"
    path.write_text(text.replace("[structure]\nat = [", "[structure]\nat = [99.0, "))
    with pytest.raises(UsageError, match=r"\[structure\]"):
        read_model(path)


def averaged(pattern, seed: int, frames: int = 16, range_m: float = 2.1, bearing_deg: float = 3.0):
    """Probabilities and turn after some frames of one speckled disc on its dark plate."""
    rng = np.random.default_rng(seed)
    memory = Features(memory_frames=20.0)
    measurement = AppearanceMeasurement(memory, PLANE, SAMPLER, BASIN, built_in_model(), 0.01, 400)
    centre = np.stack(PLANE.from_polar(np.array([range_m]), np.array([bearing_deg])), axis=-1)
    sight = PLANE.line_of_sight(centre)
    for _ in range(frames):
        picture = speckled_disc(rng, FAN, range_m, bearing_deg, BASIN.radius_m, pattern)
        image = PLANE.warp(picture)
        grey, visible = SAMPLER(image, PLANE.inside, centre, sight, *surroundings(image))
        track = dataclasses.replace(groups(1), positions=centre, existence=SURE[:1])
        evidence = measurement.gather(track, grey, visible)
    known = measurement.beliefs([track], evidence)
    return known.probabilities[0], float(sight[0] + known.rotation[0] * STEP)


@pytest.mark.parametrize("landmark", sorted(SECTORS))
@pytest.mark.parametrize("turn_deg", [20, 137, 291])
def test_a_landmark_is_known_by_its_id_and_orientation(landmark, turn_deg):
    p, orientation = averaged(disc_pattern(SECTORS[landmark], math.radians(turn_deg)), turn_deg)
    assert p.argmax() == landmark - 1
    assert p[landmark - 1] > 0.5
    symmetry = 180 if landmark == 2 else 360
    off = (math.degrees(orientation) - turn_deg + symmetry / 2) % symmetry - symmetry / 2
    assert abs(off) < 6


@pytest.mark.parametrize("seed", range(3))
def test_a_blank_and_a_filled_disc_are_none_of_these(seed):
    """PAPER's trap: to the single frame they are more ID.1 and more ID.4 than those themselves."""
    blank, _ = averaged(disc_pattern((0, 0, 0, 0)), seed)
    filled, _ = averaged(whole_disc, seed)
    floor, _ = averaged(lambda x, _: 0 * x, seed)
    for p in (blank, filled, floor):
        assert p.argmax() == 4
        assert p[4] > 0.5


@pytest.mark.parametrize(("width_deg", "needed"), [(0.4, 2), (4.0, 8)])
def test_an_id_is_earned_by_frames_and_by_more_of_a_disc_few_beams_wide(width_deg, needed):
    """At 2 m a disc of 0.3 m is 21 beams of 0.4 deg wide, and two of 4 deg."""
    judge = built_in_model()
    measurement = AppearanceMeasurement(Features(), PLANE, SAMPLER, BASIN, judge, width_deg, 400)
    centre = np.stack(PLANE.from_polar(np.array([2.0]), np.array([0.0])), axis=-1)
    track = dataclasses.replace(groups(1), positions=centre)
    grey = np.zeros((1, LINES, ANGLES))
    enough_evidence = [
        bool(
            measurement.beliefs(
                [track], measurement.gather(track, grey, grey == 0)
            ).enough_evidence[0]
        )
        for _ in range(10)
    ]
    assert enough_evidence == [frame >= needed for frame in range(1, 11)]
    track = dataclasses.replace(track, in_view=np.zeros(1, bool))
    assert not measurement.beliefs(
        [track], measurement.gather(track, grey, grey == 0)
    ).enough_evidence[0]
