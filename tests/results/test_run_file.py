"""run.toml read back: what it tells, what is refused, and how it lies under what is given."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from sonarrec.cli import main
from sonarrec.records import SonarrecError
from sonarrec.results.run_file import Given, read_run
from sonarrec.results.same_log import check_same_log
from sonarrec.sonar import Sonar

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


@pytest.mark.parametrize("text", [None, ""])
def test_a_missing_and_an_empty_one_tell_nothing(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "run.toml" if text is None else written(tmp_path, text)
    run = read_run(path)
    assert run.finished
    assert run.methods is None
    assert run.fan() is None
    given = Given(Sonar(tilt_deg=5.0), topic="/a", time="log")
    assert run.lay_under(given, same_log=True) == given


def test_it_lies_under_what_is_given(tmp_path: Path) -> None:
    run = read_run(written(tmp_path, RUN))
    laid = run.lay_under(Given(Sonar(tilt_deg=5.0), time="log"), same_log=True)
    assert (laid.sonar.tilt_deg, laid.sonar.range_max_m) == (5.0, 4.0)
    assert (laid.topic, laid.time) == ("/sonar", "log")
    other = run.lay_under(Given(), same_log=False)
    assert (other.sonar.tilt_deg, other.topic, other.time) == (20.0, None, None)
    file = tmp_path / "sonar.toml"
    assert run.lay_under(Given(sonar_file=file), same_log=False).sonar == Sonar()


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        *((f"{name} = 3", f"{name} must be a table of keys, not 3") for name in (
            *("program", "input", "sonar", "fan", "landmarks", "odometry", "model", "config"),
        )),
        ("config = [1]", "config must be a table of keys, not 1"),
        ("finished = 1", "finished must be true or false, not 1"),
        ("[input]\nname = 3", "input.name must be a text, not 3"),
        ("[input]\nbytes = true", "input.bytes must be a whole number, not True"),
        ("[input]\ntime = 'noon'", "input.time must be log or publish or header, not 'noon'"),
        ("[input]\nproblems = [1]", "input.problems must be a text, not 1"),
        ("[program]\nmethods = 'smi'", "program.methods must be a list of texts, not 'smi'"),
        ("[odometry]\ntopic = 1", "odometry.topic must be a text, not 1"),
        ("finished =", "not a readable TOML file"),
    ],
)  # fmt: skip
def test_another_type_is_one_line(tmp_path: Path, text: str, fault: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(SonarrecError) as caught:
        read_run(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert fault in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["input", "sonar", "fan", "landmarks", "odometry", "config"])
def test_every_command_that_reads_it_says_so(tmp_path: Path, name: str) -> None:
    results = tmp_path / "log"
    results.mkdir()
    written(results, f"{name} = 3\n" + ("" if name == "config" else "[config]\nseed = 0\n"))
    (results / "frames.csv").write_text("frame\n0\n")
    (results / "estimates.csv").write_text(
        "frame,method,x_px,y_px,landmark,score,declared\n0,framework,1,1,1,0.5,0\n"
    )
    (tmp_path / "gt.csv").write_text("frame,landmark,x_px,y_px,visible\n0,1,1,1,1\n")
    run, truth = str(results / "run.toml"), str(tmp_path / "gt.csv")
    sample = str(Path(__file__).parents[2] / "sample_data" / "pan")
    for command in (
        ["evaluate", "--ground-truth", truth, str(results)],
        ["report", str(results)],
        ["overlay", sample, str(results), "--mcap", str(tmp_path / "o.mcap")],
        ["truth", "propose", str(results), "--out", str(tmp_path / "p.csv")],
        ["run", sample, "--config", run, "--out", str(tmp_path / "out")],
    ):
        told = CliRunner().invoke(main, command)
        assert told.exit_code in (1, 2), command
        assert f"{run}: " in told.stderr, command
        assert f"{name} must be a table" in told.stderr, command
        assert len(told.stderr.splitlines()) == 1, command


class OtherLog:
    path = Path("other.mcap")
    frame_count = 1

    def digest_source(self) -> tuple[int, str]:
        return 7, "abd"


def test_another_log_is_told_by_its_sha256_else_by_its_frames(tmp_path: Path) -> None:
    (tmp_path / "frames.csv").write_text("frame\n0\n1\n")
    run = read_run(written(tmp_path, RUN))
    with pytest.raises(SonarrecError, match=r"results of another log, dive .* not of other\.mcap"):
        check_same_log(OtherLog(), tmp_path, run)
    nothing = read_run(tmp_path / "gone.toml")
    with pytest.raises(SonarrecError, match=r"frame 1 is listed, but other\.mcap has only 1"):
        check_same_log(OtherLog(), tmp_path, nothing)
    (tmp_path / "frames.csv").write_text("frame\n0\n")
    check_same_log(OtherLog(), tmp_path, nothing)
