"""What fits samples better is learned; tracks are labelled by where they lie."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence

import numpy as np
import pytest

from sonarrec.landmarks import load_landmarks
from sonarrec.learning.calibrate import _labelled
from sonarrec.learning.fit import fit
from sonarrec.learning.samples import Samples, Tracks, label
from sonarrec.recogniser.stage3.model_file import built_in_weights
from sonarrec.recogniser.stage3.reader import LAST_LAYER, Pictures, Reader, Weights
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, rotated_codes
from sonarrec.truth.match import Truth

BASIN = load_landmarks("basin")
CODES = rotated_codes(BASIN)
WEIGHTS = built_in_weights()


def random_pictures(seed: int, n: int) -> Pictures:
    rng = np.random.default_rng(seed)
    brightness = rng.normal(0, 1, (n, 10, ANGLES))
    brightness[:, :3] += 2 * CODES[rng.integers(0, ANGLES, n), rng.integers(0, 4, n)][:, None]
    brightness[:, 3:6] += 2
    return Pictures(brightness, np.full(brightness.shape, 9.0), np.full(n, 0.9), np.full(n, 0.04))


def drawn(weights: Weights, n: int, seed: int) -> Samples:
    """Pictures, and labels drawn from the beliefs of a reader with these weights."""
    pictures, rng = random_pictures(seed, n), np.random.default_rng(seed)
    edges = Reader(weights, CODES)(pictures).probabilities.cumsum(axis=1)
    labels = (rng.random((n, 1)) > edges[:, :-1]).sum(axis=1)
    return Samples(pictures, labels, np.arange(n))


def changed(by: float) -> Weights:
    """Discs are less likely than the built-in reader takes them to be."""
    disc = WEIGHTS["disc"].copy()
    disc[-1] -= by
    return {**WEIGHTS, "disc": disc}


def log_likelihood(weights: Weights, samples: Samples) -> float:
    p = Reader(weights, CODES)(samples.pictures).probabilities
    return float(np.log(p[np.arange(len(samples.label)), samples.label]).mean())


def faint(gain: float, bias: float) -> Weights:
    """Symbols give weaker log odds than the built-in reader takes them to give, and fewer."""
    lit = WEIGHTS["lit"] * gain
    lit[-1] += bias
    return {**WEIGHTS, "lit": lit}


def test_the_gain_and_bias_of_faint_symbols_are_learned():
    """From 1,000 pictures that fit no longer, to a tenth: a standard error of both is .04."""
    learned = fit([drawn(faint(0.5, -0.4), 1_000, 7)], WEIGHTS, CODES, prior_weight=1.0)
    gain = learned["lit"][:-1] @ WEIGHTS["lit"][:-1] / (WEIGHTS["lit"][:-1] ** 2).sum()
    bias = learned["lit"][-1] - gain * WEIGHTS["lit"][-1]
    assert (gain, bias) == pytest.approx((0.5, -0.4), abs=0.1)
    np.testing.assert_allclose(learned["lit"][:-1], gain * WEIGHTS["lit"][:-1])  # that alone


@pytest.mark.slow
def test_memory_of_learning_is_little_more_than_the_samples():
    """8,000 samples are 12 MB; what is read off them 5, and the fits of 500 to rotations 6."""
    samples = drawn(WEIGHTS, 8_000, 5)
    tracemalloc.start()
    fit([samples], WEIGHTS, CODES)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6


def test_samples_in_blocks_teach_what_they_teach_together(monkeypatch):
    recordings = [drawn(changed(2), 150, 1), drawn(changed(2), 80, 2)]
    together = fit(recordings, WEIGHTS, CODES)
    monkeypatch.setattr("sonarrec.recogniser.stage3.reader.AT_ONCE", 64)
    in_blocks = fit(recordings, WEIGHTS, CODES)
    for name in LAST_LAYER:
        np.testing.assert_allclose(in_blocks[name], together[name], atol=1e-5)


def test_a_prior_is_left_as_far_as_the_samples_ask():
    """The more samples that do not fit it, and the less it weighs, the farther."""
    other, held_out = changed(3), drawn(changed(3), 400, 9)

    def gain(n: int, weight: float) -> float:
        learned = fit([drawn(other, n, 5)], WEIGHTS, CODES, weight)
        return log_likelihood(learned, held_out) - log_likelihood(WEIGHTS, held_out)

    gains = [gain(n, 30.0) for n in (20, 80, 320)]
    assert gains[0] < gains[1] < gains[2]
    assert gains[2] > 0.5 * (log_likelihood(other, held_out) - log_likelihood(WEIGHTS, held_out))
    assert abs(gain(100, 1e7)) < 0.01


def test_samples_that_fit_leave_the_reader_as_it_is():
    """Without a prior six numbers would cost some 6 / (2 x 300) on other samples."""
    learned = fit([drawn(WEIGHTS, 300, 4)], WEIGHTS, CODES)
    held_out = drawn(WEIGHTS, 400, 8)
    assert log_likelihood(learned, held_out) > log_likelihood(WEIGHTS, held_out) - 0.03


def in_two_frames(row: list[int], number: list[int], right_m: Sequence[float]) -> Tracks:
    """Tracks of a log of two frames, 2 m ahead."""
    place = np.column_stack([right_m, np.full(len(row), 2.0)])
    frames = {"frame": np.arange(2), "timestamp_ns": np.arange(2)}
    tracks = {"row": np.array(row), "number": np.array(number), "position": place}
    pictures = random_pictures(0, len(row))
    return Tracks(name="log", landmarks=BASIN, fan=None, pictures=pictures, **frames, **tracks)


def truth(*rows: tuple[int, int, float, float]) -> Truth:
    """(frame, index of the landmark, share visible, metres to the right; all are 2 m ahead)."""
    frame, landmark, visible, right = (np.array(column) for column in zip(*rows, strict=True))
    n, place = len(rows), np.column_stack([right, np.full(len(rows), 2.0)])
    return Truth(frame, landmark, visible, place, None, np.arange(n), n, 0, 0, None)


def test_tracks_are_labelled_by_where_they_lie():
    """On a landmark to a quarter of a disc's diameter, off it from half of one, taught between."""
    diameter = 2 * BASIN.radius_m
    away = np.array([0.0, 0.2, 0.3, 0.6, 0.0])
    tracks = in_two_frames([0, 0, 0, 0, 1], [7, 8, 9, 10, 7], away * diameter)
    # Two landmarks in frame 0, the nearer counts; none in frame 1.
    place = np.array([[0.0, 2.0], [-0.2 * diameter, 2.0]])
    samples = label(tracks, np.array([0, 0]), np.array([2, 1]), place)
    assert samples.track.tolist() == [7, 8, 10, 7]
    assert samples.label.tolist() == [2, 2, 4, 4]
    expected = tracks.pictures.brightness[[0, 1, 3, 4]]
    np.testing.assert_array_equal(samples.pictures.brightness, expected)


def test_a_hidden_landmark_teaches_neither_its_id_nor_none():
    """Tracks 7 and 8 each lie on a landmark in frame 0; nothing is seen of that of track 7."""
    tracks = in_two_frames([0, 0, 0, 1, 1, 1], [7, 8, 9] * 2, [0.0, 1.0, 2.0] * 2)
    on_landmarks, stranger = truth((0, 0, 0.0, 0.0), (0, 1, 0.3, 1.0)), truth((1, 4, 1.0, 2.0))
    samples, strange = _labelled(tracks, on_landmarks, stranger)
    taught = list(zip(samples.track.tolist(), samples.label.tolist(), strict=True))
    assert taught == [(8, 1), (9, 4), (9, 4)]
    assert strange.tolist() == [False, False, True]
