"""Where the log is that results were made from."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from sonarrec.errors import MissingError, SonarrecError, is_url, name_from_text
from sonarrec.readers.open import Source, find_log
from sonarrec.results.run_file import Input


def recorded_at(folder: Path, source: Input) -> Source:
    """The log that results were made from. Raises SonarrecError if it is not there, or replaced."""
    if source.path is None:
        raise SonarrecError("run.toml does not say where the log is")
    if is_url(source.path):
        raise SonarrecError(f"its log is on a server, {source.path}")
    log = _log_at(source.path, folder, source.place)
    if source.bytes not in (None, size := _size(log)):
        raise SonarrecError(
            f"{log.path} has changed since the run (it had {source.bytes} bytes and has {size})"
        )
    return log


def _log_at(path: str, folder: Path, relative: str | None) -> Source:
    """The log at the path in run.toml, else at the place relative to the results folder.

    In both, bytes that are not UTF-8 are escaped. Raises MissingError if there is no log.
    """
    candidates = [path, name_from_text(path)]
    if relative is not None:  # the path is relative to the folder that `run` was called in
        candidates.append(str((folder.resolve() / name_from_text(relative)).resolve()))
    for candidate in candidates:
        with suppress(MissingError):
            return find_log(candidate)
    return find_log(path)


def _size(log: Source) -> int:
    """Bytes, counted as in run.toml (`readers.log.digest_of`)."""
    total = 0
    for file in log.files:
        with suppress(OSError):  # the run reported it
            total += file.stat().st_size
    return total
