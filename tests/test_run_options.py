"""Small things at hand: a slice of the frames, -v, the bar, inputs that are not there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from click.testing import Result

from sonarrec import run
from sonarrec.cli.endings import finish, print_notes
from sonarrec.results.run_file import read_run
from tests.support.batch import made
from tests.support.command import SAMPLE, on_a_terminal, sample_log, sonarrec
from tests.support.locked import locked
from tests.support.rows import read_rows

TEN = SAMPLE / "00000*.png"


def run_words(words: str, code: int, **places: Path) -> Result:
    """A command in which names in capitals stand for places; GT for the truth of the sample."""
    for name, place in {"GT": SAMPLE.parent / "pan.gt.csv", **places}.items():
        words = words.replace(name, str(place))
    return sonarrec(*words.split(), code=code)


def numbers(folder: Path) -> list[int]:
    return [int(row["frame"]) for row in read_rows(folder / "frames.csv")]


@pytest.mark.slow
def test_a_slice_of_the_frames_is_as_python_s(tmp_path: Path) -> None:
    """Frames keep their numbers, run.toml says which, and another slice is not up to date."""
    for text, expected in (("3:7", [3, 4, 5, 6]), (":2", [0, 1]), ("9:", [9]), (":", [*range(10)])):
        sonarrec("run", "-q", TEN, "--frames", text, "-o", tmp_path)
        assert numbers(tmp_path / "pan") == expected
    assert "up to date" in sonarrec("run", TEN, "--frames", ":", "-o", tmp_path).stdout
    whole = sonarrec("run", TEN, "-o", tmp_path)
    assert "other settings" in whole.stderr
    assert "up to date" not in whole.stdout


@pytest.mark.parametrize("text", ["3", "5:5", "a:b", "-3:", "1:2:3", "99999:"])
def test_a_slice_without_frames_is_refused(tmp_path: Path, text: str) -> None:
    done = sonarrec("run", TEN, "--frames", text, "-o", tmp_path / "o", code=2)
    assert "--frames" in done.stderr
    assert len(done.stderr.splitlines()) == 1


FAULTS = {  # and the exit code: `sonarrec help run`
    ("not there", 2): """run GONE | run GONE GONE | info GONE
        evaluate GONE --ground-truth GT | evaluate --ground-truth GONE | evaluate --pairs GONE
        evaluate --compare GONE GONE --ground-truth GT | report GONE | overlay GONE -o o.mcap
        calibrate GONE --ground-truth GT -o m.toml | truth check GT GONE | truth convert GONE
        truth propose GONE | map GONE | check GONE""",
    ("empty", 2): """run EMPTY | info EMPTY | evaluate EMPTY --ground-truth GT | report EMPTY
        map EMPTY | truth propose EMPTY | overlay LOG EMPTY -o o.mp4 | truth check GT EMPTY""",
    ("no truth", 2): """evaluate OUT | calibrate LOG -o m.toml | check CHECK""",
    ("a setting or a set that does not exist", 2): """run LOG --set a.b=1 | check CHECK --set a.b=1
        run LOG --landmarks GONE | evaluate OUT --ground-truth GT --landmarks GONE""",
    ("no geometry", 1): """run BARE -o o | truth check GT BARE
        calibrate BARE --ground-truth GT -o m.toml""",
    ("an output that cannot be written", 1): """run LOG -o /proc/x | map OUT -o /proc/x
        evaluate OUT --ground-truth GT -o /proc/x | report OUT -o /proc/x.html
        overlay LOG OUT -o /proc/x.mp4 | simulate --frames 2 -o /proc/x
        truth propose OUT -o /proc/x.csv | calibrate LOG --ground-truth GT -o /proc/x.toml
        info LOG --write-sonar /proc/x.toml""",
    ("a part that cannot be used", 3): """run PARTLY -o o | info PARTLY | overlay PARTLY o -o o.mp4
        evaluate OUT --ground-truth MORE | calibrate PARTLY --ground-truth GT -o m.toml""",
}


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "code"), FAULTS)
def test_a_fault_has_one_exit_code_in_all_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str, code: int
) -> None:
    monkeypatch.chdir(tmp_path)
    names = ("gone", "empty", "log", "bare", "partly", "out/log", "check.toml", "more.csv")
    keys = ("GONE", "EMPTY", "LOG", "BARE", "PARTLY", "OUT", "CHECK", "MORE")
    places = {key: tmp_path / name for key, name in zip(keys, names, strict=True)}
    for name in ("log", "bare", "partly"):
        sample_log(tmp_path / name, 40)
    places["EMPTY"].mkdir()
    sonarrec("run", "-q", "log", "-o", "out")
    (places["BARE"] / "sonar.toml").unlink()
    (places["PARTLY"] / "000003.png").write_bytes(b"no image")
    places["CHECK"].write_text('[[log]]\npath = "log"\n')
    places["MORE"].write_bytes((SAMPLE.parent / "pan.gt.csv").read_bytes())
    for words in re.split(r"\s*[|\n]\s*", FAULTS[fault, code]):
        done = run_words(words, code, **places)
        assert "Traceback" not in done.output, words


@pytest.mark.parametrize(
    ("words", "after"),
    [
        (["run", ""], "run"),
        (["run", str(SAMPLE), "--preset", ""], "--preset"),
        (["run", str(SAMPLE), "--out="], "--out"),
        (["truth", "propose", ""], "propose"),
    ],
)
def test_an_empty_word_is_refused(words: list[str], after: str) -> None:
    """Such as that of a variable that is not set: as a path it would be the folder of now."""
    assert f"argument after {after}" in sonarrec(*words, code=2).stderr


@pytest.mark.parametrize("name", ["run", "info"])
def test_ctrl_c_at_the_start_is_one_line(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sonarrec.readers.open._find", stop)
    assert sonarrec(name, SAMPLE, code=130).stderr == "sonarrec: stopped\n"


LOCKED = """run LOCKED/pan.mcap | info LOCKED/pan.mcap | report LOCKED/out | map LOCKED/out
overlay LOCKED/pan.mcap -o o | calibrate LOCKED/pan.mcap --ground-truth GT -o m.toml
truth check GT LOCKED/pan.mcap"""


@pytest.mark.parametrize("words", re.split(r" \| |\n", LOCKED))
def test_a_folder_without_permission_is_one_line(tmp_path: Path, words: str) -> None:
    with locked(tmp_path / "locked") as folder:
        done = run_words(words, 1, LOCKED=folder)
    (told,) = done.stderr.splitlines()
    assert told.startswith(f"sonarrec: {folder}")
    assert "Permission denied" in told


def test_the_bar_counts_the_frames_of_a_log_or_the_logs(tmp_path: Path) -> None:
    logs = [*map(str, made(tmp_path, "one", "two", frames=12))]
    shown = on_a_terminal("run", "-j", "1", *logs, "-o", "out", cwd=tmp_path)
    assert b"/2 [" in shown
    assert b"log/s" in shown or b"s/log" in shown
    shown = on_a_terminal("run", logs[0], "-o", "other", cwd=tmp_path)
    assert b"one:" in shown
    assert b"/12 [" in shown


def test_another_log_of_the_name_is_run_whole_though_the_first_was_run_in_part(
    tmp_path: Path,
) -> None:
    """Equal names in each day's folder are usual: a log is told from another by its SHA-256."""
    (first,), (second,) = made(tmp_path, "a/dive", frames=5), made(tmp_path, "b/dive", frames=6)
    sonarrec("run", "-q", first, "--frames", "1:3", "-o", tmp_path / "x")
    again = ["--config", tmp_path / "x" / "dive" / "run.toml", "-o"]
    sonarrec("run", "-q", second, *again, tmp_path / "y")
    assert len(numbers(tmp_path / "y" / "dive")) == 6
    first.rename(tmp_path / "renamed")
    sonarrec("run", "-q", tmp_path / "renamed", *again, tmp_path / "z")
    sonarrec("run", "-q", tmp_path / "renamed" / "*.png", *again, tmp_path / "glob")
    assert numbers(tmp_path / "z" / "renamed") == numbers(tmp_path / "glob" / "renamed") == [1, 2]
    assert numbers(run(second, tmp_path / "python", frames=(4, None)).folder) == [4, 5]


