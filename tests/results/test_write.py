"""Results on disk against the contract of the README."""

import dataclasses
import os
import tomllib

import numpy as np
import pytest

from sonarrec import config
from sonarrec.errors import SonarrecError
from sonarrec.landmarks import landmarks_from_table, load_landmarks
from sonarrec.results.columns import estimate_columns
from sonarrec.results.run_file import read_run, run_table
from sonarrec.results.write import AT_ONCE, ResultsWriter
from sonarrec.sonar.frame import Estimate, Fan, FrameResult, Motion, Stamps
from sonarrec.sonar.stated import Sonar, sonar_from_table
from tests.support.drawn import make_fan
from tests.support.rows import read_rows

BASIN = load_landmarks("basin")
CONTRACT = (
    "frame,timestamp_ns,method,object,x_px,y_px,range_m,bearing_deg,orientation_deg,existence,"
    "p_1,p_2,p_3,p_4,p_none,landmark,score,declared"
)
SONAR = Sonar(
    layout="fan", range_min_m=1.25, range_max_m=3.75, field_of_view_deg=28.8, tilt_deg=20.0
)


def estimate(**changed) -> Estimate:
    values = {
        "method": "framework",
        "object": 3,
        "x_px": 101.256,
        "y_px": 55.5,
        "range_m": 2.03694,
        "bearing_deg": -7.12345,
        "orientation_deg": 95.25,
        "existence": 0.98765,
        "probabilities": np.array([0.7, 0.1, 0.05, 0.05, 0.1]),
        "landmark": 1,
        "score": 0.6913,
        "declared": True,
    }
    return Estimate(**(values | changed))


def result(index: int = 0, *estimates: Estimate) -> FrameResult:
    return FrameResult(index, index * 250_000_000, 4, 2, estimates)


def tables(fan: Fan | None = None) -> dict:
    source = ("log_a", 12345, "0" * 64)
    methods = ("smi", "framework")
    return run_table([config.preset("default")], methods, SONAR, fan or make_fan(), BASIN, source)


def test_headers_are_the_contract_s(tmp_path):
    with ResultsWriter(tmp_path / "log_a", BASIN, tables()) as writer:
        writer.finish([])
    header = (tmp_path / "log_a/estimates.csv").read_text().splitlines()
    assert header == [CONTRACT + ",range_sigma_m,bearing_sigma_deg,orientation_sigma_deg,read"]
    assert (tmp_path / "log_a/frames.csv").read_bytes() == (
        b"frame,timestamp_ns,candidates,tracks,log_time_ns,publish_time_ns,header_stamp_ns,"
        b"dx_m,dy_m,dyaw_deg,dx_sigma_m,dy_sigma_m,dyaw_sigma_deg,stretch\n"
    )
    assert [c.name for c in estimate_columns((7, 12))][10:13] == ["p_7", "p_12", "p_none"]


def test_what_is_written_is_what_was_estimated(tmp_path):
    rng = np.random.default_rng(0)
    given = []
    for i in range(40):
        p = rng.dirichlet(np.full(5, 0.3))
        best = int(p[:4].argmax()) + 1
        given.append(estimate(object=i, probabilities=p, landmark=best, declared=i % 2 == 0))
    told = Motion(-1.25, 0.1, -0.02)
    seen = Motion(0.3, 0.0, 0.05, 0.03125, 0.001234, 0.002)
    with ResultsWriter(tmp_path, BASIN, tables()) as writer:
        writer.write(result(5, *given[:30]))
        writer.write(result(6), Stamps(log=1500000001, header=-7))
        writer.write(dataclasses.replace(result(7, *given[30:]), motion=told))
        writer.write(dataclasses.replace(result(8), motion=seen, stretch=3))
        writer.finish([])
    assert (tmp_path / "frames.csv").read_text().splitlines()[1:] == [
        "5,1250000000,4,2,,,,,,,,,,0",
        "6,1500000000,4,2,1500000001,,-7,,,,,,,0",
        "7,1750000000,4,2,,,,0.10000,-0.02000,-1.2500,,,,0",
        "8,2000000000,4,2,,,,0.00000,0.05000,0.3000,0.00123,0.00200,0.0312,3",
    ]
    body = read_rows(tmp_path / "estimates.csv")
    assert [row["frame"] for row in body] == ["5"] * 30 + ["7"] * 10
    for row, e in zip(body, given, strict=True):
        p = np.array([float(row[f"p_{name}"]) for name in (1, 2, 3, 4, "none")])
        assert p.sum() == pytest.approx(1, abs=3e-6)  # five values rounded to 1e-6
        np.testing.assert_allclose(p, e.probabilities, atol=5.1e-7)
        assert int(row["landmark"]) == e.landmark
        assert row["declared"] == str(int(e.declared))
        assert float(row["x_px"]) == pytest.approx(e.x_px, abs=0.0051)
        assert float(row["range_m"]) == pytest.approx(e.range_m, abs=5.1e-5)
        assert float(row["bearing_deg"]) == pytest.approx(e.bearing_deg, abs=5.1e-4)
        assert float(row["score"]) == pytest.approx(e.score, abs=5.1e-7)
        assert row["method"] == "framework"


