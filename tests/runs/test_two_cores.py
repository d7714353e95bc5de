"""Runs on one core and on two: the same results, and what is kept where one goes wrong."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from itertools import count, islice
from pathlib import Path

import cv2
import pytest
from click.testing import CliRunner

from sonarrec.cli import main
from sonarrec.nouns import Selection
from sonarrec.recogniser.between_stages import AfterStage2, WorkingImage
from sonarrec.recogniser.three_stages import ThreeStages
from sonarrec.recogniser.together import FRAMES_AT_ONCE, Mapped, UntilBroken
from sonarrec.runs import two_cores as module
from sonarrec.runs.two_cores import CAN_FORK, WINDOW, two_cores
from tests.support.batch import made, tables
from tests.support.slow import but_first

forks = pytest.mark.skipif(not CAN_FORK, reason="this system has no processes of this kind")
either = pytest.mark.parametrize("which", [0, pytest.param(1, marks=forks)])


def running() -> tuple[set[int], set[threading.Thread]]:
    """The children and the threads of this process, in which other tests may have left some."""
    children = (task.read_text().split() for task in Path("/proc/self/task").glob("*/children"))
    return {int(pid) for pids in children for pid in pids}, {*threading.enumerate()}


@pytest.fixture(autouse=True)
def _nothing_is_left() -> Iterator[None]:
    before = running()
    yield
    children, threads = (now - then for now, then in zip(running(), before, strict=True))
    assert not children
    assert not threads


def is_gone(pid: int) -> bool:
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z"


@pytest.mark.parametrize("damaged", but_first([[0, 7, 8], [], [*range(12)]]))
@pytest.mark.parametrize("fork", [False, pytest.param(True, marks=forks)])
def test_a_run_is_the_same_on_one_core_and_on_two(
    fork: bool, damaged: Sequence[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a process more, or threads alone."""
    monkeypatch.setattr(module, "CAN_FORK", fork)
    (log,) = made(tmp_path, "log", frames=12)
    for number in damaged:
        image = log / f"{number:06d}.png"
        image.write_bytes(image.read_bytes()[:500] + b"?" + image.read_bytes()[501:])
    told, processes = {}, []
    begin = module._process
    monkeypatch.setattr(module, "_process", lambda work: (processes.append(1), begin(work))[1])
    for cores in (1, 2):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, n=cores: {*range(n)})
        out = tmp_path / str(cores)
        done = CliRunner().invoke(main, ["run", str(log), "-o", str(out)])
        told[cores] = done.exit_code, done.output.replace(str(out), "OUT")
        assert len(processes) == fork * (cores - 1) * (len(damaged) < 12)
        if len(damaged) < 12:
            assert done.exit_code in (0, 3), done.output
            told[cores] += (tables(out / "log"),)
    assert told[1] == told[2]
    assert told[1][0] == (1 if len(damaged) == 12 else 3 if damaged else 0)


@forks
def test_where_the_process_is_killed_the_frames_so_far_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (log,) = made(tmp_path, "log", frames=40)
    stage2 = ThreeStages.stage2

    def killed(self: ThreeStages, frame: WorkingImage, selection: Selection) -> AfterStage2:
        if frame.frame == 37:
            os.kill(os.getpid(), signal.SIGKILL)
        return stage2(self, frame, selection)

    monkeypatch.setattr(ThreeStages, "stage2", killed)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    done = CliRunner().invoke(main, ["run", str(log), "-o", str(tmp_path / "out")])
    assert done.exit_code == 1
    assert f"{log}: the process that follows its objects was killed" in done.stderr
    frames = (tmp_path / "out" / "log.part" / "frames.csv").read_text().splitlines()
    assert len(frames) == 1 + 2 * FRAMES_AT_ONCE


@either
def test_results_in_order_of_a_few_items_at_a_time(which: int) -> None:
    asked = []

    def items() -> Iterator[int]:
        for n in range(100):
            asked.append(n)
            yield n

    with two_cores() as ways:
        for n, told in enumerate(ways[which](lambda n: bytes([n]) * 2**17, items())):
            assert told == bytes([n]) * 2**17  # more than a pipe holds
            assert len(asked) <= n + 1 + WINDOW
    assert n == 99


@either
@pytest.mark.parametrize("where", ["items", "work"])
@pytest.mark.parametrize("fault", [ValueError, KeyboardInterrupt])
def test_a_fault_comes_behind_the_results_before_it(
    which: int, where: str, fault: type[BaseException]
) -> None:
    def breaks(place: str) -> Callable[[int], int]:
        def at_ten(n: int) -> int:
            if n == 10 and place == where:
                raise fault("power cut")
            return n

        return at_ten

    def results() -> Iterator[int]:
        with two_cores() as ways:
            items = UntilBroken(map(breaks("items"), range(20)))
            yield from ways[which](breaks("work"), items)
            items.end()

    told = []
    with pytest.raises(fault, match="power cut"):
        told.extend(results())
    assert told == [*range(10)]


@forks
def test_a_process_that_is_killed_is_told() -> None:
    def dies(n: int) -> int:
        if n == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return n

    told = []
    with two_cores() as (_, in_order), pytest.raises(BrokenProcessPool):
        told.extend(in_order(dies, range(10_000)))
    assert told == [0, 1, 2]


@forks
def test_signals_to_all_do_not_stop_the_process() -> None:
    """Ctrl-C reaches both; what is still to be done ends with the items."""

    def itself(n: int) -> int:
        os.kill(os.getpid(), signal.SIGINT if n % 2 else signal.SIGTERM)
        return n

    with two_cores() as (_, in_order):
        assert [*in_order(itself, range(20))] == [*range(20)]


@either
def test_closed_early_none_is_left(which: int) -> None:
    with two_cores() as ways:
        assert [*islice(ways[which](lambda n: 2 * n, count()), 50)] == [*range(0, 100, 2)]


@either
def test_opencv_has_no_threads_meanwhile(which: int) -> None:
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(3)
        with two_cores() as ways:
            assert [*ways[which](lambda _: cv2.getNumThreads(), range(3))] == [1, 1, 1]
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


@forks
def test_a_process_whose_maker_is_killed_ends(tmp_path: Path) -> None:
    end = tmp_path / "pid"

    def take(in_order: Mapped) -> None:
        for pid in in_order(lambda _: os.getpid(), count()):
            end.write_text(str(pid))
            os.kill(os.getpid(), signal.SIGKILL)

    maker = os.fork()
    if maker == 0:
        with two_cores() as (_, in_order):
            take(in_order)
    os.waitpid(maker, 0)
    pid, give_up = int(end.read_text()), time.monotonic() + 60
    while not is_gone(pid):
        assert time.monotonic() < give_up, "it goes on"
        time.sleep(0.01)
