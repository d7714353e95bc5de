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


def sonarrec(*arguments: str | Path, code: int = 0) -> Result:
    result = command.sonarrec(*arguments, code=code)
    assert (code == 0) == (result.stderr == "")
    return result


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


def test_the_command(work: Path) -> None:
    (work / "log" / "sonar.toml").unlink()  # run.toml tells the geometry
    for out in ("o.mcap", "o.mp4", "shots"):
        assert sonarrec("overlay", "log", "-o", out).stdout == f"{out}: 4 frames, framework\n"
    assert Path("o.mp4").is_file()
    assert len(list(messages(work / "o.mcap"))) == 8
    assert len(list((work / "shots").iterdir())) == 4
    sonarrec("overlay", "log", "sonarrec_out/log", "-o", "one", "--frames", "2:3", "-q")
    assert [p.name for p in (work / "one").iterdir()] == ["000002.png"]
    two = [(work / d / "000002.png").read_bytes() for d in ("one", "shots")]
    assert two[0] == two[1]  # what came before is in its strip all the same


def test_a_list_of_frames(work: Path) -> None:
    sonarrec("overlay", "log", "-o", "some", "--frames", "0:2, 3", "-q")
    names = [p.name for p in sorted((work / "some").iterdir())]
    assert names == ["000000.png", "000001.png", "000003.png"]
    told = sonarrec("overlay", "log", "-o", "one", "--frames", "2,40", code=3)
    assert "lies in --frames 40:41" in told.stderr
    assert [p.name for p in (work / "one").iterdir()] == ["000002.png"]
    overlays.overlay("log", "python", frames=[(0, 1), (3, None)])
    assert len(list((work / "python").iterdir())) == 2


def test_results_find_their_log(work: Path) -> None:
    """By run.toml, also of all that a folder holds."""
    results = work / "sonarrec_out" / "log"
    assert "not found" in sonarrec("overlay", results, "-o", "x", code=2).stderr
    run = results / "run.toml"
    run.write_text(run.read_text().replace("[input]", '[input]\npath = "log"'))
    sonarrec("overlay", "log", "-o", "given", "-q")
    sonarrec("overlay", results, "-o", "found", "-q")
    shutil.copytree(results, work / "sonarrec_out" / "copy")
    assert "copy: 4 frames" in sonarrec("overlay", "sonarrec_out", "-o", "each").stdout
    drawn = [sorted((work / f).iterdir()) for f in ("given", "found", "each/log", "each/copy")]
    assert len({tuple(p.read_bytes() for p in of) for of in drawn}) == 1
    assert [p.name for p in drawn[0]] == [p.name for p in drawn[3]]
    refused = sonarrec("overlay", results, "sonarrec_out/copy", "-o", "x", code=2)
    assert "hold results" in refused.stderr
    exchanged = sonarrec("overlay", results, "log", "-o", "x", code=2)
    assert "name the log first" in exchanged.stderr


def test_the_longest_mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """ID.1 is declared from frame 1 on; it shall be ID.2 in 5 to 7, and is no mistake in frame 0,
    where no track is declared."""
    monkeypatch.chdir(tmp_path)
    truth = make_camp(tmp_path / "camp", 1, 14, trouble=False) / "dive01" / "gt.csv"
    # At 0.85 a blank disc is taken for ID.1 in one frame.
    sonarrec("run", "camp/dive01", "-q", "--set", "features.declare=0.9")
    nothing = sonarrec("overlay", "camp/dive01", "-o", "wrong", "--mistakes", "9").stdout
    assert nothing.startswith("framework: no mistake but in the first frame")
    lines = truth.read_text().splitlines()
    wrong = [
        line.replace(",1,", ",2,", 1) if line[:2] in ("5,", "6,", "7,") else line for line in lines
    ]
    truth.write_text("\n".join(wrong) + "\n")
    by_log = sonarrec("overlay", "camp/dive01", "-o", "wrong", "--mistakes", "9").stdout
    head, *told = by_log.splitlines()
    [(worst, _), _] = shown = [re.fullmatch(r"  frame (\d): (.*)", line).groups() for line in told]
    assert {re.sub(r"[01]\.\d\d", "#", what) for _, what in shown} == {
        "ID.1 declared (#) on what is ID.2; 3 of frames 5 to 7",
        "ID.2 in view and not declared: best guess ID.1 (#); 3 of frames 5 to 7",
    }
    assert head == "wrong: 1 frame, framework"
    assert [p.name for p in (tmp_path / "wrong").iterdir()] == [f"00000{worst}.png"]
    for results in ("sonarrec_out", "sonarrec_out/dive01"):
        found = sonarrec("overlay", results, "-o", "wrong", "--mistakes", "1").stdout
        assert found.splitlines() == [head, told[0]]
    both = sonarrec(
        "overlay", "sonarrec_out", "-o", "x", "--mistakes", "1", "--frames", "1:", code=2
    )
    assert "leave out --frames" in both.stderr


