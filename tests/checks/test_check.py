"""`sonarrec check` as a new user meets it: on a log, with a file, in a folder of their own."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from sonarrec import config
from tests.support.camp import OTHER_SET, make_camp
from tests.support.command import sonarrec
from tests.support.slow import but_first

SAMPLES = Path(__file__).resolve().parents[2] / "sample_data"
PAGE = Path(__file__).resolve().parents[2] / "sonarrec" / "help" / "check.md"
FILE = Path("sonarrec.check.toml")
RECORD = Path("sonarrec.check")


def log(folder: Path, name: str = "faint", frames: int = 16) -> Path:
    """The first frames of the sample that is hard: their rates move with the settings."""
    place = folder / name
    place.mkdir(parents=True)
    for file in ("sonar.toml", "gt.csv", *(f"{i:06d}.png" for i in range(frames))):
        shutil.copy(SAMPLES / "faint" / file, place)
    return place


@pytest.fixture(autouse=True)
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    log(tmp_path)
    monkeypatch.chdir(tmp_path)
    FILE.write_text('[[log]]\npath = "faint"\n')
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_red_when_declare_is_raised_then_recorded_then_green() -> None:
    assert "check sonarrec.check.toml --update`" in sonarrec("check", code=2).stderr
    assert not RECORD.exists()

    assert "1 log" in sonarrec("check", "--update").stdout
    assert {p.name for p in (RECORD / "faint").iterdir()} == {
        *("frames.csv", "estimates.csv", "run.toml")
    }
    green = sonarrec("check", "-o", "new").stdout
    assert green.startswith("unchanged: TPR 0.9")
    assert "settings" not in green
    assert Path("new/evaluation/compare.csv").is_file()
    assert contents(RECORD)["faint/estimates.csv"] == contents(Path("new/faint"))["estimates.csv"]

    # The option tries it, the file states it.
    tried = sonarrec("check", "--set", "features.declare=0.99", code=4)
    assert tried.stdout.startswith("worse: TPR 0.9")
    assert tried.stderr == ""
    FILE.write_text('set = ["features.declare=0.99"]\n' + FILE.read_text())
    quiet = sonarrec("check", "-q", code=4)
    assert quiet.stdout == ""
    assert quiet.stderr.startswith(f"sonarrec: {tried.stdout.splitlines()[0]}\n")
    assert "note: " in quiet.stderr

    before = contents(RECORD)
    updated = sonarrec("check", "--update").stdout
    assert tried.stdout in updated
    assert contents(RECORD) != before
    assert sonarrec("check").stdout.startswith("unchanged: TPR 0.")
    back = sonarrec("check", "--set", "features.declare=0.75")
    assert back.stdout.startswith("better: TPR 0.")


def test_what_is_no_truth_is_not_recorded(repository: Path) -> None:
    FILE.write_text(f'[[log]]\npath = "{log(repository, "few", 2).name}"\n')
    truth = Path("few/gt.csv")
    head, *rows = truth.read_text().splitlines()
    truth.write_text("frame,landmark\n0,9\n")
    assert "landmark 9" in sonarrec("check", "--update", code=1).stderr
    truth.write_text("\n".join([f"{head},source", *(f"{row},tracked" for row in rows)]))
    assert "unchecked proposals" in sonarrec("check", "--update", code=1).stderr
    assert not RECORD.exists()


@pytest.mark.slow
def test_the_record_is_the_same_wherever_it_is_made(
    repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also with the absolute path of the file, from another folder."""
    sonarrec("check", "--update", "-q")
    first = contents(RECORD)
    monkeypatch.chdir(repository.parent)
    sonarrec("check", repository / FILE, "--update", "-q")
    assert contents(repository / RECORD) == first
    assert str(repository).encode() not in first["faint/run.toml"]


@pytest.mark.slow
def test_a_truth_in_doubt_is_told_as_it_is_recorded_too() -> None:
    shutil.copy(SAMPLES / "pan.gt.csv", "faint/gt.csv")
    for _ in range(2):  # the first and a later record
        told = sonarrec("check", "--update", "-q", code=3).stderr
        assert "faint/gt.csv: 0 of 16 rows" in told


