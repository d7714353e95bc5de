"""Logs, tables and results fetched into the cache: one by itself, or the next while one is used.

In the cache the files lie as they lie on the server, so that what belongs to a log is found beside
it there too, and a line that names a file is told with the server's name of it.
"""

from __future__ import annotations

import threading
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from sonarrec.readers.bag_folder import METADATA, are_parts
from sonarrec.readers.find import log_name, names_a_log
from sonarrec.readers.images import names_an_image, natural_order
from sonarrec.records import MissingError, Origin, SonarrecError, UsageError
from sonarrec.remote.cache import Cache, Entry, NoRoomError, key_of
from sonarrec.remote.urls import Url, parse_url
from sonarrec.results.folders import TABLES

if TYPE_CHECKING:
    from sonarrec.remote.store import Item, Store

COMPANIONS = ("sonar.toml", "poses.csv", "gt.csv")
"""What belongs to a log: these, and each as NAME.sonar.toml and so on."""
RESULTS = ("run.toml", *TABLES)
"""What is read of results. run.toml is uploaded last: without it they are not finished."""
_LARGE = 2**20  # bytes of a file that is written down at once, lest it be fetched anew after a kill
Told = Callable[[int, int | None], None]
"""Told, as they come, how many bytes came and how many there are to come, None where unknown."""


def untold(_came: int, _all: int | None) -> None:
    pass


@dataclass(frozen=True, slots=True)
class RemoteLog:
    """A log on a server: a file, a folder, or a glob of images. up_to: the folder that was given
    and holds it, up to which what belongs to it is looked for."""

    url: Url
    up_to: Url | None = None

    @property
    def path(self) -> Path:
        """As if the server were a disk: what results are named by. Of a glob its folder."""
        url = _fixed(self.url)
        host = url.front.partition("://")[2].rpartition("@")[2]
        return Path("/", host, url.path.strip("/"))

    @property
    def shown(self) -> str:
        """The URL for lines and files, without its secrets."""
        return self.url.shown

    @property
    def name(self) -> str:
        """Of its results."""
        return log_name(self.path) if _is_file(self.url) else self.path.name


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


def find(text: str, *, recursive: bool = False) -> list[RemoteLog]:
    """The logs that a URL names, in natural order: one, those of a folder, those that match a glob.

    A folder of images or a bag is one log, and so are the images that match. Of a server that does
    not answer the URL itself is the log, which is told when its turn comes.
    Raises UsageError where the URL cannot be meant, or a folder holds images and other logs.
    """
    url = parse_url(text)
    try:
        return _found(url, recursive)
    except SonarrecError as error:
        if isinstance(error, UsageError) and not isinstance(error, MissingError):
            raise
        return [RemoteLog(url)]


def _found(url: Url, recursive: bool) -> list[RemoteLog]:
    from sonarrec.remote.store import Store

    if _is_glob(url):
        logs = _bags_as_one(Store(url), url)
        up_to = _fixed(url)
    elif _is_file(url):
        return [RemoteLog(url)]
    else:
        logs, up_to = list(_below(Store(url), url, recursive)), url
    if not logs or [log.path.rstrip("/") for log in logs] == [url.path.rstrip("/")]:
        return [RemoteLog(url)]
    logs.sort(key=lambda log: natural_order(Path(log.path)))
    return [RemoteLog(log, up_to) for log in logs]


def _bags_as_one(store: Store, pattern: Url) -> list[Url]:
    """The logs that match, parts of a bag as the bag."""
    matching = [item.url for item in store.glob(pattern) if names_a_log(item.url.name)]
    names = defaultdict[Url, list[str]](list)
    for url in matching:
        names[url.parent].append(url.name)
    bags = {
        folder
        for folder, inside in names.items()
        if are_parts(inside, folder.name) or store.companion(folder.child(METADATA))
    }
    logs = (url.parent if url.parent in bags else url for url in matching)
    return list(dict.fromkeys(logs))


def _below(store: Store, folder: Url, recursive: bool) -> Iterator[Url]:
    files, folders = store.listing(folder)
    names = [item.url.name for item in files]
    if "frames.csv" in names:  # results, whose pictures are no logs
        return
    if METADATA in names or are_parts(names, folder.name):
        yield folder
        return
    if any(map(names_an_image, names)):
        if any(map(names_a_log, names)):
            raise UsageError(f"{folder.shown}: holds images and other logs; choose by a glob")
        yield folder
        return
    yield from (item.url for item in files if names_a_log(item.url.name))
    for name in folders:
        if name[0] != ".":
            below = list(_below(store, folder.child(name), recursive)) if recursive else []
            yield from below


