"""What `make scenes` tells is what the commands would, on seeds kept apart."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from sonarrec.cli import main as sonarrec
from sonarrec.config import preset
from sonarrec.evaluation.curves import Count
from sonarrec.evaluation.judge import judge
from sonarrec.landmarks import load_landmarks
from sonarrec.simulation.scene import MotionSection, PlacedLandmark, PlacedObject, Scene
from sonarrec.simulation.simulate import write_recording
from tests.studies import baseline, scenes
from tests.studies.measured import BINS, calibration_error, errors, honesty, stated
from tests.support.simulated import METHODS, PRESETS, HoughRival, Job, matched, recognise

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


def test_errors_are_of_the_right_claims(in_memory: Path) -> None:
    truths = [t for t in table(in_memory / "gt.csv") if float(t["visible"]) >= 0.9]
    expected = []
    for claim in table(in_memory / "estimates.csv"):
        if claim["method"] != METHODS["default"] or claim["declared"] != "1":
            continue
        for truth in truths:
            same = (truth["frame"], truth["landmark"]) == (claim["frame"], claim["landmark"])
            place, true = (
                float(r["range_m"]) * np.exp(1j * np.radians(float(r["bearing_deg"])))
                for r in (claim, truth)
            )
            if same and abs(place - true) <= SCENE.landmark_set.radius_m:
                turn = 180 if claim["landmark"] == "2" else 360
                off = float(claim["orientation_deg"]) - float(truth["orientation_deg"])
                expected.append(
                    (
                        float(claim["range_m"]) - float(truth["range_m"]),
                        float(claim["bearing_deg"]) - float(truth["bearing_deg"]),
                        min((off + k * turn for k in range(-3, 4)), key=abs),
                        float(claim["bearing_sigma_deg"]),
                    )
                )
    e = errors([in_memory], METHODS["default"])
    told = np.column_stack([e.range_m, e.bearing_deg, e.orientation_deg, e.bearing_sigma_deg])
    assert len(told) > 20
    # Claims come by falling score, rows of the file by frame.
    order = np.lexsort(told.round(6).T), np.lexsort(np.round(expected, 6).T)
    np.testing.assert_allclose(told[order[0]], np.array(expected)[order[1]], atol=1e-9)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_honesty_of_normal_errors(factor: float) -> None:
    rng = np.random.default_rng(1)
    sigma = rng.uniform(0.1, 3, 20_000)
    error = rng.normal(0, factor * sigma)
    error[:50] = 1e6  # a few that went astray
    ratio, within = honesty(error, sigma)
    # The median of |x| of n normals scatters by 1.17 / sqrt(n) of itself: five times that.
    assert ratio == pytest.approx(factor, rel=5 * 1.17 / math.sqrt(20_000))
    assert within == pytest.approx(math.erf(math.sqrt(2) / factor), abs=0.015)


def test_honesty_needs_a_sigma() -> None:
    assert np.isnan(honesty(np.ones(3), np.full(3, np.nan))).all()


def test_calibration_error_by_hand(in_memory: Path) -> None:
    one = judge(matched(in_memory), METHODS["default"], "strict")
    right, gap = one.truth >= 0, 0.0
    for i in range(BINS):
        inside = (one.score >= i / BINS) & ((one.score < (i + 1) / BINS) | (i == BINS - 1))
        if inside.any():
            gap += abs(one.score[inside].mean() - right[inside].mean()) * inside.mean()
    told = calibration_error(*stated([in_memory], METHODS["default"]))
    assert told == pytest.approx(gap)


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
