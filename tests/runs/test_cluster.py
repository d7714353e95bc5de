"""A Dask scheduler and two workers on this machine; one worker is killed on the way."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from sonarrec.config import preset
from sonarrec.results.run_file import LogOptions
from sonarrec.runs import cluster as cluster_module
from sonarrec.runs.cluster import run_on_cluster
from sonarrec.runs.job import Job, Outcome, RunOptions
from tests.support.batch import (
    SAMPLE,
    answers,
    command,
    ended,
    environment,
    made,
    rows,
    tables,
    until,
)
from tests.support.command import sonarrec


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """The scheduler's address; the scheduler, and two workers."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address, running = f"tcp://127.0.0.1:{port}", []

    def start(*words: str) -> None:
        running.append(
            subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{words[0]}", *words[1:]],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd=tmp_path.parent,  # paths are those of who calls
                env=environment(tmp_path),
                start_new_session=True,  # so that a worker is killed with its children
            )
        )

    try:
        start("scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
        until(lambda: answers(port))
        for _ in range(2):
            start("worker", address, "--nthreads", "1", "--no-dashboard")
        yield address, running
    finally:
        for process in running:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.slow
def test_a_worker_is_killed_and_no_log_is_lost(
    cluster: tuple[str, list[subprocess.Popen[bytes]]], tmp_path: Path
) -> None:
    address, (_, first, _) = cluster
    logs = made(tmp_path, "a", "b", "slow", "dies", "c", "d", frames=10)
    out = tmp_path / "out"
    call = command("run", *(log.name for log in logs), "--scheduler", address, "-o", "out")
    with subprocess.Popen(call, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as running:
        until(lambda: any((out / name).is_dir() for name in "abcd"), running)
        os.killpg(first.pid, signal.SIGKILL)
        (tmp_path / "slow.go").touch()
        _, said = running.communicate(timeout=300)
    assert running.returncode == 3, said
    done = ("a", "b", "slow", "c", "d")
    states = {name: row["status"] for name, row in rows(out).items()}
    assert states == {**dict.fromkeys(done, "done"), "dies": "failed"}
    assert "SIGKILL" in rows(out)["dies"]["message"]
    here = tmp_path / "here"
    sonarrec("run", *logs[:3], *logs[4:], "-o", here, "-q")
    assert all(tables(out / n) == tables(here / n) for n in done)


@pytest.mark.slow
def test_a_scheduler_that_dies_is_told_for_each_log_that_waits(
    cluster: tuple[str, list[subprocess.Popen[bytes]]], tmp_path: Path
) -> None:
    address, (scheduler, *_) = cluster
    logs = made(tmp_path, "a", "slow", "b", "c", frames=20)
    out = tmp_path / "out"
    call = command("run", *logs, "--scheduler", address, "-o", out, "-q")
    with subprocess.Popen(call, env=environment(tmp_path), stderr=subprocess.PIPE) as running:
        until((tmp_path / "slow.waits").is_file, running)
        # The table is written though no other log ends after this one.
        until(lambda: (out / "logs.csv").is_file() and rows(out)["a"]["status"] == "done", running)
        os.killpg(scheduler.pid, signal.SIGKILL)
        said = running.communicate(timeout=300)[1].decode().splitlines()
    (tmp_path / "slow.go").touch()  # its process ends, too
    until(lambda: ended(tmp_path / "slow"))
    assert running.returncode == 3
    *lost, count = [line for line in said if ": note: " not in line]
    assert any(line.startswith(f"sonarrec: {logs[1]}: ") for line in lost)
    assert all(line.endswith(": the scheduler gave up on it (cancelled)") for line in lost)
    assert count.startswith(f"{4 - len(lost)} done, {len(lost)} failed: {logs[1]}")


@pytest.mark.slow
def test_a_cluster_without_a_worker_is_told(tmp_path: Path) -> None:
    from distributed import LocalCluster  # here: to load it takes long

    task = Job(str(tmp_path / "none"), "none", str(tmp_path), LogOptions(), RunOptions(()))
    events: list[object] = []
    with LocalCluster(n_workers=0, dashboard_address=None) as empty:

        def watch(i: int | None, event: object) -> None:
            events.append(event.status if isinstance(event, Outcome) else event)
            if i is None:
                empty.scale(1)

        run_on_cluster([task], empty.scheduler_address, watch)
    told = f"{empty.scheduler_address}: there is no worker yet; the logs wait for one"
    assert events == [told, (0, None), "failed"]


def test_a_worker_in_another_folder_finds_the_geometry_above_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (log,) = made(tmp_path, "campaign/day1/dive", frames=1)
    (log / "sonar.toml").rename(tmp_path / "campaign" / "sonar.toml")
    monkeypatch.chdir(tmp_path)
    log_options = LogOptions(up_to=Path("campaign"))
    task = Job("campaign/day1/dive", "dive", "out", log_options, RunOptions([preset("default")]))
    monkeypatch.chdir(log.parent)
    assert cluster_module._run_on_worker(task, tmp_path).error is None
    assert (tmp_path / "out" / "dive" / "run.toml").is_file()


def test_no_scheduler_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sonarrec.runs.cluster.PATIENCE", "1s")
    (log,) = made(tmp_path, "a", frames=2)
    words = ["run", log, "--scheduler", "tcp://127.0.0.1:1", "-o", tmp_path / "out"]
    assert "scheduler answers" in sonarrec(*words, code=2).stderr


@pytest.mark.parametrize("address", ["foo:bar", "xx://foo:8786"])
def test_what_is_no_address_is_refused_at_once(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client begun in vain prints a traceback when it is let go."""
    monkeypatch.setattr("distributed.Client", None)
    told = sonarrec("run", SAMPLE, "--scheduler", address, "-o", tmp_path / "out", code=2).stderr
    assert f"--scheduler {address}: expected" in told
