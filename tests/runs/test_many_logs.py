"""Many logs in one call: what one of them does costs that one only."""

from __future__ import annotations

import errno
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sonarrec.results.folders import LockedError
from sonarrec.results.run_file import LogOptions
from sonarrec.runs import many
from sonarrec.runs.job import Job, Outcome, RunOptions
from sonarrec.runs.logs_table import COLUMNS, LogsTable, read_logs
from tests.support.batch import (
    SAMPLE,
    command,
    ended,
    environment,
    made,
    peak_mb,
    rows,
    tables,
    until,
)
from tests.support.camp import make_camp
from tests.support.command import sample_log, sonarrec
from tests.support.logs import cdr_image, frames, mcap_file
from tests.test_docs import PAGES, code_lines

BIN = Path(sys.executable).parent


def states(out: Path) -> dict[str, str]:
    return {name: row["status"] for name, row in rows(out).items()}


@pytest.mark.slow
def test_a_log_that_dies_or_raises_costs_itself_only(tmp_path: Path) -> None:
    logs = made(tmp_path, "a", "b", "dies", "c", "raises", "d", "cut")
    (tmp_path / "broken").mkdir()
    (tmp_path / "cut" / "000001.png").write_bytes(b"not an image")
    out = tmp_path / "out"
    call = command("run", *logs, tmp_path / "broken", "-j", 2, "-o", out)
    done = subprocess.run(call, capture_output=True, text=True, env=environment(tmp_path))
    assert done.returncode == 3, done.stderr
    told, failed = rows(out), ("dies", "raises", "broken")
    ended = {**dict.fromkeys("abcd", "done"), **dict.fromkeys(failed, "failed")}
    assert states(out) == ended | {"cut": "partial"}
    assert told["cut"]["unusable"] == "1"
    assert "SIGKILL" in told["dies"]["message"]
    assert "bug" in told["raises"]["message"]
    assert "ZeroDivisionError: a fault" in done.stderr
    assert "4 done, 1 partial, 3 failed" in done.stderr
    alone = tmp_path / "alone"
    sonarrec("run", logs[0], "-o", alone, "-q")
    assert all(tables(out / name) == tables(alone / "a") for name in "abcd")
    # A second call does what failed or was partly read.
    shutil.copy(SAMPLE / "000001.png", tmp_path / "cut")
    sonarrec("run", *logs, "-o", out, "-q", "--overwrite")
    assert states(out) == {**dict.fromkeys(ended | {"cut": ""}, "done"), "broken": "failed"}


