"""Names of any bytes, locales without letters, and streams that are closed or full."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from click.shell_completion import BashComplete
from click.testing import CliRunner

from sonarrec.cli import main
from tests.support.command import on_a_terminal
from tests.support.command import sonarrec as in_process
from tests.support.slow import but_first

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "sample_data" / "pan"
TRUTH = ROOT / "sample_data" / "pan.gt.csv"
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def sonarrec(
    folder: Path, *words: str | bytes, after: str = "", **environment: str
) -> subprocess.CompletedProcess[bytes]:
    """after: redirections of the shell."""
    line = f'exec "$@" {after}' if after else 'exec "$@"'
    return subprocess.run(
        ["bash", "-c", line, "bash", sys.executable, "-m", "sonarrec", *words],
        cwd=folder,
        env=os.environ | environment,
        capture_output=True,
        timeout=600,
    )


PATHS = """run . | info . | calibrate . | overlay . | overlay x . | map . | evaluate .
report . | truth check . | truth check x . | truth convert . | truth propose .
truth convert --log . | run --landmarks . | run --model . | simulate --scene .
evaluate --compare . | evaluate --compare x ."""


def test_a_shell_completes_the_names_of_files() -> None:
    shell = BashComplete(main, {}, "sonarrec", "_SONARREC_COMPLETE")
    for line in re.split(r"[|\n]", PATHS):
        *words, begun = line.split()
        assert [item.type for item in shell.get_completions(words, begun)] == ["file"], line


def test_colour_only_where_it_is_wanted(tmp_path: Path) -> None:
    words = ("info", "none.mcap")
    plain = in_process(*words, code=2).stderr.strip().encode()
    assert plain.startswith(b"sonarrec: none.mcap: ")
    assert on_a_terminal(*words, cwd=tmp_path, NO_COLOR="1").strip() == plain
    coloured = on_a_terminal(*words, cwd=tmp_path, NO_COLOR="")
    assert b"\x1b[31msonarrec:\x1b[0m none.mcap" in coloured


def test_a_page_on_a_terminal_has_no_marks_of_headings(tmp_path: Path) -> None:
    page = (ROOT / "sonarrec" / "help" / "landmarks.md").read_bytes()
    shown = on_a_terminal("help", "landmarks", cwd=tmp_path, NO_COLOR="1").replace(b"\r\n", b"\n")
    assert b"# bright ring" in shown  # of a file that is shown
    assert shown.strip() == re.sub(rb"^#+ |`", b"", page, flags=re.MULTILINE).strip()


@pytest.fixture
def work(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A log of a few frames, one broken, whose names are the parameter's bytes."""
    log = os.fsencode(tmp_path) + b"/" + request.param
    try:
        os.mkdir(log)  # noqa: PTH102
    except OSError:
        pytest.skip("this file system takes no such name")
    for i in range(4):
        shutil.copy(SAMPLE / f"{i:06d}.png", log + b"/%06d.png" % i)
    shutil.copy(SAMPLE / "sonar.toml", log + b"/sonar.toml")
    with open(log + b"/000004" + request.param + b".png", "wb") as file:  # noqa: PTH123
        file.write(b"broken")
    return tmp_path


@pytest.fixture
def done(
    work: Path, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., str]:
    """Runs a command in the folder and gives what it prints."""
    monkeypatch.chdir(work)

    def here(*words: str | bytes) -> tuple[int, str]:
        told = CliRunner().invoke(main, [os.fsdecode(word) for word in words])
        assert "\x1b" not in told.output  # nothing in a name steers a terminal
        assert "\nve" not in told.stdout
        return told.exit_code, told.stdout_bytes.decode()

    def apart(*words: str | bytes) -> tuple[int, str]:
        told = sonarrec(work, *words, **environment)
        assert b"Traceback" not in told.stderr
        return told.returncode, told.stdout.decode()

    def checked(*words: str | bytes, codes: tuple[int, ...] = (0, 3)) -> str:
        code, printed = apart(*words) if environment else here(*words)
        assert code in codes, printed
        return printed

    return checked


LATIN, UTF = b"d\xe9\x1b[31m\nve", "d\u00e9v\u00e9".encode()


