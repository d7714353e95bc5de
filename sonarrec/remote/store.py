"""Files on servers, through fsspec; the only module here that uses the network.

Errors of the libraries become one line without secrets. Broken transfers are tried again.
"""

from __future__ import annotations

import base64
import glob
import hashlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from email.utils import parsedate_to_datetime
from functools import partial
from pathlib import Path
from time import sleep
from typing import Any, TypeVar

from sonarrec.errors import MissingError, SonarrecError, UsageError
from sonarrec.remote.cache import unwritable
from sonarrec.remote.urls import Url, unquoted

try:
    import fsspec
except ImportError:
    fsspec = None

RETRIES = 3  # of a broken transfer
PAUSE_S = 1.0  # before the first retry; it doubles with each retry
LONGEST_PAUSE_S = 60.0  # even if a busy server asks for more
AT_ONCE = 8  # files fetched in parallel
BLOCK_BYTES = 2**24  # requested at once, and lost if the transfer breaks
_INSTALL = "pip install 'sonarrec[remote]'"
T = TypeVar("T")


class RefusedError(SonarrecError):
    """The server denies access."""


class BrokenError(SonarrecError):
    """A transfer that broke off; it can be tried again after `after_s` seconds."""

    def __init__(self, text: str, after_s: float = 0.0) -> None:
        super().__init__(text)
        self.after_s = after_s


@dataclass(frozen=True, slots=True)
class Item:
    """A file on a server.

    size: bytes. tag: changes when the file does (ETag or modification time). md5: in hex. Each is
    None if the server does not state it.
    """

    url: Url
    size: int | None
    tag: str | None
    md5: str | None = None

    @property
    def has_version(self) -> bool:
        """Whether size and tag can show that a copy is current."""
        return self.tag is not None and self.size is not None

    @property
    def identity(self) -> str:
        """12 hex digits that change with size or tag."""
        return hashlib.sha256(f"{self.size} {self.tag}".encode()).hexdigest()[:12]


