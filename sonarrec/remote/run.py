"""What commands read and write, wherever each of it lies."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from sonarrec.readers.many import NamedLog, find_logs, named
from sonarrec.records import Origin
from sonarrec.remote.cache import Cache
from sonarrec.remote.fetch import Fetched, fetched, fetched_file, fetched_results
from sonarrec.remote.find import RemoteLog, beside, find
from sonarrec.remote.urls import Url, is_url


@dataclass(frozen=True, slots=True)
class Elsewhere:
    """What of one log's run lies on servers; it can be pickled.

    log: to be fetched, None for a local one. out: the folder that results are uploaded to, None for
    a local one.
    """

    cache: Cache
    log: RemoteLog | None = None
    out: Url | None = None


def all_logs(
    names: Iterable[str], listed: Iterable[str] = (), *, recursive: bool = False
) -> list[NamedLog | RemoteLog]:
    """As `readers.many.find_logs`, of names and of a list, those on servers found there.

    Raises UsageError.
    """
    logs: list[NamedLog | RemoteLog] = []
    for name in named(names, listed):
        found = find(name, recursive=recursive) if is_url(name) else None
        logs += found or find_logs([name], recursive=recursive)
    return logs


class Here:
    """What one command reads and writes, fetched into the cache or uploaded where it is a URL.

    All of it is held until the stack is closed, which is when what was written is uploaded; every
    method raises SonarrecError, and gives a local path back as it is. unused: a line for each part
    that could not be fetched.
    """

    def __init__(self, held: ExitStack, cache: Callable[[], Cache]) -> None:
        self._held, self._cache = held, cache
        self._origins: list[Origin] = []
        self._beside: dict[Url, Path] = {}
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

    def beside(self, log: str, name: str) -> tuple[Path | None, int | None]:
        """Of a log on a server `find.beside`, a small file that is fetched without the cache."""
        from sonarrec.remote.store import Store  # with fsspec, only where needed

        item, size = beside(log, name)
        if item is None:
            return None, size
        if item.url not in self._beside:
            place = Path(self._held.enter_context(TemporaryDirectory(prefix="sonarrec-")))
            Store(item.url).fetch(item, place / item.url.name)
            origin = Origin(item.url.shown, str(place), item.url.parent.place)
            self._held.enter_context(origin.translated())
            self._origins.append(origin)
            self._beside[item.url] = place / item.url.name
        return self._beside[item.url], size

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
