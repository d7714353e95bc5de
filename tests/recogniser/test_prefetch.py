"""Items made ahead in a thread: the same in the same order, only a few, and no thread left."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import closing
from itertools import count, islice

import pytest

from sonarrec.recogniser.prefetch import DEPTH, Prefetcher


def test_the_same_in_the_same_order() -> None:
    ahead = Prefetcher(range(1000))
    assert [*ahead] == [*range(1000)]
    ahead.close()


def test_an_exception_comes_behind_the_items_before_it() -> None:
    def breaks() -> Iterator[int]:
        yield from range(3)
        raise KeyError("three")

    ahead = Prefetcher(breaks())
    items = iter(ahead)
    time.sleep(0.1)  # the thread is done long before
    assert [next(items) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(KeyError, match="three"):
        next(items)
    ahead.close()


def test_only_a_few_wait_and_the_thread_ends_with_them() -> None:
    made = []

    def endless() -> Iterator[int]:
        while True:
            made.append(len(made))
            yield made[-1]

    before = threading.active_count()
    ahead = Prefetcher(endless())
    items = iter(ahead)
    assert [next(items) for _ in range(10)] == [*range(10)]
    time.sleep(0.1)
    assert len(made) == 10 + DEPTH
    ahead.close()
    assert threading.active_count() == before
    assert len(made) == 10 + DEPTH


def test_of_one_behind_another_no_thread_is_left() -> None:
    before = threading.active_count()
    with closing(Prefetcher(count())) as first, closing(Prefetcher(first)) as second:
        assert [*islice(second, 10)] == [*range(10)]
        assert threading.active_count() == before + 2
    assert threading.active_count() == before


def test_ctrl_c_as_the_thread_begins_leaves_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that still decodes as the program ends makes it abort, with another exit code."""
    start = threading.Thread.start

    def stopped(self: threading.Thread) -> None:
        start(self)
        raise KeyboardInterrupt

    monkeypatch.setattr(threading.Thread, "start", stopped)
    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt), closing(Prefetcher(range(10 * DEPTH))) as ahead:
        next(iter(ahead))
    assert threading.active_count() == before
