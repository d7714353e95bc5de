"""The cache of fetched files, a folder of bounded size.

An entry is a folder with `files/`, `entry.json` about them, and `lock`. Its user holds the lock, so
that no other run, process or thread deletes it. The least recently used entry is deleted first.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sonarrec.errors import SonarrecError, UsageError, name_as_text
from sonarrec.files.locks import is_there, locked
from sonarrec.files.outputs import write_text

_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
_POLL_S = 0.2


class NoRoomError(SonarrecError):
    """Logs in use fill the cache; there is room when one is no longer used."""


def unwritable(place: Path, error: OSError) -> SonarrecError:
    """The error to raise if a place in the cache cannot be written."""
    return SonarrecError(
        f"{name_as_text(place)}: cannot be written ({error.strerror}); choose another --cache"
    )


def size_bytes(text: str) -> int:
    """The bytes of a size such as "500MB", "1.5 TB" or "20g". Raises UsageError."""
    match = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([kmgt]?)b?\s*", text.lower())
    if match is None:
        raise UsageError(f"--cache-size {text}: expected a size such as 500MB or 20GB")
    return int(float(match[1]) * _UNITS[match[2]])


def default_folder() -> Path:
    """`sonarrec` in the user's cache folder. Raises SonarrecError if platformdirs is missing."""
    try:
        import platformdirs
    except ImportError:
        raise SonarrecError(
            "platformdirs, which finds the cache folder, is not installed; "
            "pip install 'sonarrec[remote]'"
        ) from None

    return Path(platformdirs.user_cache_dir("sonarrec", appauthor=False))


def key_of(text: str) -> str:
    """A folder's name for a URL; it depends on the S3 server too."""
    server = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
    return hashlib.sha256(f"{server} {text}".encode()).hexdigest()[:24]


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry, held by its lock."""

    folder: Path

    @property
    def files(self) -> Path:
        return self.folder / "files"

    def about(self) -> dict[str, Any]:
        """entry.json: url, bytes, files {name: [size, tag]}; empty if there is none."""
        about: dict[str, Any] = {}
        with suppress(OSError, ValueError):
            about = json.loads((self.folder / "entry.json").read_text(encoding="utf-8"))
        match about:
            case {"bytes": int(), "files": dict()}:
                return about
        return {}

    def write(self, about: dict[str, Any]) -> None:
        write_text(self.folder / "entry.json", json.dumps(about))

    def mark_used(self) -> None:
        """Mark it as used now, so that others are deleted first."""
        with suppress(OSError):
            os.utime(self.folder / "entry.json")


@dataclass(frozen=True, slots=True)
class Cache:
    """A folder, and how many bytes it may hold."""

    folder: Path
    limit: int

    @contextmanager
    def hold(self, key: str, *, alone: bool) -> Iterator[Entry]:
        """The entry of a key, which is not deleted inside. alone: nobody else uses it inside.

        Raises SonarrecError if the folder cannot be written.
        """
        entry = Entry(self.folder / "logs" / key)
        while True:
            try:
                entry.files.mkdir(parents=True, exist_ok=True)
                file = (entry.folder / "lock").open("ab")
            except FileNotFoundError:  # deleted at this moment
                continue
            except OSError as error:
                raise unwritable(self.folder, error) from None
            if locked(file, alone=alone) and is_there(file, entry.folder / "lock"):
                break
            file.close()
            time.sleep(_POLL_S)
        try:
            yield entry
        finally:
            entry.mark_used()
            file.close()

    def make_room(self, entry: Entry, about: dict[str, Any]) -> None:
        """Reserve room for about["bytes"] in entry.json; deletes entries that are not in use.

        Raises NoRoomError if the others are in use, SonarrecError if it can never fit.
        """
        bytes_needed: int = about["bytes"]
        if bytes_needed > self.limit:
            raise SonarrecError(
                f"{about['url']}: {_size(bytes_needed)} is more than the cache may hold "
                f"({_size(self.limit)}); give a larger --cache-size"
            )
        with (self.folder / ".lock").open("ab") as file:
            while not locked(file, alone=True):
                time.sleep(_POLL_S)
            others = [e for e in self.entries() if e.folder != entry.folder]
            sizes = {e.folder: e.about().get("bytes", 0) for e in others}
            for other in others:
                if sum(sizes.values()) + bytes_needed <= self.limit:
                    break
                if _deleted(other):
                    del sizes[other.folder]
            if sum(sizes.values()) + bytes_needed > self.limit:
                raise NoRoomError(
                    f"{about['url']}: {_size(bytes_needed)} do not fit beside the logs in use in "
                    f"{name_as_text(self.folder)} (at most {_size(self.limit)}); give a larger "
                    "--cache-size"
                )
            entry.write(about)

    def entries(self) -> list[Entry]:
        """All entries, the least recently used first."""
        entries = [Entry(folder) for folder in (self.folder / "logs").glob("*")]
        return sorted(entries, key=_last_use)


@contextmanager
def only_one(lock: Path, what: str) -> Iterator[None]:
    """Hold a lock. Raises SonarrecError, which names `what`, if another run holds it."""
    try:
        lock.parent.mkdir(parents=True, exist_ok=True)
        file = lock.open("ab")
    except OSError as error:
        raise unwritable(lock.parent, error) from None
    with file:
        if not locked(file, alone=True):
            raise SonarrecError(
                f"{what}: another run writes here now; wait for it, or choose another --out"
            )
        yield


def _last_use(entry: Entry) -> float:
    try:
        return (entry.folder / "entry.json").stat().st_mtime
    except OSError:
        return 0.0


def _deleted(entry: Entry) -> bool:
    """Delete an entry unless it is in use; whether it is gone."""
    try:
        with (entry.folder / "lock").open("ab") as file:
            if not locked(file, alone=True):
                return False
            shutil.rmtree(entry.folder, ignore_errors=True)
    except OSError:
        return False
    return not entry.folder.exists()


def _size(size: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"