def test_the_frames_drawn_are_those_that_were_run(work: Path) -> None:
    """Nobody looked at the others: an empty picture of them would say that nothing is there."""
    run = work / "sonarrec_out" / "log" / "run.toml"
    run.write_text(run.read_text().replace("[input]", '[input]\nframes = "1:3"'))
    sonarrec("overlay", "log", "-o", "shots", "-q")
    assert sorted(p.name for p in (work / "shots").iterdir()) == ["000001.png", "000002.png"]
    sonarrec("overlay", "log", "-o", "all", "--frames", "0:", "-q")
    assert len(list((work / "all").iterdir())) == 4


def test_a_run_that_was_cut_short(work: Path) -> None:
    run = work / "sonarrec_out" / "log" / "run.toml"
    run.write_text(run.read_text().replace("finished = true", "finished = false"))
    cut = "the run was cut short; frames after 3 have no results"
    assert cut in sonarrec("overlay", "log", "-o", "o.mcap", code=3).stderr
    # As a run leaves it that was stopped.
    run.parent.rename(run.parent.with_name("log.part"))
    for results in ([], ["sonarrec_out/log"]):
        told = sonarrec("overlay", "log", *results, "-o", "o.mcap", code=3)
        assert f"log.part: {cut}" in told.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "fault"),
    [
        ("-o paper.csv/o.mp4", 2, "paper.csv/o.mp4: paper.csv is not a folder"),
        ("-o log", 2, "it would become a part"),
        ("-o o.mcap --frames 3:3", 2, "no frame from 3 up to, not including, 3"),
        ("-o o.mcap --frames 9:", 2, "no frame lies in --frames 9:"),
        ("-o o.mcap --frames 2,all", 2, "frame numbers N and spans A:B"),
        ("-o o.mcap --method x", 2, "no method 'x'; there is framework"),
        ("elsewhere -o o.mcap", 2, "elsewhere: no results of log here"),
        ("-o o.mcap --ground-truth paper.csv", 1, "paper.csv: no positions"),
    ],
)
def test_faults_are_one_line(arguments: str, code: int, fault: str, work: Path) -> None:
    csv_file(work / "paper.csv", "frame,landmark", "0,3")
    told = sonarrec("overlay", "log", *arguments.format(work.name).split(), code=code)
    assert fault in told.stderr
    assert len(told.stderr.splitlines()) == 1
    assert not told.stdout


def test_truth_of_another_log_is_told(work: Path) -> None:
    csv_file(work / "gt.csv", "log,frame,landmark,x_px,y_px", "dive,3,3,43,60")
    done = sonarrec("overlay", "log", "-o", "o", "--ground-truth", "gt.csv", code=3)
    (line,) = done.stderr.splitlines()
    assert line.startswith("sonarrec: gt.csv")
    assert "no truth is drawn" in line


def test_results_of_another_log(work: Path) -> None:
    cv2.imwrite(str(work / "log" / "frame0.png"), noise(1)[0] + 1)
    told = sonarrec("overlay", "log", "-o", "o.mcap", code=1)
    assert "another log, " in told.stderr
    assert len(told.stderr.splitlines()) == 1
