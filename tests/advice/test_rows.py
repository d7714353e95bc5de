"""Truth that cannot be is found, truth that can be is not, and both are drawn."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.advice.rows import Fault, check_truth
from sonarrec.landmarks import load_landmarks
from sonarrec.readers import open_log
from sonarrec.simulation.motion import Plane, Pose
from sonarrec.simulation.scene import PlacedLandmark
from sonarrec.simulation.truth import visible_share
from sonarrec.sonar.geometry import fan_for_image
from sonarrec.sonar.stated import load_sonar
from tests.support.command import sonarrec
from tests.support.logs import image_folder

SAMPLES = Path(__file__).parents[2] / "sample_data"
SHARED = Path(__file__).parents[3] / "shared" / "data"
BASIN = load_landmarks("basin")
FRAMES = 12
HEADER = "frame,landmark,range_m,bearing_deg,visible"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Twelve black frames, wide enough for the whole fan."""
    return image_folder(tmp_path / "pings", [np.zeros((300, 560), np.uint8)] * FRAMES)


def truth(
    tmp_path: Path, rows: Sequence[str], header: str = "frame,landmark,range_m,bearing_deg"
) -> Path:
    path = tmp_path / "gt.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def faults(path: Path, log: Path, max_pan_deg: float = 5.0) -> list[Fault]:
    with open_log(log) as opened:
        return check_truth(path, opened, BASIN, max_pan_deg=max_pan_deg)[1]


def kinds(path: Path, log: Path, max_pan_deg: float = 5.0) -> list[tuple[int, str]]:
    return [(fault.line, fault.kind) for fault in faults(path, log, max_pan_deg)]


def run(*arguments: str | Path, code: int = 0) -> Result:
    return sonarrec("truth", "check", *arguments, code=code)


def test_pixels_and_metres_that_disagree_are_of_another_log(tmp_path: Path) -> None:
    pan, faint = SAMPLES / "pan", SAMPLES / "faint"
    told = run(faint / "gt.csv", pan, code=3).stdout
    assert "322 of 322 rows" in told
    assert "another log" in told
    for log in (pan, faint):
        assert "no fault" in run(log / "gt.csv", log).stdout
    # A row in three that a person moved in one pair only is no other geometry.
    header, *rows = (pan / "gt.csv").read_text().splitlines()
    cells = [row.split(",") for row in rows]
    column = header.split(",").index("x_px")
    for row in cells[::3]:
        row[column] = str(float(row[column]) + 20)
    path = truth(tmp_path, [",".join(row) for row in cells], header)
    assert "another log" not in run(path, pan).stdout


def test_the_sample_is_sound() -> None:
    assert faults(SAMPLES / "polar" / "gt.csv", SAMPLES / "polar") == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["basin_a", "basin_b", "basin_c"])
def test_recordings_of_another_simulator_are_sound(name: str) -> None:
    if not (SHARED / name).is_dir():
        pytest.skip("the shared recordings are not here")
    assert faults(SHARED / name / "gt.csv", SHARED / name) == []


def test_a_steady_pan_is_sound_up_to_its_limit(tmp_path: Path, log: Path) -> None:
    path = truth(tmp_path, [f"{k},1,2.0,{-10 + 4.9 * k:.2f}" for k in range(5)])
    assert kinds(path, log) == []
    assert kinds(path, log, max_pan_deg=4.8) == [(n, "jump") for n in (3, 4, 5, 6)]


@pytest.mark.parametrize("way", [1, -1])
def test_a_second_landmark_of_an_id_may_enter_at_an_edge(
    tmp_path: Path, log: Path, way: int
) -> None:
    """It was a jump of the first, though that one stays in view."""
    first = [f"{k},1,2.0,{way * (-4 - k)},1" for k in range(8)]
    side = [f"{k},1,2.0,{way * (18 - k)},0.2" for k in range(2, 8)]
    far = [f"{k},1,{3.8 - 0.05 * k:.2f},8,0.2" for k in range(2, 6)]
    middle = [f"{k},1,2.5,2,1" for k in range(2, 6)]
    for second, expected in ((side, []), (far, []), (middle, [(10, "jump")])):
        assert kinds(truth(tmp_path, first + second, HEADER), log) == expected