def test_geometry_that_is_given_changes_what_a_run_toml_only_worked_out(tmp_path: Path) -> None:
    """Scale and apex follow from the range window and the image where nothing states them."""
    sonarrec("run", "-q", TEN, "-o", tmp_path / "a")
    config = ["--config", tmp_path / "a" / "pan" / "run.toml"]
    wider = ["--range-max-m", "4.0"]
    for out, words in (("b", [*config, *wider]), ("c", wider)):
        sonarrec("run", "-q", TEN, *words, "-o", tmp_path / out)
    with_, without = (read_run(tmp_path / out / "pan" / "run.toml").fan() for out in "bc")
    assert with_ == without
    assert with_ != read_run(tmp_path / "a" / "pan" / "run.toml").fan()


@pytest.mark.parametrize("data", [b"\x89MCAP0\r\n\x01\x00\x00", "a.mcap\n".encode("utf-16")])
def test_a_list_that_is_a_log_or_no_utf_8_is_one_line(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_bytes(data)
    done = sonarrec("run", "--from-file", path, code=2)
    assert re.fullmatch(r"sonarrec: --from-file \S+list.txt: not a list of logs, .*\n", done.stderr)


def test_a_rate_that_is_assumed_is_said(tmp_path: Path) -> None:
    for rate, said in (([], True), (["--frame-rate-hz", "4"], False)):
        sonar = tmp_path / "sonar.toml"
        text = (SAMPLE / "sonar.toml").read_text(encoding="utf-8")
        sonar.write_text(re.sub(r"frame_rate_hz.*\n", "", text), encoding="utf-8")
        done = sonarrec("run", TEN, "--sonar", sonar, *rate, "-o", tmp_path / "o", "--overwrite")
        assert ("time, so 1 Hz is assumed" in done.stderr) == said


def test_what_is_wrong_comes_first_and_notes_are_few(capsys: pytest.CaptureFixture[str]) -> None:
    finish(False, ["done"], (), [f"{n}" for n in (1, 1, 2, 3, 4, 5, 6, 7)])
    printed = capsys.readouterr()
    assert printed.out == "done\n"
    notes = [f"sonarrec: note: {n}" for n in range(1, 6)]
    assert printed.err.splitlines() == [*notes, "sonarrec: 2 more notes"]
    print_notes(["wrong", "wrong"], ["why"])
    assert capsys.readouterr().err == "sonarrec: wrong\nsonarrec: note: why\n"


@pytest.mark.slow
def test_a_note_on_several_logs_is_told_once(tmp_path: Path) -> None:
    logs = made(tmp_path, "a", "b", frames=2)
    for log in logs:
        text = (log / "sonar.toml").read_text(encoding="utf-8")
        (log / "sonar.toml").write_text(re.sub(r"frame_rate_hz.*\n", "", text), encoding="utf-8")
    told = sonarrec("run", *logs, "-o", tmp_path / "out").stderr
    assert told.count("carry no time") == 1
    assert "1 more log" in told


@pytest.mark.parametrize(
    ("geometry", "told"),
    [
        ("", False),
        ("--range-max-m 12.0", True),  # discs of 7 px
        ("--range-min-m 40 --range-max-m 42.5 --height-m 0.68", True),  # a degree above the floor
        ("--range-min-m 1400 --range-max-m 1402.5", None),  # no picture of it can be made
    ],
)
def test_a_geometry_in_which_no_landmark_can_be_read_is_told(
    geometry: str, told: bool | None, tmp_path: Path
) -> None:
    log = sample_log(tmp_path / "log", 4)
    run = ("run", log, "-o", tmp_path / "out", *geometry.split())
    done = sonarrec(*run, code=1 if told is None else 0)
    assert len(done.stderr.splitlines()) == 1 or told is not None
    assert ("in mid-window is" in done.stderr) == bool(told)
