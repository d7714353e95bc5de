"""Files on servers, through fsspec; the only module here that uses the network.

Errors of the libraries become one line without secrets. Broken transfers are tried again.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from time import sleep
from typing import Any, TypeVar

from sonarrec.errors import MissingError, SonarrecError
from sonarrec.remote.cache import unwritable
from sonarrec.remote.urls import Url

try:
    import fsspec
except ImportError:
    fsspec = None

RETRIES = 3  # of a broken transfer
PAUSE_S = 1.0  # before the first retry; it doubles with each retry
AT_ONCE = 8  # files fetched in parallel
_ONE_PART = {"s3": {"max_concurrency": 1}, "gs": {"concurrency": 1}}
"""Several at once, as these do of themselves, would take hundreds of megabytes of memory."""
_INSTALL = "pip install 'sonarrec[remote]'"
T = TypeVar("T")


class RefusedError(SonarrecError):
    """The server denies access."""


class BrokenError(SonarrecError):
    """What a server did wrong; it can be tried again."""


@dataclass(frozen=True, slots=True)
class Item:
    """A file on a server.

    size: bytes. tag: changes when the file does (ETag or modification time). Each is None if the
    server does not state it.
    """

    url: Url
    size: int | None
    tag: str | None

    @property
    def has_version(self) -> bool:
        """Whether size and tag can show that a copy is current."""
        return self.tag is not None and self.size is not None


class Store:
    """The files of one server, for use in one thread. Every method raises SonarrecError."""

    def __init__(self, url: Url) -> None:
        """Raises SonarrecError if a package for this kind of server is not installed."""
        if fsspec is None:
            raise SonarrecError(f"{url.redacted}: fsspec is not installed; {_INSTALL}")
        try:
            self._fs: Any = _retried(url, lambda: _filesystem(url))
        except ImportError as error:
            raise SonarrecError(f"{url.redacted}: {error.name} is missing; {_INSTALL}") from None

    def item(self, url: Url) -> Item | None:
        """The file at a URL; None if there is none, or no access to it."""
        try:
            return self.file(url)
        except (MissingError, RefusedError):
            return None

    def file(self, url: Url) -> Item:
        """The file at a URL. Raises MissingError, RefusedError, SonarrecError."""
        info = _retried(url, lambda: self._fs.info(_path(url)))
        if info.get("type") == "directory":
            raise MissingError(f"{url.redacted}: is a folder, not a file")
        if url.is_web and info.get("mimetype") == "text/html":  # some servers have one for any name
            raise MissingError(f"{url.redacted}: is a web page, not a file")
        return _item(url, info)

    def listing(self, folder: Url) -> tuple[list[Item], list[str]]:
        """(files, names of folders) in a folder."""
        path = f"{folder.front}{folder.path.rstrip('/')}/" if folder.is_web else folder.path
        inside = folder.plain_path.rstrip("/")
        files, folders = [], []
        for entry in _retried(folder, lambda: self._fs.ls(path, detail=True)):
            url = _listed(folder, entry["name"])
            if entry["type"] == "directory":
                folders.append(url.name)
            # Index pages have other links too.
            elif not url.path.endswith("/") and (
                not folder.is_web or url.parent.plain_path.endswith(inside)
            ):
                files.append(_item(url, entry))
        return files, folders

    def glob(self, pattern: Url) -> list[Item]:
        """The files that match."""
        path = pattern.front * pattern.is_web + pattern.path
        found = _retried(pattern, lambda: self._fs.glob(path, detail=True))
        return [
            _item(_listed(pattern, name), entry)
            for name, entry in found.items()
            if entry["type"] != "directory"
        ]

    def described(self, items: list[Item]) -> list[Item]:
        """The same with size and tag, which index pages of web servers do not state."""
        if not items or not items[0].url.is_web:
            return items
        with ThreadPoolExecutor(AT_ONCE) as threads:
            return list(threads.map(self.file, [item.url for item in items]))

    def fetch(self, item: Item, to: Path, progress: Callable[[int], None] | None = None) -> None:
        """Write a file to `to`, whole or not at all.

        progress: called with the number of bytes that arrived; negative if they come again.
        """
        part = to.with_name(f"{to.name}.part")
        counted = 0

        def count(_: object, value: int) -> None:
            nonlocal counted
            if progress is not None:
                progress(value - counted)
            counted = value

        def ask() -> None:
            callback = fsspec.Callback(hooks={"count": count})
            one = _ONE_PART.get(item.url.scheme, {})
            try:
                self._fs.get_file(_path(item.url), str(part), callback=callback, **one)
            except OSError as error:
                if error.errno in (errno.ENOSPC, errno.EDQUOT):
                    raise unwritable(part, error) from None
                raise
            if item.size not in (None, came := part.stat().st_size):
                raise BrokenError(f"{came} of {item.size} bytes came")

        try:
            to.parent.mkdir(parents=True, exist_ok=True)
            _retried(item.url, ask)
            if item.has_version and self.item(item.url) != item:
                raise SonarrecError(
                    f"{item.url.redacted}: changed while it was fetched; run the command again"
                )
            part.replace(to)
        except OSError as error:
            raise unwritable(part, error) from None
        finally:
            part.unlink(missing_ok=True)

    def put(self, file: Path, url: Url) -> None:
        """Upload a file."""

        def ask() -> None:
            self._fs.put_file(str(file), _path(url))
            there = self.item(url)
            if there is None or there.size != file.stat().st_size:
                raise BrokenError("the server does not have the whole file")

        _retried(url, ask)

    def remove(self, url: Url) -> None:
        """Delete a file, if it exists."""
        with suppress(MissingError):
            _retried(url, lambda: self._fs.rm_file(_path(url)))


def _filesystem(url: Url) -> Any:
    if url.is_web:
        import aiohttp

        times = aiohttp.ClientTimeout(total=None, sock_connect=30, sock_read=60)
        return fsspec.filesystem("http", client_kwargs={"timeout": times, "trust_env": True})
    if url.scheme != "sftp":
        return fsspec.filesystem(url.scheme, use_listings_cache=False)
    # sshfs would take any host key; () stands for the user's known_hosts.
    from sshfs import SSHFileSystem

    options = SSHFileSystem._get_kwargs_from_urls(url.front) | {"known_hosts": ()}
    options |= fsspec.config.conf.get("sftp", {}) | {"connect_timeout": 30}
    return SSHFileSystem(**options)


def _path(url: Url) -> str:
    return str(url) if url.is_web else url.path


def _listed(near: Url, name: str) -> Url:
    """The URL of a listed name: a URL, quoted somehow, of a web server, else a path."""
    if not near.is_web:
        return replace(near, path=name, literal=True)
    path = name.partition("?")[0].removeprefix(near.front)
    for mark in "*[]":  # some index pages do not quote them
        path = path.replace(mark, f"%{ord(mark):X}")
    return replace(near, path=path)


def _item(url: Url, info: Mapping[str, Any]) -> Item:
    tag = next((info[k] for k in ("ETag", "etag", "Last-Modified", "mtime") if info.get(k)), None)
    named = replace(url, literal=True)
    return Item(named, info.get("size"), None if tag is None else str(tag))


def _retried(url: Url, ask: Callable[[], T]) -> T:
    """The result of `ask`, with up to RETRIES retries if the server breaks off.

    Raises SonarrecError, which names the URL.
    """
    for tried in range(RETRIES + 1):
        try:
            return ask()
        except Exception as error:  # s3fs, gcsfs, aiohttp and asyncssh have no common class
            fault = _fault(url, error)
            if not isinstance(fault, BrokenError):
                raise fault from None
            broken = fault
        if tried < RETRIES:
            sleep(PAUSE_S * 2**tried)
    raise SonarrecError(f"{url.redacted}: failed, also in {RETRIES} retries ({broken})")


_NO_KEY = {
    *("NoCredentialsError", "PartialCredentialsError", "ProfileNotFound"),  # of s3fs
    *("GoogleAuthError", "HostKeyNotVerifiable", "PermissionDenied"),  # of gcsfs, and of asyncssh
}


def _fault(url: Url, error: Exception) -> Exception:
    """An error of the libraries as one of ours, with its text but without secrets."""
    if isinstance(error, SonarrecError | ImportError):
        return error
    cause = error.__cause__
    # fsspec reports every error of a web server as a missing file.
    if isinstance(cause, Exception) and type(cause).__module__.startswith(("aiohttp", "asyncio")):
        error = cause
    status = getattr(error, "status", None)
    if isinstance(error, FileNotFoundError | NotADirectoryError) or status in (404, 410):
        return MissingError(f"{url.redacted}: does not exist")
    text = getattr(error, "message", None) or str(error) or type(error).__name__
    if isinstance(status, int):  # of endless redirects it is 0, and there is no text
        text = f"{status} {text}" if status else type(error).__name__
    text = " ".join(url.hide(str(text)).split())[:300]
    no_key = any(kind.__name__ in _NO_KEY for kind in type(error).__mro__)
    if isinstance(error, PermissionError) or status in (401, 403, 407) or no_key:
        return RefusedError(
            f"{url.redacted}: no access ({text}); `sonarrec help remote` says where credentials "
            "are searched"
        )
    return BrokenError(text)
