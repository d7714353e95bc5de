"""`sonarrec run` says what it goes by, and takes what lies beside the log."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import pytest

from tests.support.command import SAMPLE, sample_log, sonarrec
from tests.support.logs import frames, image_folder
from tests.support.rows import read_rows

SHORT = ("--set", "continuity.particles=100", "-o", "out")
SIX = """
frames = 8
[landmark_set]
name = "six"
radius_m = 0.16
ring = [0.8, 1.0]
symbol = [0.0, 0.62]
[motion]
pan_min_deg = -2.0
pan_max_deg = 2.0
pan_start_deg = -2.0
"""


def lines(stderr: str) -> list[str]:
    return [line for line in stderr.splitlines() if ": geometry " in line]


@pytest.fixture
def pings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    sample_log(Path("dives/pings"), 2).joinpath("sonar.toml").unlink()
    return Path("dives/pings")


def test_a_run_names_its_geometry_and_where_it_is_from(pings: Path) -> None:
    shutil.copy(SAMPLE / "sonar.toml", "dives/sonar.toml")  # beside the log's folder
    (told,) = lines(sonarrec("run", pings, *SHORT, "--tilt-deg", "22").stderr)
    assert "tilt 22 deg, height 0.68 m (options, dives/sonar.toml); landmarks basin (built" in told
    again = ("--config", "out/pings/run.toml", "-o", "again")
    (told,) = lines(sonarrec("run", pings, *again).stderr)
    assert "tilt 22 deg, height 0.68 m (out/pings/run.toml); landmarks basin (out/" in told
    assert sonarrec("run", pings, *SHORT, "--overwrite", "-q").stderr == ""


@pytest.mark.usefixtures("pings")
def test_a_scene_s_own_landmarks_need_not_be_named() -> None:
    """Before, the set that lies beside the log was not taken: 'no landmark declared'."""
    rows = [[int(n <= k) for n in range(8)] for k in range(6)]
    text = "".join(
        f"[[landmark_set.landmark]]\nid = {10 + k}\nsectors = {row}\n" for k, row in enumerate(rows)
    )
    placed = "[[landmark]]\nid = 13\nground_m = 2.0\nazimuth_deg = 0.0\norientation_deg = 40.0\n"
    Path("mine.toml").write_text(SIX + text + placed)
    sonarrec("simulate", "--scene", "mine.toml", "-o", "log.mcap")
    (told,) = lines(sonarrec("run", "log.mcap", "-o", "out").stderr)
    assert "landmarks six (log.landmarks.toml)" in told
    run = tomllib.loads(Path("out/log/run.toml").read_text())
    assert [one["id"] for one in run["landmarks"]["landmark"]] == [10, 11, 12, 13, 14, 15]
    sonarrec("evaluate", "out/log", "-q")
    rows = read_rows(Path("out/log/evaluation/confusion.csv"))
    assert "13" in {row["landmark"] for row in rows}
    (told,) = lines(sonarrec("run", "log.mcap", "-o", "other", "--landmarks", "basin").stderr)
    assert "landmarks basin (option, basin)" in told


def test_many_logs_end_in_a_table_of_what_was_found(pings: Path) -> None:
    """Before, 20 logs ended in '19 done, 1 failed'."""
    shutil.copy(SAMPLE / "sonar.toml", "dives")
    shutil.copy(SAMPLE / "000002.png", pings)
    Path("dives/broken").mkdir()
    Path("dives/broken/0.png").write_text("no picture")
    logs = ("dives/broken", "dives/pings")
    told = sonarrec("run", *logs, "-j", "1", "-o", "out", code=3).stdout
    *_, head, broken, found = told.splitlines()
    assert head.split()[:4] == ["log", "frames", "notes", "state"]
    assert broken.split() == ["broken", "-", "-", "failed", "-"]
    assert found.split() == ["pings", "3", "0", "done", "ID.1:", "2"]
    again = sonarrec("run", *logs, "-j", "1", "-o", "out", code=3).stdout.splitlines()[-1]
    assert again.split() == ["pings", "3", "-", "up", "to", "date", "ID.1:", "2"]
    assert "ID.1" not in sonarrec("run", *logs, "-o", "out", "-q", code=3).output


@pytest.mark.parametrize(("pose", "told"), [("free", True), ("floor", False)])
def test_poses_that_plates_do_not_use_are_told(pose: str, told: bool, tmp_path: Path) -> None:
    log, tags, poses = tmp_path / "log", tmp_path / "tags.toml", tmp_path / "poses.csv"
    image_folder(log, frames(3))
    text = 'name = "tags"\nkind = "drawn"\nfamily = "actag24h10"\nids = [0, 2]\nsize_m = 0.3\n'
    tags.write_text(f'{text}pose = "{pose}"\n')
    poses.write_text("timestamp,yaw,x,y\n0,0,0,0\n1,1,0,0\n9,2,0,0\n")
    done = sonarrec("run", log, "-o", tmp_path / "out", "--landmarks", tags, "--odometry", poses)
    assert ("does not use the poses" in done.stderr) == told
