"""`sonarrec overlay`: what it finds, what it refuses, and what it leaves."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import pytest
from click.testing import Result

from sonarrec.overlays import overlay as overlays
from sonarrec.readers import open_log
from tests.support import command
from tests.support.camp import make_camp
from tests.support.estimates import BASIN, csv_file, moving, noise, write_results
from tests.support.foxglove import messages
from tests.support.logs import image_folder


def draw(*arguments: str | Path, code: int = 0) -> Result:
    result = command.sonarrec("overlay", *arguments, code=code)
    assert (code == 0) == (result.stderr == "")
    return result


def names(folder: Path | str) -> list[str]:
    return sorted(path.name for path in Path(folder).iterdir())


def set_run(before: str, after: str) -> Path:
    """Change the run.toml of the results; returns it."""
    run = Path("sonarrec_out/log/run.toml")
    text = run.read_text()
    assert before in text
    run.write_text(text.replace(before, after))
    return run


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a log, `log`, and what `sonarrec run` would leave of it."""
    monkeypatch.chdir(tmp_path)
    image_folder(tmp_path / "log", noise(4))
    with open_log("log") as log:
        size, sha256 = log.digest_source()
        sonar = log.sonar.as_table()
    run = {
        "input": {"name": "log", "bytes": size, "sha256": sha256},
        "sonar": sonar,
        "landmarks": BASIN.as_table(),
    }
    write_results(tmp_path / "sonarrec_out" / "log", moving(4), run)
    return tmp_path


@pytest.mark.usefixtures("work")
def test_the_command() -> None:
    Path("log/sonar.toml").unlink()  # run.toml tells the geometry
    for out in ("o.mcap", "o.mp4", "shots"):
        assert draw("log", "-o", out).stdout == f"{out}: 4 frames, framework\n"
    assert Path("o.mp4").is_file()
    assert len(list(messages(Path("o.mcap")))) == 8
    assert len(names("shots")) == 4
    draw("log", "sonarrec_out/log", "-o", "one", "--frames", "2:3", "-q")
    assert names("one") == ["000002.png"]
    one, other = (Path(folder, "000002.png").read_bytes() for folder in ("one", "shots"))
    assert one == other  # what came before is in its strip all the same


@pytest.mark.usefixtures("work")
def test_a_list_of_frames() -> None:
    draw("log", "-o", "some", "--frames", "0:2, 3", "-q")
    assert names("some") == ["000000.png", "000001.png", "000003.png"]
    assert "40:41" in draw("log", "-o", "one", "--frames", "2,40", code=3).stderr
    assert names("one") == ["000002.png"]
    overlays.overlay("log", "python", frames=[(0, 1), (3, None)])
    assert len(names("python")) == 2


def test_results_find_their_log(work: Path) -> None:
    results = work / "sonarrec_out" / "log"
    assert "not found" in draw(results, "-o", "x", code=2).stderr
    set_run("[input]", '[input]\npath = "log"')
    draw("log", "-o", "given", "-q")
    draw(results, "-o", "found", "-q")
    shutil.copytree(results, work / "sonarrec_out" / "copy")
    assert "copy: 4 frames" in draw("sonarrec_out", "-o", "each").stdout
    drawn = [
        {name: (work / folder / name).read_bytes() for name in names(folder)}
        for folder in ("given", "found", "each/log", "each/copy")
    ]
    assert drawn == drawn[:1] * 4
    assert "hold results" in draw(results, "sonarrec_out/copy", "-o", "x", code=2).stderr
    assert "log first" in draw(results, "log", "-o", "x", code=2).stderr