def test_logs_whose_process_cannot_be_started_have_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their threads ended, and the call with 0, as if all were done."""

    def refused(*_: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(many.Processes, "_start", refused)
    call = ["run", *made(tmp_path, "a", "b", frames=1), "-j", "2", "-o", tmp_path / "out"]
    told = sonarrec(*call, code=1).stderr
    assert f"{tmp_path / 'a'}: no process" in told
    assert states(tmp_path / "out") == {"a": "failed", "b": "failed"}


def test_a_fault_beside_the_processes_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> Outcome:
        raise ZeroDivisionError

    monkeypatch.setattr(many.Processes, "run", broken)
    tasks = [Job(name, name, "out", LogOptions(), RunOptions([])) for name in "ab"]
    with pytest.raises(ZeroDivisionError):
        many.run_in_processes(tasks, 2, print)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[bytes]]:
    """The tables of a log of some frames, and of one longer than a run looks ahead."""
    place = tmp_path_factory.mktemp("undisturbed")
    logs = [*made(place, "short"), *made(place, "slow", frames=60)]
    sonarrec("run", *logs, "-o", place / "out", "-q")
    return {log.name: tables(place / "out" / log.name) for log in logs}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sent", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGKILL, -9)]
)
def test_a_call_that_is_stopped_goes_on(
    sent: signal.Signals, code: int, undisturbed: dict[str, list[bytes]], tmp_path: Path
) -> None:
    logs = [*made(tmp_path, "a"), *made(tmp_path, "slow", frames=60), *made(tmp_path, "b", "c")]
    out = tmp_path / "out"
    call = command("run", *logs, "-j", 2, "-o", out)
    with subprocess.Popen(call, env=environment(tmp_path), stderr=subprocess.PIPE) as running:
        part = out / "slow.part" / "frames.csv"
        until(lambda: part.is_file() and len(part.read_text().splitlines()) > 2, running)
        running.send_signal(sent)
        assert running.wait(300) == code, running.stderr.read().decode()
    time.sleep(2 * many._REPORT_EVERY_S)
    (tmp_path / "slow.go").touch()  # SIGKILL is noticed at the next report
    until(lambda: ended(tmp_path / "slow"))
    kept = part.read_text().splitlines()
    assert len(kept) > 2
    if code > 0:
        told = rows(out)["slow"]
        assert (told["status"], told["message"]) == ("waiting", "stopped")
        assert int(told["frames"]) == len(kept) - 1
    assert not (out / "slow").exists()
    finished = {file: file.stat().st_mtime_ns for file in out.glob("?/run.toml")}
    sonarrec("run", *logs, "-o", out)
    assert {file: file.stat().st_mtime_ns for file in finished} == finished, "done twice"
    assert {*states(out).values()} == {"done"}
    for log in logs:
        assert tables(out / log.name) == undisturbed["slow" if log.name == "slow" else "short"]


@pytest.mark.slow
def test_a_call_is_stopped_though_a_log_hangs(tmp_path: Path) -> None:
    logs = made(tmp_path, "a", "hangs")
    call = ["run", *logs, "-o", tmp_path / "out", "-q"]
    words = command(*call, "-j", 2)
    with subprocess.Popen(words, env=environment(tmp_path), stderr=subprocess.PIPE) as running:
        until((tmp_path / "hangs.held").is_file, running)
        running.send_signal(signal.SIGINT)
        try:
            assert running.wait(300) == 130, running.stderr.read().decode()
        finally:
            running.kill()
    until(lambda: ended(tmp_path / "hangs"))
    sonarrec(*call)


@pytest.mark.parametrize("share", ["0/3", "4/3", "1", "a/b", "1/0", "/"])
def test_a_share_that_cannot_be(share: str, tmp_path: Path) -> None:
    done = sonarrec("run", SAMPLE, "--shard", share, "-o", tmp_path / "out", code=2)
    assert "expected I/N" in done.stderr


def test_a_foreign_logs_csv_is_not_replaced(tmp_path: Path) -> None:
    (log,) = made(tmp_path, "a", frames=3)
    (tmp_path / "out").mkdir()
    mine = tmp_path / "out" / "logs.csv"
    for text in ("day,diver\n1,me\n", f"diver,{','.join(COLUMNS)}\n"):
        mine.write_text(text)
        done = sonarrec("run", log, "-o", tmp_path / "out")
        assert "logs.csv line 1" in done.stderr
        assert mine.read_text() == text
    assert (tmp_path / "out" / "a" / "frames.csv").is_file()


def test_a_log_that_another_call_has_in_hand_keeps_that_call_s_row(tmp_path: Path) -> None:
    """It was told as failed though it was done."""
    task = Job("a", "a", str(tmp_path), LogOptions(), RunOptions([]))
    first, second = (LogsTable(tmp_path, [task]) for _ in range(2))
    for table in (first, second):
        table.add(0, (0, None))
        table.write()
    second.add(0, Outcome("failed", error=LockedError("another run writes here now")))
    first.add(0, Outcome("done"))
    first.write()
    second.write()
    assert states(tmp_path) == {"a": "done"}


def test_a_log_that_ended_is_told_though_nothing_happens_after(tmp_path: Path) -> None:
    table = LogsTable(tmp_path, [Job(n, n, "out", LogOptions(), RunOptions([])) for n in "ab"])
    table.write()
    table.add(0, Outcome("done"))  # within the second in which the file is not written again
    until(lambda: rows(tmp_path)["a"]["status"] == "done")


def test_a_log_that_cannot_be_found_has_a_row_of_its_own(tmp_path: Path) -> None:
    """Under the name that its results will have: they are the others' names, too."""
    (log,) = made(tmp_path, "day1/dive", frames=1)
    (tmp_path / "day2").mkdir()
    (tmp_path / "day2" / "dive.mcap").touch()
    gone = tmp_path / "day3" / "dive.mcap"
    logs, out = [log, tmp_path / "day2" / "dive.mcap", gone], tmp_path / "out"
    sonarrec("run", *logs, "-j", "1", "-o", out, code=3)
    failed = dict.fromkeys(("day2-dive", "day3-dive"), "failed")
    assert states(out) == {"day1-dive": "done", **failed}
    assert (out / "day1-dive" / "run.toml").is_file()


