"""Maps and paths of a vehicle nobody told the poses of, against the simulator's own."""

from __future__ import annotations

import math
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w

from sonarrec.arrays import FloatArray
from sonarrec.mapping.axes import CHI2_95
from sonarrec.mapping.build import make_map
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import scene_sonar
from tests.support.command import sonarrec
from tests.support.vehicle import VehicleRun, truth_of, vehicle_run

pytestmark = pytest.mark.slow

FRAMES = 90
SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "pan.mcap"


@pytest.fixture(scope="module", params=[8720, 8721])
def dive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of a vehicle run in a folder of images, and its results beside it."""
    folder = tmp_path_factory.mktemp("dive")
    run = vehicle_run(request.param, laps=1)
    log = folder / "dive"
    log.mkdir()
    sonar = {"sonar": scene_sonar(run.scene).as_table()}
    (log / "sonar.toml").write_text(tomli_w.dumps(sonar))
    for frame in islice(render(run.scene, run.poses()[:FRAMES], run.ground), FRAMES):
        cv2.imwrite(str(log / f"{frame.index:05d}.png"), frame.image)
    (folder / "landmarks.toml").write_text(tomli_w.dumps(run.scene.landmark_set.as_table()))
    (folder / "seed").write_text(str(request.param))
    words = ["--landmarks", folder / "landmarks.toml", "-o", folder / "out", "-q"]
    sonarrec("run", log, *words)
    return folder


def truth(folder: Path) -> VehicleRun:
    return vehicle_run(int((folder / "seed").read_text()), laps=1)


def from_first(path: FloatArray) -> FloatArray:
    """(n, 3) yaw (deg), x, y as the first pose sees them."""
    yaw = math.radians(path[0, 0])
    x, y = (path[:, 1:] - path[0, 1:]).T
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.column_stack([path[:, 0] - path[0, 0], x * cos - y * sin, x * sin + y * cos])


def test_a_map_without_poses_is_relative_to_the_first_frame(dive: Path) -> None:
    run = truth(dive)
    site = make_map([dive / "out" / "dive"])
    assert not site.diagnostics.notes
    true = truth_of(run)
    places = from_first(np.vstack([run.path[0], np.column_stack([0 * true[:, 0], true[:, 1:3]])]))
    squared = []
    for one in site.landmarks:
        off = one.position - places[1:, 1:]
        nearest = int(np.hypot(*off.T).argmin())
        assert true[nearest, 0] == one.id
        assert np.hypot(*off[nearest]) < 0.12
        squared.append(off[nearest] @ np.linalg.inv(one.covariance) @ off[nearest])
    assert len(squared) >= 4
    assert np.mean(np.array(squared) < CHI2_95) >= 0.75
