"""Curves that are known are learned; tracks are labelled by where they lie."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from sonarrec.recogniser.stage3.description import FEATURES
from sonarrec.recogniser.stage3.model import AppearanceModel, built_in_model

from sonarrec.landmarks import load_landmarks
from sonarrec.learning.calibrate import _labelled
from sonarrec.learning.fit import PRIOR_WEIGHT, fit
from sonarrec.learning.samples import Samples, Tracks, label
from sonarrec.truth.match import Truth

BASIN = load_landmarks("basin")


def known_model() -> AppearanceModel:
    """Two features that tell, one of them bent; the others are worth nothing."""
    knots = np.linspace(-2, 2, 8)
    values = [np.zeros((2, 8)) for _ in FEATURES]
    values[0][:] = 1.5 * knots
    values[1][:] = -2 * np.abs(knots) + 2 * np.abs(knots).mean()
    return AppearanceModel(np.array([-1.0, -1.0]), (knots,) * len(FEATURES), tuple(values))


def drawn(
    model: AppearanceModel, count: int, seed: int, ids: int = 4, smear: float = 0.0
) -> Samples:
    """Features drawn at random, and labels drawn from the model's probabilities."""
    rng = np.random.default_rng(seed)
    features = rng.uniform(-2, 2, (count, ids, len(FEATURES)))
    smears = np.full(count, smear)
    edges = model.probabilities(features, smears).cumsum(axis=1)
    labels = (rng.random((count, 1)) > edges[:, :-1]).sum(axis=1)
    return Samples(features, smears, labels, np.arange(count))


def apart(one: AppearanceModel, other: AppearanceModel, feature: int, of: int = 0) -> float:
    """Root mean square between two curves of mean 0 over their range; of: 0 sharp, 1 smeared."""
    at = np.linspace(-1.9, 1.9, 50)
    curves = [np.interp(at, m.knots[feature], m.values[feature][of]) for m in (one, other)]
    curves = [c - c.mean() for c in curves]
    return float(np.sqrt(np.mean((curves[0] - curves[1]) ** 2)))


def log_likelihood(model: AppearanceModel, samples: Samples) -> float:
    p = model.probabilities(samples.features, samples.smear)
    return float(np.log(p[np.arange(len(samples.label)), samples.label]).mean())


@pytest.mark.slow
def test_memory_of_learning_is_little_more_than_the_samples():
    """75 MB; with the hat functions of all 8,000 samples at once it is 188 MB."""
    samples = drawn(known_model(), 8_000, 5, smear=0.2)
    tracemalloc.start()
    fit([samples], known_model())  # a prior that fits: few steps
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6


