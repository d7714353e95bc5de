"""run.toml read back: what it tells, what is refused, and how it completes options."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.results.read import check_same_log
from sonarrec.results.run_file import LogOptions, read_run
from sonarrec.sonar.geometry import in_image, pixel_from_polar
from sonarrec.sonar.stated import Sonar
from tests.support.command import SAMPLE, sample_log, sonarrec
from tests.support.logs import frames, image_folder
from tests.support.slow import but_first

RUN = """\
finished = false
[program]
methods = ["smi", "framework"]
[input]
name = "dive"
bytes = 7
sha256 = "abc"
topic = "/sonar"
time = "header"
problems = ["frame 3: damaged, skipped"]
[sonar]
layout = "fan"
range_min_m = 1.0
range_max_m = 4.0
field_of_view_deg = 30.0
tilt_deg = 20.0
[fan]
rows = 300
columns = 200
metres_per_pixel = 0.01
apex_px = [99.5, 400.0]
later_key = 1
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "run.toml"
    path.write_text(text)
    return path


def test_what_it_tells(tmp_path: Path) -> None:
    run = read_run(written(tmp_path, RUN))
    assert not run.finished
    assert run.methods == ("smi", "framework")
    assert (run.input.name, run.input.bytes, run.input.sha256) == ("dive", 7, "abc")
    assert run.input.problems == ("frame 3: damaged, skipped",)
    fan = run.fan()
    assert fan is not None
    assert (fan.metres_per_pixel, fan.apex_column, fan.apex_row) == (0.01, 99.5, 400.0)
    assert run.landmark_set().name == "basin"


def test_the_fan_ends_with_the_image_and_where_none_is_stated_nowhere(tmp_path: Path) -> None:
    near_corner = np.array([1.02]), np.array([14.5])
    fan = read_run(written(tmp_path, RUN)).fan()
    assert fan is not None
    assert pixel_from_polar(fan, *near_corner)[1] > 300
    assert not in_image(fan, *near_corner)
    unstated = RUN.replace("rows = 300\ncolumns = 200\n", "")
    fan = read_run(written(tmp_path, unstated)).fan()
    assert fan is not None
    assert in_image(fan, *near_corner)
    for rows in ('"many"', "0"):
        wrong = RUN.replace("rows = 300", f"rows = {rows}")
        with pytest.raises(SonarrecError, match=r"run\.toml: fan\.rows"):
            read_run(written(tmp_path, wrong))


