"""What commands read and write, wherever each of it lies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Self

from sonarrec.records import Origin
from sonarrec.remote.ahead import Ahead
from sonarrec.remote.cache import Cache
from sonarrec.remote.fetch import (
    Fetched,
    RemoteLog,
    Told,
    fetched,
    fetched_file,
    fetched_results,
    find,
)
from sonarrec.remote.urls import is_url

if TYPE_CHECKING:
    from sonarrec.remote.upload import Outbox


class Elsewhere:
    """The logs of a run, those on servers found there, and where its results go.

    logs: a name of each in order, without secrets. paths: of those on servers, by their numbers,
    what their results are named by. out: the local folder that results are made in.
    """

    def __init__(self, names: Sequence[str], out: Path | str, cache: Callable[[], Cache]) -> None:
        """names: paths and URLs. cache: called where one of them is a URL.

        Raises UsageError where a URL cannot be meant.
        """
        found: list[str | RemoteLog] = []
        for name in names:
            found += find(name) if is_url(name) else [name]
        remote = [log if isinstance(log, RemoteLog) else None for log in found]
        self.logs = [log.url.shown if isinstance(log, RemoteLog) else log for log in found]
        self.paths = {i: log.path for i, log in enumerate(remote) if log is not None}
        self._box: Outbox | None = None
        if is_url(out):
            from sonarrec.remote.upload import Outbox  # with fsspec, only where needed

            self._box = Outbox(str(out), cache())
        self.out = Path(out) if self._box is None else self._box.folder
        self._ahead = Ahead(remote, cache()) if self.paths else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._ahead is not None:
            self._ahead.close()

    @contextmanager
    def log(self, number: int, told: Told) -> Iterator[tuple[Path, Origin | None]]:
        """What to open of the log of this number, and where it was fetched from.

        told: called as the bytes that are waited for come. Raises SonarrecError as `fetched`.
        """
        if self._ahead is None:
            yield Path(self.logs[number]), None
            return
        with self._ahead.log(number, told) as found:
            if found is None:
                yield Path(self.logs[number]), None
            else:
                yield found.path, found.origin

    @contextmanager
    def results(self, name: str | None) -> Iterator[Callable[[str], str]]:
        """Inside, results are made in `out`/<name>; after it they are where the run wants them.

        Gives what puts the server's names into a line. Raises SonarrecError.
        """
        with ExitStack() as held:
            if self._box is not None and name is not None:
                held.enter_context(self._box.results(name))
            yield str if self._box is None else self._box.origin.told


class Here:
    """What one command reads and writes, fetched into the cache or uploaded where it is a URL.

    All of it is held until the stack is closed, which is when what was written is uploaded; every
    method raises SonarrecError, and gives a local path back as it is. unused: a line for each part
    that could not be fetched.
    """

    def __init__(self, held: ExitStack, cache: Callable[[], Cache]) -> None:
        self._held, self._cache = held, cache
        self._origins: list[Origin] = []
        self.unused: list[str] = []

    def results(self, place: Path | str) -> Path:
        """The folder of results, of one log or of several."""
        if not is_url(place):
            return Path(place)
        return self._enter(fetched_results(str(place), self._cache()))

    def file(self, place: Path | str | None) -> Path | None:
        """A file that may be given, such as a table of truth."""
        if place is None or not is_url(place):
            return None if place is None else Path(place)
        return self._enter(fetched_file(str(place), self._cache()))

    def log(self, place: Path | str) -> Path:
        """What to open of a log."""
        return self._enter(fetched(str(place), self._cache())) if is_url(place) else Path(place)

    def output(self, place: Path | str, name: str = "") -> Path:
        """Where to write a folder, or the file of this name."""
        if not is_url(place):
            return Path(place)
        from sonarrec.remote.upload import uploaded  # with fsspec, only where needed

        path, origin = self._held.enter_context(uploaded(str(place), name))
        self._origins.append(origin)
        return path

    def _enter(self, opening: AbstractContextManager[Fetched]) -> Path:
        found = self._held.enter_context(opening)
        self._origins.append(found.origin)
        self.unused += found.unused
        return found.path

    def told(self, text: str) -> str:
        """A line with the server's names in place of the local ones."""
        for origin in self._origins:
            text = origin.told(text)
        return text


def inside(place: Path | str, name: str) -> Path | str:
    """A name in a folder, local or not."""
    return f"{str(place).rstrip('/')}/{name}" if is_url(place) else Path(place) / name
