"""What `make taught` leaves out of a model is left out of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from learning.built_in import RECORDINGS
from learning.random_scenes import KINDS_OF_SCENE, STRETCH_KINDS
from sonarrec.learning.fit import fit
from sonarrec.learning.samples import Samples
from sonarrec.recogniser.stage3_features.description import FEATURES
from sonarrec.recogniser.stage3_features.model import AppearanceModel, parse_model
from tests.studies.taught import LESSONS, LearningReport


def samples(seed: int) -> Samples:
    """Of which every feature tells something, and more of it where the picture is sharp."""
    rng = np.random.default_rng(seed)
    label = rng.integers(0, 5, 400)
    smear = rng.uniform(0, 0.2, 400)
    features = rng.normal(0, 2, (400, 4, len(FEATURES)))
    features[np.arange(400), np.minimum(label, 3)] += ((label < 4) * (1 - 4 * smear))[:, None]
    return Samples(features, smear, label, np.arange(400))


def taught(lesson: LearningReport) -> AppearanceModel:
    """By recordings of two kinds, as it is read again from its file."""
    parts = [lesson(kind, samples(i)) for i, kind in enumerate(("plain", "symbols"))]
    return parse_model(fit([p for p in parts if p is not None]).as_toml(), "a test")


def test_features_left_out_tell_nothing() -> None:
    lesson = LESSONS["no rivals: symbols that no ID has"]
    told = [np.abs(values).max() for values in taught(lesson).values]
    left_out = FEATURES.index("rival_misfit")
    assert told[left_out] == 0
    assert min(told[:left_out] + told[left_out + 1 :]) > 0.1


def test_one_set_of_curves() -> None:
    one, two = (
        taught(LESSONS[name])
        for name in (
            "the same curves for sharp and smeared",
            "all that the built-in model is taught",
        )
    )
    assert all(np.array_equal(*values) for values in one.values)
    assert not any(np.array_equal(*values) for values in two.values)


@pytest.mark.parametrize(
    ("name", "left"),
    [
        ("never taught rings with symbols that are nobody's", lambda kind: kind != "symbols"),
        ("taught the basin's kinds alone", lambda kind: kind in KINDS_OF_SCENE + STRETCH_KINDS),
    ],
)
def test_kinds_left_out(name: str, left: Callable[[str], bool]) -> None:
    one = samples(0)
    for kind in RECORDINGS:
        assert (LESSONS[name](kind, one) is one) == left(kind)
