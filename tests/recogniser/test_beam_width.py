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
from sonarrec.recogniser.restore.beam_width import with_beams
from sonarrec.results.run_file import LogOptions
from sonarrec.sonar.frame import Frame
from tests.support import messages
from tests.support.command import sonarrec
from tests.support.drawn import make_fan
from tests.support.messages import log_of, polar_frames

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
    ("view_deg", "beams", "usual_deg", "polar_deg"),
    [(39, 96, 0.4, 0.4), (41, 512, 0.6, 0.16), (81, 512, 1, 0.32), (130, 256, 1, 1)],
)
def test_the_usual_width_is_by_the_view_and_at_most_two_beams(
    view_deg, beams, usual_deg, polar_deg
):
    polar = SimpleNamespace(beam_deg=view_deg / beams)
    for shown_as, width_deg in ((None, usual_deg), (polar, polar_deg)):
        first = Frame(0, 0, np.empty(0), make_fan(field_of_view_deg=view_deg), polar=shown_as)
        (found,), notes = with_beams([preset("default")], None, first)
        assert found.features.beam_width_deg == pytest.approx(width_deg)
        assert len(notes) == (width_deg != usual_deg)


def width_in(folder: Path) -> float:
    table = tomllib.loads((folder / "run.toml").read_text())
    return float(table["config"]["features"]["beam_width_deg"])


def test_a_run_says_and_keeps_what_it_took(wide: Path, tmp_path: Path) -> None:
    def told_by(name: str, *more: str | Path) -> tuple[bool, float]:
        """Whether a run says a width, and what it took."""
        told = sonarrec("run", wide, "-q", "-o", tmp_path / name, *more).stderr
        return "beam width" in told, width_in(tmp_path / name / "wide")

    taken = pytest.approx(STATED_DEG)
    assert told_by("out") == (True, taken)
    assert told_by("again", "--config", tmp_path / "out" / "wide" / "run.toml") == (False, taken)
    # A setting goes before what the messages state.
    assert told_by("own", "--set", "features.beam_width_deg=0.5") == (False, 0.5)


def test_whatever_reads_a_log_takes_the_width_that_a_run_takes(wide, tmp_path, monkeypatch):
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
