"""Results written to a server: made in a local folder first, uploaded when they are finished.

run.toml goes first where results are replaced and comes last: without it a folder on a server
holds no finished results. What could not be uploaded stays, and is uploaded by the next run.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sonarrec.records import Origin, SonarrecError
from sonarrec.remote.cache import Cache, key_of, only_one
from sonarrec.remote.store import MissingError, Store, writable
from sonarrec.remote.urls import Url, parse_url
from sonarrec.results.folders import OURS

_MARK = "run.toml"
_WHOLE = "estimates.csv"  # results from before, held against new ones, come without it
_HELD = (_MARK, "frames.csv")


class Outbox:
    """The folder of a server that `--out` names.

    folder: the local one that stands for it, in the cache but never taken away. origin: says the
    server's names in place of the local ones.
    """

    def __init__(self, out: str, cache: Cache) -> None:
        """Raises UsageError where nothing can be written there."""
        self._url = writable(parse_url(out))
        self.folder = cache.folder / "out" / key_of(self._url.shown)
        self.origin = Origin(self._url.shown, str(self.folder), self._url.shown.rstrip("/"))

    @contextmanager
    def results(self, name: str) -> Iterator[None]:
        """Inside, a run makes the results of a log in `folder`/<name>; after it they are uploaded.

        Those of before on the server are there to be held against, as far as that needs.
        Raises SonarrecError where the server cannot be read or written; what was made stays.
        """
        made, there = self.folder / name, self._url.child(name)
        with only_one(self.folder / f".{name}.upload", there.shown):
            with self.origin.translated():
                store = Store(there)
                if not (made / _WHOLE).is_file():
                    shutil.rmtree(made, ignore_errors=True)
                    _fetch_held(store, there, made)
                yield
            if (made / _WHOLE).is_file():
                try:
                    _upload(store, made, there)
                except SonarrecError as error:
                    raise SonarrecError(
                        f"{error}; the results wait in {made}, and the same command uploads them"
                    ) from None
            shutil.rmtree(made, ignore_errors=True)


def _upload(store: Store, made: Path, there: Url) -> None:
    try:
        files, folders = store.listing(there)
    except MissingError:
        files, folders = [], []
    before = {item.url.name for item in files} | set(folders)
    for old in sorted(before & set(OURS), key=lambda name: name != _MARK):
        store.remove(there.child(old))
    paths = sorted(p for p in made.rglob("*") if p.is_file())
    for path in sorted(paths, key=lambda p: p == made / _MARK):
        store.put(path, there.child(path.relative_to(made).as_posix()))


def _fetch_held(store: Store, there: Url, made: Path) -> None:
    """run.toml and frames.csv of finished results on the server, where there are any."""
    items = [item for name in _HELD if (item := store.item(there.child(name))) is not None]
    if len(items) == len(_HELD):
        for item in items:
            store.fetch(item, made / item.url.name)


@contextmanager
def uploaded(out: str, name: str = "") -> Iterator[tuple[Path, Origin]]:
    """A local place for what is to be at `out`, uploaded at the end.

    name: of the one file that it is, "" of a folder. Raises SonarrecError where it cannot be
    uploaded.
    """
    url = writable(parse_url(out))
    with tempfile.TemporaryDirectory(prefix="sonarrec-") as temporary:
        folder = Path(temporary)
        place = folder / name if name else folder
        origin = Origin(url.shown, str(place), url.shown.rstrip("/"))
        with origin.translated():
            yield place, origin
        store = Store(url)
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            store.put(path, url if name else url.child(path.relative_to(folder).as_posix()))
