"""What servers hold, through fsspec: the one module of this room that speaks to a network.

Whatever the libraries below raise becomes one line without secrets. What breaks off is tried again.
"""

from __future__ import annotations

import base64
import glob
import hashlib
import os
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any, TypeVar

from sonarrec.records import MissingError, SonarrecError, UsageError, shown
from sonarrec.remote.urls import Url, unquoted

try:
    import fsspec
except ImportError:
    fsspec = None

AGAIN = 3  # times that a broken transfer is tried again
PAUSE_S = 1.0  # before the first of them; twice as long before each further one
LONGEST_PAUSE_S = 60.0  # whatever a busy server asks for
AT_ONCE = 8  # files of a folder
BLOCK_BYTES = 2**24  # asked for at once: what is lost when a transfer breaks off
_INSTALL = "pip install 'sonarrec[remote]'"
T = TypeVar("T")


class RefusedError(SonarrecError):
    """The server does not let us."""


class BrokenError(SonarrecError):
    """A transfer that broke off: to be tried again, not sooner than after so many seconds."""

    def __init__(self, text: str, after_s: float = 0.0) -> None:
        super().__init__(text)
        self.after_s = after_s


class StoppedError(SonarrecError):
    """The run ends; nobody waits for this transfer any more."""


@dataclass(frozen=True, slots=True)
class Item:
    """A file on a server.

    size: bytes. tag: what changes when the file does (ETag, time of change). md5: in hex. Each is
    None where the server does not tell it.
    """

    url: Url
    size: int | None
    tag: str | None
    md5: str | None = None

    @property
    def known(self) -> bool:
        """Whether a copy can be told to be this very file."""
        return self.tag is not None and self.size is not None

    @property
    def identity(self) -> str:
        """12 hex digits that differ where size or tag do."""
        return hashlib.sha256(f"{self.size} {self.tag}".encode()).hexdigest()[:12]