def test_samples_in_blocks_teach_what_they_teach_together(monkeypatch):
    recordings = [drawn(known_model(), 200, 1), drawn(known_model(), 100, 2, smear=0.6)]
    together = fit(recordings)
    monkeypatch.setattr("sonarrec.learning.fit.AT_ONCE", 64)
    in_blocks = fit(recordings)
    np.testing.assert_allclose(in_blocks.bias, together.bias, atol=1e-6)
    for one, other in zip(in_blocks.values, together.values, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.slow
def test_what_the_smear_changes_is_learned_from_smeared_pictures_alone():
    """Without any, the curves of smeared pictures are those of sharp ones."""
    truth = known_model()
    bent, level = truth.values[0][0], np.zeros(8)
    truth = replace(truth, values=(np.array([bent, level]), *truth.values[1:]))
    learned = fit([drawn(truth, 300, 1)])
    np.testing.assert_allclose(learned.bias[1], learned.bias[0])
    for of_sharp, of_smeared in learned.values:
        np.testing.assert_allclose(of_smeared, of_sharp, atol=1e-9)
    learned = fit([drawn(truth, 3000, 1), drawn(truth, 3000, 2, smear=0.2)])
    # A knot sees some 3000 / 8 samples: its log odds are good to 1 / sqrt(375 p (1 - p)) = .1.
    for feature in range(len(FEATURES)):
        assert apart(learned, truth, feature) < 0.25
        assert apart(learned, truth, feature, of=1) < 0.25


@pytest.mark.slow
def test_a_prior_is_left_as_far_as_the_samples_ask():
    """Few samples that fit it leave it alone, many that do not make it give way.

    Many: in proportion to how strongly curves are drawn to it.
    """
    truth = known_model()
    other = replace(truth, values=(-truth.values[0], *truth.values[1:]))
    few = fit([drawn(truth, 30, 4)], truth)
    assert max(apart(few, truth, feature) for feature in range(len(FEATURES))) < 0.2
    many = [drawn(other, int(PRIOR_WEIGHT), seed) for seed in range(10, 27)]
    steps = [
        apart(fit(samples, truth), other, 0)
        for samples in ([drawn(other, 30, 5)], [drawn(other, 300, 5)], many)
    ]
    assert steps[0] > steps[1] > steps[2]
    assert steps[2] < 0.25 * apart(truth, other, 0)
    # The more it weighs, the nearer one stays to it.
    samples = [drawn(other, 300, 6)]
    kept = [apart(fit(samples, truth, weight), truth, 0) for weight in (1.0, 10.0, 1e6)]
    assert kept[0] > kept[1] > kept[2]
    assert kept[2] < 0.01


def test_what_is_learned_fits_its_samples_no_worse_than_the_prior():
    """Of features that tell next to nothing, far from which Newton's first steps overshoot."""
    rng = np.random.default_rng(0)
    count = 1500
    labels = np.where(rng.random(count) < 0.9, rng.integers(0, 4, count), 4)
    features = rng.normal(0, 1, (count, 4, len(FEATURES)))
    on = np.flatnonzero(labels < 4)
    features[on, labels[on]] += 0.5
    samples = Samples(features, rng.uniform(0, 0.2, count), labels, np.arange(count))
    prior = built_in_model()
    assert log_likelihood(fit([samples], prior), samples) > log_likelihood(prior, samples)


def in_two_frames(
    row: list[int], number: list[int], position: np.ndarray, **looks: np.ndarray
) -> Tracks:
    """Tracks of a log of two frames. looks: what is seen of them, if it matters."""
    nothing = {"features": np.zeros((len(row), 4, len(FEATURES))), "smear": np.zeros(len(row))}
    return Tracks(
        name="log",
        landmarks=BASIN,
        fan=None,
        frame=np.arange(2),
        timestamp_ns=np.arange(2),
        row=np.array(row),
        number=np.array(number),
        position=position,
        **nothing | looks,
    )


def truth(*rows: tuple[int, int, float, float]) -> Truth:
    """(frame, index of the landmark, share visible, metres to the right; all are 2 m ahead)."""
    frame, landmark, visible, right = (np.array(column) for column in zip(*rows, strict=True))
    position = np.column_stack([right, np.full(len(rows), 2.0)])
    return Truth(
        frame, landmark, visible, position, None, np.arange(len(rows)), len(rows), 0, 0, None
    )


def test_tracks_are_labelled_by_where_they_lie():
    """On a landmark to a quarter of a disc's diameter, off it from half of one, taught between."""
    diameter = 2 * BASIN.radius_m
    away = np.array([0.0, 0.2, 0.3, 0.6, 0.0])
    tracks = in_two_frames(
        [0, 0, 0, 0, 1],
        [7, 8, 9, 10, 7],
        np.column_stack([away * diameter, np.full(5, 2.0)]),
        features=np.arange(5 * 4 * len(FEATURES), dtype=float).reshape(5, 4, -1),
        smear=np.arange(5) / 10,
    )
    # Two landmarks in frame 0, the nearer counts; none in frame 1.
    place = np.array([[0.0, 2.0], [-0.2 * diameter, 2.0]])
    samples = label(tracks, np.array([0, 0]), np.array([2, 1]), place)
    assert samples.track.tolist() == [7, 8, 10, 7]
    assert samples.label.tolist() == [2, 2, 4, 4]
    np.testing.assert_array_equal(samples.features, tracks.features[[0, 1, 3, 4]])
    assert samples.smear.tolist() == [0.0, 0.1, 0.3, 0.4]


def test_a_hidden_landmark_teaches_neither_its_id_nor_none():
    """Tracks 7 and 8 each lie on a landmark in frame 0; nothing is seen of that of track 7."""
    tracks = in_two_frames(
        [0, 0, 0, 1, 1, 1], [7, 8, 9] * 2, np.array([[0.0, 2], [1, 2], [2, 2]] * 2)
    )
    on_landmarks, stranger = truth((0, 0, 0.0, 0.0), (0, 1, 0.3, 1.0)), truth((1, 4, 1.0, 2.0))
    samples, strange = _labelled(tracks, on_landmarks, stranger)
    taught = list(zip(samples.track.tolist(), samples.label.tolist(), strict=True))
    assert taught == [(8, 1), (9, 4), (9, 4)]
    assert strange.tolist() == [False, False, True]
