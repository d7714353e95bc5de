"""Many logs in one call: what one of them does costs that one only."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SAMPLE = Path(__file__).parents[2] / "sample_data" / "pan"
FRAMES = 6
BEHAVIOUR = '''
"""Read by every process at its start: logs of these names misbehave while they are read."""
import os, signal, sys, time
if "sonarrec" in "".join(sys.orig_argv):
    from sonarrec.readers import log

    iterate = log.Log.__iter__

    def misbehave(self):
        for frame in iterate(self):
            yield frame
            if self.name == "hangs":
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
                time.sleep(1000)
            if self.name == "slow":
                time.sleep(0.2)
            if self.name == "dies":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.name == "raises":
                raise ZeroDivisionError("a fault of ours")

    log.Log.__iter__ = misbehave
'''


def made(folder: Path, *names: str, frames: int = FRAMES) -> list[Path]:
    """Logs of a few frames of the sample."""
    for name in names:
        (folder / name).mkdir(parents=True)
        shutil.copy(SAMPLE / "sonar.toml", folder / name)
        for i in range(frames):
            shutil.copy(SAMPLE / f"{i:06d}.png", folder / name)
    return [folder / name for name in names]


def environment(folder: Path) -> dict[str, str]:
    """In which logs misbehave by their names."""
    home = folder / "behaviour"
    home.mkdir(exist_ok=True)
    (home / "sitecustomize.py").write_text(BEHAVIOUR)
    return os.environ | {"PYTHONPATH": str(home)}


def command(*words: str | Path) -> list[str]:
    return [sys.executable, "-m", "sonarrec", *map(str, words)]


def rows(out: Path) -> dict[str, dict[str, str]]:
    with (out / "logs.csv").open(newline="") as file:
        return {row["log"]: row for row in csv.DictReader(file)}


def tables(folder: Path) -> list[bytes]:
    names = ("frames.csv", "estimates.csv", "sightings.csv")
    return [(folder / name).read_bytes() for name in names]


def test_a_log_that_dies_hangs_or_raises_costs_itself_only(tmp_path: Path) -> None:
    logs = made(tmp_path, "a", "b", "dies", "c", "raises", "hangs", "d")
    (tmp_path / "broken").mkdir()
    out = tmp_path / "out"
    done = subprocess.run(
        command("run", *logs, tmp_path / "broken", "-j", 2, "--timeout", 5, "-o", out),
        capture_output=True,
        text=True,
        env=environment(tmp_path),
    )
    assert done.returncode == 3, done.stderr
    told = rows(out)
    states = {name: row["status"] for name, row in told.items()}
    assert [name for name, state in states.items() if state == "done"] == ["a", "b", "c", "d"]
    assert {name for name, state in states.items() if state == "failed"} == {
        "dies",
        "raises",
        "hangs",
        "broken",
    }
    assert "SIGKILL" in told["dies"]["message"]
    assert "5 s (--timeout)" in told["hangs"]["message"]
    assert "fault of sonarrec" in told["raises"]["message"]
    assert "ZeroDivisionError: a fault of ours" in done.stderr
    assert "4 done, 4 failed" in done.stderr
    alone = tmp_path / "alone"
    subprocess.run(command("run", logs[0], "-o", alone, "-q"), check=True)
    assert all(tables(out / name) == tables(alone / "a") for name in "abcd")


def test_one_after_the_other_gives_the_same_as_side_by_side(tmp_path: Path) -> None:
    logs = made(tmp_path, "a", "b", "c")
    for jobs in (1, 3):
        out = tmp_path / str(jobs)
        subprocess.run(command("run", *logs, "-j", jobs, "-o", out, "-q"), check=True)
    for name in "abc":
        assert tables(tmp_path / "1" / name) == tables(tmp_path / "3" / name)


@pytest.mark.parametrize(
    ("sent", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGKILL, -9)]
)
def test_a_call_that_is_stopped_goes_on(sent: signal.Signals, code: int, tmp_path: Path) -> None:
    logs = made(tmp_path, "a", "slow", "b", "c", frames=20)
    out = tmp_path / "out"
    call = command("run", *logs, "-j", 2, "-o", out)
    with subprocess.Popen(call, env=environment(tmp_path), stderr=subprocess.PIPE) as running:
        part = out / "slow.part" / "frames.csv"
        while not (part.is_file() and len(part.read_text().splitlines()) > 2):
            time.sleep(0.05)
        running.send_signal(sent)
        assert running.wait(30) == code
    time.sleep(1)  # of SIGKILL: the log's process sees within .2 s that nobody waits for it
    kept = part.read_text().splitlines()
    assert 2 < len(kept) <= 21
    assert not (out / "slow").exists()
    finished = {
        name: (out / name / "run.toml").stat().st_mtime_ns
        for name in "abc"
        if (out / name).exists()
    }
    time.sleep(0.5)
    again = subprocess.run(call, capture_output=True, text=True)
    assert again.returncode == 0, again.stderr
    for name, when in finished.items():
        assert (out / name / "run.toml").stat().st_mtime_ns == when, "done twice"
    assert {row["status"] for row in rows(out).values()} == {"done"}
    fresh = tmp_path / "fresh"
    subprocess.run(command("run", *logs, "-o", fresh, "-q"), check=True)
    assert all(tables(out / log.name) == tables(fresh / log.name) for log in logs)


def test_shares_make_up_the_whole(tmp_path: Path) -> None:
    logs = made(tmp_path, *"abcde", frames=3)
    out = tmp_path / "out"
    running = [
        subprocess.Popen(command("run", *logs, "--shard", f"{i}/3", "-j", 1, "-o", out, "-q"))
        for i in (1, 2, 3)
    ]
    assert [process.wait() for process in running] == [0, 0, 0]
    assert sorted(rows(out)) == [*"abcde"]
    assert {row["status"] for row in rows(out).values()} == {"done"}


@pytest.mark.parametrize("share", ["0/3", "4/3", "1", "a/b", "1/0", "/"])
def test_a_share_that_cannot_be(share: str, tmp_path: Path) -> None:
    call = command("run", SAMPLE, "--shard", share, "-o", tmp_path / "out")
    done = subprocess.run(call, capture_output=True, text=True)
    assert done.returncode == 2
    assert "expected I/N" in done.stderr


def test_status_tells_the_table_while_it_grows_and_after(tmp_path: Path) -> None:
    logs = made(tmp_path, "a", "slow", frames=20)
    out = tmp_path / "out"
    with subprocess.Popen(
        command("run", *logs, "-j", 2, "-o", out, "-q"), env=environment(tmp_path)
    ) as running:
        states: set[str] = set()
        while running.poll() is None:
            if (out / "logs.csv").is_file():
                told = subprocess.run(command("status", out, "--json"), capture_output=True)
                states |= set(json.loads(told.stdout)["counts"])
    assert "running" in states
    told = subprocess.run(command("status", out), capture_output=True, text=True)
    assert told.stdout.startswith("2 logs: 2 done\n40 frames, 0 unusable")


def test_status_without_a_table(tmp_path: Path) -> None:
    told = subprocess.run(command("status", tmp_path), capture_output=True, text=True)
    assert told.returncode == 2
    assert "no such file" in told.stderr


def test_a_foreign_logs_csv_is_not_replaced(tmp_path: Path) -> None:
    (log,) = made(tmp_path, "a", frames=3)
    (tmp_path / "out").mkdir()
    mine = tmp_path / "out" / "logs.csv"
    mine.write_text("day,diver\n1,me\n")
    done = subprocess.run(
        command("run", log, "-o", tmp_path / "out"), capture_output=True, text=True
    )
    assert done.returncode == 0
    assert "logs.csv line 2: not a row of" in done.stderr
    assert mine.read_text() == "day,diver\n1,me\n"
    assert (tmp_path / "out" / "a" / "frames.csv").is_file()