def test_run_toml_says_finished_only_at_the_end(tmp_path):
    def run(folder: str) -> dict:
        return tomllib.loads((tmp_path / folder / "run.toml").read_text())

    with ResultsWriter(tmp_path / "log_a", BASIN, tables()) as writer:
        assert run("log_a.part")["finished"] is False
        writer.write(result(0, estimate()))
        assert run("log_a.part")["finished"] is False
        assert not (tmp_path / "log_a").exists()
        writer.finish(["000007.png: cannot be read"])
    assert run("log_a")["finished"] is True
    assert run("log_a")["input"]["frames_processed"] == 1
    assert run("log_a")["input"]["problems"] == ["000007.png: cannot be read"]
    assert [p.name for p in tmp_path.iterdir()] == ["log_a"]
    assert not list((tmp_path / "log_a").glob("*.part"))


def test_run_toml_holds_all_that_the_run_needs_again(tmp_path):
    with ResultsWriter(tmp_path, BASIN, tables()) as writer:
        writer.finish([])
    file = tmp_path / "run.toml"
    table = tomllib.loads(file.read_text())
    assert (table["input"]["name"], table["input"]["bytes"]) == ("log_a", 12345)
    assert len(table["input"]["sha256"]) == 64
    assert table["program"]["version"]
    assert config.configs(path=file) == [config.preset("default")]
    assert landmarks_from_table(table["landmarks"], "run.toml") == BASIN
    assert sonar_from_table(table["sonar"], "run.toml") == SONAR  # as stated, nothing added
    assert read_run(file).fan() == make_fan()


def test_a_fan_that_looks_aside_is_read_back_as_it_was(tmp_path):
    """A field of view alone would put it evenly to both sides."""
    aside = dataclasses.replace(make_fan(), bearing_min_deg=1.6, bearing_max_deg=30.4)
    with ResultsWriter(tmp_path, BASIN, tables(aside)) as writer:
        writer.finish([])
    run = read_run(tmp_path / "run.toml")
    assert run.fan() == aside
    assert run.fan(Sonar(field_of_view_deg=20.0)).bearing_min_deg == -10


def test_a_frame_waits_for_others_but_no_longer_than_a_second(tmp_path, monkeypatch):
    def written() -> list[int]:
        return [int(row["frame"]) for row in read_rows(tmp_path / "log_a.part/frames.csv")]

    now = 0.0
    monkeypatch.setattr("sonarrec.results.write.monotonic", lambda: now)
    with ResultsWriter(tmp_path / "log_a", BASIN, tables()) as writer:
        for i in range(AT_ONCE + 3):
            writer.write(result(i, estimate()))
        assert written() == [*range(AT_ONCE)]
        now = 1.1
        writer.write(result(AT_ONCE + 3))
        assert written() == [*range(AT_ONCE + 4)]
        writer.write(result(AT_ONCE + 4))
    assert written() == [*range(AT_ONCE + 5)]


@pytest.mark.parametrize("taken", ["file in the way", "no permission"])
def test_a_folder_that_cannot_be_written_is_one_line(tmp_path, taken):
    folder = tmp_path / "out"
    if taken == "file in the way":
        folder.write_text("")
    else:
        folder.mkdir(mode=0o500)
        if os.access(folder, os.W_OK):
            pytest.skip("this user may write everywhere")
    with pytest.raises(SonarrecError) as caught:
        ResultsWriter(folder / "log_a", BASIN, tables())
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)
    assert "--out" in str(caught.value)
