"""Writes results to a server: they are made in a local folder and uploaded when finished.

When results are replaced, run.toml is deleted first and uploaded last, since results on a server
count as finished only with run.toml. Evaluations, maps and pages made from the old results are
deleted too. If the upload fails, the results stay in the local folder for the next run to upload.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sonarrec.errors import MissingError, SonarrecError, UsageError
from sonarrec.nouns import Origin
from sonarrec.remote.cache import Cache, key_of, only_one
from sonarrec.remote.store import Item, Store
from sonarrec.remote.urls import Url, parse_url
from sonarrec.results.folders import ESTIMATES, MADE, OURS, PAGES, TABLES, estimates_of
from sonarrec.tables.outputs import is_output

_MARK = "run.toml"


class Outbox:
    """The folder of a server that `--out` names.

    url: of that folder. folder: the local folder in its place, in the cache but never deleted.
    origin: puts the paths of the server into messages.
    """

    def __init__(self, out: Url, cache: Cache) -> None:
        """Raises UsageError if nothing can be written there."""
        self.url = _writable(out)
        self.folder = cache.folder / "out" / key_of(self.url.redacted)
        self.origin = Origin(self.url.redacted, str(self.folder), self.url.redacted.rstrip("/"))

    @contextmanager
    def results(self, name: str, *, upload: bool = True) -> Iterator[None]:
        """Inside, a run makes the results of a log in `folder`/<name>; then they are uploaded.

        The small files of old results are fetched first, to see if they are up to date. upload:
        False to do no more than that. Raises SonarrecError if the server cannot be read or written;
        new results stay in `folder`.
        """
        local, remote = self.folder / name, self.url.child(name)
        with only_one(self.folder / f".{name}.upload", remote.redacted):
            with self.origin.translated():
                store = Store(remote)
                if not _is_whole(local):
                    shutil.rmtree(local, ignore_errors=True)
                    _fetch_held(store, remote, local)
                yield
            if _is_whole(local):
                if not upload:
                    return
                try:
                    _upload(store, local, remote)
                except SonarrecError as error:
                    raise SonarrecError(
                        f"{error}; the results are in {local}; the same command uploads them"
                    ) from None
            shutil.rmtree(local, ignore_errors=True)

    def fetch(self, name: str, to: str | None = None) -> None:
        """Fetch a file, such as logs.csv, into `folder`, if the server has it.

        to: its local name. Raises SonarrecError.
        """
        store = Store(self.url)
        item = store.item(self.url.child(name))
        if item is not None:
            store.fetch(item, self.folder / (to or name))

    def put(self, name: str) -> None:
        """Upload a file of `folder` if it exists. Raises SonarrecError."""
        if (self.folder / name).is_file():
            Store(self.url).put(self.folder / name, self.url.child(name))


def _is_whole(local: Path) -> bool:
    """Whether the folder holds new results that are not uploaded yet."""
    large = estimates_of(local)
    return large.is_file() and large.stat().st_size > 0


def _listing(store: Store, remote: Url) -> tuple[dict[str, Item], list[str]]:
    """(files by name, names of folders) in a folder that need not exist."""
    try:
        files, folders = store.listing(remote)
    except MissingError:
        return {}, []
    return {item.url.name: item for item in files}, folders


def _upload(store: Store, local: Path, remote: Url) -> None:
    before, folders = _listing(store, remote)
    old = [remote.child(name) for name in sorted(before.keys() & set(OURS), key=_MARK.__ne__)]
    for folder in (remote.child(name) for name in MADE.keys() & set(folders)):
        files, _ = _listing(store, folder)
        old += [folder.child(name) for name in files.keys() & set(MADE[folder.name])]
    # Pages are known by their mark; others belong to the user.
    with tempfile.TemporaryDirectory(prefix="sonarrec-") as temporary:
        for name in PAGES.keys() & before.keys():
            store.fetch(before[name], page := Path(temporary) / name)
            old += [before[name].url] if is_output(page, PAGES[name]) else []
    for place in old:
        store.remove(place)
    paths = sorted(p for p in local.rglob("*") if p.is_file())
    for path in sorted(paths, key=lambda p: p == local / _MARK):
        store.put(path, remote.child(path.relative_to(local).as_posix()))


def _fetch_held(store: Store, remote: Url, local: Path) -> None:
    """Fetch run.toml and the small tables of finished results, if the server has any.

    An empty file stands for the estimates, which are not compared with those of a new run.
    """
    there, _ = _listing(store, remote)
    large = next((name for name in ESTIMATES if name in there), None)
    small = {_MARK, *TABLES} - {*ESTIMATES}
    if large is not None and small <= there.keys():
        for name in small:
            store.fetch(there[name], local / name)
        (local / large).touch()


def _writable(url: Url) -> Url:
    """The URL itself. Raises UsageError if results cannot be written there."""
    if url.is_web:
        raise UsageError(
            f"{url.redacted}: results cannot be written to a web server; give a local --out, "
            "or s3://, gs://, sftp://"
        )
    return url


@contextmanager
def uploaded(out: str, name: str = "") -> Iterator[tuple[Path, Origin]]:
    """A local place for an output that is uploaded to `out` at the end.

    name: of the file, "" for a folder. Raises SonarrecError if it cannot be uploaded.
    """
    url = _writable(parse_url(out))
    with tempfile.TemporaryDirectory(prefix="sonarrec-") as temporary:
        folder = Path(temporary)
        place = folder / name if name else folder
        origin = Origin(url.redacted, str(place), url.redacted.rstrip("/"))
        with origin.translated():
            yield place, origin
        store = Store(url)
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            store.put(path, url if name else url.child(path.relative_to(folder).as_posix()))
