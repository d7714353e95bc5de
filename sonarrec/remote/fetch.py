"""Fetches logs, tables and results into the cache.

Files have the same relative paths in the cache as on the server, so that a log's companions are
found beside it. In messages the paths of the cache are replaced by those of the server.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING
from uuid import uuid4

from sonarrec.errors import SonarrecError
from sonarrec.nouns import Origin
from sonarrec.remote.cache import Cache, NoRoomError, deleted, files_in, key_of, unwritable
from sonarrec.remote.find import RemoteLog, items_of, relative, with_literal_name
from sonarrec.remote.urls import Url, parse_url
from sonarrec.results.folders import ESTIMATES, TABLES

if TYPE_CHECKING:
    from sonarrec.remote.store import Item

RESULTS = frozenset({"run.toml", *TABLES, *ESTIMATES})
"""The files of results that are fetched. Without run.toml, uploaded last, they are unfinished."""
Progress = Callable[[int, int | None], None]
"""Called as bytes arrive with how many have arrived, and how many there are, None if unknown."""


@dataclass(frozen=True, slots=True)
class CachedCopy:
    """A log or results in the cache.

    path: the file, folder or glob to open. origin: the server's URL, for run.toml and messages.
    up_to: the highest folder in which companions of the log are searched. unused: a line for each
    part that was left out.
    """

    path: Path
    origin: Origin
    up_to: Path | None = None
    unused: tuple[str, ...] = ()


@contextmanager
def fetched(
    log: RemoteLog | str, cache: Cache, progress: Progress | None = None
) -> Iterator[CachedCopy]:
    """A log in the cache: fetched if it is missing or has changed, and kept while it is used.

    Several processes or threads may call it at once for one log; it is fetched once.
    It waits until other logs make room. progress: called as bytes arrive.
    Raises SonarrecError if it cannot be fetched. In a SonarrecError raised inside, paths of the
    cache are replaced by those of the server.
    """
    from sonarrec.remote.store import Store

    log = log if isinstance(log, RemoteLog) else RemoteLog(with_literal_name(parse_url(log)))
    root, name, items = items_of(log, Store(log.url))
    with _kept(log.url, root, items, cache, progress) as (files, origin):
        yield CachedCopy(files / name, origin, files if log.up_to else None)


@contextmanager
def fetched_file(text: str, cache: Cache) -> Iterator[CachedCopy]:
    """One file, such as a ground-truth table; otherwise as `fetched`."""
    from sonarrec.remote.store import Store

    url = parse_url(text)
    with _kept(url, url.parent, [Store(url).file(url)], cache) as (files, origin):
        yield CachedCopy(files / relative(url, url.parent), origin)


@contextmanager
def fetched_results(text: str, cache: Cache) -> Iterator[CachedCopy]:
    """The finished results at a URL, of one log or of several; otherwise as `fetched`.

    Raises SonarrecError if there are none. Results without run.toml, which is uploaded last, are
    not finished.
    """
    from sonarrec.remote.store import Store

    url = parse_url(text)
    store = Store(url)

    def results_in(folder: Url) -> list[Item]:
        return [item for item in store.listing(folder)[0] if item.url.name in RESULTS]

    found = {url: results_in(url)}
    if not found[url]:
        folders = [url.child(name) for name in store.listing(url)[1]]
        found = {folder: results_in(folder) for folder in folders}
    items: list[Item] = []
    unfinished: list[str] = []
    for folder, there in found.items():
        if {"run.toml", "frames.csv"} <= {item.url.name for item in there}:
            items += there
        elif there:
            why = "left out because its upload is not finished (it has no run.toml)"
            unfinished.append(f"{folder.redacted}: {why}")
    if not items:
        none = f"{url.redacted}: holds no results of `sonarrec run`"
        raise SonarrecError(unfinished[0] if unfinished else none)
    with _kept(url, url.parent, store.described(items), cache) as (files, origin):
        yield CachedCopy(files / relative(url, url.parent), origin, unused=tuple(unfinished))


@contextmanager
def _kept(
    url: Url, root: Url, items: Sequence[Item], cache: Cache, progress: Progress | None = None
) -> Iterator[tuple[Path, Origin]]:
    """The folder in the cache with exactly these files, which are not deleted inside.

    url: of the log or the results. root: the folder on the server that the one in the cache stands
    for. The folder is named by the files' versions. Files without one are fetched each time, and
    deleted after use.
    """
    # A dict, since a glob or an index page may name a file twice.
    wanted = {relative(item.url, root): item for item in items}
    lasting = all(item.has_version for item in wanted.values())
    versions = sorted((name, item.size, item.tag) for name, item in wanted.items())
    key = key_of(url.redacted, root.redacted, versions if lasting else uuid4().hex)
    try:
        while True:
            with cache.hold(key, alone=False) as entry:
                if all(_is_whole(entry, name, item) for name, item in wanted.items()):
                    origin = Origin(url.redacted, str(entry / "files"), root.place.rstrip("/"))
                    with origin.translated():
                        yield entry / "files", origin
                    return
            try:
                with cache.hold(key, alone=True) as entry:
                    _fill(entry, url.redacted, wanted, cache, progress)
            except NoRoomError:
                if not lasting:
                    raise
                sleep(1.0)
            except OSError as error:  # the disk is full
                raise unwritable(cache.folder, error) from None
    finally:
        if not lasting:
            deleted(cache.entry(key))


def _is_whole(entry: Path, name: str, item: Item) -> bool:
    path = entry / "files" / name
    return path.is_file() and item.size in (None, path.stat().st_size)


def _fill(
    entry: Path, url: str, wanted: dict[str, Item], cache: Cache, progress: Progress | None
) -> None:
    """Fetch the missing files, several at once. Raises SonarrecError."""
    from sonarrec.remote.store import AT_ONCE, Store

    sizes = [item.size for item in wanted.values()]
    cache.reserve(entry, sum(size or 0 for size in sizes), url)
    missing = [name for name, item in wanted.items() if not _is_whole(entry, name, item)]
    total = None if None in sizes else sum(wanted[name].size or 0 for name in missing)
    lacks = iter(missing)
    arrived, lock, errors = 0, threading.Lock(), list[BaseException]()

    def count(more: int) -> None:
        nonlocal arrived
        if errors:
            raise SonarrecError(f"{url}: given up")
        with lock:
            arrived += more
            if total is None:  # of files whose server states no size
                cache.reserve(entry, arrived, url)
            if progress is not None:
                progress(arrived, total)

    def work() -> None:
        try:
            while not errors and (name := next(lacks, None)):
                item = wanted[name]
                Store(item.url).fetch(item, entry / "files" / name, count)
        except BaseException as error:  # raised below
            errors.append(error)

    # Daemons, so that a run that is stopped does not wait for transfers.
    threads = [threading.Thread(target=work, daemon=True) for _ in missing[:AT_ONCE]]
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    except BaseException as error:
        errors.append(error)
        raise
    if errors:
        raise errors[0]
    cache.reserve(entry, sum(path.stat().st_size for path in files_in(entry)), url)
