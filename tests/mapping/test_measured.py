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
from sonarrec.readers.poses_csv import read_poses
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import scene_sonar
from tests.support.command import sonarrec
from tests.support.rows import read_rows
from tests.support.vehicle import RATE_HZ, VehicleRun, truth_of, vehicle_run

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
    sonarrec("run", log, *words, "--odometry-out", folder / "path.csv")
    return folder


def truth(folder: Path) -> VehicleRun:
    return vehicle_run(int((folder / "seed").read_text()), laps=1)


def from_first(path: FloatArray) -> FloatArray:
    """(n, 3) yaw (deg), x, y as the first pose sees them."""
    yaw = math.radians(path[0, 0])
    x, y = (path[:, 1:] - path[0, 1:]).T
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.column_stack([path[:, 0] - path[0, 0], x * cos - y * sin, x * sin + y * cos])


def test_the_path_written_is_the_true_one_within_its_errors(dive: Path) -> None:
    true = from_first(truth(dive).path[:FRAMES])
    poses = read_poses(dive / "path.csv")
    assert poses.at.tolist() == [round(n * 1e9 / RATE_HZ) for n in range(FRAMES)]
    off = poses.pose - true
    # 7.8 m of way: 60 mm is 0.8 %, of which 0.3 to 0.6 % is the height that is stated wrongly.
    assert (np.abs(off) < (1.5, 0.06, 0.06)).all()
    rows = read_rows(dive / "path.csv")
    sigma = np.array(
        [[float(r[k]) for k in ("yaw_sigma_deg", "x_sigma_m", "y_sigma_m")] for r in rows]
    )
    assert (np.diff(sigma[:, 0]) >= 0).all()
    assert (np.abs(off[1:]) < 4 * sigma[1:]).all()
    # A frame that faded is bridged by the last speed, give or take 2 deg of turn.
    assert (sigma[-1] < (4, 0.1, 0.1)).all()


def test_the_path_read_back_tells_the_motion_that_was_measured(dive: Path) -> None:
    again = dive / "again.csv"
    words = ["--landmarks", dive / "landmarks.toml", "-q", "--odometry-out", again]
    sonarrec("run", dive / "dive", *words, "-o", dive / "told", "--odometry", dive / "path.csv")
    first, second = (read_poses(dive / name).pose for name in ("path.csv", "again.csv"))
    np.testing.assert_allclose(second, first, atol=2e-3)  # frames.csv has a hundredth of a mm
    told = read_rows(dive / "told" / "dive" / "frames.csv")
    assert {row["dx_sigma_m"] for row in told} == {""}
    assert abs(float(told[10]["dy_m"])) > 0.05


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


def test_several_logs_or_another_file_are_refused(dive: Path) -> None:
    two = [dive / "dive", SAMPLE]
    told = sonarrec("run", *two, "-o", dive / "x", "--odometry-out", dive / "p.csv", code=2)
    assert "--odometry-out is for one log" in told.stderr
    (dive / "mine.csv").write_text("something else\n")
    words = ["-o", dive / "x", "--odometry-out", dive / "mine.csv"]
    told = sonarrec("run", dive / "dive", *words, code=2)
    assert "not overwritten" in told.stderr
    assert (dive / "mine.csv").read_text() == "something else\n"
    sonarrec("run", dive / "dive", "-o", dive / "p", "--preset", "paper", "-q")
    words = ["-o", dive / "p", "--preset", "paper", "-q", "--odometry-out", dive / "none.csv"]
    told = sonarrec("run", dive / "dive", *words, code=1)
    assert "measured motion" in told.stderr
