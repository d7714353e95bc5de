"""What `make scenes` tells is what the commands would, on seeds kept apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonarrec.config import preset
from sonarrec.landmarks import load_landmarks
from sonarrec.simulation.scene import MotionSection, PlacedLandmark, PlacedObject, Scene
from sonarrec.simulation.simulate import write_recording
from tests.studies import baseline, plates, scenes
from tests.studies.baseline import METHOD, Settings
from tests.studies.learning import plates as lessons
from tests.studies.paper.world import kept_worlds
from tests.support.claims import all_scored, evaluate
from tests.support.command import sonarrec
from tests.support.counted import Count
from tests.support.rows import read_rows
from tests.support.simulated import METHODS, PRESETS, Job, recognise

pytestmark = pytest.mark.slow

# Another radius than the built-in set's, so that the set has to be handed on.
SMALL = replace(load_landmarks("basin"), name="small", radius_m=0.12)
PLACES = ((1, 1.6, -5.0, 30.0), (2, 2.1, 0.0, 350.0), (4, 1.7, 6.0, 250.0))
SCENE = Scene(
    name="small",
    frames=24,
    landmark_set=SMALL,
    motion=MotionSection(pan_min_deg=-3, pan_max_deg=3, pan_start_deg=-3, pan_deg_s=2),
    landmarks=tuple(PlacedLandmark(*place) for place in PLACES),
    objects=(PlacedObject("blank", ground_m=2.2, azimuth_deg=8.0),),
)


def test_harness_is_what_the_commands_do(tmp_path: Path) -> None:
    log, in_memory = tmp_path / SCENE.name, tmp_path / "in_memory"
    recognise(Job(SCENE, in_memory, [preset(name) for name in PRESETS], {METHOD: Settings()}))
    write_recording(SCENE, log)
    results = tmp_path / "out" / log.name
    run = ["run", log, "--preset", ",".join(PRESETS), "--landmarks", log / "landmarks.toml"]
    sonarrec(*run, "--out", results.parent, "-q")
    sonarrec("evaluate", "--ground-truth", log / "gt.csv", results, "-q")
    assert (in_memory / "gt.csv").read_bytes() == (log / "gt.csv").read_bytes()
    ours = [r for r in read_rows(in_memory / "estimates.csv") if r["method"] != baseline.METHOD]
    assert ours == read_rows(results / "estimates.csv")
    expected = {
        (r["protocol"], r["method"]): tuple(int(r[c]) for c in ("tp", "tn", "fp", "fn"))
        for r in read_rows(results / "evaluation" / "confusion.csv")
        if r["landmark"] == "total"
    }
    [row] = scenes.scored_rows([scenes.Recording(SCENE.name, SCENE.seed, in_memory)])
    counted = {(how, METHODS[name]): count[:4] for (how, name), count in row.counts.items()}
    assert {key: counted[key] for key in expected} == expected
    assert len(counted) == len(expected) + 2  # the rival, under both protocols
    assert expected["strict", "framework:default"][0] > 20


@pytest.mark.parametrize("more", [["no_landmark", "tiny_discs"], ["--ours"]])
def test_the_command_tells_its_tables(more: list[str], tmp_path, monkeypatch, capsys) -> None:
    """In one process; so few frames that much is 0/0."""
    monkeypatch.setattr(scenes, "in_processes", lambda work, items: list(map(work, items)))
    few = ["--seeds", "2000", "--frames", "4", "--out", str(tmp_path / "out")]
    scenes.main(["--kinds", "plain", *more, *few])
    assert "default, pooled: TPR" in capsys.readouterr().out


def test_intervals_over_recordings_are_those_of_all_that_may_be_drawn() -> None:
    """Of two recordings each alone is drawn twice in a quarter of all cases: more than 2.5 %."""
    none = scenes.Row("no_landmark", 1, 0, {("strict", "default"): Count(0, 9, 1, 0)})
    first = scenes.Row("plain", 1, 2, {("strict", "default"): Count(9, 90, 10, 1)})
    second = scenes.Row("plain", 2, 2, {("strict", "default"): Count(5, 98, 2, 5)})
    assert scenes.intervals([first, second], "default") == ((0.5, 0.9), (0.02, 0.1))
    assert scenes.intervals([second] * 3, "default") == ((0.5, 0.5), (0.02, 0.02))
    tpr, fpr = scenes.intervals([none, none], "default")
    assert np.isnan(tpr).all()
    assert fpr == (0.1, 0.1)


def test_the_study_of_plates_counts_a_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plates, "FRAMES", 8)
    claimed, whole, wrong, absent = plates.count(plates.REPORTED[0])
    assert whole - 3 <= claimed <= whole
    assert wrong == 0
    assert 6 <= whole <= 8 * plates.IDS - absent  # of one plate of the set, near its edge at first


def test_in_the_paper_s_worlds_the_framework_finds_more_than_smi(tmp_path: Path) -> None:
    """In the median of three, whose rates differ widely."""
    gains = []
    for world in kept_worlds()[:3]:
        folder = tmp_path / str(world.number)
        recognise(Job(world.scene(1, frames=240), folder, [preset("paper")]))
        tpr = {
            s.method: s.count().tpr
            for s in all_scored(evaluate(folder, folder / "gt.csv").counts)
            if s.protocol == "paper"
        }
        gains.append(tpr["framework"] - tpr["smi"])
    assert np.median(gains) > 0.05


def test_plates_are_learned_from_sets_of_every_family() -> None:
    for made in lessons.FAMILIES:
        drawing = made(np.random.default_rng(0))
        assert drawing.any()
        assert not drawing.all()
    assert len(lessons._family()) == 2591
