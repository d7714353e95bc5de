"""The reader: its formulas by hand, its exact sums, its file, and what it reads of drawn discs."""

from __future__ import annotations

import math
import warnings
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.arrays import selected
from sonarrec.errors import UsageError
from sonarrec.landmarks import load_landmarks
from sonarrec.recogniser.stage3.model_file import as_toml, built_in_weights, read_model
from sonarrec.recogniser.stage3.reader import (
    INPUT_STEPS,
    LAYERS,
    WEIGHT_STEPS,
    Pictures,
    Reader,
    sigmoid,
)
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, ShapeSampler, rotated_codes
from tests.support.drawn import SECTORS

BASIN = load_landmarks("basin")
CODES = rotated_codes(BASIN)
WEIGHTS = built_in_weights()
READ = Reader(WEIGHTS, CODES)
BANDS = ShapeSampler(BASIN, (12.0, 12.0)).bands
LINES = 10


def random_pictures(seed: int, n: int = 3) -> Pictures:
    rng = np.random.default_rng(seed)
    shape = (n, LINES, ANGLES)
    brightness = rng.normal(0, 2, shape)
    count = np.where(rng.random(shape) < 0.2, 0.0, rng.uniform(0.5, 20, shape))
    return Pictures(brightness, count, rng.uniform(0.01, 0.99, n), rng.uniform(0, 0.3, n))


