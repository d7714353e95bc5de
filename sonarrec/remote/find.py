"""Finds the logs that a URL names, and the companions of a log on the server."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sonarrec.errors import MissingError, SonarrecError, UsageError
from sonarrec.readers.containers.bag_folder import METADATA, are_parts
from sonarrec.readers.containers.images import names_an_image
from sonarrec.readers.named_logs import RESULTS
from sonarrec.readers.open import SHARED, log_name, names_a_log
from sonarrec.remote.urls import HIDDEN, Url, parse_url
from sonarrec.tables.order import natural_order

if TYPE_CHECKING:
    from sonarrec.remote.store import Item, Store

COMPANIONS = ("sonar.toml", "landmarks.toml", "poses.csv", "gt.csv")
"""Companions of a log: files of these names, and NAME.sonar.toml and so on."""


@dataclass(frozen=True, slots=True)
class RemoteLog:
    """A log on a server: a file, a folder, or a glob of images.

    up_to: the folder that was given and holds the log, the highest one searched for companions.
    """

    url: Url
    up_to: Url | None = None

    @property
    def path(self) -> Path:
        """Its path as if the server were a disk, to name results by; for a glob its folder."""
        url = _fixed(self.url)
        host = url.front.partition("://")[2].rpartition("@")[2]
        return Path("/", host, url.plain_path.strip("/"))

    @property
    def name(self) -> str:
        """Name of its results."""
        return log_name(self.path) if _is_file(self.url) else self.path.name


def find(text: str, *, recursive: bool = False) -> list[RemoteLog]:
    """The logs that a URL names, in natural order: a log, the logs of a folder, or those of a glob.

    A folder of images, a bag, or the images of a glob are one log. If the server does not answer,
    the URL is returned as one log, so that the error is reported when its turn comes.
    Raises UsageError if the URL is invalid, or if a folder holds images and other logs.
    """
    url = parse_url(text)
    from sonarrec.remote.store import Store

    try:
        found = with_literal_name(url)
        if _is_glob(found):
            logs, up_to = _bags_as_one(Store(found), found), _fixed(found)
        elif _is_file(found):
            return [RemoteLog(found)]
        else:
            found = up_to = replace(found, literal=True)
            logs = list(_below(Store(found), found, recursive))
    except SonarrecError as error:
        if isinstance(error, UsageError) and not isinstance(error, MissingError):
            raise
        return [RemoteLog(url)]
    if not logs or [log.path.rstrip("/") for log in logs] == [found.path.rstrip("/")]:
        return [RemoteLog(logs[0] if logs else found)]
    return [RemoteLog(log, up_to) for log in sorted(logs, key=lambda log: natural_order(log.path))]


def _bags_as_one(store: Store, pattern: Url) -> list[Url]:
    """The logs that match; parts of a bag are returned as the bag."""
    matching = [item.url for item in store.glob(pattern) if names_a_log(item.url.name)]
    names = defaultdict[Url, list[str]](list)
    for url in matching:
        names[url.parent].append(url.name)
    bags = {
        folder
        for folder, inside in names.items()
        if are_parts(inside, folder.name) or store.item(folder.child(METADATA))
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
            raise UsageError(f"{folder.redacted}: holds images and other logs; choose with a glob")
        yield folder
        return
    yield from (item.url for item in files if names_a_log(item.url.name))
    for name in folders:
        if recursive and name[0] != ".":
            yield from _below(store, folder.child(name), recursive)


def with_literal_name(url: Url) -> Url:
    """The URL, with * ? [ taken as literal if a file or folder of that name exists.

    Raises SonarrecError if the server cannot be read.
    """
    from sonarrec.remote.store import Store

    if url.is_web or not _is_glob(url):  # they can be quoted in a web URL
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
    return not url.literal and any(mark in url.path for mark in "*?[")


def _fixed(url: Url) -> Url:
    """The folder in front of the first wildcard; without one the URL itself."""
    while _is_glob(url):
        url = url.parent
    return url


def items_of(log: RemoteLog, store: Store) -> tuple[Url, str, list[Item]]:
    """(the folder that holds everything, the log's name in it, its files and companions)."""
    url, root = log.url, _around(log)[1]
    if _is_file(url):
        items = [store.file(url)]
    else:
        if _is_glob(url):
            items = parts = [i for i in store.glob(url) if names_an_image(i.url.name)]
        else:
            there = store.listing(url)[0]
            parts = [i for i in there if names_a_log(i.url.name) or names_an_image(i.url.name)]
            items = parts + [i for i in there if i.url.name.endswith((METADATA, *COMPANIONS))]
        if not parts:
            raise SonarrecError(f"{url.redacted}: no log and no image here")
        items = store.described(items)
    known = {item.url for item in items}
    places = (place for place in _companions(log, COMPANIONS) if place not in known)
    items += [item for place in places if (item := store.item(place)) is not None]
    return root, relative(url, root), items


def beside(text: str, name: str) -> tuple[Item | None, int | None]:
    """(the companion `name` of the log at a URL, None if there is none; the log's size).

    The size is None if not known, as that of a folder.
    Raises SonarrecError if a file is missing or the server cannot be read.
    """
    from sonarrec.remote.store import Store

    if HIDDEN in text:
        raise SonarrecError(f"{text}: run.toml does not keep the secret that gives access there")
    log = RemoteLog(with_literal_name(parse_url(text)))
    store = Store(log.url)
    size = store.file(log.url).size if _is_file(log.url) else None
    companions = map(store.item, _companions(log, (name,)))
    return next((item for item in companions if item is not None), None), size


def _around(log: RemoteLog) -> tuple[Url, Url]:
    """(the folder that the log is or lies in, the highest folder searched for companions)."""
    if _is_file(log.url):
        return log.url.parent, log.up_to or log.url.parent
    folder = _fixed(log.url)
    return folder, log.up_to or folder.parent


def _companions(log: RemoteLog, names: tuple[str, ...]) -> list[Url]:
    """Where companions of these names may be: in the log's folder and in those above.

    Above a folder that is the log given, only NAME.sonar.toml and so on, and what serves several.
    """
    folder, root = _around(log)
    own = [f"{log.name}.{name}" for name in names]
    places = [(folder, [*own, *names])]
    while folder.path.strip("/") != root.path.strip("/"):
        folder = folder.parent
        shared = [name for name in names if name in SHARED or log.up_to is not None]
        places.append((folder, [*own, *shared]))
    return [place.child(name) for place, inside in places for name in inside]


def relative(url: Url, root: Url) -> str:
    """The path below `root`. Raises SonarrecError if it cannot be a local file name."""
    relative = url.plain_path.removeprefix(root.plain_path).strip("/")
    if {"", ".", ".."} & set(relative.split("/")) or "\\" in relative or "\0" in relative:
        raise SonarrecError(f"{url.redacted}: this name cannot be used for a local file")
    return relative
