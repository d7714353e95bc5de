"""`sonarrec info --try-radii`, on a recording of discs of .15 m radius."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sonarrec.errors import SonarrecError
from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.readers import open_log
from sonarrec.runs import radii
from sonarrec.runs.frames import Recogniser
from sonarrec.runs.radii import RadiusTrial, RadiusTrials, try_radii
from tests.support.command import SAMPLE, sonarrec
from tests.support.logs import frames, image_folder

TRUE_RADIUS_M, TRUE_IDS = 0.15, {1, 3}
FIELD = Path(__file__).resolve().parents[3] / "shared" / "data"


def ignore(total: int) -> None:
    """In place of a progress bar."""


def landmarks_of(radius_m: float) -> LandmarkSet:
    return replace(load_landmarks("basin"), radius_m=radius_m)


def landmarks_file(folder: Path, radius_m: float) -> Path:
    built_in = Path(radii.__file__).parents[1] / "landmark_sets" / "basin.toml"
    text = built_in.read_text()
    assert f"radius_m = {TRUE_RADIUS_M}" in text
    path = folder / "landmarks.toml"
    path.write_text(text.replace(f"radius_m = {TRUE_RADIUS_M}", f"radius_m = {radius_m}"))
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"ring": (0.72, 1.0)}, (0.15, 0.792)),
        ({"radius_m": 0.14}, (0.154, 0.8)),
    ],
)
def test_the_culprit_is_the_one_that_was_stated_wrongly(
    changed: dict[str, Any], told: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ring that begins 10 % too far in was taken for a radius."""
    monkeypatch.setattr(radii, "MOST_FRAMES", 32)
    monkeypatch.setattr(radii, "STEPS", 1)
    log_folder = FIELD / "basin_a"
    if not log_folder.is_dir():
        pytest.skip(f"test recordings not found in {FIELD}")
    with open_log(log_folder) as log:
        trials = try_radii(log, replace(load_landmarks("basin"), **changed), 248, ignore)
    assert trials.better is not None
    assert (trials.better.radius_m, trials.better.ring_from) == told


@pytest.mark.slow
def test_a_trial_declares_what_a_run_declares(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(radii, "STEPS", 0)
    with open_log(SAMPLE) as log:
        trials = try_radii(log, landmarks_of(TRUE_RADIUS_M), 128, ignore)
        results = list(Recogniser(log).recognise())
    trial = trials.trials[0]
    declared = [
        {e.landmark for e in r.estimates if e.declared and e.method == "framework"} for r in results
    ]
    assert trial.frames_declared == sum(map(bool, declared))
    assert trial.ids == {one: sum(one in ids for ids in declared) for one in sorted(TRUE_IDS)}
    assert trials.better is None


@pytest.mark.slow
def test_no_disc_is_tried_that_the_sonar_cannot_see() -> None:
    with open_log(str(SAMPLE / "00000*.png")) as log:
        trials = try_radii(log, landmarks_of(3.0), 10, ignore)
        assert max(t.radius_m for t in trials.trials) == 3.63  # its window ends at 3.75 m
        with pytest.raises(SonarrecError, match="larger than what this sonar sees"):
            try_radii(log, landmarks_of(4.0), 10, ignore)


def test_only_a_clear_difference_counts() -> None:
    def trials(stated: int, other: int) -> RadiusTrials:
        return RadiusTrials(
            0.15,
            0.8,
            100,
            (RadiusTrial(0.136, 0.8, other, {1: other}), RadiusTrial(0.15, 0.8, stated, {})),
        )

    assert trials(0, 8).better is None
    assert trials(40, 80).better is None
    better = trials(4, 9).better
    assert better is not None
    assert better.radius_m == 0.136


def test_the_command_tells_the_radius(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(radii, "MOST_FRAMES", 24)
    monkeypatch.setattr(radii, "STEPS", 1)
    stated = landmarks_file(tmp_path, 0.165)
    words = ("info", "--quick", SAMPLE, "--landmarks", stated, "--try-radii")
    lines = sonarrec(*words).stdout.splitlines()
    (at,) = [i for i, line in enumerate(lines) if line.startswith("  radii ")]
    assert "frames of 24 " in lines[at]
    assert "0.15 to 0.182 m" in lines[at]
    assert "(stated)" in lines[at + 3]
    assert "fits better than the 0.165 m stated: check radius_m" in lines[-1]
    (log,) = json.loads(sonarrec(*words, "--json").stdout)["logs"]
    assert log["radii"]["stated_m"] == 0.165
    assert log["radii"]["better_m"] == pytest.approx(TRUE_RADIUS_M, rel=0.05)
    assert [t["radius_m"] for t in log["radii"]["trials"]][1] == 0.165
    assert "radii" not in json.loads(sonarrec(*words[:-1], "--json").stdout)["logs"][0]


def test_a_log_without_its_geometry_is_described_all_the_same(tmp_path: Path) -> None:
    folder = image_folder(tmp_path / "log", frames(3, 30, 24))
    (folder / "sonar.toml").unlink()
    result = sonarrec("info", folder, "--try-radii", code=1)
    assert "3 of 3 can be used" in result.stdout
    assert "lacks range_min_m" in result.stderr
    assert "Traceback" not in result.output


def test_a_run_that_declares_nothing_names_the_option(tmp_path: Path) -> None:
    stated = landmarks_file(tmp_path, 0.3)
    words = ("run", SAMPLE, "-o", tmp_path / "out", "--frames", "0:12")
    assert "--try-radii" in sonarrec(*words, "--landmarks", stated).stdout
    assert "--try-radii" not in sonarrec(*words, "--overwrite").stdout