def test_truth_by_time_denser_than_the_frames(tmp_path: Path, log: Path) -> None:
    """Frames are 250 ms apart; of stamps in between only the nearest belongs to a frame."""
    rows = [f"{n * 50_000_000},1,2.0,{-5 + n / 5:.2f}" for n in range(40)]
    header = "timestamp_ns,landmark,range_m,bearing_deg"
    assert kinds(truth(tmp_path, rows, header), log) == []
    late = [*rows, "9000000000,1,2.0,0"]
    assert kinds(truth(tmp_path, late, header), log) == [(42, "frame")]


def test_a_log_is_known_by_its_folders_and_its_name(tmp_path: Path, log: Path) -> None:
    """As results are called whose logs share a name; it was told that no row names it."""
    two = [f"{tmp_path.name}-pings", f"{tmp_path.parent.name}-{tmp_path.name}-pings"]
    header = "log,frame,landmark,range_m,bearing_deg"
    for name in two:
        found = faults(truth(tmp_path, [f"{name},0,9,2,0", "b-pings,0,1,2,0"], header), log)
        assert [fault.line for fault in found] == [2]
    # A namesake in another folder may have the short name; its rows were taken.
    found = faults(truth(tmp_path, ["pings,0,1,2,0", f"{two[0]},0,9,2,0"], header), log)
    assert [fault.line for fault in found] == [3]


def test_truth_of_other_logs_alone_or_without_rows_is_a_failure(tmp_path: Path, log: Path) -> None:
    path = truth(tmp_path, ["a,0,1,2.0,0"], "log,frame,landmark,range_m,bearing_deg")
    assert "pings" in run(path, log, code=1).stderr
    for header in ("frame,landmark,x_px,y_px", "timestamp_ns,landmark,range_m,bearing_deg"):
        assert "no row" in run(truth(tmp_path, [], header), log, code=1).stderr


def test_a_range_of_nothing_or_less_is_outside(tmp_path: Path, log: Path) -> None:
    """Squared, -2 m was in the middle of the image."""
    rows = ["0,1,-2.0,0,1", "1,1,-2.0,0,1", "5,1,0,0,1"]
    found = [f for f in faults(truth(tmp_path, rows, HEADER), log) if f.kind == "outside"]
    assert [fault.line for fault in found] == [2, 3, 4]
    assert "range -2.00 m" in found[0].text


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (["0,7,2.0,0,1"], [(2, "landmark")]),
        (["12,1,2.0,0,1"], [(2, "frame")]),
        (["0,1,2.0,0,1.2"], [(2, "visible")]),
        (["0,1,2.0,0,-0.1"], [(2, "visible")]),
        (["0,1,2.0,30,0.5"], [(2, "outside")]),
        (["0,1,0.3,0,0.5"], [(2, "outside")]),
        (["0,1,2.0,14.4,1"], [(2, "visible")]),
        (["0,1,2.0,14.4,0.5"], []),
        (["0,1,2.0,0,0.2"], []),  # hidden by something else
        (["0,1,2.0,0,1", "", "0,1,2.0,0,1"], [(4, "repeated")]),
        (["0,1,2.0,0,1", "0,1,2.01,0,1"], [(3, "overlap")]),
        (["0,1,2.0,0,1", "0,2,2.0,9,1", "0,3,2.02,9.1,1"], [(4, "overlap")]),
        (["0,1,2.0,0,1", "1,1,2.2,0,1"], [(3, "jump")]),
        (["0,1,2.0,0,1", "1,1,2.0,6,1"], [(3, "jump")]),
        (["0,1,2,0,1", "1,1,2,9,1", "2,1,2,1,1", "3,1,2,1,1"], [(3, "jump"), (4, "jump")]),
        # A mistyped ID.
        ([f"{k},{1 + 3 * (k == 2)},2,{k},1" for k in range(5)], [(4, "changed")]),
        # One leaves while another enters elsewhere.
        (["0,1,2,-14,0.5", "1,2,2,14,0.5"], []),
        # A mistyped ID near an edge, while another landmark of that ID is in view.
        (
            [f"{k},1,2,{k - 6},1" for k in range(4)]
            + [f"{k},{2 - (k == 2)},2,{k + 7},1" for k in range(4)],
            [(8, "changed"), (8, "jump")],
        ),
        # Neighbours that pan by more than a radius; the outer one leaves.
        (["0,1,2,9,1", "0,2,2,-14,0.5", "1,1,2,4.5,1", "1,2,2,-18,0.1", "2,1,2,0,1"], []),
        # Two landmarks named the other way round from frame 2 on.
        (
            [f"{k},{1 + (k > 1)},2,{k},1" for k in range(4)]
            + [f"{k},{2 - (k > 1)},2,{k + 8},1" for k in range(4)],
            [(4, "jump")],
        ),
    ],
)
def test_found(tmp_path: Path, log: Path, rows: list[str], expected: list[tuple[int, str]]) -> None:
    assert kinds(truth(tmp_path, rows, HEADER), log) == expected


