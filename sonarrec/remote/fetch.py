"""Fetches logs, tables and results into the cache, if wanted in the background.

Files have the same relative paths in the cache as on the server, so that a log's companions are
found beside it. In messages the paths of the cache are replaced by those of the server.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING

from sonarrec.errors import SonarrecError
from sonarrec.nouns import Origin
from sonarrec.remote.cache import Cache, Entry, NoRoomError, key_of, unwritable
from sonarrec.remote.find import RemoteLog, items_of, relative, with_literal_name
from sonarrec.remote.urls import Url, parse_url
from sonarrec.results.folders import ESTIMATES, TABLES

if TYPE_CHECKING:
    from sonarrec.remote.store import Item, Store

RESULTS = frozenset({"run.toml", *TABLES, *ESTIMATES})
"""The files of results that are fetched. Without run.toml, uploaded last, they are unfinished."""
_LARGE = 2**20  # bytes; larger files are recorded as soon as they are there, in case of a kill
Progress = Callable[[int, int | None], None]
"""Called as bytes arrive with how many have arrived, and how many there are, None if unknown."""


def no_progress(_arrived: int, _all: int | None) -> None:
    pass


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
    log: RemoteLog | str, cache: Cache, progress: Progress = no_progress
) -> Iterator[CachedCopy]:
    """A log in the cache: fetched if it is missing or has changed, and kept while it is used.

    Several processes or threads may call it at once for one log; it is fetched once.
    progress: called as bytes arrive.
    Raises SonarrecError if it cannot be fetched. In a SonarrecError raised inside, paths of the
    cache are replaced by those of the server.
    """
    log = log if isinstance(log, RemoteLog) else RemoteLog(with_literal_name(parse_url(log)))
    with _hold(log, _Transfer(cache, progress)) as local_log, local_log.origin.translated():
        yield local_log


@dataclass(frozen=True, slots=True)
class _Transfer:
    """How files get into the cache.

    progress: called as bytes arrive. wait: until other logs make room, instead of raising
    NoRoomError.
    """

    cache: Cache
    progress: Progress = no_progress
    wait: bool = True


@contextmanager
def _hold(log: RemoteLog, transfer: _Transfer) -> Iterator[CachedCopy]:
    """As `fetched`, but errors raised inside keep the paths of the cache."""
    from sonarrec.remote.store import Store

    root, name, items = items_of(log, Store(log.url))
    with _keep(log.url, root, items, transfer) as (files, origin):
        yield CachedCopy(files / name, origin, files if log.up_to else None)


def fetch_ahead(log: RemoteLog, cache: Cache) -> None:
    """Fetch a log in the background, if there is room beside the logs in use.

    `fetched` then finds it, or reports the error.
    """

    def fetch() -> None:
        with suppress(Exception), _hold(log, _Transfer(cache, wait=False)):
            pass

    # A daemon, so that a run that is stopped does not wait for the transfer.
    threading.Thread(target=fetch, daemon=True).start()


@contextmanager
def fetched_file(text: str, cache: Cache) -> Iterator[CachedCopy]:
    """One file, such as a ground-truth table; otherwise as `fetched`."""
    from sonarrec.remote.store import Store

    url = parse_url(text)
    with _fetched_below(url, [Store(url).file(url)], cache) as found:
        yield found


@contextmanager
def _fetched_below(
    url: Url, items: Sequence[Item], cache: Cache, unused: Sequence[str] = ()
) -> Iterator[CachedCopy]:
    """The file at a URL, or these files in the folder there; otherwise as `fetched`."""
    root = url.parent
    with _keep(url, root, items, _Transfer(cache)) as (files, origin), origin.translated():
        yield CachedCopy(files / relative(url, root), origin, None, tuple(unused))


@contextmanager
def fetched_results(text: str, cache: Cache) -> Iterator[CachedCopy]:
    """The finished results at a URL, of one log or of several; otherwise as `fetched`.

    Raises SonarrecError if there are none. Results without run.toml, which is uploaded last, are
    not finished.
    """
    from sonarrec.remote.store import Store

    url = parse_url(text)
    store = Store(url)
    folders = [url]
    items, unfinished = _finished(store, url)
    if not items and not unfinished:
        folders = [url.child(name) for name in store.listing(url)[1]]
    per_folder = [(folder, *_finished(store, folder)) for folder in folders]
    items = [item for _, finished, _ in per_folder for item in finished]
    unused = [
        f"{folder.redacted}: left out because its upload is not finished (it has no run.toml)"
        for folder, _, unfinished in per_folder
        if unfinished
    ]
    if not items:
        why = unused[0] if unused else f"{url.redacted}: holds no results of `sonarrec run`"
        raise SonarrecError(why)
    with _fetched_below(url, store.described(items), cache, unused) as found:
        yield found


def _finished(store: Store, folder: Url) -> tuple[list[Item], bool]:
    """(the files of the results in a folder if they are finished, whether they are unfinished)."""
    files, _ = store.listing(folder)
    names = {item.url.name for item in files}
    there = [item for item in files if item.url.name in RESULTS]
    if "run.toml" in names and "frames.csv" in names:
        return there, False
    return [], bool(there)


@contextmanager
def _keep(
    url: Url, root: Url, items: Sequence[Item], transfer: _Transfer
) -> Iterator[tuple[Path, Origin]]:
    """The folder in the cache with exactly these files, which are not deleted inside.

    They are fetched if they are missing or have changed. url: of the log or the results. root: the
    folder on the server that the one in the cache stands for.
    """
    key = key_of(f"{url.redacted.rstrip('/')} {root.redacted}")
    # A dict, since a glob or an index page may name a file twice.
    wanted = {relative(item.url, root): item for item in items}
    cache, renewed = transfer.cache, False
    while True:
        with cache.hold(key, alone=False) as entry:
            if _is_whole(entry, wanted, renewed):
                yield entry.files, Origin(url.redacted, str(entry.files), root.place.rstrip("/"))
                return
        try:
            with cache.hold(key, alone=True) as entry:
                if not _is_whole(entry, wanted, renewed):
                    _fill(entry, url.redacted, wanted, transfer)
                renewed = True
        except NoRoomError:
            if not transfer.wait:
                raise
            sleep(1.0)
        except OSError as error:  # the disk is full
            raise unwritable(cache.folder, error) from None


def _is_whole(entry: Entry, wanted: dict[str, Item], renewed: bool) -> bool:
    """Whether an entry holds exactly the wanted files, by their path below its `files`.

    renewed: it was fetched just now, so files whose version the server does not state are current.
    """
    have = entry.about().get("files", {})
    if have.keys() != wanted.keys():
        return False
    return all(_is_there(entry, have, name, item, renewed) for name, item in wanted.items())


def _is_there(
    entry: Entry, have: dict[str, list[object]], name: str, item: Item, renewed: bool
) -> bool:
    """Whether a file is in an entry, in the version that the server has. have: by entry.json."""
    path = entry.files / name
    if have.get(name) != [item.size, item.tag] or not path.is_file():
        return False
    if item.size is not None and path.stat().st_size != item.size:
        return False
    return item.has_version or renewed


def _fill(entry: Entry, url: str, wanted: dict[str, Item], transfer: _Transfer) -> None:
    """Fetch the missing files and delete others. Raises SonarrecError."""
    from sonarrec.remote.store import AT_ONCE, Store

    held = entry.about().get("files", {})
    have = {
        name: held[name]
        for name, item in wanted.items()
        if _is_there(entry, held, name, item, False)
    }
    sizes = [item.size for item in wanted.values()]
    about = {"url": url, "bytes": sum(size or 0 for size in sizes), "files": have}
    transfer.cache.make_room(entry, about)
    # Transfers that were broken off go on where they were.
    parts = {f"{name}.{item.identity}.part" for name, item in wanted.items()}
    for path in _files_below(entry.files):
        if path.relative_to(entry.files).as_posix() not in {*have, *parts}:
            path.unlink()
    lacks = [name for name in wanted if name not in have]
    total = None if None in sizes else sum(wanted[n].size or 0 for n in lacks)
    arrived, lock, given_up = 0, threading.Lock(), threading.Event()

    def count(more: int) -> None:
        nonlocal arrived
        if given_up.is_set():
            raise SonarrecError(f"{url}: given up")
        with lock:
            arrived += more
            transfer.progress(arrived, total)

    def one(name: str) -> None:
        item = wanted[name]
        Store(item.url).fetch(item, entry.files / name, count)
        with lock:
            have[name] = [item.size, item.tag]
            if (item.size or 0) >= _LARGE:
                entry.write(about)

    try:
        _at_once(one, lacks, AT_ONCE)
    except BaseException:
        given_up.set()
        raise
    finally:
        entry.write(about)
    size = sum(path.stat().st_size for path in _files_below(entry.files))
    entry.write({**about, "bytes": size})


def _files_below(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _at_once(one: Callable[[str], None], names: Sequence[str], most: int) -> None:
    """Call `one` for each name, `most` at a time; raises the first error.

    In daemon threads, so that a run that is stopped does not wait for transfers.
    """
    left, errors = deque(names), list[BaseException]()

    def work() -> None:
        while left and not errors:
            try:
                name = left.popleft()
            except IndexError:  # another thread was quicker
                return
            try:
                one(name)
            except BaseException as error:  # raised below
                errors.append(error)

    threads = [threading.Thread(target=work, daemon=True) for _ in names[:most]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