class Store:
    """The files of one server, seen from one thread."""

    def __init__(self, url: Url, stop: threading.Event | None = None) -> None:
        """stop: once it is set, what is under way ends with StoppedError.

        Raises SonarrecError where the packages for it are not installed.
        """
        self._stop = stop or threading.Event()
        self._url = url
        if fsspec is None:
            raise SonarrecError(f"{url.shown}: fsspec is not installed; {_INSTALL}")
        self._streams = False
        with self._told(url):
            try:
                self._fs: Any = self._filesystem(url)
            except ImportError as error:
                raise SonarrecError(f"{url.shown}: {error.name} is missing; {_INSTALL}") from None

    @staticmethod
    def _filesystem(url: Url) -> Any:
        if url.is_web:
            import aiohttp

            times = aiohttp.ClientTimeout(total=None, sock_connect=30, sock_read=60)
            given: dict[str, Any] = {"client_kwargs": {"timeout": times, "trust_env": True}}
        elif url.scheme == "sftp":
            # sshfs would take any host key; () stands for the user's known_hosts.
            from sshfs import SSHFileSystem

            given = SSHFileSystem._get_kwargs_from_urls(url.front)
            given["known_hosts"] = ()
            given |= fsspec.config.conf.get("sftp", {}) | {"connect_timeout": 30}
            return SSHFileSystem(**given)
        else:
            given = {"use_listings_cache": False}
        return fsspec.filesystem(url.scheme, **given)

    def _path(self, url: Url) -> str:
        return str(url) if url.is_web else url.path

    # What is there

    def item(self, url: Url) -> Item | None:
        """The file at a URL; None where there is none, or none for us."""
        try:
            return self.file(url)
        except (MissingError, RefusedError):
            return None

    def file(self, url: Url) -> Item:
        """The file at a URL. Raises MissingError, RefusedError, SonarrecError."""

        def ask() -> Item:
            with self._told(url):
                given = {"refresh": True} if url.scheme == "s3" else {}
                found = self._fs.info(self._path(url), **given)
            if found.get("type") == "directory":
                raise MissingError(f"{url.shown}: a folder, no file")
            return _item(url, found)

        return self._retried(ask, url)

    def companion(self, url: Url) -> Item | None:
        """As `item`; a page that a web server gives for any name is none."""

        def is_page() -> bool:
            with self._told(url):
                return bool(self._fs.info(self._path(url)).get("mimetype") == "text/html")

        found = self.item(url)
        return None if found is not None and url.is_web and self._retried(is_page, url) else found

    def listing(self, folder: Url) -> tuple[list[Item], list[str]]:
        """(files, names of folders) in a folder. Raises SonarrecError where it cannot be read."""

        def ask() -> list[dict[str, Any]]:
            with self._told(folder):
                path = self._path(folder)
                if folder.is_web:
                    path = path.partition("?")[0].rstrip("/") + "/"
                given = {"refresh": True} if folder.scheme == "s3" else {}
                found: list[dict[str, Any]] = self._fs.ls(path, detail=True, **given)
                return found

        files, folders = [], []
        for one in self._retried(ask):
            path = unquoted(one["name"].partition("?")[0]) if folder.is_web else one["name"]
            name = path.rstrip("/").rpartition("/")[2]
            if one["type"] == "directory":
                folders.append(name)
            elif name and not path.endswith("/") and _same_folder(folder, path):
                files.append(_item(folder.child(name), one))
        return files, folders

    def glob(self, pattern: Url) -> list[Item]:
        """The files that match. Raises SonarrecError where the folder cannot be read."""

        def ask() -> Mapping[str, dict[str, Any]]:
            with self._told(pattern):
                path = self._path(pattern).partition("?")[0] if pattern.is_web else pattern.path
                found: Mapping[str, dict[str, Any]] = self._fs.glob(path, detail=True)
                return found

        items = []
        for path, one in self._retried(ask).items():
            if one["type"] != "directory":
                at = unquoted(path).removeprefix(pattern.front) if pattern.is_web else path
                items.append(_item(Url(pattern.scheme, pattern.front, at, pattern.query), one))
        return items

    def described(self, items: list[Item]) -> list[Item]:
        """The same with size and tag, which the index pages of web servers do not tell."""
        if not items or not items[0].url.is_web:
            return items
        with ThreadPoolExecutor(AT_ONCE) as threads:
            return list(threads.map(self.file, [item.url for item in items]))

    # Fetched

    def fetch(self, item: Item, to: Path, told: Callable[[int], None] = lambda _: None) -> Item:
        """Write a file to `to`, whole and checked or not at all; the item as it was fetched.

        told: how many bytes came, as they come; below zero where they have to come again.
        A transfer that breaks off goes on where it was, or anew where the server cannot do that.
        Raises SonarrecError after AGAIN more tries, and where the disk takes no more.
        """
        to.parent.mkdir(parents=True, exist_ok=True)
        part = to.with_name(f"{to.name}.{item.identity}.part")
        if not item.known:
            part.unlink(missing_ok=True)

        def ask() -> Item:
            self._transfer(item, part, told)
            self._check(item, part, told)
            return item

        try:
            self._retried(ask)
            os.replace(part, to)  # noqa: PTH105
        except OSError as error:
            raise SonarrecError(
                f"{shown(part)}: cannot be written ({error.strerror}); choose another --cache"
            ) from None
        return item

    def _transfer(self, item: Item, part: Path, told: Callable[[int], None]) -> None:
        at = part.stat().st_size if part.exists() else 0
        if at and (self._streams or item.size is None):
            told(-at)
            at = 0
        if item.size is not None and at > item.size:
            told(-at)
            at = 0
        with part.open("r+b" if at else "wb") as out, self._opened(item) as file:
            out.seek(at)
            while item.size is None or at < item.size:
                self._stopped()
                wanted = BLOCK_BYTES if item.size is None else min(BLOCK_BYTES, item.size - at)
                with self._told(item.url):
                    block = self._read(file, at, wanted)
                if not block:
                    break
                out.write(block)
                at += len(block)
                told(len(block))

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
        given: dict[str, Any] = {} if item.url.scheme == "sftp" else {"block_size": block}
        if item.url.is_web or item.url.scheme in ("s3", "gs"):
            given["cache_type"] = "none"
        with self._told(item.url):
            file = self._fs.open(self._path(item.url), "rb", **given)
        try:
            yield file
        finally:
            file.close()

    def _check(self, item: Item, part: Path, told: Callable[[int], None]) -> None:
        """Raises BrokenError where the file is not what the server holds."""
        size = part.stat().st_size
        if item.size is not None and size != item.size:
            raise BrokenError(f"{size} of {item.size} bytes came")
        if item.md5 is not None and _md5(part) == item.md5:
            return
        now = self.item(item.url)
        changed = now is None or (now.size, now.tag) != (item.size, item.tag)
        if changed or (item.md5 is not None and not self._encrypted(item)):
            part.unlink()
            told(-size)
            if changed:
                raise SonarrecError(f"{item.url.shown}: changed while it was fetched; run again")
            raise BrokenError("its checksum is not the server's")

    def _encrypted(self, item: Item) -> bool:
        """Whether S3 encrypted it, so that the ETag is no MD5."""
        if item.url.scheme != "s3":
            return False
        bucket, _, key = item.url.path.partition("/")
        with self._told(item.url):
            head = self._fs.call_s3("head_object", Bucket=bucket, Key=key)
        return head.get("ServerSideEncryption") not in (None, "AES256")

    # Written

    def put(self, file: Path, url: Url) -> None:
        """Upload a file, which nobody sees before it is whole. Raises SonarrecError."""

        def ask() -> None:
            # SFTP shows a file while it grows.
            to = url.parent.child(f"{url.name}.part") if url.scheme == "sftp" else url
            with self._told(url):
                self._fs.put_file(str(file), self._path(to))
                if to != url:
                    self.remove(url)
                    self._fs.mv(self._path(to), self._path(url))
            there = self.item(url)
            if there is None or there.size != file.stat().st_size:
                raise BrokenError("the server does not hold all of it")

        self._stopped()
        self._retried(ask, url)

    def remove(self, url: Url) -> None:
        """Delete a file or a folder with all in it, where there is one. Raises SonarrecError."""

        # s3fs and gcsfs take it for a glob, which would delete what lies elsewhere.
        path = self._path(url) if url.scheme == "sftp" else glob.escape(self._path(url))

        def ask() -> None:
            try:
                with self._told(url):
                    self._fs.rm(path, recursive=True)
            except MissingError:
                pass

        self._retried(ask, url)

    # Faults

    def _stopped(self) -> None:
        if self._stop.is_set():
            raise StoppedError("stopped")

    def _retried(self, ask: Callable[[], T], url: Url | None = None) -> T:
        """What `ask` gives, asked up to AGAIN more times where it breaks off.

        Raises SonarrecError, told of the URL, where all of them do.
        """
        for tried in range(AGAIN + 1):
            try:
                return ask()
            except BrokenError as error:
                if tried == AGAIN:
                    url = url or self._url
                    raise SonarrecError(
                        f"{url.shown}: broke off, and {AGAIN} times again ({error})"
                    ) from None
                self._stop.wait(max(PAUSE_S * 2**tried, min(error.after_s, LONGEST_PAUSE_S)))
                self._stopped()
        raise AssertionError("not reached")

    @contextmanager
    def _told(self, url: Url) -> Iterator[None]:
        """A fault of the libraries as one of ours: which kind, and its text without secrets."""
        try:
            yield
        except (SonarrecError, ImportError):
            raise
        except Exception as error:  # s3fs, gcsfs, aiohttp and asyncssh share no class
            cause = error.__cause__
            # fsspec calls whatever a web server does a missing file.
            if cause is not None and type(cause).__module__.startswith(("aiohttp", "asyncio")):
                error = cause if isinstance(cause, Exception) else error
            status = getattr(error, "status", None)
            if isinstance(error, FileNotFoundError | NotADirectoryError) or status in (404, 410):
                raise MissingError(f"{url.shown}: nothing is there") from None
            text = getattr(error, "message", None) or str(error) or type(error).__name__
            if status == 0:  # of redirects without an end aiohttp tells nothing else
                status, text = None, type(error).__name__
            text = f"{status} {text}" if isinstance(status, int) else str(text)
            text = " ".join(url.hide(text).split())[:300]
            if isinstance(error, PermissionError) or status in (401, 403, 407) or _no_key(error):
                raise RefusedError(
                    f"{url.shown}: no access ({text}); `sonarrec help remote` says where "
                    "credentials are looked for"
                ) from None
            raise BrokenError(text, _retry_after_s(error)) from None