def test_a_frame_that_cannot_be_read(tmp_path: Path, log: Path) -> None:
    (log / "frame5.png").write_bytes(b"broken")
    path = truth(tmp_path, ["5,1,2.0,0", "6,1,2.0,0"])
    (fault,) = faults(path, log)
    assert fault.line == 2
    assert "frame 5 " in fault.text
    done = run(path, log, code=3)
    assert "frame5.png" in done.stderr


def test_truth_without_positions(tmp_path: Path, log: Path) -> None:
    path = truth(tmp_path, ["0,1", "40,1", "1,8"], "frame,landmark")
    assert kinds(path, log) == [(3, "frame"), (4, "landmark")]


@settings(max_examples=40)
@given(range_m=st.floats(1.3, 3.7), bearing_deg=st.floats(-20, 20), margin=st.floats(-0.08, 0.08))
def test_visible_of_the_simulator_is_always_sound(
    tmp_path_factory: pytest.TempPathFactory, range_m: float, bearing_deg: float, margin: float
) -> None:
    """Whatever share the simulator works out, and a person's estimate that is near to it."""
    folder = tmp_path_factory.mktemp("check")
    log = image_folder(folder / "pings", [np.zeros((60, 112), np.uint8)])
    fan = fan_for_image(load_sonar(log / "sonar.toml").complete("test"), 60, 112)
    ground = math.sqrt(range_m**2 - 0.68**2)
    pose = Pose(0.0, 0.68, 0.0, 0.0)
    share = visible_share(fan, pose, PlacedLandmark(1, ground, bearing_deg), 0.15, Plane())
    if share > 0:
        visible = min(max(share + margin, 0), 1)
        row = f"0,1,{range_m:.5f},{bearing_deg:.4f},{visible:.4f}"
        assert kinds(truth(folder, [row], HEADER), log) == []


def test_the_command_tells_lines(tmp_path: Path) -> None:
    shutil.copy(SAMPLES / "pan" / "gt.csv", tmp_path / "gt.csv")
    done = run(tmp_path / "gt.csv", SAMPLES / "pan")
    assert "199 rows" in done.stdout
    with (tmp_path / "gt.csv").open("a") as file:
        file.write("500,1,100,100,2.0,0,1,0\n")
    done = run(tmp_path / "gt.csv", SAMPLES / "pan", code=3)
    assert "gt.csv line 201: " in done.stdout


def test_many_faults_of_a_kind_are_counted(tmp_path: Path, log: Path) -> None:
    path = truth(tmp_path, [f"{k % 12},5,2.0" for k in range(50)], "frame,landmark,visible")
    done = run(path, log, code=3)
    assert done.stdout.count("set 'basin' (1, 2, 3, 4), in 50 rows") == 1
    assert done.stdout.count("a share") == 20
    assert "30 more" in done.stdout


def test_the_truth_of_each_log_is_found(tmp_path: Path) -> None:
    """In or next to the log, or in a folder of truths; a log without costs itself."""
    camp, labelled = tmp_path / "camp", tmp_path / "labelled"
    labelled.mkdir()
    for name in ("one", "two"):
        image_folder(camp / name, [np.zeros((60, 112), np.uint8)] * 3)
    truth(tmp_path, ["0,1,2.0,0.0"]).rename(labelled / "one.gt.csv")
    done = run(labelled, camp, code=3)
    assert f"{labelled}/one.gt.csv: 1 row" in done.stdout
    assert f"{labelled}/two.gt.csv" in done.stderr
    truth(tmp_path, ["0,1,2.0,0.0", "1,1,2.0,0.0"]).rename(camp / "two" / "gt.csv")
    shutil.copy(labelled / "one.gt.csv", camp)
    done = run(camp)
    assert "one.gt.csv: 1 row" in done.stdout
    assert "two/gt.csv: 2 rows" in done.stdout
    assert "1 row" in run(camp / "one").stdout
    assert "name the log" in run(labelled / "one.gt.csv", code=2).stderr


def test_a_jump_is_told_with_its_way_and_its_lines(tmp_path: Path, log: Path) -> None:
    path = truth(tmp_path, ["0,1,2.0,3", "1,1,2.25,-4"])
    assert "by -7.0 deg and +0.25 m" in run(path, log, code=3).stdout
