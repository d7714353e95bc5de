"""Logs, tables and results fetched into the cache: one by itself, or the next while one is used.

In the cache the files lie as they lie on the server, so that what belongs to a log is found beside
it there too, and a line that names a file is told with the server's name of it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sonarrec.records import Origin, SonarrecError, shown
from sonarrec.remote.cache import Cache, Entry, NoRoomError, key_of
from sonarrec.remote.find import RemoteLog, meant, relative, wanted
from sonarrec.remote.urls import Url, parse_url
from sonarrec.results.folders import ESTIMATES, TABLES

if TYPE_CHECKING:
    from sonarrec.remote.store import Item, Store

RESULTS = frozenset({"run.toml", *TABLES, *ESTIMATES})
"""What is read of results. run.toml is uploaded last: without it they are not finished."""
_LARGE = 2**20  # bytes of a file that is written down at once, lest it be fetched anew after a kill
Told = Callable[[int, int | None], None]
"""Told, as they come, how many bytes came and how many there are to come, None where unknown."""


def untold(_came: int, _all: int | None) -> None:
    pass


@dataclass(frozen=True, slots=True)
class Fetched:
    """A log or results in the cache, which stay there until they are given back.

    path: the file, folder or glob to open. origin: where it is from, for run.toml and every line.
    up_to: the folder up to which what belongs to it is looked for. unused: a line for each part
    that was left out.
    """

    path: Path
    origin: Origin
    up_to: Path | None = None
    unused: tuple[str, ...] = ()


@contextmanager
def fetched(
    log: RemoteLog | str, cache: Cache, told: Told = untold, stop: threading.Event | None = None
) -> Iterator[Fetched]:
    """A log in the cache, fetched where it is not there or has changed, kept while it is used.

    Any process or thread may call it, also for the same log at once: it is fetched once.
    told: called as bytes come. stop: set, it ends what is under way.
    Raises SonarrecError where it cannot be fetched. A SonarrecError raised inside is told with
    the server's names in place of those in the cache.
    """
    log = log if isinstance(log, RemoteLog) else RemoteLog(meant(parse_url(log)))
    with hold(log, cache, told, stop or threading.Event()) as found, found.origin.translated():
        yield found


@contextmanager
def hold(
    log: RemoteLog, cache: Cache, told: Told, stop: threading.Event, *, wait: bool = True
) -> Iterator[Fetched]:
    """wait: for room that other logs in use take, instead of NoRoomError."""
    from sonarrec.remote.store import Store

    root, name, items = wanted(log, Store(log.url, stop))
    with _kept(log.url.shown, root, items, cache, told, stop, wait) as entry:
        origin = Origin(log.url.shown, str(entry.files), root.place.rstrip("/"))
        yield Fetched(entry.files / name, origin, entry.files if log.up_to else None)


def fetch_ahead(log: RemoteLog, cache: Cache) -> None:
    """Fetch a log meanwhile, where there is room beside those in use, for `fetched` to find.

    What fails is told by `fetched`.
    """

    def fetch() -> None:
        with suppress(Exception), hold(log, cache, untold, threading.Event(), wait=False):
            pass

    # A daemon: a run that is stopped does not wait for a block that is on its way.
    threading.Thread(target=fetch, daemon=True).start()


@contextmanager
def fetched_file(text: str, cache: Cache) -> Iterator[Fetched]:
    """One file, such as a table of truth, as `fetched`."""
    from sonarrec.remote.store import Store

    url = parse_url(text)
    items, root = [Store(url).file(url)], url.parent
    with _found(url, root, items, cache) as found:
        yield found


@contextmanager
def _found(
    url: Url, root: Url, items: Sequence[Item], cache: Cache, unused: Sequence[str] = ()
) -> Iterator[Fetched]:
    """These files, which lie below `root`, as `fetched`."""
    with _kept(url.shown, root, items, cache, untold, threading.Event(), True) as entry:
        origin = Origin(url.shown, str(entry.files), root.place.rstrip("/"))
        with origin.translated():
            yield Fetched(entry.files / relative(url, root), origin, None, tuple(unused))


@contextmanager
def fetched_results(text: str, cache: Cache) -> Iterator[Fetched]:
    """The finished results at a URL, of one log or of several, as `fetched`.

    Raises SonarrecError where there is none: run.toml, which is uploaded last, is missing.
    """
    from sonarrec.remote.store import Store

    url = parse_url(text)
    store = Store(url)
    folders = [url]
    items, unfinished = _finished(store, url)
    if not items and not unfinished:
        folders = [url.child(name) for name in store.listing(url)[1]]
    found = [(folder, *_finished(store, folder)) for folder in folders]
    items = [item for _, finished, _ in found for item in finished]
    unused = [
        f"{folder.shown}: left out, for its upload is not finished (run.toml comes last)"
        for folder, _, unfinished in found
        if unfinished
    ]
    if not items:
        why = unused[0] if unused else f"{url.shown}: holds no results of `sonarrec run`"
        raise SonarrecError(why)
    with _found(url, url.parent, store.described(items), cache, unused) as there:
        yield there


def _finished(store: Store, folder: Url) -> tuple[list[Item], bool]:
    """(the tables of finished results in a folder, whether there are some that are not)."""
    files, _ = store.listing(folder)
    names = {item.url.name for item in files}
    there = [item for item in files if item.url.name in RESULTS]
    if "run.toml" in names and "frames.csv" in names:
        return there, False
    return [], bool(there)


@contextmanager
def _kept(
    url: str,
    root: Url,
    items: Sequence[Item],
    cache: Cache,
    told: Told,
    stop: threading.Event,
    wait: bool,
) -> Iterator[Entry]:
    """The entry with just these files, held: as it is where they are there, else fetched."""
    key = key_of(f"{url.rstrip('/')} {root.shown}")
    # Of a name that comes twice, by a glob or an index page, the one file.
    names = {relative(item.url, root): item for item in items}
    renewed = False
    while True:
        with cache.hold(key, alone=False, stop=stop) as entry:
            if _is_whole(entry, names, renewed):
                yield entry
                return
        with cache.hold(key, alone=True, stop=stop) as entry:
            if not _is_whole(entry, names, renewed):
                try:
                    _fill(entry, url, names, cache, told, stop)
                except NoRoomError:
                    if not wait:
                        raise
                    stop.wait(1.0)
                    continue
                except OSError as error:  # a full disk
                    raise SonarrecError(
                        f"{shown(entry.folder)}: cannot be written ({error.strerror}); choose "
                        "another --cache"
                    ) from None
            renewed = True


def _is_whole(entry: Entry, names: dict[str, Item], renewed: bool) -> bool:
    """Whether an entry holds these very files. renewed: those of which the server tells too little
    to know were fetched just now."""
    have = entry.about().get("files", {})
    if have.keys() != names.keys():
        return False
    return all(_is_there(entry, have, name, item, renewed) for name, item in names.items())


def _is_there(
    entry: Entry, have: dict[str, list[object]], name: str, item: Item, renewed: bool
) -> bool:
    path = entry.files / name
    if have.get(name) != [item.size, item.tag] or not path.is_file():
        return False
    if item.size is not None and path.stat().st_size != item.size:
        return False
    return item.known or renewed


def _fill(
    entry: Entry,
    url: str,
    names: dict[str, Item],
    cache: Cache,
    told: Told,
    stop: threading.Event,
) -> None:
    """Fetch what is not there, and delete what is there no more. Raises SonarrecError."""
    from sonarrec.remote.store import AT_ONCE, StoppedError, Store

    have = entry.about().get("files", {})
    have = {
        n: h for n, h in have.items() if n in names and _is_there(entry, have, n, names[n], False)
    }
    sizes = [item.size for item in names.values()]
    about = {"url": url, "bytes": sum(size or 0 for size in sizes), "files": have}
    cache.make_room(entry, about)
    parts = {f"{name}.{item.identity}.part" for name, item in names.items()}  # to go on with
    for path in sorted(entry.files.rglob("*")):
        if path.is_file() and path.relative_to(entry.files).as_posix() not in {*have, *parts}:
            path.unlink()
    lacks = [name for name in names if name not in have]
    total = None if None in sizes else sum(names[n].size or 0 for n in lacks)
    came, lock, given_up = [0], threading.Lock(), threading.Event()

    def count(more: int) -> None:
        if given_up.is_set():
            raise StoppedError(f"{url}: given up")
        with lock:
            came[0] += more
            told(came[0], total)

    def one(name: str) -> None:
        item = names[name]
        Store(item.url, stop).fetch(item, entry.files / name, count)
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
    held = sum(p.stat().st_size for p in entry.files.rglob("*") if p.is_file())
    entry.write({**about, "bytes": held, "files": have})


def _at_once(one: Callable[[str], None], names: Sequence[str], most: int) -> None:
    """Call it for each name, `most` at a time, until one of them raises, which is raised.

    By daemons, not by an executor: a run that is stopped does not wait for what is on its way.
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
