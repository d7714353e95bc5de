"""`make paper`: what it rests on."""

from __future__ import annotations

import tomllib
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from sonarrec.config import PRESETS, preset
from sonarrec.evaluation.curves import PUBLISHED
from sonarrec.simulation.motion import poses
from sonarrec.simulation.scene import scene_fan
from tests.studies import baseline, bench, scenes, study
from tests.studies.learning.built_in import MODEL_SEEDS
from tests.studies.paper import choices, prediction, search, world
from tests.studies.paper.published import FRAMES, IDS, IN_VIEW, PRESENT, TABLE_4, TABLE_5
from tests.studies.paper.single import look
from tests.studies.paper.world import PARTS, drawn, in_view, kept_worlds, put_together
from tests.support.simulated import score

pytestmark = pytest.mark.slow

SEEDS = {
    "the built-in model": MODEL_SEEDS,
    "settings": scenes.TUNING,
    "make scenes": scenes.REPORTED,
    "make study": study.STUDIED,
    "the rival's tuning": [seed for seed, _ in baseline.TUNING_SCENES],
    "make bench": [which[0] for which in bench.REPORTED if not isinstance(which, str)],
    "stage 1 and SMI": search.SETTINGS_SEEDS,
    "the worlds": range(search.FIRST_SEED, search.FIRST_SEED + search.WORLDS * search.SEEDS_EACH),
    "the choices": choices.SEEDS,
    "the report": prediction.SEEDS,
}


def test_no_seed_is_used_twice() -> None:
    for (a, seeds), (b, others) in combinations(SEEDS.items(), 2):
        assert not set(seeds) & set(others), f"{a} and {b} share seeds"
    drawings = 2 * search.DRAWINGS + search.MEASURED + search.MORE
    assert drawings <= search.SEEDS_EACH
    assert len(study.STUDIED) >= 30


def test_no_world_serves_twice() -> None:
    """The worlds of the choices and of the report are others, and no two are akin."""
    chosen, reported = kept_worlds("choice"), kept_worlds("report")
    assert len(chosen) == search.FOR_CHOICES
    assert len(reported) >= 8
    numbers = [w.number for w in (*chosen, *reported)]
    assert len(set(numbers)) == len(numbers)
    # The places of things and all that is drawn once differ in each of them.
    for a, b in combinations([w.vector() for w in (*chosen, *reported)], 2):
        assert np.mean(np.isclose(a, b)) < 0.2


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


def test_the_kept_worlds_are_within_the_ranges() -> None:
    vectors = np.array([w.vector() for use in ("choice", "report") for w in kept_worlds(use)])
    assert ((vectors >= world.LOW - 1e-9) & (vectors <= world.HIGH + 1e-9)).all()


def test_a_world_is_put_together_of_parts() -> None:
    rng = np.random.default_rng(1)
    first = drawn(rng)
    second = drawn(rng, first)
    both = put_together([second, *[first] * (len(PARTS) - 1)])
    for name in world.NAMES:
        source = second if name in PARTS[0] else first
        assert both.values[name] == source.values[name]
    shared = [n for n, same in zip(world.NAMES, world.SHARED, strict=True) if same]
    assert "pan_start_deg" in shared
    assert all(first.values[n] == second.values[n] for n in shared)


def test_the_preset_is_what_was_chosen() -> None:
    with choices.CHOSEN.open("rb") as file:
        chosen = tomllib.load(file)["preset"]
    for section, settings in chosen.items():
        for key, value in settings.items():
            assert getattr(getattr(preset("paper"), section), key) == value, f"{section}.{key}"
    assert set(chosen) <= set(PRESETS["paper"])


def test_counts_in_memory_are_those_of_the_program(tmp_path: Path) -> None:
    """SMI over a recording: the search's own counts, and the tables scored by `evaluate`."""
    scene = kept_worlds("report")[0].scene(1, frames=48)
    prediction.record(prediction.Job(scene, tmp_path))
    scored = {(s.protocol, s.method): s for s in score([tmp_path]).scored}
    assert {s.method for s in scored.values()} == set(prediction.METHODS.values())
    seen = look(scene, 1, [preset("paper").candidates])[0]
    tpr, fpr = seen.rates(seen.score >= preset("paper").smi.declare)
    smi = scored["paper", prediction.METHODS["SMI"]]
    for k in range(len(IDS)):
        np.testing.assert_allclose([tpr[k], fpr[k]], [smi.count(k).tpr, smi.count(k).fpr])
    framework = scored["paper", prediction.METHODS["framework"]].count()
    assert framework.double == 0
    assert framework.total == len(IDS) * 48


def test_the_sign_flip_test_is_exact() -> None:
    assert prediction.flipped(np.full(8, 0.02)) == pytest.approx(2 / 256)
    assert prediction.flipped(np.array([1.0, -1.0, 1.0, -1.0])) == 1
    assert prediction.flipped(np.array([3.0, 1.0, -2.0])) == pytest.approx(6 / 8)
