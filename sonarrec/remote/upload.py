"""Results written to a server: made in a local folder first, uploaded when they are finished.

run.toml goes first where results are replaced and comes last: without it a folder on a server
holds no finished results. What was made from those of before goes as well. What could not be
uploaded stays, and is uploaded by the next run.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from sonarrec.files.outputs import is_output
from sonarrec.records import MissingError, Origin, SonarrecError
from sonarrec.remote.cache import Cache, key_of, only_one
from sonarrec.remote.store import Item, Store, writable
from sonarrec.remote.urls import Url, parse_url
from sonarrec.results.folders import ESTIMATES, MADE, OURS, PAGES, TABLES, estimates_of

_MARK = "run.toml"
_LARGE = ESTIMATES
"""Not fetched of results that are there only to be held against new ones: empty, it stands for the
one on the server."""


class Outbox:
    """The folder of a server that `--out` names.

    url: of that folder. folder: the local one that stands for it, in the cache but never taken
    away. origin: says the server's names in place of the local ones.
    """

    def __init__(self, out: Url, cache: Cache) -> None:
        """Raises UsageError where nothing can be written there."""
        self.url = writable(out)
        self.folder = cache.folder / "out" / key_of(self.url.shown)
        self.origin = Origin(self.url.shown, str(self.folder), self.url.shown.rstrip("/"))

    @contextmanager
    def results(self, name: str, *, upload: bool = True) -> Iterator[None]:
        """Inside, a run makes the results of a log in `folder`/<name>; after it they are uploaded.

        Those of before on the server are there to be held against, as far as that needs. upload:
        False where only that is done. Raises SonarrecError where the server cannot be read or
        written; what was made stays.
        """
        made, there = self.folder / name, self.url.child(name)
        with only_one(self.folder / f".{name}.upload", there.shown):
            with self.origin.translated():
                store = Store(there)
                if not _is_whole(made):
                    shutil.rmtree(made, ignore_errors=True)
                    _fetch_held(store, there, made)
                yield
            if _is_whole(made):
                if not upload:
                    return
                try:
                    _upload(store, made, there)
                except SonarrecError as error:
                    raise SonarrecError(
                        f"{error}; the results wait in {made}, and the same command uploads them"
                    ) from None
            shutil.rmtree(made, ignore_errors=True)

    def fetch(self, name: str, to: str | None = None) -> None:
        """Fetch a file, such as logs.csv, into `folder`, where there is one there.

        to: its name here. Raises SonarrecError.
        """
        store = Store(self.url)
        item = store.item(self.url.child(name))
        if item is not None:
            store.fetch(item, self.folder / (to or name))

    def put(self, name: str) -> None:
        """Upload a file of `folder`, where it is there. Raises SonarrecError."""
        if (self.folder / name).is_file():
            Store(self.url).put(self.folder / name, self.url.child(name))


def _is_whole(made: Path) -> bool:
    """Whether a run made results there, which were not uploaded yet."""
    large = estimates_of(made)
    return large.is_file() and large.stat().st_size > 0


def _upload(store: Store, made: Path, there: Url) -> None:
    try:
        files, folders = store.listing(there)
    except MissingError:
        files, folders = [], []
    before = {item.url.name: item for item in files}
    for old in sorted(before.keys() & set(OURS), key=lambda name: name != _MARK):
        store.remove(there.child(old))
    for place in (*_made_inside(store, there, folders), *_pages(store, before)):
        store.remove(place)
    paths = sorted(p for p in made.rglob("*") if p.is_file())
    for path in sorted(paths, key=lambda p: p == made / _MARK):
        store.put(path, there.child(path.relative_to(made).as_posix()))


def _made_inside(store: Store, there: Url, folders: Sequence[str]) -> Iterator[Url]:
    """What was made from the results of before, in folders: whole ones where nothing else is."""
    for name in MADE.keys() & set(folders):
        files, below = store.listing(there.child(name))
        ours = [item.url for item in files if item.url.name in MADE[name]]
        yield from ours if below or len(ours) < len(files) else [there.child(name)]


def _pages(store: Store, files: Mapping[str, Item]) -> Iterator[Url]:
    """The pages made from the results of before: by their mark, for others are the user's."""
    with tempfile.TemporaryDirectory(prefix="sonarrec-") as temporary:
        for name in PAGES.keys() & files.keys():
            store.fetch(files[name], page := Path(temporary) / name)
            if is_output(page, PAGES[name]):
                yield files[name].url


def _fetch_held(store: Store, there: Url, made: Path) -> None:
    """run.toml and tables of finished results on the server, where there are any."""
    names = (_MARK, *(name for name in TABLES if name not in _LARGE))
    items = [item for name in names if (item := store.item(there.child(name))) is not None]
    large = next((n for n in _LARGE if store.item(there.child(n)) is not None), None)
    if len(items) == len(names) and large is not None:
        for item in items:
            store.fetch(item, made / item.url.name)
        (made / large).touch()


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
