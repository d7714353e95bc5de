"""The width of the beams, measured on simulated sonars whose beams are known."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w
from click.testing import CliRunner

from sonarrec import Recogniser, load_landmarks, open_log, preset, read_results, run
from sonarrec.cli import main
from sonarrec.config import Config
from sonarrec.errors import SonarrecError
from sonarrec.learning import calibrate
from sonarrec.nouns import Frame
from sonarrec.recogniser.restore.beam_width import (
    beam_width_deg,
    measured_width_deg,
    usual_beam_width_deg,
)
from sonarrec.results.run_file import LogOptions
from sonarrec.simulation.background import survey
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import Scene, scene_fan, scene_sonar
from tests.studies.learning.random_scenes import random_scene
from tests.support.slow import but_first

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "pan.mcap"


def scene_of(seed: int, view_deg: float, beams: int, width_deg: float) -> Scene:
    drawn = random_scene(seed, ("plain", "fading", "low_contrast", "near_miss")[seed % 4])
    sonar = replace(drawn.sonar, field_of_view_deg=view_deg, beams=beams, beam_width_deg=width_deg)
    return replace(drawn, frames=4, sonar=sonar)


@pytest.mark.parametrize(
    ("view_deg", "beams", "width_deg"),
    but_first(
        [
            (28.8, 96, 0.4),
            (28.8, 96, 0.3),
            (28.8, 96, 0.6),
            (28.8, 48, 0.8),
            (28.8, 96, 1.0),
            (60.0, 256, 0.6),
            (120.0, 256, 1.0),
            (120.0, 512, 1.5),
        ]
    ),
)
def test_the_beams_of_simulated_sonars_are_measured(
    view_deg: float, beams: int, width_deg: float
) -> None:
    """A fan image does not tell how far its beams lie apart, from an eighth of their width to all
    of it, which widens the correlation by up to a third; and receivers smear to neighbours."""
    ratios = []
    for seed in range(8730, 8734):
        scene = scene_of(seed, view_deg, beams, width_deg)
        fan = scene_fan(scene)
        found = measured_width_deg(fan, [f.image for f in render(scene)])
        assert found is not None
        ratios.append(found / width_deg)
    assert 0.8 < np.median(ratios) < 1.3
    assert min(ratios) > 0.68
    assert max(ratios) < 1.6


def test_the_usual_width_serves_unless_the_images_clearly_show_another() -> None:
    for width_deg, expected in ((0.4, False), (1.2, True)):
        scene = scene_of(8740, 28.8, 96, width_deg)
        fan, images = scene_fan(scene), [f.image for f in render(scene)]
        found, measured = beam_width_deg(fan, images)
        assert measured == expected
        assert found == pytest.approx(width_deg, rel=0.35)
        assert usual_beam_width_deg(fan) == 0.4
    assert usual_beam_width_deg(replace(fan, bearing_min_deg=-65, bearing_max_deg=65)) == 1.0


def test_a_picture_without_speckle_tells_nothing() -> None:
    fan = scene_fan(scene_of(8740, 28.8, 96, 0.4))
    even = np.full((fan.rows, fan.columns), 90, np.uint8)
    assert measured_width_deg(fan, [even, 0 * even]) is None
    assert beam_width_deg(fan, [even]) == (0.4, False)


def log_of(folder: Path, scene: Scene) -> Path:
    folder.mkdir()
    sonar = {"sonar": scene_sonar(scene).as_table()}
    (folder / "sonar.toml").write_text(tomli_w.dumps(sonar))
    for frame in render(scene):
        cv2.imwrite(str(folder / f"{frame.index:05d}.png"), frame.image)
    return folder


def width_in(folder: Path) -> float:
    table = tomllib.loads((folder / "run.toml").read_text())
    return float(table["config"]["features"]["beam_width_deg"])


def test_a_run_says_and_keeps_what_it_took(tmp_path: Path) -> None:
    log = log_of(tmp_path / "wide", scene_of(8741, 28.8, 96, 1.2))

    def told_by(*more: str) -> str:
        words = ["run", str(log), "-q", "-o", str(tmp_path / "out"), *more]
        result = CliRunner().invoke(main, words)
        assert result.exit_code == 0, result.output
        return result.stderr

    told = told_by()
    took = width_in(tmp_path / "out" / "wide")
    assert took == pytest.approx(1.2, rel=0.35)
    assert f"beams are taken to be {took:g} deg wide, as the first frames show" in told
    # Again from its run.toml, and with a width of one's own.
    estimates = (tmp_path / "out" / "wide" / "estimates.csv").read_bytes()
    run_file = tmp_path / "run.toml"
    run_file.write_bytes((tmp_path / "out" / "wide" / "run.toml").read_bytes())
    assert "beams" not in told_by("--config", str(run_file), "--overwrite")
    assert (tmp_path / "out" / "wide" / "estimates.csv").read_bytes() == estimates
    assert "beams" not in told_by("--set", "features.beam_width_deg=0.5")
    assert width_in(tmp_path / "out" / "wide") == 0.5


def test_whatever_reads_a_log_takes_the_width_that_a_run_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = log_of(tmp_path / "wide", scene_of(8741, 28.8, 96, 1.2))
    written = read_results(run(log, tmp_path / "out").folder)
    with open_log(log) as opened:
        scores = [e.score for r in Recogniser(opened).recognise() for e in r.estimates]
    np.testing.assert_allclose(scores, written.estimates.score, atol=5.1e-7)
    background = survey(lambda: open_log(log), load_landmarks("basin"), preset("default"))
    taken = [background.beam_width_deg]

    def described(frames: Iterable[Frame], config: Config, *_: object, **__: object) -> None:
        taken.append(config.features.beam_width_deg)
        assert len([*frames]) == 4
        raise SonarrecError("enough seen")

    monkeypatch.setattr(calibrate, "describe", described)
    truth = tmp_path / "gt.csv"
    truth.write_text("frame,landmark,x_px,y_px\n0,1,50,50\n")
    with pytest.raises(SonarrecError, match="enough seen"):
        calibrate.learn([log], truth, preset("default"), load_landmarks("basin"), LogOptions())
    assert taken == 2 * [width_in(tmp_path / "out" / "wide")]


def test_nothing_is_said_of_the_usual_width(tmp_path: Path) -> None:
    result = CliRunner().invoke(
        main, ["run", str(SAMPLE), "--frames", ":20", "-q", "-o", str(tmp_path)]
    )
    assert result.exit_code == 0
    assert "beam" not in result.stderr
    assert width_in(tmp_path / "pan") == 0.4
