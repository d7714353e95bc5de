"""Results made in another process: the same in the same order, and no process left."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing
from itertools import count, islice
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from sonarrec.recogniser.own_process import CAN_FORK, DEPTH, SCARCE, OwnProcess

pytestmark = pytest.mark.skipif(not CAN_FORK, reason="this system has no processes of this kind")
Item = TypeVar("Item")
Numbers = npt.NDArray[np.float64]
MB = 2**20


def numbers(n: int) -> tuple[int, Numbers]:
    return n, np.random.default_rng(n).random((100, n % 7))


def sums_in_pairs(items: Iterator[tuple[int, Numbers]]) -> Iterator[list[tuple[int, float]]]:
    while pair := [*islice(items, 2)]:
        yield [(n, float(array.sum())) for n, array in pair]


def same(item: Item) -> Item:
    return item


def no_process_is_left() -> bool:
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)
    return True


def test_the_same_in_the_same_order() -> None:
    expected = [*sums_in_pairs(map(numbers, range(301)))]
    with closing(OwnProcess(same, sums_in_pairs, MB)) as process:
        assert [*process.results(map(numbers, range(301)))] == expected
    assert no_process_is_left()


def test_results_larger_than_what_a_pipe_holds() -> None:
    def large(items: Iterator[int]) -> Iterator[bytes]:
        for item in items:
            yield from (bytes([item]) * MB for _ in range(3))

    with closing(OwnProcess(same, large, MB)) as process:
        told = [*process.results(range(4 * DEPTH))]
    assert told == [bytes([n]) * MB for n in range(4 * DEPTH) for _ in range(3)]


def test_only_a_few_items_wait() -> None:
    made = []

    def items() -> Iterator[int]:
        for n in range(1000):
            made.append(n)
            yield n

    def slowly(items: Iterator[int]) -> Iterator[int]:
        for n in items:
            time.sleep(0.01)
            yield n

    with closing(OwnProcess(same, slowly, MB)) as process:
        results = process.results(items())
        for n in range(10):
            assert next(results) == n
            assert len(made) <= n + DEPTH + 2
    assert no_process_is_left()


def test_items_are_made_by_the_one_that_has_time() -> None:
    def made(n: int) -> tuple[int, int]:
        return n, os.getpid()

    def quickly(items: Iterator[tuple[int, int]]) -> Iterator[tuple[int, int]]:
        yield from items

    def slowly(items: Iterator[tuple[int, int]]) -> Iterator[tuple[int, int]]:
        for item in items:
            time.sleep(0.01)
            yield item

    def read_slowly() -> Iterator[int]:
        for n in range(50):
            time.sleep(0.01)
            yield n

    this = os.getpid()
    with closing(OwnProcess(made, slowly, MB)) as process:  # here, but for those it begins with
        told = [*process.results(range(50))]
    assert [n for n, _ in told] == [*range(50)]
    assert [maker == this for _, maker in told[:SCARCE]] == [False] * SCARCE
    assert sum(maker == this for _, maker in told) > 25
    with closing(OwnProcess(made, quickly, MB)) as process:  # there: it waits for each
        told = [*process.results(read_slowly())]
    assert [n for n, _ in told] == [*range(50)]
    assert sum(maker == this for _, maker in told) < 25


@pytest.mark.parametrize("few", [0, DEPTH + 1])
def test_a_fault_in_making_an_item_comes_behind_the_results(
    few: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All are made here, or all there."""
    monkeypatch.setattr("sonarrec.recogniser.own_process.SCARCE", few)
    this = os.getpid()
    places = []

    def made(n: int) -> float:
        places.append(os.getpid())
        return 10 / (5 - n)

    told = []
    with closing(OwnProcess(made, same, MB)) as process, pytest.raises(ZeroDivisionError):
        told.extend(process.results(count()))
    assert told == [10 / (5 - n) for n in range(5)]
    assert (this in places) == (few == 0)
    assert no_process_is_left()