def test_the_longest_mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """ID.1 is declared from frame 1 on; it shall be ID.2 in 5 to 7, and is no mistake in frame 0,
    where no track is declared."""
    monkeypatch.chdir(tmp_path)
    truth = make_camp(tmp_path / "camp", 1, 14, trouble=False) / "dive01" / "gt.csv"
    # At 0.85 a blank disc is taken for ID.1 in one frame.
    command.sonarrec("run", "camp/dive01", "-q", "--set", "features.declare=0.9")
    nothing = draw("camp/dive01", "-o", "wrong", "--mistakes", "9").stdout
    assert nothing.startswith("framework: no mistake")
    wrong = re.sub("^([567]),1,", r"\1,2,", truth.read_text(), flags=re.MULTILINE)
    truth.write_text(wrong)
    by_log = draw("camp/dive01", "-o", "wrong", "--mistakes", "9").stdout
    head, *told = by_log.splitlines()
    [(worst, _), _] = shown = [re.fullmatch(r"  frame (\d): (.*)", line).groups() for line in told]
    assert {re.sub(r"[01]\.\d\d", "#", what) for _, what in shown} == {
        "ID.1 declared (#) on what is ID.2; 3 of frames 5 to 7",
        "ID.2 in view and not declared: best guess ID.1 (#); 3 of frames 5 to 7",
    }
    assert head == "wrong: 1 frame, framework"
    assert names("wrong") == [f"00000{worst}.png"]
    for results in ("sonarrec_out", "sonarrec_out/dive01"):
        found = draw(results, "-o", "wrong", "--mistakes", "1").stdout
        assert found.splitlines() == [head, told[0]]
    both = draw("sonarrec_out", "-o", "x", "--mistakes", "1", "--frames", "1:", code=2)
    assert "--frames" in both.stderr


@pytest.mark.usefixtures("work")
def test_the_frames_drawn_are_those_that_were_run() -> None:
    """Nobody looked at the others: an empty picture of them would say that nothing is there."""
    set_run("[input]", '[input]\nframes = "1:3"')
    draw("log", "-o", "shots", "-q")
    assert names("shots") == ["000001.png", "000002.png"]
    draw("log", "-o", "all", "--frames", "0:", "-q")
    assert len(names("all")) == 4


@pytest.mark.usefixtures("work")
def test_a_run_that_was_cut_short() -> None:
    run = set_run("finished = true", "finished = false")
    assert "frames after 3" in draw("log", "-o", "o.mcap", code=3).stderr
    # As a run leaves it that was stopped.
    run.parent.rename(run.parent.with_name("log.part"))
    for results in ([], ["sonarrec_out/log"]):
        told = draw("log", *results, "-o", "o.mcap", code=3).stderr
        assert re.search("log.part: .*frames after 3", told)


@pytest.mark.parametrize(
    ("arguments", "code", "fault"),
    [
        ("-o paper.csv/o.mp4", 2, "paper.csv is not a folder"),
        ("-o log", 2, "become a part"),
        ("-o o.mcap --frames 3:3", 2, "from 3 "),
        ("-o o.mcap --frames 9:", 2, "--frames 9:"),
        ("-o o.mcap --frames 2,all", 2, "A:B"),
        ("-o o.mcap --method x", 2, "'x'; there is framework"),
        ("elsewhere -o o.mcap", 2, "elsewhere: no results"),
        ("-o o.mcap --ground-truth paper.csv", 1, "paper.csv: no positions"),
    ],
)
def test_faults_are_one_line(arguments: str, code: int, fault: str, work: Path) -> None:
    csv_file(work / "paper.csv", "frame,landmark", "0,3")
    told = draw("log", *arguments.split(), code=code)
    (line,) = told.stderr.splitlines()
    assert fault in line
    assert not told.stdout


def test_truth_of_another_log_is_told(work: Path) -> None:
    csv_file(work / "gt.csv", "log,frame,landmark,x_px,y_px", "dive,3,3,43,60")
    (line,) = draw("log", "-o", "o", "--ground-truth", "gt.csv", code=3).stderr.splitlines()
    assert line.startswith("sonarrec: gt.csv")


def test_results_of_another_log(work: Path) -> None:
    cv2.imwrite(str(work / "log" / "frame0.png"), noise(1)[0] + 1)
    (line,) = draw("log", "-o", "o.mcap", code=1).stderr.splitlines()
    assert "another log" in line
