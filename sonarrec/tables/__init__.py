"""Reads TOML and CSV, writes files safely; and names of files: their endings and their order."""

from __future__ import annotations

import os
import re
import stat
import unicodedata
from contextlib import suppress
from pathlib import Path

from sonarrec.errors import SonarrecError

PART = ".part"
"""Ending of the name of a results folder whose run is not finished; no other folder has it."""
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm"})
"""How the names of images end; a folder that holds some is a log."""
ARRAY_SUFFIX = ".npy"
"""Of an array of NumPy; a folder that holds some, and neither images nor other logs, is a log."""
STREAMS = ("/dev/std", "/dev/fd/", "/proc/")
"""Prefixes of names that may refer to open files of this process."""

# Seconds since 1970 with their decimals, at whose end programs leave out zeros, or all of them;
# else whole numbers.
_NUMBER = re.compile(r"(1[0-9]{9})(?:\.([0-9]+)|(?![0-9]))|[0-9]+")


def natural_order(path: str | Path) -> str:
    """Sort key by which frame2.png comes before frame10.png, and 1700000000.25 before 1700000000.5.

    The key is one text: for very many files it takes a fraction of the memory of a list of parts.
    A zero byte, which no path holds, and the count of its digits are put before each number. The
    path itself comes last, for 1 and 01 are the same number.
    """
    text = os.fspath(path)
    return f"{_NUMBER.sub(_led_by_its_length, text)}\0\0{text}"


def _led_by_its_length(number: re.Match[str]) -> str:
    seconds, decimals = number.groups(default="")
    digits = (seconds or number[0]).lstrip("0")
    led = f"\0{len(digits):04d}{digits}"
    return f"{led}.{decimals}\0" if seconds else led


_SOMETHING_ELSE = {
    b"version https://git-lfs": "a pointer of Git LFS; `git lfs pull` fetches the file",
    b"/annex/objects/": "a pointer of git-annex; `git annex get` fetches the file",
    b"PK\3\4": "a ZIP, or a sheet of Excel: unpack it, or save it as CSV (UTF-8)",
    b"\x1f\x8b": "compressed; unpack it",
    b"\x28\xb5\x2f\xfd": "compressed; unpack it",
    b"<!doctype html": "a web page; download the file again",
}


def something_else(head: bytes) -> str | None:
    """What a file is that begins so, and what to do; None if it may be one that is read."""
    head = head.lower()
    return next(
        (what for mark, what in _SOMETHING_ELSE.items() if head.startswith(mark.lower())), None
    )


_KINDS = {
    "image": rb"\x89PNG|\xff\xd8\xff|II\*\0|MM\0\*|BM.{4}\0{4}|P5\s",
    "video": rb"RIFF.{4}AVI |.{4}ftyp(?!heic|heix|mif1|avif)|\x1a\x45\xdf\xa3",
    "MCAP": rb"\x89MCAP",
    "ROS 1 bag": rb"#ROSBAG",
    "ROS 2 bag (SQLite)": rb"SQLite format 3",
}


def kind_of(head: bytes) -> str | None:
    """The kind of recording that a file is by its first bytes, as readers are called; or None."""
    return next((k for k, mark in _KINDS.items() if re.match(mark, head, re.DOTALL)), None)


def not_text(head: bytes, wanted: str) -> str | None:
    """What a file is that begins so, and what to do; None if it may be a text. wanted: such as "a
    TOML file"."""
    if what := something_else(head):
        return what
    kind = kind_of(head)
    return kind and f"not {wanted} but a file of another kind ({kind}); give {wanted} here"


def refuse_pipe(path: Path) -> None:
    """Raise SonarrecError for a named pipe, into which perhaps nobody ever writes.

    That of `<(command)` is none.
    """
    with suppress(OSError):
        if stat.S_ISFIFO(path.stat().st_mode) and not str(path).startswith(STREAMS):
            raise SonarrecError(f"{path}: a pipe, at which this would wait; give a file")


def composed(name: str) -> str:
    """A name in the form in which names are compared: some systems part letters and accents."""
    return unicodedata.normalize("NFC", name)
