"""Runs on one core and on several: the same results, and what is kept where one goes wrong."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest
from click.testing import CliRunner

from sonarrec.cli import main
from sonarrec.recogniser import together
from sonarrec.recogniser.between_stages import AfterStage1, AfterStage2
from sonarrec.recogniser.own_process import CAN_FORK, OwnProcess
from sonarrec.recogniser.prefetch import Prefetcher
from sonarrec.recogniser.three_stages import ThreeStages
from sonarrec.recogniser.together import FRAMES_AT_ONCE
from tests.support.batch import made, tables


@pytest.mark.parametrize("damaged", [(), (5,), (0, 7, 8), range(12)])
@pytest.mark.parametrize("fork", [False, True])
def test_a_run_is_the_same_with_and_without(
    fork: bool,
    damaged: Sequence[int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With a process more, or two threads."""
    if fork and not CAN_FORK:
        pytest.skip("this system has no processes of this kind")
    monkeypatch.setattr(together, "CAN_FORK", fork)
    (log,) = made(tmp_path, "log", frames=12)
    for number in damaged:
        image = log / f"{number:06d}.png"
        image.write_bytes(image.read_bytes()[:500] + b"?" + image.read_bytes()[501:])
    told = {}
    threads, processes = [], []
    make, begin = Prefetcher._make, OwnProcess.__init__
    monkeypatch.setattr(Prefetcher, "_make", lambda *given: (threads.append(given), make(*given)))
    monkeypatch.setattr(OwnProcess, "__init__", lambda *a: (processes.append(a), begin(*a))[1])
    before = threading.active_count()
    for cores in (1, 2):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, n=cores: {*range(n)})
        out = tmp_path / str(cores)
        done = CliRunner().invoke(main, ["run", str(log), "-o", str(out)])
        told[cores] = done.exit_code, done.output.replace(str(out), "OUT")
        used = (cores - 1) * (len(damaged) < 12)
        assert len(processes) == fork * used
        assert len(threads) == 2 * (not fork) * used
        if len(damaged) < 12:
            told[cores] += (tables(out / "log"),)
    assert told[1] == told[2]
    assert told[1][0] == (1 if len(damaged) == 12 else 3 if damaged else 0)
    assert threading.active_count() == before


@pytest.mark.skipif(not CAN_FORK, reason="this system has no processes of this kind")
def test_where_the_process_is_killed_the_frames_so_far_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (log,) = made(tmp_path, "log", frames=40)
    stage2 = ThreeStages.stage2

    def killed(self: ThreeStages, frame: AfterStage1) -> AfterStage2:
        if frame.frame == 37:
            os.kill(os.getpid(), signal.SIGKILL)
        return stage2(self, frame)

    monkeypatch.setattr(ThreeStages, "stage2", killed)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    done = CliRunner().invoke(main, ["run", str(log), "-o", str(tmp_path / "out")])
    assert done.exit_code == 1
    assert f"{log}: the process that follows its objects was killed" in done.stderr
    frames = (tmp_path / "out" / "log.part" / "frames.csv").read_text().splitlines()
    assert len(frames) == 1 + 2 * FRAMES_AT_ONCE