@pytest.mark.parametrize("text", [None, ""])
def test_a_missing_and_an_empty_one_tell_nothing(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "run.toml" if text is None else written(tmp_path, text)
    run = read_run(path)
    assert run.finished
    assert run.methods is None
    assert run.fan() is None
    log_options = LogOptions(Sonar(tilt_deg=5.0), topic="/a", time="log")
    assert run.complete(log_options, same_log=True) == log_options


def test_it_lies_under_what_is_given(tmp_path: Path) -> None:
    run = read_run(written(tmp_path, RUN))
    laid = run.complete(LogOptions(Sonar(tilt_deg=5.0), time="log"), same_log=True)
    assert (laid.sonar.tilt_deg, laid.sonar.range_max_m) == (5.0, 4.0)
    assert (laid.topic, laid.time) == ("/sonar", "log")
    other = run.complete(LogOptions(), same_log=False)
    assert (other.sonar.tilt_deg, other.topic, other.time) == (20.0, None, None)
    file = tmp_path / "sonar.toml"
    assert run.complete(LogOptions(sonar_file=file), same_log=False).sonar == Sonar()


class OtherLog:
    path = Path("other.mcap")
    frame_count = 1

    def digest_source(self) -> tuple[int, str]:
        return 7, "abd"


def test_another_log_is_told_by_its_sha256_else_by_its_frames(tmp_path: Path) -> None:
    (tmp_path / "frames.csv").write_text("frame\n0\n1\n")
    run = read_run(written(tmp_path, RUN))
    with pytest.raises(SonarrecError, match=r"dive.* other\.mcap"):
        check_same_log(OtherLog(), tmp_path, run)
    nothing = read_run(tmp_path / "gone.toml")
    with pytest.raises(SonarrecError, match="frame 1 "):
        check_same_log(OtherLog(), tmp_path, nothing)
    (tmp_path / "frames.csv").write_text("frame\n0\n")
    check_same_log(OtherLog(), tmp_path, nothing)


def test_of_the_same_log_the_topic_of_poses_serves_again(tmp_path: Path) -> None:
    """`site` left it out, and measured in the images what the run had been told."""
    (tmp_path / "run.toml").write_text('finished = true\n[odometry]\ntopic = "/odom"\n')
    run = read_run(tmp_path / "run.toml")
    assert run.complete(LogOptions(), same_log=True).odometry_topic == "/odom"
    assert run.complete(LogOptions(), same_log=False).odometry_topic is None
    table = LogOptions(odometry=tmp_path / "poses.csv")
    assert run.complete(table, same_log=True).odometry_topic is None
    (tmp_path / "run.toml").write_text('finished = true\n[odometry]\nname = "poses.csv"\n')
    run = read_run(tmp_path / "run.toml")
    run.check_poses(table)
    with pytest.raises(UsageError, match="odometry poses\\.csv"):
        run.check_poses(run.complete(LogOptions(), same_log=True))


def test_rows_that_were_cut_since_are_told_and_run_anew(tmp_path: Path) -> None:
    """Whole lines off the end of a table, or all of them, were taken for what the run wrote."""
    log = image_folder(tmp_path / "log", frames(4, 80, 100))
    run, folder = ("run", log, "-o", tmp_path / "out", "-q"), tmp_path / "out" / "log"
    truth = tmp_path / "gt.csv"
    truth.write_text("frame,landmark,range_m,bearing_deg\n0,1,2.0,0.0\n")
    score = ("evaluate", folder, "--ground-truth", truth, "-q")
    sonarrec(*run)
    whole = {name: (folder / name).read_bytes() for name in ("frames.csv", "estimates.csv")}
    before = sonarrec(*score).stderr
    for name, key in (("frames.csv", "frames_processed"), ("estimates.csv", "estimates")):
        lines = whole[name].splitlines(keepends=True)
        table = tomllib.loads((folder / "run.toml").read_text())
        assert table["input"][key] == len(lines) - 1 > 0
        (folder / name).write_bytes(b"".join(lines[:-1]).rstrip(b"\n"))
        lost = f"{name} holds {len(lines) - 2} of the {len(lines) - 1} rows that the run wrote"
        assert f"log: {lost}" in sonarrec(*score, code=3).stderr
        (folder / name).write_bytes(lines[0])
        assert f"replaced ({name} holds 0 of the" in sonarrec(*run).stderr
        assert {name: (folder / name).read_bytes() for name in whole} == whole
    assert sonarrec(*score).stderr == before
    run_toml = folder / "run.toml"
    run_toml.write_text(run_toml.read_text().replace("estimates = ", 'estimates = "x" # '))
    assert "input.estimates" in sonarrec(*score, code=1).stderr


@pytest.mark.parametrize("name", but_first(["estimates.csv", "sightings.csv", "frames.csv"]))
def test_tables_that_were_edited_are_told_and_run_anew(name: str, tmp_path: Path) -> None:
    """Another ID in the last row, or a row more."""
    log, folder = sample_log(tmp_path / "pan", 8), tmp_path / "out" / "pan"
    sonarrec("run", log, "-o", tmp_path / "out", "-q")
    truth, drawn = SAMPLE / "gt.csv", ("-o", tmp_path / "o.mcap")
    usual = sonarrec("evaluate", folder, "--ground-truth", truth, "-q", code=3).stderr
    sonarrec("overlay", log, folder, *drawn)
    whole = (folder / name).read_bytes()
    *lines, last = whole.splitlines(keepends=True)
    more = [last, last.replace(b"7,", b"99,", 1)]
    changed = more if name == "frames.csv" else [last.replace(b"1", b"2", 1)]
    (folder / name).write_bytes(b"".join([*lines, *changed]))
    told = sonarrec("evaluate", folder, "--ground-truth", truth, "-q", code=3).stderr
    assert f"{name} was changed" in told
    assert f"{name} was changed" not in usual
    assert f"{name} was changed" in sonarrec("overlay", log, folder, *drawn, code=3).stderr
    assert f"{name} was changed" in sonarrec("run", log, "-o", tmp_path / "out").stderr
    assert (folder / name).read_bytes() == whole
    assert "up to date" in sonarrec("run", log, "-o", tmp_path / "out").stdout
