"""The height where only the tilt is stated, against the height that the simulator knows."""

from __future__ import annotations

import math
import re
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonarrec.readers import open_log
from sonarrec.readers.decode.height import LEAST, height_from_images
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import load_scene, scene_fan
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import floor_depth
from tests.support.command import SAMPLE, sonarrec
from tests.support.drawn import make_fan
from tests.support.logs import read
from tests.support.slow import but_first

SAMPLES = SAMPLE.parent
# Nearest and farthest range (m), tilt (deg) and height (m).
WINDOWS = [
    (1.25, 3.75, 20, 0.68),
    (1.4, 2.65, 20, 0.66),
    (0.5, 6.0, 20, 0.7),
    (0.5, 10.0, 25, 1.2),
    (0.5, 5.0, 30, 1.3),
    (0.7, 4.0, 40, 1.0),
    (1.0, 4.0, 45, 1.6),
]


@pytest.mark.parametrize(("low", "high", "tilt", "height"), WINDOWS)
def test_of_a_bare_floor(low: float, high: float, tilt: float, height: float) -> None:
    """A height that is wrong by a fifth loses no landmark."""
    scene = load_scene("sample_pan")
    stated = {"range_min_m": low, "range_max_m": high, "tilt_deg": float(tilt), "height_m": height}
    sonar = replace(scene.sonar, **stated, tilt_error_deg=0.0, range_bins=300)
    scene = replace(scene, frames=2, sonar=sonar, landmarks=(), objects=())
    fan = replace(scene_fan(scene), height_m=None)
    found = height_from_images([frame.image for frame in render(scene)], fan)
    assert found == pytest.approx(height, rel=0.2)
    if high >= 6:  # windows much longer than the floor that is seen
        assert floor_depth(fan) > 1.5 * height


def floor_from(fan: Fan, begins_m: float, before: int = 0) -> np.ndarray:
    """An even floor from some slant range on; before: the grey level nearer than that."""
    row, column = np.mgrid[: fan.rows, : fan.columns]
    range_m = np.hypot(column - fan.apex_column, fan.apex_row - row) * fan.metres_per_pixel
    return np.where(range_m < begins_m, before, 100).astype(np.uint8)


@pytest.mark.parametrize("begins_m", [1.6, 2.0])
def test_the_floor_begins_under_the_beams_lower_edge(begins_m: float) -> None:
    fan = make_fan(range_max_m=5.25, height_m=None)
    expected = begins_m * math.sin(math.radians(20 + 10))
    ring_m = fan.window_m / 96
    for before in (0, 40):  # noise in the water, below half of the floor
        found = height_from_images([floor_from(fan, begins_m, before)], fan)
        assert found == pytest.approx(expected, abs=ring_m)


def test_the_bounds() -> None:
    fan = make_fan(range_min_m=0.2, range_max_m=5.2, height_m=None)
    mid_window = floor_depth(fan)
    for begins_m, expected in ((0.0, LEAST * mid_window), (4.5, mid_window)):
        found = height_from_images([floor_from(fan, begins_m)], fan)
        assert found == pytest.approx(expected, rel=0.01)
    # A bright spot before the floor, of a fish or a cable, is not its beginning.
    floor = floor_from(fan, 1.7)
    spot = cv2.circle(floor.copy(), (fan.columns // 2, fan.rows - 60), 5, 200, -1)
    assert height_from_images([spot], fan) == height_from_images([floor], fan)


def test_black_images_tell_nothing() -> None:
    fan = make_fan(height_m=None)
    assert height_from_images([np.zeros((fan.rows, fan.columns), np.uint8)], fan) is None
    level = replace(fan, tilt_deg=0.0)
    assert height_from_images([floor_from(level, 2.0)], level) is None


@pytest.mark.parametrize("name", but_first(["polar", "pan"]))
def test_a_log_without_its_height(name: str, tmp_path: Path) -> None:
    log = tmp_path / name
    shutil.copytree(SAMPLES / name, log)
    text = (log / "sonar.toml").read_text()
    (log / "sonar.toml").write_text(re.sub(r"height_m.*", "", text))
    with open_log(SAMPLES / name) as opened:
        truth = opened.sonar.height_m
    (height,) = {frame.fan.height_m for frame in read(log).frames}
    assert height == pytest.approx(truth, rel=0.2)
    first, second = (tmp_path / out / name for out in "ab")
    sonarrec("run", log, "-o", tmp_path / "a", "-q", "--frames", "40:50")
    sonarrec("run", log, "--config", first / "run.toml", "-o", tmp_path / "b", "-q")
    assert (first / "estimates.csv").read_bytes() == (second / "estimates.csv").read_bytes()
    tables = tomllib.loads((first / "run.toml").read_text())
    assert tables["fan"]["height_m"] == height
    # It is not stated: the same settings may serve for another dive.
    assert "height_m" not in tables["sonar"]
