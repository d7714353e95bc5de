"""`make paper`: what its three parts rest on."""

from __future__ import annotations

import tomllib
from itertools import combinations

import numpy as np
import pytest

from learning.built_in import MODEL_SEEDS
from sonarrec.config import PRESETS, preset
from sonarrec.evaluation.counting.curves import PUBLISHED
from sonarrec.recogniser.stage3.published import TABLE_3
from sonarrec.simulation.motion import poses
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import load_scene, scene_fan, scene_table
from tests.studies import baseline, bench, scenes, study
from tests.studies.paper import choices, prediction, world
from tests.studies.paper.parts import BAYES, CONTINUITY, LEARNED, Parts
from tests.studies.paper.published import FRAMES, IDS, IN_VIEW, PRESENT, TABLE_4, TABLE_5
from tests.studies.paper.world import drawn, in_view, kept_worlds

pytestmark = pytest.mark.slow

SEEDS = {
    "the built-in model": MODEL_SEEDS,
    "settings": scenes.TUNING,
    "make scenes": scenes.REPORTED,
    "make study": study.STUDIED,
    "the rival's tuning": [seed for seed, _ in baseline.TUNING_SCENES],
    "make bench": [which[0] for which in bench.REPORTED if not isinstance(which, str)],
    "the worlds": world.SEEDS,
    "their stable frames": world.STABLE_SEEDS,
    "the choices": choices.SEEDS,
    "the prediction": prediction.SEEDS,
}


def test_no_seed_is_used_twice() -> None:
    for (a, seeds), (b, others) in combinations(SEEDS.items(), 2):
        assert not set(seeds) & set(others), f"{a} and {b} share seeds"
    assert len(study.STUDIED) >= 30


def test_the_search_has_seeds_enough() -> None:
    """So that no recording of the search is one of another part's."""
    pool, used = world.FIRST, world.FIRST
    for r in world.ROUNDS:
        pool = min(pool, r.parents) + r.children
        used += pool * r.recordings
    assert used <= len(world.SEEDS)
    assert pool <= len(world.STABLE_SEEDS)
    assert len(kept_worlds()) <= len(choices.SEEDS)


# Tables 4 and 5 as printed: TP, TN, FP, FN of ID.1 to ID.4 and in total.
COUNTS_4 = [(353, 588, 52, 9), (0, 989, 3, 0), (266, 626, 20, 81), (239, 625, 37, 95)]
COUNTS_5 = [(350, 611, 29, 2), (0, 992, 0, 0), (300, 625, 21, 46), (239, 631, 31, 91)]


@pytest.mark.parametrize(("table", "counts"), [(TABLE_4, COUNTS_4), (TABLE_5, COUNTS_5)])
def test_the_published_rates_follow_from_the_published_counts(table, counts) -> None:
    for k, (tp, tn, fp, fn) in enumerate([*counts, tuple(np.sum(counts, axis=0))]):
        assert table["fpr"][k] == pytest.approx(fp / (fp + tn), abs=6e-5)
        assert table["tpr"][k] == pytest.approx(tp / (tp + fn) if tp + fn else 0, abs=6e-5)
    assert (table["fpr"][4], table["tpr"][4]) in [(fpr, tpr) for _, fpr, tpr in PUBLISHED]


def test_in_view_is_what_the_counts_of_table_5_say() -> None:
    for k, (tp, _, _, fn) in enumerate(COUNTS_5):
        assert IN_VIEW.get(IDS[k], 0) == tp + fn


def test_worlds_lie_in_their_ranges_and_are_seen_as_often_as_published() -> None:
    scene = drawn(np.random.default_rng(3)).scene(5)
    assert scene.frames == FRAMES
    # Counted from the simulator's truth, not by the search's own rule.
    seen = dict.fromkeys(PRESENT, 0)
    fan = scene_fan(scene)
    for item in scene.landmarks:
        pan = np.array([p.pan_deg for p in poses(scene)])
        half = (fan.bearing_max_deg - fan.bearing_min_deg) / 2
        seen[item.id] = int((np.abs(item.azimuth_deg - pan) < half).sum())
    for i, frames in IN_VIEW.items():
        # The search leaves the yaw's jitter out, which moves a frame or two at each edge.
        assert abs(seen[i] - frames) <= world.IN_VIEW_TOLERANCE + 6


def test_in_view_of_a_place_in_the_middle_of_the_pan() -> None:
    """Well inside 80 degrees of pan a fan of 28.8 degrees shows it for 28.8 / 80 of the time."""
    counts = in_view(np.array([[0.0, 5.0, -5.0]]), np.array([-40.0]))
    whole = 6 * 28.8 / 0.5  # six whole passes; the seventh ends before it comes there
    assert counts[0] == pytest.approx(whole, abs=7)


def test_the_kept_worlds_are_within_the_ranges_and_unlike() -> None:
    worlds = kept_worlds()
    vectors = np.array([w.vector() for w in worlds])
    assert ((vectors >= world.LOW - 1e-9) & (vectors <= world.HIGH + 1e-9)).all()
    assert len(np.unique(vectors, axis=0)) == len(worlds)


def test_the_built_in_scene_is_the_middle_one_of_the_kept_worlds() -> None:
    scene = load_scene("paper")
    kept = kept_worlds()[0].scene(scene.seed)
    assert scene_table(kept) == scene_table(scene)


def test_the_preset_is_what_was_chosen() -> None:
    with choices.CHOSEN.open("rb") as file:
        chosen = tomllib.load(file)["preset"]
    for section, settings in chosen.items():
        for key, value in settings.items():
            assert getattr(getattr(preset("paper"), section), key) == value, f"{section}.{key}"
    assert set(chosen) <= set(PRESETS["paper"])


def test_a_learned_measurement_model_is_near_the_published() -> None:
    """Rows sum to 1, the right ID is the likeliest; it is blurred by frames that are not stable."""
    with choices.CHOSEN.open("rb") as file:
        learned = np.array(tomllib.load(file)["learned"])
    assert learned.sum(axis=1) == pytest.approx(1, abs=2e-4)
    assert (learned.argmax(axis=1) == np.arange(len(IDS))).all()
    assert np.abs(learned - TABLE_3).max() < 0.06


def test_parts_speak_of_every_frame() -> None:
    scene = kept_worlds()[0].scene(1, frames=12)
    parts = Parts(scene_fan(scene), scene.landmark_set)
    told = [parts.step(frame.image) for frame in render(scene)]
    methods = {e.method for estimates in told for e in estimates}
    assert methods == {CONTINUITY, BAYES, LEARNED}
    for estimates in told:
        for e in estimates:
            assert e.probabilities.sum() == pytest.approx(1)
            assert 0 <= e.score <= 1
