"""What a person mistypes is answered by what was meant: each kind in several forms."""

from __future__ import annotations

import contextlib
import math
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from sonarrec.cli import main
from sonarrec.errors import SonarrecError, plain_number
from sonarrec.landmarks import BUILT_IN
from sonarrec.tables.toml import parse_toml
from tests.support.command import SAMPLE, sample_log, sonarrec
from tests.support.rows import read_rows, write_rows


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working folder with a log, its truth, and its results."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(sample_log(folder / "dive", 4), folder / "my long dive")
    shutil.copy(SAMPLE / "gt.csv", folder / "truth.csv")
    (folder / "logs2").mkdir()
    (folder / "logs2" / "new.mcap").write_bytes(b"\x89MCAP0\r\n")
    (folder / "c.toml").write_text('[[log]]\npath = "logs2\\new.mcap"\n')
    (folder / "model.toml").write_text('reader = "0"\n')
    shutil.copy(SAMPLE / "000000.png", folder / "photo.mp4")
    shutil.move(sample_log(folder / "bare", 1) / "sonar.toml", folder / "bare" / "sonar.toml.txt")
    with contextlib.chdir(folder):
        sonarrec("run", "dive", "-q")
    return folder


@pytest.fixture
def here(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, to work in."""
    monkeypatch.chdir(shutil.copytree(site, tmp_path, dirs_exist_ok=True))
    return tmp_path


def refused(*words: str) -> str:
    """What a command says that ends as bad usage or as failed."""
    done = CliRunner().invoke(main, [*words])
    assert done.exit_code in (1, 2, 3), done.output
    return done.stderr


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        # A name that is not there
        ("run dvie", "dive?"),
        ("info Dive.", "dive?"),
        ("evaluate sonarrec_out/diev", "sonarrec_out/dive?"),
        ("report sonarec_out", "sonarrec_out?"),
        ("evaluate --ground-truth truth.cvs", "truth.csv?"),
        ("run my long dive", "'my long dive'"),
        ("report my long dive", "quotes"),
        # Arguments exchanged
        ("evaluate truth.csv sonarrec_out/dive", "--ground-truth"),
        ("evaluate truth.csv", "--ground-truth"),
        ("truth check dive truth.csv", "table first"),
        ("calibrate sonarrec_out/dive -o m.toml", "the log is dive"),
        ("calibrate truth.csv -o m.toml", "a table, not a log"),
        ("truth review dive sonarrec_out/dive", "results are given with --results"),
        ("truth review dive truth.csv", "a ground truth is given with --truth"),
        ("evaluate sonarrec_out/dive truth.csv", "a ground truth is given with --ground-truth"),
        ("evaluate --compare sonarrec_out/dive dive/../sonarrec_out/dive", "one folder"),
        ("run dive -landmarks basin", "--landmarks?"),
        ("run dive --config dive/sonar.toml", "--sonar"),
        ("run dive --sonar truth.csv", "CSV"),
        # Dashes, quotes and spaces of a word processor or a web page
        ("run dive \N{EN DASH}o out2", "type -o"),
        ("run dive \N{EM DASH}out=out2", "type --out=out2"),
        ("run dive --tilt-deg \N{MINUS SIGN}30", "type -30"),
        ("\N{EN DASH}q run dive", "type -q"),
        ("run \N{LEFT DOUBLE QUOTATION MARK}dive\N{RIGHT DOUBLE QUOTATION MARK}", "type 'dive'"),
        ("run dive\u00a0-q", "space"),
        # Paths of other systems
        ("run logs2\\new.mcap", "did you mean logs2/new.mcap?"),
        ("info dive --sonar dive\\sonar.toml", "did you mean dive/sonar.toml?"),
        ("check c.toml", "did you mean logs2/new.mcap?"),
        ("run ~/dive", "home"),
        ("run dive -o ~/out", "home"),
        # A file of another kind, or a folder
        ("run dive --landmarks dive/000000.png", "image"),
        ("check logs2/new.mcap", "MCAP"),
        ("evaluate sonarrec_out/dive --ground-truth logs2/new.mcap", "MCAP"),
        ("run photo.mp4", "kind image"),
        ("check sonarrec_out", "a folder"),
        ("run dive --config model.toml", "--model"),
        ("run bare", "call it sonar.toml"),
        # Numbers of an option
        ("map --origin 54,3233 10,1394", "LAT,LON,HEADING"),
        ("map sonarrec_out/dive --origin 54.3,10.1", "LAT,LON,HEADING"),
        # The command left out, or not first
        ("dive", "run dive"),
        ("-q run dive", "command comes first"),
        ("--height-m .7 run dive", "command comes first"),
        # An output of another kind
        ("overlay dive -o x.avi", ".mp4"),
        ("overlay dive -o x.GIF", ".mcap"),
        ("report sonarrec_out/dive -o r.pdf", ".html"),
        ("map sonarrec_out/dive -o m.html", "folder"),
        ("run dive -o results.csv", "folder"),
        ("export sonarrec_out/dive -o x.xlsx", ".json"),
        ("truth propose sonarrec_out/dive -o p.txt", ".csv"),
    ],
)
def test_a_slip_is_answered_by_what_was_meant_and_writes_nothing(
    words: str, meant: str, here: Path
) -> None:
    before = {*here.rglob("*")}
    assert meant in refused(*words.split(" "))
    assert {*here.rglob("*")} == before


@pytest.mark.parametrize("log", [".", "./", "./.", "..", "../", "in/..", "../dive/", "../dive/."])
def test_the_current_folder_and_the_one_above_are_logs_and_results(
    log: str, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "dive" / "in").mkdir()
    monkeypatch.chdir(here / "dive" / "in" if log in ("..", "../") else here / "dive")
    assert "dive: 4 frames" in sonarrec("run", log, "-o", here / "out").stdout
    shutil.copy(here / "truth.csv", here / "dive" / "gt.csv")
    shutil.copytree(here / "out" / "dive", here / "out2" / "dive")
    (here / "out2" / "dive" / "in").mkdir()
    monkeypatch.chdir(here / "out2" / "dive" / Path.cwd().relative_to(here / "dive"))
    assert "TPR" in sonarrec("evaluate", log, code=3).stdout
    # "." of the run is not the current folder, though a log is there, too.
    monkeypatch.chdir(here / "bare")
    assert "TPR" in sonarrec("evaluate", here / "out" / "dive", code=3).stdout


@pytest.mark.usefixtures("here")
def test_a_model_that_was_learned_from_the_log_it_is_scored_on_is_told() -> None:
    log = sample_log(Path("pool"), 12)
    rows = [row for row in read_rows(SAMPLE / "gt.csv") if int(row["frame"]) < 12]
    write_rows(log / "gt.csv", rows)
    shutil.copytree(log, "other")
    sonarrec("calibrate", log, "-o", "m.toml")
    for name in ("pool", "other"):
        sonarrec("run", name, "--model", "m.toml", "-q")
        results = f"sonarrec_out/{name}"
        sonarrec("run", name, "-o", "plain", "-q")
        for words in ((results,), ("--compare", f"plain/{name}", results)):
            told = "learned from" in sonarrec("evaluate", *words).stdout
            assert told == (name == "pool")


def test_a_geometry_under_another_name_is_told_by_info(here: Path) -> None:
    assert "sonar.toml.txt" in sonarrec("info", "bare").stdout
    (here / "bare" / "sonar.toml.txt").rename(here / "bare" / "sonar.toml")
    assert "lacks" not in sonarrec("info", "bare").stdout


@pytest.mark.parametrize(
    ("options", "frames", "meant"),
    [
        ("--config other/run.toml", "1:3", "height_m"),
        ("--sonar other/run.toml", "1:3", "height_m"),
        ("--config sonarrec_out/dive/run.toml", "1:3", ""),
        ("--sonar sonarrec_out/dive/run.toml", "1:3", ""),
        ("--sonar other/run.toml --height-m 0.68", "1:3", ""),
        ("--sonar beams.toml", "1:3", "beams.toml is used"),
    ],
)
def test_a_geometry_that_is_used_in_place_of_the_logs_own_is_told(
    options: str, frames: str, meant: str, here: Path
) -> None:
    sample_log(here / "else", 3)
    text = (here / "dive" / "sonar.toml").read_text()
    (here / "else" / "sonar.toml").write_text(re.sub("height_m.*", "height_m = 0.9", text))
    sonarrec("run", "else", "-q", "-o", "o")
    (here / "o" / "else").rename(here / "other")
    polar = text.replace('"fan"', '"polar"') + "bearings_deg = [-1, 0, 1]\n"
    (here / "beams.toml").write_text(re.sub("field_of_view_deg.*\n", "", polar))
    words = "run", "dive", *options.split(), "--frames", frames, "-q", "-o", here / "out"
    told = sonarrec(*words, code=1 if "beams" in options else 0).stderr
    assert ("log's own dive/sonar.toml" in told) == bool(meant)
    assert meant in told


@pytest.mark.parametrize(
    ("name", "like", "meant"),
    [
        ("d1_sonar.toml", "sonar.toml", "d1.sonar.toml"),
        ("d1_landmarks.toml", "landmarks.toml", "d1.landmarks.toml"),
        ("landmark.toml", "landmarks.toml", "d1.landmarks.toml"),
        ("d2_sonar.toml", "sonar.toml", ""),
        ("d2.landmarks.toml", "landmarks.toml", ""),
        ("d1.landmarks.toml", "landmarks.toml", ""),
        ("d1_notes.txt", "truth.csv", ""),
    ],
)
def test_a_file_of_the_log_under_another_name_is_told_where_one_is_found(
    name: str, like: str, meant: str, here: Path
) -> None:
    shutil.move(here / "dive" / "000000.png", here / "d1.png")
    shutil.move(here / "dive" / "sonar.toml", here / "sonar.toml")
    shutil.copy(BUILT_IN / "basin.toml", here / "landmarks.toml")
    shutil.copy(here / like, here / name)
    (here / "landmarks.toml").unlink()
    told = sonarrec("run", "d1.png", "-q", "-o", "out").stderr
    assert ("call it" in told) == bool(meant)
    assert meant in told


@pytest.mark.parametrize(
    "name", ["gt.csv.txt", "GT.csv", "gt (1).csv", "dive.gt(2).csv", "Dive.gt.csv.csv"]
)
def test_a_truth_or_poses_under_another_name_are_told(name: str, here: Path) -> None:
    words = "evaluate", "sonarrec_out/dive"
    shutil.copy("truth.csv", here / "dive" / name)
    assert f"{name} is there: call it dive.gt.csv" in refused(*words)
    shutil.copy("truth.csv", here / "dive" / "gt.csv")
    os.utime(here / "dive" / name, (2e9, 2e9))
    assert f"{name} is newer" in sonarrec(*words, code=3).stderr
    os.utime(here / "dive" / name, (1e9, 1e9))
    assert name not in sonarrec(*words, code=3).stderr
    for other in ("dive.gt_old.csv", "other.gt.csv", "gt_2.csv"):
        (here / "dive" / name).replace(here / "dive" / other)
        name = other
        assert name not in sonarrec(*words, code=3).stderr
    shutil.move("dive/gt.csv", "dive/dive.gt.csv")
    shutil.copy("truth.csv", "dive/gt (3).csv")  # perhaps of another log
    assert "gt (3)" not in sonarrec(*words, code=3).stderr
    Path("dive/Poses.csv").write_text("timestamp,yaw\n0,0\n1,0\n")
    assert "Poses.csv is there" in sonarrec("run", "dive", "-q", "-o", "out").stderr


@pytest.mark.parametrize(
    ("text", "meant"),
    [("0,68", "0.68"), ("-1,5", "-1.5"), (",5", ".5"), ("20°", "alone"), ("3 m", "alone")],
)
def test_a_number_is_written_with_a_point_and_alone(text: str, meant: str) -> None:
    assert meant in plain_number(text)
    assert not plain_number("north")
    option = CliRunner().invoke(main, ["run", "x", f"--range-min-m={text}"]).stderr
    assert meant in " ".join(option.split())
    with pytest.raises(SonarrecError):
        parse_toml(f"range_min_m = {text}", "x")


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("flip = True", "flip = true"),
        ("flip = No", "true or"),
        ("height_m = None", "delete"),
        ("height_m = .68", "0.3"),
        ("height_m = 0.68 m", "unit"),
        ("height_m: 0.68", "equals"),
        ("bearings_deg = (1, 2)", "square"),
        ("layout = fan", 'layout = "fan"'),
        ("layout = \N{LEFT DOUBLE QUOTATION MARK}fan\N{RIGHT DOUBLE QUOTATION MARK}", "straight"),
        (r'path = "logs\pan.mcap"', "in place of"),
        (r'path = "C:\Users\pan.mcap"', "in place of"),
        ("// mine", "#"),
        ("a = 1\na = 2", "twice"),
    ],
)
def test_a_line_that_is_no_toml_is_answered_by_how_it_is_written(line: str, meant: str) -> None:
    with pytest.raises(SonarrecError, match=meant):
        parse_toml(line, "x")


@pytest.mark.parametrize(
    ("header", "meant"),
    [
        ("frame,landmark,u,v", "x_px, y_px"),
        ("frame,landmark,cx,cy", "x_px, y_px"),
        ("frame,landmark,slant_range,azimuth", "range_m, bearing_deg"),
        ("frame,id,x_px,y_px", "id to landmark"),
        ("Frame,landmark,x_px,y_px", "Frame to frame"),
        ("frame;landmark;x_px;y_px", "commas"),
    ],
)
@pytest.mark.usefixtures("here")
def test_columns_of_other_programs_are_told_as_ours(header: str, meant: str) -> None:
    separator = ";" if ";" in header else ","
    Path("gt.csv").write_text(f"{header}\n{separator.join('1123')}\n")
    assert meant in refused("evaluate", "sonarrec_out/dive", "--ground-truth", "gt.csv")


def test_pictures_of_results_may_lie_next_to_photos(here: Path) -> None:
    for n in range(1, 4):
        shutil.copy(here / "dive" / "000000.png", here / f"photo{n}.png")
    for out in ("shots", "shots.mp4"):
        sonarrec("overlay", "dive", "-o", out)
    assert "photo" in refused("info", "dive", "--preview", "p.png")
    # A single image with its sonar.toml is a log, too, next to which its results may lie.
    (here / "one").mkdir()
    shutil.copy(here / "dive" / "000001.png", here / "one" / "pic.png")
    shutil.copy(here / "dive" / "sonar.toml", here / "one")
    sonarrec("run", "one/pic.png", "-o", "out")
    sonarrec("overlay", "one/pic.png", "out", "-o", "one/drawn")
    for out in ("dive/x.mp4", "dive/shots"):
        assert "become a part" in refused("overlay", "dive", "-o", out)


@pytest.mark.parametrize(("key", "value"), [("field_of_view_deg", 0.5), ("tilt_deg", 0.35)])
def test_angles_in_radians_are_told(here: Path, key: str, value: float) -> None:
    option = f"--{key.replace('_', '-')}"
    told = sonarrec("run", "dive", option, value, "-o", here / "out", "-q").stderr
    assert "in radians" in told
    assert "in radians" not in sonarrec("run", "dive", "-o", here / "out", "-q").stderr


@pytest.mark.parametrize(
    ("options", "meant"),
    [
        (("--frame-rate-hz", "250"), "write 4"),
        (("--tilt-deg", "80", "--range-min-m", "0.75"), "axis meets the floor at 0.69 m"),
    ],
)
def test_a_stated_geometry_that_cannot_be_is_told(
    here: Path, options: tuple[str, ...], meant: str
) -> None:
    assert meant in sonarrec("run", "dive", *options, "-o", here / "out", "-q").stderr
    assert meant not in sonarrec("run", "dive", "-o", here / "out", "-q").stderr


def test_a_scene_of_which_nothing_comes_into_view_is_told(tmp_path: Path) -> None:
    near, far = tmp_path / "near", tmp_path / "far.toml"
    assert not sonarrec("simulate", "--frames", 2, "-o", near, "-q").stderr
    metres = re.compile("^ground_m = .*", re.MULTILINE)
    far.write_text(metres.sub("ground_m = 1800.0", (near / "scene.toml").read_text()))
    assert "into view" in sonarrec("simulate", "--scene", far, "-o", tmp_path / "o", "-q").stderr


@pytest.mark.usefixtures("here")
def test_a_run_of_one_frame_has_no_hints_that_cannot_help() -> None:
    words = ("--frames", "1:2", "--set", "features.declare_alone=1", "-q")
    told = sonarrec("run", "dive", *words).stderr
    assert "single frame" in told
    assert "--range-order" not in told


@pytest.mark.parametrize("text", ["two", "2.5", "4 cores"])
def test_a_whole_number_is_asked_for_with_an_example(text: str) -> None:
    assert "such as 2" in refused("run", "x", "--jobs", text)


@pytest.mark.usefixtures("here")
def test_a_command_of_one_method_takes_one() -> None:
    assert "smi" in refused("map", "sonarrec_out/dive", "--method", "framework", "--method", "smi")


@pytest.mark.parametrize(
    ("option", "value", "meant"), [("--within", "15", "0.15"), ("--tolerance", "125", "0.125")]
)
def test_a_tolerance_larger_than_the_log_is_asked_for_in_its_unit(
    option: str, value: str, meant: str, tmp_path: Path
) -> None:
    call = "evaluate", SAMPLE.parent / "regression" / "pan", "--ground-truth"
    call = *call, SAMPLE.parent / "pan.gt.csv", "-q", "-o", tmp_path / "out", option
    assert meant in sonarrec(*call, value, code=2).stderr
    assert not (tmp_path / "out").exists()
    sonarrec(*call, meant)


def test_a_log_that_moved_is_told_by_the_report(here: Path) -> None:
    shutil.move(here / "dive", here / "elsewhere")
    told = sonarrec("report", "sonarrec_out/dive", code=3).stderr
    assert "--log" in told
    assert "--ground-truth" in told
    given = ("--log", "elsewhere", "--ground-truth", "truth.csv")
    # The truth is of the whole recording.
    assert "click" in sonarrec("report", "sonarrec_out/dive", *given, code=3).stdout


@pytest.mark.parametrize(
    ("column", "slip", "meant"),
    [
        ("range_m", lambda range_m: (range_m**2 - 0.68**2) ** 0.5, "slant range"),
        ("orientation_deg", math.radians, "in degrees"),
        ("range_m", float, None),
    ],
)
def test_a_truth_that_is_off_throughout_is_told(
    column: str, slip: Callable[[float], float], meant: str | None, tmp_path: Path
) -> None:
    header = ["frame", "landmark", "range_m", "bearing_deg", "visible", "orientation_deg"]
    rows = [{k: row[k] for k in header} for row in read_rows(SAMPLE / "gt.csv")]
    for row in rows:
        row[column] = str(slip(float(row[column])))
    write_rows(tmp_path / "truth.csv", rows)
    results = SAMPLE.parent / "regression" / "pan"
    call = "evaluate", results, "--ground-truth", tmp_path / "truth.csv", "-q"
    told = sonarrec(*call, "-o", tmp_path / "out").stderr
    assert ("claims on them" in told) == bool(meant)
    assert (meant or "") in told


def test_logs_that_failed_are_named_where_others_are_scored(tmp_path: Path) -> None:
    sample_log(tmp_path / "good", 4)
    (tmp_path / "bad.mcap").write_bytes(b"\x89MCAP0\r\n")
    sonarrec("run", tmp_path / "good", tmp_path / "bad.mcap", "-q", "-o", tmp_path / "out", code=3)
    call = "evaluate", tmp_path / "out", "--ground-truth", SAMPLE / "gt.csv", "-q"
    assert "1 log failed: bad" in sonarrec(*call, code=3).stderr


def test_rates_of_each_log_are_printed_where_details_are_asked_for(tmp_path: Path) -> None:
    for name in ("pan", "faint", "polar"):
        shutil.copy(SAMPLE.parent / name / "gt.csv", tmp_path / f"{name}.gt.csv")
    call = "evaluate", SAMPLE.parent / "regression", "--ground-truth", tmp_path
    call = *call, "-o", tmp_path / "out"
    assert "per log" not in sonarrec(*call).stdout
    assert "per log" in sonarrec(*call, "-v").stdout