class Store:
    """The files of one server, for use in one thread."""

    def __init__(self, url: Url) -> None:
        """Raises SonarrecError if a package for this kind of server is not installed."""
        self._url = url
        if fsspec is None:
            raise SonarrecError(f"{url.redacted}: fsspec is not installed; {_INSTALL}")
        self._streams = False  # whether the server sends files from the beginning only
        with self._translated(url):
            try:
                self._fs: Any = self._filesystem(url)
            except ImportError as error:
                raise SonarrecError(
                    f"{url.redacted}: {error.name} is missing; {_INSTALL}"
                ) from None

    @staticmethod
    def _filesystem(url: Url) -> Any:
        if url.is_web:
            import aiohttp

            times = aiohttp.ClientTimeout(total=None, sock_connect=30, sock_read=60)
            options: dict[str, Any] = {"client_kwargs": {"timeout": times, "trust_env": True}}
        elif url.scheme == "sftp":
            # sshfs would take any host key; () stands for the user's known_hosts.
            from sshfs import SSHFileSystem

            options = SSHFileSystem._get_kwargs_from_urls(url.front)
            options["known_hosts"] = ()
            options |= fsspec.config.conf.get("sftp", {}) | {"connect_timeout": 30}
            return SSHFileSystem(**options)
        else:
            options = {"use_listings_cache": False}
        return fsspec.filesystem(url.scheme, **options)

    def _path(self, url: Url) -> str:
        return str(url) if url.is_web else url.path

    # Listing

    def item(self, url: Url) -> Item | None:
        """The file at a URL; None if there is none, or no access to it."""
        try:
            return self.file(url)
        except (MissingError, RefusedError):
            return None

    def file(self, url: Url) -> Item:
        """The file at a URL. Raises MissingError, RefusedError, SonarrecError."""

        def ask() -> Item:
            with self._translated(url):
                options = {"refresh": True} if url.scheme == "s3" else {}
                info = self._fs.info(self._path(url), **options)
            if info.get("type") == "directory":
                raise MissingError(f"{url.redacted}: is a folder, not a file")
            return _item(url, info)

        return self._retried(ask, url)

    def companion(self, url: Url) -> Item | None:
        """As `item`, but None for an HTML page, which some web servers return for any name."""

        def is_page() -> bool:
            with self._translated(url):
                return bool(self._fs.info(self._path(url)).get("mimetype") == "text/html")

        item = self.item(url)
        return None if item is not None and url.is_web and self._retried(is_page, url) else item

    def listing(self, folder: Url) -> tuple[list[Item], list[str]]:
        """(files, names of folders) in a folder. Raises SonarrecError if it cannot be read."""

        def ask() -> list[dict[str, Any]]:
            with self._translated(folder):
                path = self._path(folder)
                if folder.is_web:
                    path = path.partition("?")[0].rstrip("/") + "/"
                options = {"refresh": True} if folder.scheme == "s3" else {}
                entries: list[dict[str, Any]] = self._fs.ls(path, detail=True, **options)
                return entries

        files, folders = [], []
        for entry in self._retried(ask):
            path = unquoted(entry["name"].partition("?")[0]) if folder.is_web else entry["name"]
            name = path.rstrip("/").rpartition("/")[2]
            if entry["type"] == "directory":
                folders.append(name)
            elif name and not path.endswith("/") and _same_folder(folder, path):
                files.append(_item(folder.child(name), entry))
        return files, folders

    def glob(self, pattern: Url) -> list[Item]:
        """The files that match. Raises SonarrecError if the folder cannot be read."""

        def ask() -> Mapping[str, dict[str, Any]]:
            with self._translated(pattern):
                path = self._path(pattern).partition("?")[0] if pattern.is_web else pattern.path
                entries: Mapping[str, dict[str, Any]] = self._fs.glob(path, detail=True)
                return entries

        items = []
        for path, entry in self._retried(ask).items():
            if entry["type"] != "directory":
                at = unquoted(path).removeprefix(pattern.front) if pattern.is_web else path
                items.append(_item(Url(pattern.scheme, pattern.front, at, pattern.query), entry))
        return items

    def described(self, items: list[Item]) -> list[Item]:
        """The same with size and tag, which index pages of web servers do not state."""
        if not items or not items[0].url.is_web:
            return items
        with ThreadPoolExecutor(AT_ONCE) as threads:
            return list(threads.map(self.file, [item.url for item in items]))

    # Fetching

    def fetch(self, item: Item, to: Path, progress: Callable[[int], None] = lambda _: None) -> None:
        """Write a file to `to`, complete and checked, or not at all.

        progress: called with the number of bytes that arrived; negative if they must be fetched
        again. A broken transfer is resumed if the server can do that, else repeated.
        Raises SonarrecError after RETRIES retries, or if the disk is full.
        """
        to.parent.mkdir(parents=True, exist_ok=True)
        part = to.with_name(f"{to.name}.{item.identity}.part")
        if not item.has_version:
            part.unlink(missing_ok=True)

        def ask() -> None:
            self._transfer(item, part, progress)
            self._check(item, part, progress)

        try:
            self._retried(ask)
            os.replace(part, to)  # noqa: PTH105
        except OSError as error:
            raise unwritable(part, error) from None

    def _transfer(self, item: Item, part: Path, progress: Callable[[int], None]) -> None:
        at = part.stat().st_size if part.exists() else 0
        if at and (self._streams or item.size is None):
            progress(-at)
            at = 0
        if item.size is not None and at > item.size:
            progress(-at)
            at = 0
        with part.open("r+b" if at else "wb") as out, self._opened(item) as file:
            out.seek(at)
            while item.size is None or at < item.size:
                wanted = BLOCK_BYTES if item.size is None else min(BLOCK_BYTES, item.size - at)
                with self._translated(item.url):
                    block = self._read(file, at, wanted)
                if not block:
                    break
                out.write(block)
                at += len(block)
                progress(len(block))

    def _read(self, file: Any, at: int, wanted: int) -> bytes:
        if not self._streams and file.seekable():
            file.seek(at)
        try:
            return bytes(file.read(wanted))
        except ValueError as error:
            if "range requests" not in str(error):
                raise
            self._streams = True
            raise BrokenError("the server cannot go on in the middle") from None

    @contextmanager
    def _opened(self, item: Item) -> Iterator[Any]:
        block = 0 if item.url.is_web and (self._streams or item.size is None) else BLOCK_BYTES
        options: dict[str, Any] = {} if item.url.scheme == "sftp" else {"block_size": block}
        if item.url.is_web or item.url.scheme in ("s3", "gs"):
            options["cache_type"] = "none"
        with self._translated(item.url):
            file = self._fs.open(self._path(item.url), "rb", **options)
        try:
            yield file
        finally:
            file.close()

    def _check(self, item: Item, part: Path, progress: Callable[[int], None]) -> None:
        """Raises BrokenError if the file differs from that on the server."""
        size = part.stat().st_size
        if item.size is not None and size != item.size:
            raise BrokenError(f"{size} of {item.size} bytes came")
        if item.md5 is not None and _md5(part) == item.md5:
            return
        now = self.item(item.url)
        changed = now is None or (now.size, now.tag) != (item.size, item.tag)
        if changed or (item.md5 is not None and not self._encrypted(item)):
            part.unlink()
            progress(-size)
            if changed:
                raise SonarrecError(
                    f"{item.url.redacted}: changed while it was fetched; run the command again"
                )
            raise BrokenError("its checksum differs from the server's")

    def _encrypted(self, item: Item) -> bool:
        """Whether S3 encrypted the file; then its ETag is not the MD5."""
        if item.url.scheme != "s3":
            return False
        bucket, _, key = item.url.path.partition("/")
        with self._translated(item.url):
            head = self._fs.call_s3("head_object", Bucket=bucket, Key=key)
        return head.get("ServerSideEncryption") not in (None, "AES256")

    # Writing

    def put(self, file: Path, url: Url) -> None:
        """Upload a file, which appears only when it is complete. Raises SonarrecError."""

        def ask() -> None:
            # SFTP shows files while they grow.
            to = url.parent.child(f"{url.name}.part") if url.scheme == "sftp" else url
            with self._translated(url):
                self._fs.put_file(str(file), self._path(to))
                if to != url:
                    self.remove(url)
                    self._fs.mv(self._path(to), self._path(url))
            there = self.item(url)
            if there is None or there.size != file.stat().st_size:
                raise BrokenError("the server does not have the whole file")

        self._retried(ask, url)

    def remove(self, url: Url) -> None:
        """Delete a file, or a folder and its contents, if it exists. Raises SonarrecError."""

        # s3fs and gcsfs treat the path as a glob, which could delete other files.
        path = self._path(url) if url.scheme == "sftp" else glob.escape(self._path(url))

        def ask() -> None:
            try:
                with self._translated(url):
                    self._fs.rm(path, recursive=True)
            except MissingError:
                pass

        self._retried(ask, url)

    # Errors

    def _retried(self, ask: Callable[[], T], url: Url | None = None) -> T:
        """The result of `ask`, with up to RETRIES retries after a BrokenError.

        Raises SonarrecError, which names the URL, if all fail.
        """
        for tried in range(RETRIES + 1):
            try:
                return ask()
            except BrokenError as error:
                if tried == RETRIES:
                    url = url or self._url
                    raise SonarrecError(
                        f"{url.redacted}: failed, also in {RETRIES} retries ({error})"
                    ) from None
                sleep(max(PAUSE_S * 2**tried, min(error.after_s, LONGEST_PAUSE_S)))
        raise AssertionError("not reached")

    @contextmanager
    def _translated(self, url: Url) -> Iterator[None]:
        """Turn an error of the libraries into one of ours, with its text but without secrets."""
        try:
            yield
        except (SonarrecError, ImportError):
            raise
        except Exception as error:  # s3fs, gcsfs, aiohttp and asyncssh have no common class
            cause = error.__cause__
            # fsspec reports every error of a web server as a missing file.
            if cause is not None and type(cause).__module__.startswith(("aiohttp", "asyncio")):
                error = cause if isinstance(cause, Exception) else error
            status = getattr(error, "status", None)
            if isinstance(error, FileNotFoundError | NotADirectoryError) or status in (404, 410):
                raise MissingError(f"{url.redacted}: does not exist") from None
            text = getattr(error, "message", None) or str(error) or type(error).__name__
            if status == 0:  # endless redirects; aiohttp states nothing else
                status, text = None, type(error).__name__
            text = f"{status} {text}" if isinstance(status, int) else str(text)
            text = " ".join(url.hide(text).split())[:300]
            if isinstance(error, PermissionError) or status in (401, 403, 407) or _no_key(error):
                raise RefusedError(
                    f"{url.redacted}: no access ({text}); `sonarrec help remote` says where "
                    "credentials are searched"
                ) from None
            raise BrokenError(text, _retry_after_s(error)) from None


