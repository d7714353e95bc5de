"""One log on two cores, by the standard pools: stage 1 in threads, stages 2 and 3 in a process.

Stage 1 leaves Python's lock, so threads serve it, and images need not be handed over. Stages 2 and
3 do not: in a thread they would take turns with reading.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from threading import Thread
from traceback import format_exception
from typing import Any, TypeVar

import cv2

from sonarrec.recogniser.together import Burst, Mapped

Given = TypeVar("Given")
Made = TypeVar("Made")
CAN_FORK = sys.platform == "linux"
"""Elsewhere a process would have to load all modules anew, or may not be forked safely."""
STOPS = (signal.SIGINT, signal.SIGTERM)
THREADS = 2
WINDOW = 6
"""Items that are being made or wait at most: images are large."""
_work: Callable[[Any], Any]
"""What the process does; it is a copy of this one, so that nothing has to be handed over."""


@contextmanager
def two_cores() -> Iterator[tuple[Mapped, Mapped]]:
    """`anywhere` and `in_order` of `Together.results`. Meanwhile OpenCV has no threads of its own:
    they would take the other core, and a copied process has none.

    Raises BrokenProcessPool at the next result where the process was killed.
    """
    with ExitStack() as running:
        running.callback(cv2.setNumThreads, cv2.getNumThreads())
        cv2.setNumThreads(1)

        def in_order(work: Callable[[Given], Made], items: Iterable[Given]) -> Iterator[Made]:
            if CAN_FORK:
                with suppress(OSError):  # no room for another process
                    return _ordered(running.enter_context(_process(work)), items)
            return map(work, items)

        def anywhere(work: Callable[[Given], Made], items: Iterable[Given]) -> Iterator[Made]:
            threads = ThreadPoolExecutor(THREADS)
            running.callback(threads.shutdown, cancel_futures=True)
            return _ordered(lambda item: threads.submit(work, item), items)

        yield anywhere, in_order


@contextmanager
def _process(work: Callable[[Given], Made]) -> Iterator[Callable[[Given], Future[Made]]]:
    """A function that has a process do the work on its argument, one by one."""
    context = multiprocessing.get_context("fork")
    with ExitStack() as running:
        pool = ProcessPoolExecutor(1, context, _begin, (work,))
        running.callback(pool.shutdown, cancel_futures=True)
        # Signals to all are for this process: it ends the other one, which inherits the mask.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
        try:
            pool.submit(os.getpid)  # forks it now, before there are threads
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        yield lambda item: pool.submit(_do, item)


def _begin(work: Callable[[Any], Any]) -> None:
    global _work
    _work = work
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _do(item: Any) -> Any:
    made = _work(item)
    if isinstance(made, Burst) and made.error is not None:  # pickled it loses its traceback
        made.error.add_note("".join(format_exception(made.error)))
    return made


def _ordered(submit: Callable[[Given], Future[Made]], items: Iterable[Given]) -> Iterator[Made]:
    """The results in the items' order."""
    waiting = deque[Future[Made]]()
    for item in items:
        waiting.append(submit(item))
        while waiting and (len(waiting) == WINDOW or waiting[0].done()):
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
