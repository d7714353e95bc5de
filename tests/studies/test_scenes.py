"""What `make scenes` tells is what the commands would, on seeds kept apart."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from sonarrec.cli import main as sonarrec
from sonarrec.config import preset
from sonarrec.evaluation.curves import Count
from sonarrec.landmarks import load_landmarks
from sonarrec.simulation.scene import MotionSection, PlacedLandmark, PlacedObject, Scene
from sonarrec.simulation.simulate import write_recording
from tests.studies import baseline, scenes
from tests.support.simulated import METHODS, PRESETS, HoughRival, Job, recognise

pytestmark = pytest.mark.slow

# Another radius than the built-in set's, so that the set has to be handed on.
SCENE = Scene(
    name="small",
    frames=24,
    landmark_set=replace(load_landmarks("basin"), name="small", radius_m=0.12),
    motion=MotionSection(pan_min_deg=-3, pan_max_deg=3, pan_start_deg=-3, pan_deg_s=2),
    landmarks=(
        PlacedLandmark(1, ground_m=1.6, azimuth_deg=-5.0, orientation_deg=30.0),
        PlacedLandmark(2, ground_m=2.1, azimuth_deg=0.0, orientation_deg=350.0),
        PlacedLandmark(4, ground_m=1.7, azimuth_deg=6.0, orientation_deg=250.0),
    ),
    objects=(PlacedObject("blank", ground_m=2.2, azimuth_deg=8.0),),
)


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def in_memory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of SCENE as the harness makes them."""
    folder = tmp_path_factory.mktemp("in_memory") / SCENE.name
    recognise(Job(SCENE, folder, [preset(name) for name in PRESETS], (HoughRival,)))
    return folder


def test_harness_is_what_the_commands_do(in_memory: Path, tmp_path: Path) -> None:
    log = tmp_path / SCENE.name
    write_recording(SCENE, log)
    results = tmp_path / "out" / log.name
    run = ["run", log, "--preset", ",".join(PRESETS), "--landmarks", log / "landmarks.toml"]
    for command in (
        [*run, "--out", results.parent, "-q"],
        ["evaluate", "--ground-truth", log / "gt.csv", results, "-q"],
    ):
        done = CliRunner().invoke(sonarrec, list(map(str, command)), catch_exceptions=False)
        assert done.exit_code == 0, done.output

    assert (in_memory / "gt.csv").read_bytes() == (log / "gt.csv").read_bytes()
    ours = [r for r in table(in_memory / "estimates.csv") if r["method"] != baseline.METHOD]
    assert ours == table(results / "estimates.csv")
    expected = {
        (r["protocol"], r["method"]): tuple(int(r[c]) for c in ("tp", "tn", "fp", "fn"))
        for r in table(results / "evaluation" / "confusion.csv")
        if r["landmark"] == "total"
    }
    [row] = scenes.scored_rows([scenes.Recording(SCENE.name, SCENE.seed, in_memory)])
    counted = {
        (protocol, METHODS[name]): (c.tp, c.tn, c.fp, c.fn)
        for (protocol, name), c in row.counts.items()
    }
    assert {key: counted[key] for key in expected} == expected
    assert len(counted) == len(expected) + 2  # the rival, under both protocols
    assert expected["strict", "framework:default"][0] > 20


@pytest.mark.parametrize(
    ("command", "arguments", "told"),
    [
        (scenes.main, ["--kinds", "plain", "no_landmark", "tiny_discs"], "default, pooled: TPR"),
        (scenes.main, ["--kinds", "plain", "--ours"], "default, pooled: TPR"),
    ],
)
def test_commands_tell_their_tables(
    command: Callable[[list[str]], None],
    arguments: list[str],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """In one process; so few frames that much is 0/0."""
    monkeypatch.setattr(scenes, "in_processes", lambda work, items: list(map(work, items)))
    command([*arguments, "--seeds", "2000", "--frames", "4", "--out", str(tmp_path / "out")])
    assert told in capsys.readouterr().out


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