@pytest.mark.parametrize(
    ("work", "name", "environment"),
    but_first([(LATIN, LATIN, {}), (UTF, UTF, ASCII)]),
    indirect=["work"],
)
def test_names_of_any_bytes(work: Path, name: bytes, done: Callable[..., str]) -> None:
    """Where they need a locale of its own, in a process that has it."""
    done("run", name, codes=(3,))
    [folder] = (p for p in (work / "sonarrec_out").iterdir() if p.is_dir())
    with (folder / "run.toml").open("rb") as file:
        run = tomllib.load(file)
    assert run["finished"] is True
    assert len(run["input"]["problems"]) == 1
    assert "up to date" in done("run", name, codes=(3,))
    results = os.fsencode(folder.relative_to(work))
    done("info", name)
    done("evaluate", results, "--ground-truth", str(TRUTH))
    shutil.copy(TRUTH, os.fsencode(work) + b"/" + name + b".gt.csv")
    done("evaluate", results)  # with the truth beside the log
    done("report", results, "--log", name)
    done("overlay", name, results, "-o", "o.mcap")
    done("truth", "check", name + b".gt.csv", name)
    done("run", name, "-o", b"out" + name)


def test_help_prints_where_the_terminal_has_ascii_only(tmp_path: Path) -> None:
    assert sonarrec(tmp_path, "help", "method", **ASCII).stdout.startswith(b"method: ")


@pytest.mark.slow
@pytest.mark.parametrize("after", ["2>&-", ">&-", ">&- 2>&-", "2>/dev/full"])
def test_closed_streams_cost_no_result(tmp_path: Path, after: str) -> None:
    log = str(SAMPLE / "00000[0-2].png")
    assert sonarrec(tmp_path, "run", log, "-o", "o", after=after).returncode == 0
    tables = tmp_path / "o" / "pan"
    assert len((tables / "frames.csv").read_text().splitlines()) == 4
    assert (tables / "estimates.csv").read_text().startswith("frame,timestamp_ns,method")
    assert sonarrec(tmp_path, "info", log, after=after).returncode == 0
    made = sonarrec(tmp_path, "overlay", str(SAMPLE), "o", "-o", "o.mcap", after=after)
    assert made.returncode == 1  # of another log: told, where anybody listens
    assert not (tmp_path / "o.mcap").exists()


def test_a_list_from_a_closed_stdin_names_no_log(tmp_path: Path) -> None:
    done = sonarrec(tmp_path, "run", "--from-file", "-", after="<&-")
    assert done.returncode == 2
    assert done.stderr == b"sonarrec: --from-file: the list names no log\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full not found")
@pytest.mark.parametrize("words", but_first([["run"], ["info"], ["help", "run"]]))
def test_a_full_stdout_is_one_line(tmp_path: Path, words: list[str]) -> None:
    log = [] if words[0] == "help" else [str(SAMPLE / "00000[0-2].png")]
    done = sonarrec(tmp_path, *words, *log, after=">/dev/full")
    assert done.returncode == 1
    *before, last = done.stderr.splitlines()
    assert last == b"sonarrec: stdout: cannot be written (No space left on device)"
    assert len(before) == (words[0] == "run")  # what it goes by
    if words[0] == "run":
        assert "finished = true" in (tmp_path / "sonarrec_out" / "pan" / "run.toml").read_text()


def test_a_method_s_name_cannot_steer_the_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "frames.csv").write_text("frame,timestamp_ns\n0,0\n1,1\n")
    (tmp_path / "estimates.csv").write_text(
        "frame,method,range_m,bearing_deg,landmark,score,declared\n0,\x1b[31mred,2,0,1,.9,1\n"
    )
    (tmp_path / "gt.csv").write_text("frame,landmark,range_m,bearing_deg\n0,1,2,0\n")
    monkeypatch.chdir(tmp_path)
    for words in (
        ["evaluate", ".", "--ground-truth", "gt.csv"],
        ["report", "."],
        ["truth", "propose", ".", "--method", "\x1b[31mred"],
        ["overlay", str(SAMPLE), ".", "-o", "o.mcap", "--method", "\x1b[31mred"],
    ):
        done = CliRunner().invoke(main, words)
        assert "\x1b" not in done.output, words
        if words[0] == "evaluate":
            assert "\\x1b[31mred" in done.stdout


def test_ctrl_c_while_the_commands_are_loaded_is_one_line(tmp_path: Path) -> None:
    """A click that is found before the real one."""
    (tmp_path / "click.py").write_text("import os, signal; os.kill(os.getpid(), signal.SIGINT)")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    done = sonarrec(tmp_path, "config", PYTHONPATH=path)
    assert (done.returncode, done.stdout, done.stderr) == (130, b"", b"sonarrec: stopped\n")
