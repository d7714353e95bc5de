"""A few items made ahead in a thread: while one is worked on, the next are made."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Generic, TypeVar

import cv2

T = TypeVar("T")
DEPTH = 4
"""How many items wait at most: images are large."""
START_S = 5.0
"""How long a thread takes at most from the call that starts it to its first line."""


class Ahead(Generic[T]):
    """One pass over an iterable, in order, whose items are made in another thread.

    An exception that the iterable raises comes after the items before it. The thread begins with
    the first item that is asked for. Call `close` in the end: a thread that still decodes while
    Python ends makes the program abort.
    """

    def __init__(self, items: Iterable[T]) -> None:
        # Queues alone: Ctrl-C in the middle of a Semaphore would leave it locked for ever.
        self._made: SimpleQueue[tuple[T] | BaseException | None] = SimpleQueue()
        self._room: SimpleQueue[None] = SimpleQueue()
        for _ in range(DEPTH):
            self._room.put(None)
        self._begun: SimpleQueue[None] = SimpleQueue()
        self._asked = self._closed = False
        self._thread = Thread(target=self._make, args=(items,), daemon=True)

    def _make(self, items: Iterable[T]) -> None:
        self._begun.put(None)
        cv2.ipp.setUseIPP(False)  # as in __init__.py: each thread has its own switch
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
        self._asked = True
        self._thread.start()
        while isinstance(made := self._made.get(), tuple):
            self._room.put(None)
            yield made[0]
        if made is not None:
            raise made

    def close(self) -> None:
        """End the thread, once the item in the making is done."""
        self._closed = True
        self._room.put(None)
        if self._asked:
            # Ctrl-C may have come while the thread was being started: only one that runs is joined.
            with suppress(Empty):
                self._begun.get(timeout=START_S)
                self._thread.join()
