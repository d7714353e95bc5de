"""The width of the beams: usual, stated by the log, or set; the same for whatever reads a log."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sonarrec import Recogniser, load_landmarks, open_log, preset, read_results, run
from sonarrec.config import Config
from sonarrec.errors import SonarrecError
from sonarrec.learning import calibrate
from sonarrec.recogniser.restore.beam_width import usual_beam_width_deg, with_beams
from sonarrec.results.run_file import LogOptions
from sonarrec.simulation.scene import Scene, scene_fan
from sonarrec.sonar.frame import Frame
from tests.support import messages
from tests.support.command import sonarrec
from tests.support.messages import log_of, polar_frames

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "pan.mcap"
STATED_DEG = 1.3


@pytest.fixture
def wide(tmp_path: Path) -> Path:
    """A log of polar pings that state beams 1.3 deg wide."""
    widths = {"rx_beamwidths": np.full(messages.BEAMS, np.radians(STATED_DEG), np.float32)}
    pings = [messages.projected_fields(k, image) for k, image in enumerate(polar_frames())]
    pings = [ping | {"ping_info": ping["ping_info"] | widths} for ping in pings]
    (tmp_path / "wide.sonar.toml").write_text("[sonar]\ntilt_deg = 20.0\n")
    return log_of(tmp_path / "wide.mcap", pings)


@pytest.mark.parametrize(
    ("view_deg", "beams", "expected_deg"),
    [(130.0, 512, 0.51), (130.0, 256, 1.0), (28.8, 96, 0.4), (28.8, 48, 0.4), (60.0, 512, 0.23)],
)
def test_many_beams_are_not_wider_than_two_of_them(
    view_deg: float, beams: int, expected_deg: float
) -> None:
    scene = Scene()
    sonar = replace(scene.sonar, field_of_view_deg=view_deg, beams=beams)
    fan = scene_fan(replace(scene, sonar=sonar))
    polar = SimpleNamespace(beam_deg=view_deg / beams)
    for first, width_deg in (
        (Frame(0, 0, np.empty(0), fan), usual_beam_width_deg(fan)),
        (Frame(0, 0, np.empty(0), fan, polar=polar), expected_deg),
    ):
        (found,), notes = with_beams([preset("default")], None, first)
        assert found.features.beam_width_deg == pytest.approx(width_deg)
        assert len(notes) == (width_deg != usual_beam_width_deg(fan))


def width_in(folder: Path) -> float:
    table = tomllib.loads((folder / "run.toml").read_text())
    return float(table["config"]["features"]["beam_width_deg"])


def test_the_usual_width_follows_from_the_field_of_view(tmp_path: Path) -> None:
    fan = scene_fan(Scene())
    for view_deg, width_deg in ((28.8, 0.4), (60.0, 0.6), (130.0, 1.0)):
        edges = {"bearing_min_deg": -view_deg / 2, "bearing_max_deg": view_deg / 2}
        assert usual_beam_width_deg(replace(fan, **edges)) == width_deg
    told = sonarrec("run", SAMPLE, "--frames", ":20", "-q", "-o", tmp_path).stderr
    assert "beam" not in told
    assert width_in(tmp_path / "pan") == 0.4


def test_a_run_says_and_keeps_what_it_took(wide: Path, tmp_path: Path) -> None:
    def told_by(*more: str | Path) -> str:
        return sonarrec("run", wide, "-q", "-o", tmp_path / "out", *more).stderr

    assert f"beam width: {STATED_DEG:g} deg" in told_by()
    assert width_in(tmp_path / "out" / "wide") == pytest.approx(STATED_DEG)
    # Again from its run.toml, and with a width of one's own.
    run_file = tmp_path / "run.toml"
    run_file.write_bytes((tmp_path / "out" / "wide" / "run.toml").read_bytes())
    assert "beams" not in told_by("--config", run_file, "--overwrite")
    assert width_in(tmp_path / "out" / "wide") == pytest.approx(STATED_DEG)
    # A setting goes before what the messages state.
    assert "beams" not in told_by("--set", "features.beam_width_deg=0.5")
    assert width_in(tmp_path / "out" / "wide") == 0.5


def test_whatever_reads_a_log_takes_the_width_that_a_run_takes(
    wide: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    default = preset("default")  # such pings show no discs: any ring will do
    rings = replace(default, candidates=replace(default.candidates, threshold=0.2))
    written = read_results(run(wide, tmp_path / "out", preset=rings).folder)
    with open_log(wide) as opened:
        found = Recogniser(opened, preset=rings).recognise()
        scores = [e.score for r in found for e in r.estimates]
    assert scores
    np.testing.assert_allclose(scores, written.estimates.score, atol=5.1e-7)
    taken: list[float] = []

    def described(frames: Iterable[Frame], config: Config, *_: object, **__: object) -> None:
        taken.append(config.features.beam_width_deg)
        assert len([*frames]) == len(polar_frames())
        raise SonarrecError("enough seen")

    monkeypatch.setattr(calibrate, "describe", described)
    truth = tmp_path / "gt.csv"
    truth.write_text("frame,landmark,x_px,y_px\n0,1,50,50\n")
    with pytest.raises(SonarrecError, match="enough seen"):
        calibrate.learn([wide], truth, preset("default"), load_landmarks("basin"), LogOptions())
    assert taken == 1 * [width_in(tmp_path / "out" / "wide")]
