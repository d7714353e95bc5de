"""The cache of fetched files, a folder of bounded size.

An entry holds one version of one log: a folder with `files/`, `bytes` (how many it may take), and
`lock`. Its user holds the lock, so that no other run, process or thread deletes it. The least
recently used entry is deleted first. fsspec's own file cache does not serve here: it writes down
the URLs with their secrets, and knows neither a bound nor other processes.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.tables.locks import is_there, locked

_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}


class NoRoomError(SonarrecError):
    """Logs in use fill the cache; there is room when one is no longer used."""


def unwritable(place: Path, error: OSError) -> SonarrecError:
    """The error to raise if a place in the cache cannot be written."""
    return SonarrecError(f"{place}: cannot be written ({error.strerror}); choose another --cache")


def size_bytes(text: str) -> int:
    """The bytes of a size such as "500MB", "1.5 TB" or "20g". Raises UsageError."""
    match = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([kmgt]?)b?\s*", text.lower())
    if match is None:
        raise UsageError(f"--cache-size {text}: expected a size such as 500MB or 20GB")
    return int(float(match[1]) * _UNITS[match[2]])


def default_folder() -> Path:
    """`sonarrec` in the user's cache folder."""
    caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(caches).expanduser() / "sonarrec"


def key_of(*texts: object) -> str:
    """A folder's name for what the texts, URLs among them, name on an S3 server or another."""
    server = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
    return hashlib.sha256(" ".join(map(str, (server, *texts))).encode()).hexdigest()[:24]


@dataclass(frozen=True, slots=True)
class Cache:
    """A folder, and how many bytes it may hold."""

    folder: Path
    limit: int

    def entry(self, key: str) -> Path:
        return self.folder / "logs" / key

    @contextmanager
    def hold(self, key: str, *, alone: bool) -> Iterator[Path]:
        """The entry of a key, which is not deleted inside. alone: nobody else uses it inside.

        Raises SonarrecError if the folder cannot be written.
        """
        entry = self.entry(key)
        while True:
            try:
                (entry / "files").mkdir(parents=True, exist_ok=True)
                lock = (entry / "lock").open("ab")
            except FileNotFoundError:  # deleted at this moment
                continue
            except OSError as error:
                raise unwritable(self.folder, error) from None
            locked(lock, alone=alone, wait=True)
            if is_there(lock, entry / "lock"):
                break
            lock.close()
        with lock:
            yield entry
            with suppress(OSError):
                os.utime(lock.name)

    def reserve(self, entry: Path, count: int, url: str) -> None:
        """Reserve room for `count` bytes in an entry; deletes entries that are not in use.

        Raises NoRoomError if the others are in use, SonarrecError if it can never fit.
        """
        if count > self.limit:
            raise SonarrecError(
                f"{url}: {_size(count)} is more than the cache may hold ({_size(self.limit)}); "
                "give a larger --cache-size"
            )
        with (self.folder / ".lock").open("ab") as lock:
            locked(lock, alone=True, wait=True)
            others = sorted((self.folder / "logs").glob("*"), key=_last_use)
            sizes = {other: _bytes(other) for other in others if other != entry}
            for other in [*sizes]:
                if sum(sizes.values()) + count <= self.limit:
                    break
                if deleted(other):
                    del sizes[other]
            if sum(sizes.values()) + count > self.limit:
                raise NoRoomError(
                    f"{url}: {_size(count)} do not fit beside the logs in use in "
                    f"{self.folder} (at most {_size(self.limit)}); give a larger "
                    "--cache-size"
                )
            (entry / "bytes").write_text(str(count))


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


def files_in(entry: Path) -> list[Path]:
    return [path for path in (entry / "files").rglob("*") if path.is_file()]


def _bytes(entry: Path) -> int:
    """What an entry may take."""
    try:
        return int((entry / "bytes").read_text())
    except (OSError, ValueError):  # nothing was reserved yet
        return 0


def _last_use(entry: Path) -> float:
    try:
        return (entry / "lock").stat().st_mtime
    except OSError:
        return 0.0


def deleted(entry: Path) -> bool:
    """Delete an entry unless it is in use; whether it is gone."""
    try:
        with (entry / "lock").open("ab") as lock:
            if locked(lock, alone=True):
                shutil.rmtree(entry, ignore_errors=True)
    except OSError:
        pass
    return not entry.exists()


def _size(size: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"
