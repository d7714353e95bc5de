"""Inputs and outputs of commands, local or on servers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from sonarrec.nouns import Origin
from sonarrec.readers.named_logs import NamedLog, log_arguments, logs_named
from sonarrec.remote.cache import Cache
from sonarrec.remote.fetch import CachedCopy, fetched, fetched_file, fetched_results
from sonarrec.remote.find import RemoteLog, beside, find
from sonarrec.remote.urls import Url, is_url


def all_logs(
    names: Iterable[str], listed: Iterable[str] = (), *, recursive: bool = False
) -> list[NamedLog | RemoteLog]:
    """The logs that names and a list of names stand for, local or on servers.

    Raises UsageError as `readers.named_logs.logs_named` and `find`.
    """
    logs: list[NamedLog | RemoteLog] = []
    for name in log_arguments(names, listed):
        remote_logs = find(name, recursive=recursive) if is_url(name) else None
        logs += remote_logs or logs_named(name, recursive=recursive)
    return logs


class RemoteFiles:
    """The inputs and outputs of one command: URLs are fetched or uploaded, local paths returned.

    Everything is held until the stack is closed, and outputs are uploaded then. Every method
    raises SonarrecError. unused: a line for each part that could not be fetched.
    """

    def __init__(self, stack: ExitStack, cache: Callable[[], Cache]) -> None:
        self._stack, self._cache = stack, cache
        self._origins: list[Origin] = []
        self._beside: dict[Url, Path] = {}
        self.unused: list[str] = []

    def results(self, place: Path | str) -> Path:
        """A results folder, of one log or of several."""
        return self._local(place, fetched_results)

    def file(self, place: Path | str | None) -> Path | None:
        """An optional file, such as a ground-truth table."""
        return None if place is None else self._local(place, fetched_file)

    def log(self, place: Path | str) -> Path:
        """The path to open for a log."""
        return self._local(place, fetched)

    def _local(
        self, place: Path | str, fetch: Callable[[str, Cache], AbstractContextManager[CachedCopy]]
    ) -> Path:
        if not is_url(place):
            return Path(place)
        copy = self._stack.enter_context(fetch(str(place), self._cache()))
        self._origins.append(copy.origin)
        self.unused += copy.unused
        return copy.path

    def beside(self, log: str, name: str) -> tuple[Path | None, int | None]:
        """As `find.beside`, with the file fetched to a temporary folder."""
        from sonarrec.remote.store import Store  # with fsspec, only where needed

        item, size = beside(log, name)
        if item is None:
            return None, size
        if item.url not in self._beside:
            place = Path(self._stack.enter_context(TemporaryDirectory(prefix="sonarrec-")))
            Store(item.url).fetch(item, place / item.url.name)
            origin = Origin(item.url.redacted, str(place), item.url.parent.place)
            self._stack.enter_context(origin.translated())
            self._origins.append(origin)
            self._beside[item.url] = place / item.url.name
        return self._beside[item.url], size

    def output(self, place: Path | str, name: str = "") -> Path:
        """A local place for an output folder, or for an output file of this name."""
        if not is_url(place):
            return Path(place)
        from sonarrec.remote.upload import uploaded  # with fsspec, only where needed

        path, origin = self._stack.enter_context(uploaded(str(place), name))
        self._origins.append(origin)
        return path

    def with_server_names(self, text: str) -> str:
        """A message with the paths of the server in place of local ones."""
        for origin in self._origins:
            text = origin.with_server_names(text)
        return text


def inside(place: Path | str, name: str) -> Path | str:
    """The path or URL of a name in a folder."""
    return f"{str(place).rstrip('/')}/{name}" if is_url(place) else Path(place) / name
