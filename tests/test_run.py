"""End to end: what a user types, what comes back, and the exit code."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import tomli_w

from tests.support.command import sample_log, sonarrec
from tests.support.rows import read_rows

HEAVY = ("pandas", "scipy", "matplotlib", "numpy.ma", "numpy", "cv2")


def one_line_fault(*arguments: str | Path, code: int = 1) -> str:
    """The message of a command that fails: on stderr, from the program, without a traceback."""
    result = sonarrec(*arguments, code=code)
    assert result.stderr.startswith("sonarrec: ")
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    return result.stderr


@pytest.fixture
def pings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of ten frames with their geometry, in the folder that a user works in."""
    monkeypatch.chdir(tmp_path)
    return sample_log(tmp_path / "pings", 10)


def test_estimates_keep_the_contract(pings: Path) -> None:
    sonarrec("run", pings)
    results = Path("sonarrec_out/pings")
    frames, rows = (read_rows(results / name) for name in ("frames.csv", "estimates.csv"))
    assert [int(r["frame"]) for r in frames] == list(range(10))
    for row in rows:
        beliefs = {c: float(row[c]) for c in row if c.startswith("p_")}
        assert sum(beliefs.values()) == pytest.approx(1, abs=1e-5)
        assert 0 <= float(row["score"]) <= 1
        assert row["declared"] in "01"
        ids = {c: v for c, v in beliefs.items() if c != "p_none"}
        assert ids[f"p_{row['landmark']}"] == max(ids.values())
    for frame in frames:
        for method, column in (("smi", "candidates"), ("framework", "tracks")):
            seen = [r for r in rows if r["frame"] == frame["frame"] and r["method"] == method]
            assert len(seen) == int(frame[column])
            assert len({r["object"] for r in seen}) == len(seen)


def test_run_toml_gives_the_same_bytes_again(pings: Path) -> None:
    settings = ("--set", "seed=7", "--set", "continuity.particles=1200", "--preset", "paper")
    sonarrec("run", pings, "--tilt-deg", "19", *settings)
    first = Path("sonarrec_out/pings")
    run = tomllib.loads((first / "run.toml").read_text())
    assert run["finished"] is True
    assert run["config"]["seed"] == 7
    assert run["config"]["preset"] == "paper"
    assert run["config"]["continuity"]["particles"] == 1200
    assert run["sonar"]["tilt_deg"] == 19
    assert run["input"]["frames_processed"] == 10
    sonarrec("run", pings, "--config", first / "run.toml", "--out", "again")
    for name in ("frames.csv", "estimates.csv", "run.toml"):
        assert (first / name).read_bytes() == (Path("again/pings") / name).read_bytes(), name


@pytest.mark.slow
def test_silent_where_stderr_is_no_terminal(pings: Path) -> None:
    command = [sys.executable, "-m", "sonarrec", "run", str(pings)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr.count("\n") == 1  # what it goes by
    assert "10 frames" in done.stdout
    quiet = subprocess.run([*command, "-q", "--overwrite"], capture_output=True, check=True)
    assert (quiet.stdout, quiet.stderr) == (b"", b"")


def modules_after(code: str) -> set[str]:
    """Which of the HEAVY modules a piece of code has imported, in a process of its own."""
    tail = f"\nimport sys\nprint([m for m in {HEAVY} if m in sys.modules], file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", code + tail], capture_output=True, text=True, check=True
    )
    return {m for m in HEAVY if repr(m) in done.stderr}


def as_main(*arguments: str) -> str:
    return (
        f"import runpy, sys\nsys.argv = ['sonarrec', *{list(arguments)!r}]\n"
        "try:\n    runpy.run_module('sonarrec', run_name='__main__')\n"
        "except SystemExit as end:\n    assert not end.code\n"
    )


@pytest.mark.slow
def test_heavy_imports_are_late(pings: Path) -> None:
    assert modules_after("import pandas") == {"pandas", "numpy", "numpy.ma"}
    assert modules_after(as_main("--help")) == set()
    assert modules_after(as_main("run", "--help")) == set()
    assert modules_after(as_main("run", str(pings), "-q")) == {"numpy", "cv2"}


def test_a_pipe_and_a_device_are_no_missing_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "dive.mcap")
    for name in (tmp_path / "dive.mcap", os.devnull):
        message = one_line_fault("run", name, code=2)
        assert f"sonarrec: {name}: neither" in message


def test_geometry_by_flags_alone(pings: Path) -> None:
    sonarrec("run", pings, "--out", "by_file")
    sonar = tomllib.loads((pings / "sonar.toml").read_text())["sonar"]
    (pings / "sonar.toml").unlink()
    flags = [a for k, v in sonar.items() for a in (f"--{k.replace('_', '-')}", str(v))]
    sonarrec("run", pings, *flags, "--out", "by_flags")
    written = [Path(out, "pings/estimates.csv").read_bytes() for out in ("by_file", "by_flags")]
    assert written[0] == written[1]


@pytest.mark.parametrize(
    ("flags", "word"), [(("--range-min-m", "4"), "range_min_m"), (("--height-m", "9"), "height_m")]
)
def test_contradictory_geometry(pings: Path, flags: tuple[str, ...], word: str) -> None:
    """A flag that cannot be meant is named; it may be the file's value that it contradicts."""
    message = one_line_fault("run", pings, *flags, code=2)
    assert message.startswith(f"sonarrec: {flags[0]}: ")
    assert word in message
    assert message.count("\n") == 1
    stated = tomllib.loads((pings / "sonar.toml").read_text())["sonar"] | {word: float(flags[1])}
    (pings / "sonar.toml").write_text(tomli_w.dumps({"sonar": stated}))
    message = one_line_fault("run", pings, code=2)
    assert message.startswith(f"sonarrec: {pings / 'sonar.toml'}: ")