def _is_file(url: Url) -> bool:
    named = names_a_log(url.name) or names_an_image(url.name)
    return named and not url.path.endswith("/") and not _is_glob(url)


def _is_glob(url: Url) -> bool:
    marks = "*[" if url.is_web else "*?["
    return any(mark in url.path for mark in marks)


def _fixed(url: Url) -> Url:
    """The folder in front of the first wildcard; without one the URL itself."""
    while _is_glob(url):
        url = url.parent
    return url


def _wanted(log: RemoteLog, store: Store) -> tuple[Url, str, list[Item]]:
    """(the folder that all of it lies in, the log's name there, its files and companions)."""
    url = log.url
    if _is_file(url):
        folder, items, root = url.parent, [store.file(url)], log.up_to or url.parent
    else:
        folder = _fixed(url)
        root = log.up_to or folder.parent
        if _is_glob(url):
            items = [i for i in store.glob(url) if names_an_image(i.url.name)]
            pattern = url.name
            items = [i for i in items if fnmatchcase(i.url.name, pattern)]
        else:
            files, _ = store.listing(url)
            kept = (*COMPANIONS, METADATA)
            items = [i for i in files if _belongs(i.url.name, kept)]
        if not any(names_a_log(i.url.name) or names_an_image(i.url.name) for i in items):
            raise SonarrecError(f"{url.shown}: no log and no image here")
        items = store.described(items)
    items += _companions(log, store, folder, root, {str(i.url) for i in items})
    return root, _relative(url, root), items


def _belongs(name: str, kept: tuple[str, ...]) -> bool:
    return names_a_log(name) or names_an_image(name) or name in kept or name.endswith(COMPANIONS)


def _companions(
    log: RemoteLog, store: Store, folder: Url, root: Url, there: set[str]
) -> list[Item]:
    """What belongs to the log and is there, in its folder and in those above up to `root`.

    Above a folder that was given itself only that which bears its name.
    """
    own = [f"{log.name}.{name}" for name in COMPANIONS]
    places = [(folder, [*own, *COMPANIONS])]
    while folder.path.strip("/") != root.path.strip("/"):
        folder = folder.parent
        places.append((folder, own if log.up_to is None else [*own, *COMPANIONS]))
    urls = [place.child(name) for place, names in places for name in names]
    found = [store.companion(url) for url in urls if str(url) not in there]
    return [item for item in found if item is not None]


def _relative(url: Url, root: Url) -> str:
    """A place below `root`. Raises SonarrecError where it is no name for a local file."""
    relative = url.path.removeprefix(root.path).strip("/")
    parts = PurePosixPath(relative).parts
    if not parts or {".", ".."} & set(relative.split("/")) or "\\" in relative or "\0" in relative:
        raise SonarrecError(f"{url.shown}: a name that cannot be kept in a local folder")
    return relative


# Into the cache


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
    log = log if isinstance(log, RemoteLog) else RemoteLog(parse_url(log))
    with hold(log, cache, told, stop or threading.Event()) as found, found.origin.translated():
        yield found


@contextmanager
def hold(
    log: RemoteLog, cache: Cache, told: Told, stop: threading.Event, *, wait: bool = True
) -> Iterator[Fetched]:
    """wait: for room that other logs in use take, instead of NoRoomError."""
    from sonarrec.remote.store import Store

    root, name, items = _wanted(log, Store(log.url, stop))
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
    with _kept(url.shown, root, items, cache, untold, threading.Event(), True) as entry:
        origin = Origin(url.shown, str(entry.files), root.place.rstrip("/"))
        with origin.translated():
            yield Fetched(entry.files / _relative(url, root), origin)


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
    items, root = store.described(items), url.parent
    with _kept(url.shown, root, items, cache, untold, threading.Event(), True) as entry:
        origin = Origin(url.shown, str(entry.files), root.place.rstrip("/"))
        with origin.translated():
            yield Fetched(entry.files / _relative(url, root), origin, None, tuple(unused))


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
    names = {_relative(item.url, root): item for item in items}
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
