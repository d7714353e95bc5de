"""What `make transfer` leaves out, and how it counts."""

from __future__ import annotations

import numpy as np
import pytest

from sonarrec.learning.samples import Samples
from sonarrec.recogniser.stage3.description import FEATURES
from tests.studies.learning.built_in import FOLDS, folds, samples_of
from tests.studies.learning.random_scenes import ALL_KINDS
from tests.studies.transfer import figures


def test_every_kind_is_left_out_once() -> None:
    parts = folds(ALL_KINDS)
    assert len(parts) == FOLDS
    assert sorted(kind for part in parts for kind in part) == sorted(ALL_KINDS)


def test_figures_by_hand() -> None:
    """Two landmarks, one told as the other; a blank, told as a landmark with .8."""
    probability = np.array([[0.9, 0.05, 0.05], [0.6, 0.3, 0.1], [0.8, 0.1, 0.1], [0.1, 0.1, 0.8]])
    truth = np.array([0, 1, 2, 2])
    samples = Samples(np.zeros((4, 2, 1)), np.zeros(4), truth, np.arange(4))
    found = figures([("plain", samples)], [probability])
    assert found["log loss"] == f"{-np.log([0.9, 0.3, 0.1, 0.8]).mean():.4f}"
    assert (found["TPR"], found["false"]) == ("0.500", "1 of 4")
    assert found["right of .75 to .9"] == "0.00 of 1"
    assert found["TPR at 1 of 1000"] == "0.500"


@pytest.mark.slow
def test_landmarks_look_like_what_they_are() -> None:
    samples = samples_of(("plain", 2000))
    on = samples.label < samples.features.shape[1]
    assert np.count_nonzero(on) > 20
    best = samples.features[on][..., FEATURES.index("rival_misfit")].argmin(axis=1)
    assert (best == samples.label[on]).mean() > 0.9