@pytest.mark.slow
def test_limits_replace_those_of_the_file() -> None:
    FILE.write_text("least_tpr = { framework = 0.9, smi = 0.01 }\n" + FILE.read_text())
    sonarrec("check", "--update", "-q")
    sonarrec("check", "-q")
    low = sonarrec("check", "--least-tpr", "framework=0.995", code=4)
    assert re.match(r"limit not kept: TPR 0\.9.* \(framework, strict\) .* 0\.995", low.stdout)
    # SMI's FPR is high; nobody looks at it unless asked.
    sonarrec("check", "-q", "--most-fpr", "0.1")
    high = sonarrec("check", "-q", "--most-fpr", "smi=0.1", code=4)
    assert "(smi, strict) is above 0.1" in high.stderr
    unknown = sonarrec("check", "--most-fpr", "smj=0.1", code=2)
    assert re.search(r"method smj: .* framework, smi", unknown.stderr)


@pytest.mark.slow
def test_a_log_that_cannot_be_run_leaves_the_record(repository: Path) -> None:
    log(repository, "other", 4)
    FILE.write_text(FILE.read_text() + '[[log]]\npath = "other"\n')
    sonarrec("check", "--update", "-q")
    before = contents(RECORD)
    (repository / "other" / "sonar.toml").write_text("[sonar]\nlayout = 1\n")
    FILE.write_text('set = ["features.declare=0.9"]\n' + FILE.read_text())
    failed = sonarrec("check", "--update", code=1)
    assert "recorded, since" in failed.stderr
    assert contents(RECORD) == before
    partly = sonarrec("check", "--set", "features.declare=0.85", code=3)
    assert "sonarrec.check" in partly.stderr
    assert "unchanged" in partly.stdout


@pytest.mark.slow
def test_a_log_new_in_the_file_and_one_gone_from_it(repository: Path) -> None:
    log(repository, "other", 4)
    sonarrec("check", "--update", "-q")
    FILE.write_text(FILE.read_text() + '[[log]]\npath = "other"\n')
    new = sonarrec("check", code=3)
    assert "sonarrec.check" in new.stderr
    FILE.write_text('[[log]]\npath = "other"\n')
    (RECORD / "faint" / "note.txt").write_text("mine")
    told = sonarrec("check", "--update")
    assert "sonarrec.check/faint" in told.stderr
    files = "frames.csv", "estimates.csv", "run.toml"
    assert set(contents(RECORD)) == {
        *("faint/note.txt", *(f"{log}/{name}" for log in ("faint", "other") for name in files))
    }
    (RECORD / "other" / "run.toml").write_text("")
    assert "on record" in sonarrec("check", code=2).stderr


@pytest.mark.slow
def test_the_record_of_another_log_is_not_compared(repository: Path) -> None:
    sonarrec("check", "--update", "-q")
    shutil.copy(SAMPLES / "faint" / "000050.png", repository / "faint" / "000000.png")
    told = sonarrec("check", code=1)
    assert "different logs" in told.stderr
    assert told.stderr.endswith("--update` records new results\n")
    assert "on record" in sonarrec("check", "--update").stdout
    sonarrec("check", "-q")


@pytest.mark.slow
def test_nothing_is_written_over_the_record() -> None:
    sonarrec("check", "--update", "-q")
    before = contents(RECORD)
    for out in (RECORD, RECORD / "faint", Path()):
        assert "on record" in sonarrec("check", "-o", out, code=2).stderr
    told = sonarrec("check", "--update", "--set", "features.declare=0.9", code=2)
    assert "write the settings there" in told.stderr
    assert contents(RECORD) == before


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "sonarrec.check.toml lacks log"),
        ("log = []", "names no log"),
        ("lg = 1", "unknown key lg (did you mean log?)"),
        ("[[log]]\npath = 'nowhere'", "[[log]] 1: nowhere: no such file"),
        ("[[log]]\npath = 'faint'\nground_truth = 'x.csv'", "[[log]] 1: x.csv: no such file"),
        ("[[log]]\npath = 'bare'", "[[log]] 1: no gt.csv in or beside bare"),
        ("[[log]]\npath = 'faint'\nname = '../up'", "not the name of one folder"),
        ("[[log]]\npath = 'faint'\nname = '..'", "not the name of one folder"),
        ("[[log]]\npath = 'faint'\nname = \"a\\u0000\"", "not the name of one folder"),
        ("[[log]]\npath = 'faint'\n" * 2, "given 2 times"),
        ("record = '.'\n[[log]]\npath = 'faint'", "faint is the log itself"),
        ("least_tpr = { framework = 2 }\n[[log]]\npath = 'faint'", "least_tpr.framework must be"),
        ("band = -1\n[[log]]\npath = 'faint'", "band must be a number from 0 to 1"),
    ],
)
def test_a_file_that_cannot_be_used(text: str, told: str, repository: Path) -> None:
    (repository / "bare").mkdir()
    shutil.copy(SAMPLES / "faint" / "000000.png", repository / "bare")
    FILE.write_text(text)
    done = sonarrec("check", "--update", code=2)
    assert told in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not RECORD.exists()


