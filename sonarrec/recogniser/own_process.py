"""Shares the work on some items with a process of its own, on another core.

Threads would take turns at what is done in Python itself, which is half of the recogniser's time.
"""

from __future__ import annotations

import mmap
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from traceback import format_exc
from typing import Any, Generic, NoReturn, TypeVar

import cv2

Given = TypeVar("Given")
Item = TypeVar("Item")
Result = TypeVar("Result")
CAN_FORK = sys.platform == "linux"
"""Elsewhere a process would have to load all modules anew, or may not be forked safely."""
STOPS = signal.SIGINT, signal.SIGTERM
DEPTH = 8
"""How many items may wait at most: the process must not run out of them, but images are large."""
SCARCE = 3
"""With fewer that wait, the process makes the next one: it would soon have nothing to do."""


class OwnProcess(Generic[Given, Item, Result]):
    """A process that makes results of items; these are made by whichever process has time.

    It is a copy of this one, so that nothing has to be handed over but items and results; what the
    work changes in memory is changed in the copy alone. Items go through memory that both share.
    Until `close` is called, OpenCV has no threads: they would take the other one's core, and a copy
    has none. Make it before any other thread.
    """

    def __init__(
        self,
        make: Callable[[Given], Item],
        work: Callable[[Iterator[Item]], Iterator[Result]],
        most_bytes: int,
    ) -> None:
        """make: makes an item, whatever was made before it. work: makes the results.

        most_bytes: that the arrays of an item take, or those of what it is made of. Raises OSError
        where there is no room for another process.
        """
        self._make = make
        self._memory = [mmap.mmap(-1, most_bytes) for _ in range(DEPTH)]
        self._pipe, its_end = Pipe()
        self._threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        # Not to be stopped before it has settled that it is not: it would go on as this one does.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
        try:
            self._process = os.fork()
            if self._process == 0:
                self._pipe.close()
                _work(make, work, its_end, self._memory)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        its_end.close()

    def results(self, given: Iterable[Given]) -> Iterator[Result]:
        """The results, as soon as they are made. given: what the items are made of.

        An exception that the iterable or `make` raises is raised after the results of the items
        before it.
        Raises ChildProcessError where the process was killed.
        """
        left, broken = iter(given), None
        free, ended = [*range(DEPTH)], False
        while True:
            while ended or not free or self._pipe.poll():
                kind, what = self._told()
                if kind == "free":
                    free.append(what)
                elif kind == "result":
                    yield what
                elif kind == "end":
                    if broken is not None:
                        raise broken
                    return
                else:
                    raise what
            try:
                raw = next(left)
                made = DEPTH - len(free) >= SCARCE
                item = self._make(raw) if made else raw
            except BaseException as error:
                ended, broken = True, None if isinstance(error, StopIteration) else error
                self._tell(None)
            else:
                self._tell((free[-1], made, *_put(item, self._memory[free[-1]])))
                free.pop()

    def _tell(self, message: object) -> None:
        try:
            self._pipe.send(message)
        except OSError:
            raise ChildProcessError("killed") from None

    def _told(self) -> Any:
        try:
            return self._pipe.recv()
        except (EOFError, OSError):
            raise ChildProcessError("killed") from None

    def close(self) -> None:
        """Wait for the process to end, at the latest with the item that it works on."""
        self._pipe.close()
        os.waitpid(self._process, 0)
        cv2.setNumThreads(self._threads)


def _work(
    make: Callable[[Any], Any],
    work: Callable[[Iterator[Any]], Iterator[Any]],
    pipe: Connection,
    memory: list[mmap.mmap],
) -> NoReturn:
    """Make results until there are no more items, or nobody wants them; then end the process."""
    try:
        for stop in STOPS:
            signal.signal(stop, signal.SIG_IGN)  # the other one ends it
        for result in work(_items(make, pipe, memory)):
            pipe.send(("result", result))
        pipe.send(("end", None))
    except (EOFError, OSError):
        pass  # the other one has ended
    except BaseException as error:
        error.add_note(format_exc())
        pipe.send(("error", error))
    finally:
        os._exit(0)  # what else is to be done at the end, the other one does


def _items(make: Callable[[Any], Any], pipe: Connection, memory: list[mmap.mmap]) -> Iterator[Any]:
    """The items in order; each leaves its memory free for another."""
    while (told := pipe.recv()) is not None:
        slot, made, sizes, rest = told
        item = _taken(memory[slot], sizes, rest)
        pipe.send(("free", slot))
        yield item if made else make(item)


def _put(item: object, memory: mmap.mmap) -> tuple[list[int], bytes]:
    """Put an item's arrays into the memory. Returns their sizes in bytes, and the rest of it."""
    arrays: list[pickle.PickleBuffer] = []
    rest = pickle.dumps(item, protocol=5, buffer_callback=arrays.append)
    memory.seek(0)
    return [memory.write(array.raw()) for array in arrays], rest


def _taken(memory: mmap.mmap, sizes: list[int], rest: bytes) -> Any:
    """The item that `_put` was given; its arrays are copies, not to be written to."""
    memory.seek(0)
    return pickle.loads(rest, buffers=map(memory.read, sizes))