def writable(url: Url) -> Url:
    """The URL itself. Raises UsageError where results cannot be written there."""
    if url.is_web:
        raise UsageError(
            f"{url.shown}: a web server takes no results; give --out, local or s3, gs, sftp"
        )
    return url


def _no_key(error: Exception) -> bool:
    """Credentials or a host key are missing: no use to try again."""
    names = {c.__name__ for c in type(error).__mro__}
    return bool(
        names & {"NoCredentialsError", "PartialCredentialsError", "HostKeyNotVerifiable"}
        | names & {"PermissionDenied", "ProfileNotFound", "GoogleAuthError"}
    )


def _retry_after_s(error: Exception) -> float:
    """How long a web server that is busy asks to wait: seconds, or until a date; 0 without."""
    headers = getattr(error, "headers", None)  # of aiohttp
    stated = str(headers.get("Retry-After", "")) if isinstance(headers, Mapping) else ""
    try:
        if stated.isdigit():
            return float(stated)
        until = parsedate_to_datetime(stated)
        return (until - datetime.now(until.tzinfo)).total_seconds()
    except (ValueError, OverflowError):  # no date, or one beyond every calendar
        return 0.0


def _same_folder(folder: Url, path: str) -> bool:
    """Whether a listed path lies in the folder: an index page has other links too."""
    inside = path.rpartition("/")[0]
    return not folder.is_web or inside.endswith(folder.path.rstrip("/"))


def _item(url: Url, found: Mapping[str, Any]) -> Item:
    tag = next((found[k] for k in ("ETag", "etag", "Last-Modified", "mtime") if found.get(k)), None)
    size = found.get("size")
    url = replace(url, literal=True)
    return Item(url, size, None if tag is None else str(tag), _stated_md5(url, found))


def _stated_md5(url: Url, found: Mapping[str, Any]) -> str | None:
    if url.scheme == "s3":
        tag = str(found.get("ETag", "")).strip('"')
        return tag if re.fullmatch(r"[0-9a-f]{32}", tag) else None  # of one part
    stated = found.get("md5Hash") or found.get("Content-MD5")
    try:
        return base64.b64decode(str(stated), validate=True).hex() if stated else None
    except ValueError:
        return None


def _md5(path: Path) -> str:
    digest = hashlib.md5(usedforsecurity=False)
    with path.open("rb") as file:
        while block := file.read(2**20):
            digest.update(block)
    return digest.hexdigest()