def writable(url: Url) -> Url:
    """The URL itself. Raises UsageError if results cannot be written there."""
    if url.is_web:
        raise UsageError(
            f"{url.redacted}: results cannot be written to a web server; give a local --out, "
            "or s3://, gs://, sftp://"
        )
    return url


_NO_KEY = {
    *("NoCredentialsError", "PartialCredentialsError", "ProfileNotFound"),  # of s3fs
    *("GoogleAuthError", "HostKeyNotVerifiable", "PermissionDenied"),  # of gcsfs, and of asyncssh
}


def _no_key(error: Exception) -> bool:
    """Whether credentials or a host key are missing, so that retries are useless."""
    return any(c.__name__ in _NO_KEY for c in type(error).__mro__)


def _retry_after_s(error: Exception) -> float:
    """How long a busy web server asks to wait, stated in seconds or as a date; 0 if not stated."""
    headers = getattr(error, "headers", None)  # of aiohttp
    stated = str(headers.get("Retry-After", "")) if isinstance(headers, Mapping) else ""
    try:
        if stated.isdigit():
            return float(stated)
        until = parsedate_to_datetime(stated)
        return (until - datetime.now(until.tzinfo)).total_seconds()
    except (ValueError, OverflowError):  # not a date, or one out of range
        return 0.0


def _same_folder(folder: Url, path: str) -> bool:
    """Whether a listed path lies in the folder; index pages have other links too."""
    inside = path.rpartition("/")[0]
    return not folder.is_web or inside.endswith(folder.path.rstrip("/"))


def _item(url: Url, info: Mapping[str, Any]) -> Item:
    tag = next((info[k] for k in ("ETag", "etag", "Last-Modified", "mtime") if info.get(k)), None)
    size = info.get("size")
    url = replace(url, literal=True)
    return Item(url, size, None if tag is None else str(tag), _stated_md5(url, info))


def _stated_md5(url: Url, info: Mapping[str, Any]) -> str | None:
    if url.scheme == "s3":
        tag = str(info.get("ETag", "")).strip('"')
        # Of a file that was uploaded in several parts the tag is no MD5, and has a dash.
        return tag if re.fullmatch(r"[0-9a-f]{32}", tag) else None
    stated = info.get("md5Hash") or info.get("Content-MD5")
    try:
        return base64.b64decode(str(stated), validate=True).hex() if stated else None
    except ValueError:
        return None


def _md5(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, partial(hashlib.md5, usedforsecurity=False)).hexdigest()
