"""Checks that results belong to a log."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from sonarrec.errors import SonarrecError, number_of
from sonarrec.results.read import read_frames
from sonarrec.results.run_file import RunFile


class RecordedLog(Protocol):
    """What identifies a log; `readers.log.Log` has it."""

    @property
    def path(self) -> Path: ...
    @property
    def frame_count(self) -> int | None: ...
    def digest_source(self) -> tuple[int, str]: ...


def check_same_log(log: RecordedLog, folder: Path, run: RunFile) -> None:
    """Raise SonarrecError if the results in `folder` are of another log.

    Compared by size and SHA-256 or, if run.toml lacks them, by the number of frames.
    """
    made_from = run.input
    if made_from.sha256 is not None:
        size, digest = log.digest_source()
        if (size, digest) != (made_from.bytes, made_from.sha256):
            raise SonarrecError(
                f"{folder}: results of another log, {made_from.name} with "
                f"{made_from.bytes} bytes and SHA-256 {made_from.sha256[:12]}..., not of "
                f"{log.path} with {size} and {digest[:12]}...; give the log they were made from, "
                f"or `sonarrec run {log.path}`"
            )
        return
    last = last_frame(folder)
    if log.frame_count is not None and last >= log.frame_count:
        raise SonarrecError(
            f"{folder / 'frames.csv'}: results of another log: frame {last} is listed, but "
            f"{log.path} has only {number_of(log.frame_count, 'frame')}"
        )


def last_frame(folder: Path) -> int:
    """The number of the last frame that was processed; -1 if there is none."""
    return int(read_frames(folder)["frame"].max(initial=-1))


def check_one_log(old: Path, before: RunFile, new: Path, after: RunFile) -> str | None:
    """Raise SonarrecError if two results folders are of different logs or topics.

    Returns a note if a run.toml lacks the SHA-256, so that frames are matched by number; else None.
    """
    a, b = before.input, after.input
    if not a.sha256 or not b.sha256:
        without = " and ".join(str(f) for f, i in ((old, a), (new, b)) if not i.sha256)
        return f"{without}: no SHA-256 of the log in run.toml; frames are matched by number"
    if (a.sha256, a.topic) != (b.sha256, b.topic):
        names = (
            f"{i.name} (SHA-256 {i.sha256[:12]}...{f', topic {i.topic}' if i.topic else ''})"
            for i in (a, b)
            if i.sha256
        )
        raise SonarrecError(
            f"{old} and {new}: results of different logs, {' and '.join(names)}; compare results "
            "of one log"
        )
    return None