@pytest.mark.parametrize("fault", [KeyError("five"), KeyboardInterrupt()])
def test_a_fault_of_the_items_comes_behind_their_results(fault: BaseException) -> None:
    def items() -> Iterator[tuple[int, Numbers]]:
        yield from map(numbers, range(5))
        raise fault

    told = []
    with closing(OwnProcess(same, sums_in_pairs, MB)) as process, pytest.raises(type(fault)):
        told.extend(process.results(items()))
    assert told == [*sums_in_pairs(map(numbers, range(5)))]
    assert no_process_is_left()


def test_a_fault_of_the_work_comes_behind_the_results_before_it() -> None:
    def breaks(items: Iterator[int]) -> Iterator[int]:
        for n in items:
            yield 10 // (3 - n)

    told = []
    with closing(OwnProcess(same, breaks, MB)) as process:
        with pytest.raises(ZeroDivisionError) as raised:
            told.extend(process.results(range(100)))
        assert "in breaks" in "".join(raised.value.__notes__)  # where it was raised
    assert told == [3, 5, 10]
    assert no_process_is_left()


def test_one_that_is_killed_is_told() -> None:
    def dies(items: Iterator[int]) -> Iterator[int]:
        for n in items:
            if n == 3:
                os.kill(os.getpid(), signal.SIGKILL)
            yield n

    told = []
    with (
        closing(OwnProcess(same, dies, MB)) as process,
        pytest.raises(ChildProcessError, match="killed"),
    ):
        told.extend(process.results(range(10_000)))
    assert told == [0, 1, 2]
    assert no_process_is_left()


def test_signals_to_all_do_not_stop_it() -> None:
    """Ctrl-C reaches both; what is still to be done ends with the items."""

    def itself(items: Iterator[int]) -> Iterator[int]:
        for n in items:
            os.kill(os.getpid(), signal.SIGINT if n % 2 else signal.SIGTERM)
            yield n

    with closing(OwnProcess(same, itself, MB)) as process:
        assert [*process.results(range(20))] == [*range(20)]


def test_a_signal_as_it_begins_stops_this_one_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    fork = os.fork

    def forked() -> int:
        process = fork()
        os.kill(os.getpid(), signal.SIGINT)  # in both
        return process

    monkeypatch.setattr(os, "fork", forked)
    this = os.getpid()
    with pytest.raises(KeyboardInterrupt):
        OwnProcess(same, sums_in_pairs, MB)
    assert os.getpid() == this
    os.waitpid(-1, 0)


def test_closed_early_none_is_left() -> None:
    def doubled(items: Iterator[int]) -> Iterator[int]:
        yield from (2 * n for n in items)

    with closing(OwnProcess(same, doubled, MB)) as process:
        assert [*islice(process.results(count()), 50)] == [*range(0, 100, 2)]
    assert no_process_is_left()
    with closing(OwnProcess(same, doubled, MB)):
        pass
    assert no_process_is_left()


def test_opencv_has_no_threads_meanwhile() -> None:
    def threads(items: Iterator[int]) -> Iterator[int]:
        image = np.random.default_rng(0).random((1000, 1000)).astype(np.float32)
        for _ in items:
            cv2.GaussianBlur(image, (0, 0), 5)
            yield cv2.getNumThreads()

    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(3)
        cv2.GaussianBlur(np.zeros((1000, 1000), np.float32), (0, 0), 5)  # they run
        with closing(OwnProcess(same, threads, MB)) as process:
            assert [*process.results(range(3))] == [1, 1, 1]
            assert cv2.getNumThreads() == 1
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


def test_a_process_whose_maker_is_killed_ends(tmp_path: Path) -> None:
    end = tmp_path / "pid"

    def itself(items: Iterator[int]) -> Iterator[int]:
        for _ in items:
            yield os.getpid()

    maker = os.fork()
    if maker == 0:
        process = OwnProcess(same, itself, MB)
        for pid in process.results(count()):
            end.write_text(str(pid))
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(maker, 0)
    pid = int(end.read_text())
    for _ in range(500):
        state = Path(f"/proc/{pid}/stat")
        if not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z":
            break
        time.sleep(0.01)
    else:
        pytest.fail("it goes on")