def drawn(landmark: int, turn: int, bright: float = 2.0, dark: float = -1.0) -> Pictures:
    """A perfect landmark: ring and bright sectors, plate, floor outside."""
    matrix = np.zeros((1, LINES, ANGLES))
    on = np.array([SECTORS[landmark][a // 9] for a in range(ANGLES)], bool)
    matrix[:, BANDS.symbol] = np.roll(np.where(on, bright, dark), turn)
    matrix[:, BANDS.gap] = dark
    matrix[:, BANDS.ring] = bright
    return Pictures(matrix, np.full(matrix.shape, 20.0), np.array([0.95]), np.array([0.03]))


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_beliefs_are_those_of_the_formulas_written_out(seed: int) -> None:
    pictures = random_pictures(seed, 1)
    of_directions, of_object = READ.layers(pictures)
    reading = READ(pictures)
    lit = [float(d @ WEIGHTS["lit"]) for d in of_directions[0]]
    disc, other = (float(of_object[0] @ WEIGHTS[name]) for name in ("disc", "other"))
    scale = math.exp(WEIGHTS["scale"][0])
    np.testing.assert_allclose(reading.lit[0], lit, atol=1e-4)
    for k in range(4):
        fit = [
            sum(c * v - math.log1p(math.exp(v)) for c, v in zip(code, lit, strict=True))
            for code in CODES[:, k]
        ]
        expected = disc + math.log(sum(math.exp(scale * f) for f in fit) / ANGLES)
        assert reading.log_beliefs[0, k] == pytest.approx(expected, abs=2e-3)
    free = disc + other - scale * sum(math.log1p(math.exp(-abs(v))) for v in lit)
    assert reading.log_beliefs[0, 4] == pytest.approx(math.log1p(math.exp(free)), abs=2e-3)
    np.testing.assert_allclose(reading.probabilities.sum(axis=1), 1)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_sums_are_exact_in_single_precision_so_their_order_cannot_matter(seed: int) -> None:
    """The layers written out in double precision give the same bits."""
    pictures = random_pictures(seed)
    of_directions, _ = READ.layers(pictures)
    seen = (pictures.count[:, :3] > 0).any(axis=1)
    in_double = [_layers_in_double(pictures, network) for network in range(len(WEIGHTS["hidden"]))]
    assert (of_directions[..., :-1][seen] == np.concatenate(in_double, axis=2)[seen]).all()


def _layers_in_double(pictures: Pictures, network: int) -> np.ndarray:
    """(n, ANGLES, C) of one network, tap by tap."""
    from sonarrec.recogniser.stage3 import reader

    h = reader._steps(reader.direction_inputs(pictures)).astype(float)
    for i, (width, dilation) in enumerate(LAYERS):
        kernel = WEIGHTS[f"conv{i}"][network].reshape(width, h.shape[2], -1)
        new = WEIGHTS[f"conv{i}_bias"][network] + sum(
            np.roll(h, (width // 2 - j) * dilation, axis=1) @ kernel[j] for j in range(width)
        )
        h = np.maximum(new, 0) + (h if i else 0)
        h = np.rint(h * INPUT_STEPS) / INPUT_STEPS
    return h


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_neither_what_was_never_seen_nor_other_objects_matter(seed: int) -> None:
    pictures = random_pictures(seed)
    known = READ(pictures)
    unseen = np.where(pictures.count == 0, 77.0, pictures.brightness)
    order = np.array([2, 0, 1])
    for other, rows in (
        (replace(pictures, brightness=unseen), slice(None)),
        (selected(pictures, order), order),
    ):
        again = READ(other)
        for name in (field.name for field in fields(known)):
            np.testing.assert_array_equal(getattr(again, name), getattr(known, name)[rows])


def test_the_order_of_the_ids_does_not_matter() -> None:
    pictures, order = random_pictures(5), [3, 1, 0, 2]
    other = Reader(WEIGHTS, CODES[:, order])(pictures).probabilities[:, :-1]
    np.testing.assert_allclose(other, READ(pictures).probabilities[:, order], atol=1e-6)


def test_nothing_seen_at_all_and_no_objects_give_numbers_and_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for n in (0, 1):
            nothing = np.zeros((n, LINES, ANGLES))
            found = READ(Pictures(nothing, nothing, np.full(n, 0.9), np.zeros(n)))
            assert found.probabilities.shape == (n, 5)
            assert np.isfinite(found.probabilities).all()


@pytest.mark.parametrize("landmark", sorted(SECTORS))
@pytest.mark.parametrize("turn", [0, 5, 13, 27])
def test_a_perfect_landmark_is_read_direction_by_direction(landmark: int, turn: int) -> None:
    reading = READ(drawn(landmark, turn))
    truth = CODES[turn, landmark - 1] > 0
    edge = (truth != np.roll(truth, 1)) | (truth != np.roll(truth, -1))
    assert ((reading.lit[0] > 0) == truth)[~edge].all()
    assert reading.probabilities[0].argmax() == landmark - 1
    period = 18 if landmark == 2 else 36
    off = (reading.rotation[0, landmark - 1] - turn + period / 2) % period - period / 2
    assert abs(off) < 1


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 0.9])
def test_a_rotation_between_two_steps_lies_between_them(share: float) -> None:
    """The log odds of ID.1 rotated by a part of a step: those of two steps, mixed."""
    lit = 8.0 * (2 * CODES[:, 0] - 1)
    mixed = (1 - share) * lit[[10]] + share * lit[[11]]
    reading = READ.judged(mixed, np.zeros(1), np.zeros(1))
    assert reading.rotation[0, 0] == pytest.approx(10 + share, abs=0.03)


def test_a_direction_of_which_nothing_was_seen_says_nothing() -> None:
    """Half of a landmark beyond the fan's edge: IDs that agree with the other half stay."""
    pictures = drawn(1, 0)  # lit in the first quarter
    pictures.count[:, :, ANGLES // 2 :] = 0
    reading = READ(pictures)
    assert (reading.lit[0, ANGLES // 2 :] == 0).all()
    assert (reading.lit[0, 1:8] > 0).all()
    assert reading.probabilities[0, 3] < 0.2  # ID.4 has one dark quarter only


@pytest.mark.parametrize("landmark", sorted(SECTORS))
def test_an_id_that_the_set_lacks_is_none_of_these(landmark: int) -> None:
    rest = [k for k in range(4) if k != landmark - 1]
    assert Reader(WEIGHTS, CODES[:, rest])(drawn(landmark, 4)).probabilities[0].argmax() == 3


def test_the_last_layer_survives_its_file(tmp_path) -> None:
    rng = np.random.default_rng(3)
    drawn = {n: rng.normal(size=WEIGHTS[n].shape) for n in ("lit", "disc")}
    weights = WEIGHTS | {n: np.rint(w * WEIGHT_STEPS) / WEIGHT_STEPS for n, w in drawn.items()}
    path = tmp_path / "model.toml"
    path.write_text(as_toml(weights))
    again = read_model(path).weights
    for name, values in weights.items():
        np.testing.assert_allclose(again[name], values, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("bias = 1.0\nsmeared_bias = 1.0", "calibrate"),  # of an earlier version
        (as_toml(WEIGHTS).replace('reader = "', 'reader = "0'), "calibrate"),  # of another reader
        ("not toml", "readable TOML"),
        (None, "No such file"),
    ],
    ids=["earlier", "another", "text", "none"],
)
def test_a_file_that_is_no_model_is_told_in_one_line(tmp_path, text, told) -> None:
    path = tmp_path / "model.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UsageError, match=told) as fault:
        read_model(path)
    assert "\n" not in str(fault.value)


def test_sigmoid_is_the_logistic_function_without_overflow() -> None:
    np.testing.assert_allclose(
        sigmoid(np.array([-900.0, 0.0, 2.0])), [0, 0.5, 1 / (1 + math.exp(-2))]
    )
