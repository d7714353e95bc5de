"""Which logs a URL names, and what lies on the server that belongs to a log."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from sonarrec.readers.bag_folder import METADATA, are_parts
from sonarrec.readers.find import log_name, names_a_log
from sonarrec.readers.images import MAX_FILE_BYTES, names_an_image, natural_order
from sonarrec.readers.many import RESULTS
from sonarrec.records import MissingError, SonarrecError, UsageError
from sonarrec.remote.urls import HIDDEN, Url, parse_url

if TYPE_CHECKING:
    from sonarrec.remote.store import Item, Store

WINDOWS = os.name == "nt"
_ALL_REFUSE = re.compile(r"\0")
_WINDOWS_REFUSES = re.compile(r'[<>:"|?*\x00-\x1f]|[ .](?=/|$)')  # x.mcap:y is a stream of x.mcap
COMPANIONS = ("sonar.toml", "poses.csv", "gt.csv")
"""What belongs to a log: these, and each as NAME.sonar.toml and so on."""


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


def find(text: str, *, recursive: bool = False) -> list[RemoteLog]:
    """The logs that a URL names, in natural order: one, those of a folder, those that match a glob.

    A folder of images or a bag is one log, and so are the images that match. Of a server that does
    not answer the URL itself is the log, which is told when its turn comes.
    Raises UsageError where the URL cannot be meant, or a folder holds images and other logs.
    """
    url = parse_url(text)
    try:
        return _found(meant(url), recursive)
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
        url = replace(url, literal=True)
        logs, up_to = list(_below(Store(url), url, recursive)), url
    if not logs or [log.path.rstrip("/") for log in logs] == [url.path.rstrip("/")]:
        return [RemoteLog(logs[0] if logs else url)]
    logs.sort(key=lambda log: natural_order(log.path))
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
    if RESULTS.intersection(names):
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


def meant(url: Url) -> Url:
    """The URL; * ? [ are literal where a file or folder of this very name is there, as on a disk.

    Raises SonarrecError where the server cannot be read.
    """
    from sonarrec.remote.store import Store

    if url.is_web or not _is_glob(url):  # a web URL can quote them
        return url
    store, literal = Store(url), replace(url, literal=True)
    try:
        there = store.item(literal) is not None or any(store.listing(literal))
    except MissingError:
        there = False
    return literal if there else url


def _is_file(url: Url) -> bool:
    named = names_a_log(url.name) or names_an_image(url.name)
    return named and not url.path.endswith("/") and not _is_glob(url)


def _is_glob(url: Url) -> bool:
    marks = "*[" if url.is_web else "*?["
    return not url.literal and any(mark in url.path for mark in marks)


def _fixed(url: Url) -> Url:
    """The folder in front of the first wildcard; without one the URL itself."""
    while _is_glob(url):
        url = url.parent
    return url


def wanted(log: RemoteLog, store: Store) -> tuple[Url, str, list[Item]]:
    """(the folder that all of it lies in, the log's name there, its files and companions)."""
    url, root = log.url, _around(log)[1]
    if _is_file(url):
        items = [store.file(url)]
    else:
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
    there = {str(item.url) for item in items}
    for place in _companions(log, COMPANIONS):
        if str(place) not in there and (found := store.companion(place)) is not None:
            items.append(found)
    return root, relative(url, root), items


def beside(text: str, name: str) -> tuple[Item | None, int | None]:
    """The file that belongs to the log of a URL, such as its gt.csv, None without one; and how
    many bytes the log has there, counted as for run.toml, None where that is not known.

    Raises SonarrecError where the log is not there, or the server cannot be read.
    """
    from sonarrec.remote.store import Store

    if HIDDEN in text:
        raise SonarrecError(f"{text}: what gives access there is not written down in run.toml")
    log = RemoteLog(meant(parse_url(text)))
    store = Store(log.url)
    size = _bytes(log.url, store)
    found = (store.companion(place) for place in _companions(log, (name,)))
    return next((item for item in found if item is not None), None), size


def _bytes(log: Url, store: Store) -> int | None:
    if _is_file(log):
        return store.file(log).size
    files = store.glob(log) if _is_glob(log) else store.listing(log)[0]
    images = [item for item in files if names_an_image(item.url.name)]
    if not images or any(names_a_log(item.url.name) for item in files):
        return None  # a bag, whose metadata tell which of the files are its own
    total = 0
    for item in images:
        if item.size is None:  # an index page tells none
            return None
        total += item.size if item.size <= MAX_FILE_BYTES else 0
    return total


def _belongs(name: str, kept: tuple[str, ...]) -> bool:
    return names_a_log(name) or names_an_image(name) or name in kept or name.endswith(COMPANIONS)


def _around(log: RemoteLog) -> tuple[Url, Url]:
    """(the folder that the log is or lies in, the last one up to which is looked)."""
    if _is_file(log.url):
        return log.url.parent, log.up_to or log.url.parent
    folder = _fixed(log.url)
    return folder, log.up_to or folder.parent


def _companions(log: RemoteLog, names: tuple[str, ...]) -> list[Url]:
    """Where files of these names that belong to the log may be: in its folder and above it.

    Above a folder that was given itself only that which bears its name.
    """
    folder, root = _around(log)
    own = [f"{log.name}.{name}" for name in names]
    places = [(folder, [*own, *names])]
    while folder.path.strip("/") != root.path.strip("/"):
        folder = folder.parent
        places.append((folder, own if log.up_to is None else [*own, *names]))
    return [place.child(name) for place, inside in places for name in inside]


def relative(url: Url, root: Url) -> str:
    """A place below `root`. Raises SonarrecError where it is no name for a local file."""
    relative = url.path.removeprefix(root.path).strip("/")
    parts = PurePosixPath(relative).parts
    leads_away = not parts or {".", ".."} & set(relative.split("/")) or "\\" in relative
    if leads_away or (_WINDOWS_REFUSES if WINDOWS else _ALL_REFUSE).search(relative):
        raise SonarrecError(f"{url.shown}: a name that cannot be kept in a local folder")
    return relative