def test_a_folder_of_logs_with_a_landmark_set_beside_the_file(repository: Path) -> None:
    log(repository / "logs", "a", 4)
    log(repository / "logs", "b", 4)
    [basin] = Path(config.__file__).parent.rglob("landmark*/basin.toml")
    shutil.copy(basin, repository / "mine.toml")
    FILE.write_text('landmarks = "mine.toml"\n[[log]]\npath = "logs/*"\n')
    assert "2 logs" in sonarrec("check", "--update").stdout
    assert {p.name for p in RECORD.iterdir()} == {"a", "b"}
    for own in ("name = 'a'", "ground_truth = 'faint/gt.csv'"):  # of one log alone
        FILE.write_text(f"[[log]]\npath = 'logs/*'\n{own}\n")
        assert "2 logs" in sonarrec("check", "--update", code=2).stderr


def test_logs_of_two_landmark_sets_are_scored_by_set(repository: Path) -> None:
    """Their rates do not add up; what is worse in either counts."""
    other = make_camp(repository / "camp", 5, 6) / OTHER_SET
    FILE.write_text(f'[[log]]\npath = "camp/dive01"\n[[log]]\npath = "camp/{other.name}"\n')
    assert "2 logs" in sonarrec("check", "--update").stdout
    same = sonarrec("check", "-o", "new")
    assert same.stderr == ""
    basin, camp = same.stdout.split("landmarks camp\n")
    assert basin.startswith("landmarks basin\nunchanged: ")
    assert camp.startswith("unchanged: ")
    assert "in dive01" in basin
    assert f"in {other.name}" in camp
    assert {p.parent.name for p in Path("new").rglob("compare.csv")} == {"basin", "camp"}
    truth = (other / "gt.csv").read_text()
    (other / "gt.csv").write_text(truth.replace(",11,", ",12,"))
    worse = sonarrec("check", "-q", "--least-tpr", "0.5", code=4).stderr
    assert worse.count("limit not kept") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "setting",
    [
        *("features.declare=0.99", "features.memory_frames=1"),
        *("continuity.motion=random_walk", "candidates.threshold=0.8"),
    ],
)
def test_the_samples_show_what_a_setting_costs(setting: str) -> None:
    told = sonarrec("check", SAMPLES / FILE, "--set", setting, code=4)
    assert told.stdout.startswith("worse: TPR ")
    row = next(line for line in told.stdout.splitlines() if line.startswith("faint"))
    assert row.endswith("worse")


@pytest.mark.slow
def test_the_samples_are_as_on_record() -> None:
    assert "on record" not in sonarrec("check", SAMPLES / FILE).stderr


@pytest.mark.parametrize(
    "text", but_first(['[input]\nname = "x"\n', "# a comment\n", "finished = true\n"])
)
def test_a_record_that_does_not_name_its_log_is_not_compared(repository: Path, text: str) -> None:
    paths = [log(repository, name, 3).name for name in ("first", "second")]
    FILE.write_text("".join(f'[[log]]\npath = "{path}"\n' for path in paths))
    sonarrec("check", "--update")
    (RECORD / "first" / "run.toml").write_text(text)
    both = sonarrec("check", code=4)
    assert "not compared" in both.stderr
    assert "second" in both.stdout
    FILE.write_text('[[log]]\npath = "first"\n')
    alone = sonarrec("check", code=4)
    assert "not compared" in alone.stderr
    assert alone.stdout == ""


@pytest.mark.slow
def test_the_steps_of_the_help_page_compare(repository: Path) -> None:
    [workflow] = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (job,) = YAML(typ="safe").load(workflow)["jobs"].values()
    steps = [step["run"] for step in job["steps"] if "run" in step]
    assert [step.split()[:2] for step in steps] == [["pip", "install"], ["sonarrec", "check"]]
    (kept,) = [s["with"] for s in job["steps"] if "upload-artifact" in s.get("uses", "")]
    sonarrec("check", "--update")
    paths = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    bash = ["bash", "-e", "-c", steps[1]]
    done = subprocess.run(bash, env=os.environ | {"PATH": paths}, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(b"unchanged: TPR ")
    assert (repository / kept["path"] / "faint" / "estimates.csv").is_file()
