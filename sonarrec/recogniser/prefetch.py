"""Makes the next items of an iterable in a thread, while the caller works on one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Generic, TypeVar

import cv2

T = TypeVar("T")
DEPTH = 4
"""How many items may wait at most; few, since images are large."""
START_S = 5.0
"""How long a thread takes at most from the call that starts it to its first line."""


class Prefetcher(Generic[T]):
    """One pass over an iterable, in order, whose items are made in another thread.

    An exception that the iterable raises is raised after the items before it. The thread starts
    when the iteration does. Call `close` at the end: a thread that still decodes while Python exits
    makes the program abort.
    """

    def __init__(self, items: Iterable[T]) -> None:
        # Queues alone: Ctrl-C in the middle of a Semaphore would leave it locked for ever.
        self._made: SimpleQueue[tuple[T] | BaseException | None] = SimpleQueue()
        self._room: SimpleQueue[None] = SimpleQueue()
        for _ in range(DEPTH):
            self._room.put(None)
        self._begun: SimpleQueue[None] = SimpleQueue()
        self._started = self._closed = False
        self._thread = Thread(target=self._make, args=(items,), daemon=True)

    def _make(self, items: Iterable[T]) -> None:
        self._begun.put(None)
        cv2.ipp.setUseIPP(False)  # as in the package: each thread has its own switch
        last: BaseException | None = None
        try:
            left = iter(items)
            while self._has_room():
                self._made.put((next(left),))
        except StopIteration:
            pass
        except BaseException as error:
            last = error
        self._made.put(last)

    def _has_room(self) -> bool:
        """Wait until another item may be made; False where none is wanted any more."""
        self._room.get()
        return not self._closed

    def __iter__(self) -> Iterator[T]:
        self._started = True
        self._thread.start()
        while isinstance(made := self._made.get(), tuple):
            self._room.put(None)
            yield made[0]
        if made is not None:
            raise made

    def close(self) -> None:
        """End the thread, after the item that it is making."""
        self._closed = True
        self._room.put(None)
        if self._started:
            # Ctrl-C may have come while the thread was being started: only one that runs is joined.
            with suppress(Empty):
                self._begun.get(timeout=START_S)
                self._thread.join()