@pytest.mark.slow
def test_a_dry_run_says_what_would_be_done_and_does_nothing(tmp_path: Path) -> None:
    logs = made(tmp_path, "a", "b", "c", frames=3)
    (logs[2] / "sonar.toml").write_text("[sonar]\nlayout = 3\n")
    out = tmp_path / "out"

    def told(*more: str, code: int = 3) -> list[str]:
        done = sonarrec("run", *logs, "-o", out, *more, code=code)
        return [line.partition(": ")[2] for line in done.stdout.splitlines()]

    assert told("--dry-run")[:2] == ["new", "new"]
    assert told("--dry-run")[2].startswith("fails (")
    assert not out.exists()
    sonarrec("run", logs[0], "-o", out, "-q")
    before = sorted((p, p.stat().st_mtime_ns) for p in out.rglob("*"))
    assert told("--dry-run")[:2] == ["up to date", "new"]
    anew = told("--dry-run", "--overwrite")
    assert anew[:2] == ["done again (asked for)"] * 2
    assert anew[2].startswith("fails (")
    changed = told("--dry-run", "--set", "features.declare=.9", "--set", "seed=3")
    assert "seed, features.declare" in changed[0]
    assert sorted((p, p.stat().st_mtime_ns) for p in out.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "text", "fault", "code"),
    [
        ("run --sonar", "[sonar]\ntilt_degg = 3\n", "tilt_degg", 2),
        ("info --sonar", "[sonar]\ntilt_degg = 3\n", "tilt_degg", 2),
        ("run --odometry", "timestamp,yaw\n0,a\n1,2\n", " line 2: yaw", 1),
    ],
)
def test_a_file_given_for_all_logs_is_told_once(
    words: str, text: str, fault: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    logs, bad = made(tmp_path, "a", "b", "c", frames=2), tmp_path / "bad"
    bad.write_text(text)
    [told] = sonarrec(*words.split(), bad, *logs, code=code).stderr.splitlines()
    assert told.startswith(f"sonarrec: {bad}")
    assert fault in told
    assert not (tmp_path / "sonarrec_out").exists()


@pytest.mark.slow
def test_a_refused_namesake_leaves_the_row_of_results_that_stand(tmp_path: Path) -> None:
    """The row became its own: the log that was done was told as failed, and done again."""
    logs = made(tmp_path, "day1/dive", "day2/dive", "other", frames=2)
    shutil.copy(SAMPLE / "000005.png", logs[1] / "000001.png")  # another log
    out = tmp_path / "out"

    def by_path() -> dict[str, str]:
        return {row.path: row.status for row in read_logs(out / "logs.csv")}

    sonarrec("run", logs[0], logs[2], "-o", out, "-q")
    both = ["run", logs[1], logs[2], "-o", out]
    assert "another log" in sonarrec(*both, code=3).stderr
    assert by_path() == {str(logs[0]): "done", str(logs[2]): "done", str(logs[1]): "failed"}
    kept = tables(out / "dive")
    assert "holds the results" in sonarrec(*both, code=3).stderr
    assert tables(out / "dive") == kept, "replaced unasked"
    sonarrec(*both, "--overwrite", "-q")
    assert by_path() == {str(logs[2]): "done", str(logs[1]): "done"}


def test_equal_lines_are_one_and_failures_come_again_at_the_end(tmp_path: Path) -> None:
    make_camp(tmp_path / "camp", 5, 3)
    call = ("run", tmp_path / "camp", "--recursive", "-j", 1, "-o", tmp_path / "out")
    lines = sonarrec(*call, code=3).stderr.splitlines()
    assert len([line for line in lines if ": geometry " in line]) == 2  # one a landmark set
    assert "sonarrec: 2 more logs: as dive01" in lines
    first, again = (n for n, line in enumerate(lines) if "not one frame" in line)
    [counted] = (n for n, line in enumerate(lines) if "4 done, 1 failed" in line)
    assert first < counted < again


def test_two_processes_give_the_bytes_of_one(tmp_path: Path) -> None:
    logs = made(tmp_path, "a", "b", frames=6)
    for jobs in "12":
        sonarrec("run", *logs, "--jobs", jobs, "-o", tmp_path / jobs)
    files = [path.relative_to(tmp_path / "1") for path in sorted((tmp_path / "1").glob("*/*.csv"))]
    assert len(files) == 6
    for file in files:
        assert (tmp_path / "2" / file).read_bytes() == (tmp_path / "1" / file).read_bytes()


@pytest.mark.slow
def test_memory_of_a_run_does_not_grow_with_the_log(tmp_path: Path) -> None:
    peaks = []
    for count in (1000, 4000):
        log = sample_log(tmp_path / str(count), 0)
        for n in range(count):
            (log / f"{n:06d}.png").symlink_to(SAMPLE / f"{n % 128:06d}.png")
        run = ["-m", "sonarrec", "run", str(log), "-q", "-o", str(tmp_path / "out")]
        peaks.append(peak_mb([sys.executable, *run]))
    assert peaks[1] < 1.05 * peaks[0]


@pytest.fixture
def shared(tmp_path: Path) -> Path:
    """A folder that all machines see, with four logs in two folders and the program's .venv."""
    place = tmp_path / "shared"
    for n, name in enumerate("abcd"):
        log = place / "dives" / str(n % 2) / f"{name}.mcap"
        images = frames(3, seed=n)
        mcap_file(log, [("/s", k * 10**8, cdr_image(image)) for k, image in enumerate(images)])
    (place / ".venv").mkdir()
    (place / ".venv" / "bin").symlink_to(BIN)
    (tmp_path / "bin").mkdir()
    srun = tmp_path / "bin" / "srun"
    srun.write_text('#!/bin/sh\nexec "$@"\n')
    srun.chmod(srun.stat().st_mode | stat.S_IXUSR)
    return place


@pytest.mark.slow
def test_a_slurm_array(shared: Path) -> None:
    """Every log is done, by one of the tasks, of which none had nothing to do."""
    blocks = re.split(r"\n\n+", "\n".join(code_lines(PAGES["run"])))
    [script] = (block for block in blocks if re.search("(?m)^#SBATCH", block))
    (shared / "job.sh").write_text(f"{script}\n")
    given = {"SLURM_ARRAY_TASK_COUNT": "2", "SLURM_CPUS_PER_TASK": "1", "SCRATCH": str(shared)}
    given["PATH"] = os.pathsep.join([f"{shared.parent}/bin", str(BIN), os.environ["PATH"]])

    def task(number: int) -> str:
        env = os.environ | given | {"SLURM_ARRAY_TASK_ID": str(number)}
        return subprocess.run(
            ["sh", "job.sh"], cwd=shared, env=env, capture_output=True, text=True, check=True
        ).stdout

    done = [re.findall(r"(?m)^(?:.*results/)?(\w)(?: +3 |: 3 frames)", task(n)) for n in (1, 2)]
    assert sorted(done[0] + done[1]) == [*"abcd"]
    assert all(done)
    status = {name: row["status"] for name, row in rows(shared / "results").items()}
    assert status == dict.fromkeys("abcd", "done")
    assert "2 up" in task(1)
