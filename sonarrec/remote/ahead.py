"""The logs of a run one after another: the next one is fetched while one is used."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

from sonarrec.remote.cache import Cache, NoRoomError
from sonarrec.remote.fetch import Fetched, RemoteLog, Told, hold, untold


class Ahead:
    """The logs of a run one after another: the next one is fetched while one is used."""

    def __init__(self, logs: Sequence[RemoteLog | None], cache: Cache) -> None:
        """logs: those of the run in order, None for one that is local."""
        self._logs = [(number, log) for number, log in enumerate(logs) if log is not None]
        self._cache = cache
        self._stop = threading.Event()
        self._next: _UnderWay | None = None

    def close(self) -> None:
        """End what is under way."""
        self._stop.set()
        if self._next is not None:
            self._next.give_back()

    @contextmanager
    def log(self, number: int, told: Told = untold) -> Iterator[Fetched | None]:
        """The log of this number in the cache, until it is done with; None for a local one.

        told: called as the bytes that are waited for come. Raises SonarrecError as `fetched`.
        """
        mine = next((log for n, log in self._logs if n == number), None)
        following = next(((n, log) for n, log in self._logs if n > number), None)
        with ExitStack() as held:
            here = None
            if mine is not None:
                here = self._taken(number, mine, told, held)
                held.enter_context(here.origin.translated())
            if following is not None and self._next is None:
                self._next = _UnderWay(*following, self._cache, self._stop)
            yield here

    def _taken(self, number: int, log: RemoteLog, told: Told, held: ExitStack) -> Fetched:
        under_way = self._next
        if under_way is None or under_way.number != number:
            under_way = _UnderWay(number, log, self._cache, self._stop, wait=True)
        else:
            self._next = None
        held.callback(under_way.give_back)
        found = under_way.wait(told)
        if found is None:  # there was no room beside the log before
            return self._taken(number, log, told, held)
        return found


class _UnderWay:
    """A log that a thread fetches, and holds until it is given back."""

    def __init__(
        self,
        number: int,
        log: RemoteLog,
        cache: Cache,
        stop: threading.Event,
        *,
        wait: bool = False,
    ) -> None:
        """wait: for room that logs in use take."""
        self.number = number
        self._came: tuple[int, int | None] = 0, None
        self._found: Fetched | None = None
        self._error: BaseException | None = None
        self._held = ExitStack()
        self._stop, self._wait = stop, wait
        # A daemon: a run that is stopped does not wait for a block that is on its way.
        self._thread = threading.Thread(target=self._fetch, args=(log, cache), daemon=True)
        self._thread.start()

    def _fetch(self, log: RemoteLog, cache: Cache) -> None:
        def told(came: int, of: int | None) -> None:
            self._came = came, of

        try:
            self._found = self._held.enter_context(
                hold(log, cache, told, self._stop, wait=self._wait)
            )
        except BaseException as error:  # raised where the log is waited for
            self._error = error

    def wait(self, told: Told) -> Fetched | None:
        """The log once it is there; None where there was no room beside the log before."""
        while self._thread.is_alive():
            self._thread.join(0.1)
            told(*self._came)
        if self._error is not None and not isinstance(self._error, NoRoomError):
            raise self._error
        return self._found

    def give_back(self) -> None:
        """Others may take its room. What is still on its way ends by itself once stopped."""
        if not self._thread.is_alive():
            self._held.close()
