"""Where the log is that results were made from, and whether a run would give them again."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from sonarrec.errors import SonarrecError, is_url, listed, name_from_text, number_of
from sonarrec.landmarks import load_landmarks
from sonarrec.readers.open import LANDMARKS_FILE, SONAR_FILE, Source, find_log
from sonarrec.results.folders import is_file
from sonarrec.results.identity import why_outdated
from sonarrec.results.run_file import Input, RunFile, read_run
from sonarrec.sonar.stated import load_sonar


def recorded_at(folder: Path, source: Input) -> Source:
    """The log that results were made from. Raises SonarrecError if it is not there, or replaced."""
    if source.path is None:
        raise SonarrecError("run.toml does not say where the log is")
    if is_url(source.path):
        raise SonarrecError(f"its log is on a server, {source.path}")
    log = _log_at(source.path, folder, source)
    if source.bytes not in (None, size := _size(log)):
        raise SonarrecError(
            f"{log.path} has changed since the run (it had {source.bytes} bytes and has {size})"
        )
    return log


def _log_at(path: str, folder: Path, source: Input) -> Source:
    """The log at the path in run.toml, else at the place relative to the results folder; a log of
    another size, such as "." of another folder, only if there is no other.

    In both, bytes that are not UTF-8 are escaped. Raises SonarrecError if there is no log.
    """
    candidates, logs = [path, name_from_text(path)], list[Source]()
    if source.place is not None:  # the path is relative to the folder that `run` was called in
        candidates.append(str((folder.resolve() / name_from_text(source.place)).resolve()))
    for candidate in candidates:
        with suppress(SonarrecError):
            logs.append(find_log(candidate))
            if source.bytes in (None, _size(logs[-1])):
                return logs[-1]
    return logs[0] if logs else find_log(path)


def _size(log: Source) -> int:
    """Bytes, counted as in run.toml (`readers.log.digest_of`)."""
    total = 0
    for file in log.files:
        with suppress(OSError):  # the run reported it
            total += file.stat().st_size
    return total


def outdated(folders: Sequence[Path]) -> list[str]:
    """A line if a run now may not give the results in some of these folders again."""
    changed = []
    for folder in folders:
        with suppress(SonarrecError):  # reported where its tables are read
            if not is_file(folder / "run.toml"):
                continue
            run = read_run(folder / "run.toml")
            if why := why_outdated(run.table) or _changed_since(folder, run):
                changed.append((folder, why))
    if not changed:
        return []
    (first, why), *more = changed
    others = f" and {number_of(len(more), 'more folder')}" if more else ""
    return [f"{first}{others}: {why}; `sonarrec run` of the log replaces them"]


def _changed_since(folder: Path, run: RunFile) -> str:
    """Which of the log's files is newer than the results and states something else; empty: none.

    Its age counts too: an option may have taken precedence over a file that is as it was.
    """
    log = recorded_at(folder, run.input)
    for name, load, used in (
        (SONAR_FILE, load_sonar, run.sonar),
        (LANDMARKS_FILE, load_landmarks, run.landmark_set),
    ):
        file = log.companion(name)
        if file is None or file.stat().st_mtime_ns <= run.path.stat().st_mtime_ns:
            continue
        now, then = load(file).as_table(), used().as_table()
        if keys := [key for key in {**now, **then} if now.get(key) != then.get(key)]:
            return f"of an older {file}, which was changed after the run in {listed(keys, 3)}"
    return ""
