"""The logs and the results of one run, wherever each of them lies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Self

from sonarrec.records import Origin
from sonarrec.remote.cache import Cache
from sonarrec.remote.fetch import Ahead, RemoteLog, Told, find
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
