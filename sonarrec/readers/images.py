"""Reads folders, globs and lists of images."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sonarrec.readers.pixels import decode_image
from sonarrec.readers.raw import RawFrame, UnusableError

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm"})


def natural_order(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key by which frame2.png comes before frame10.png."""
    parts = re.split(r"(\d+)", str(path))
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts], str(path)


def is_image(path: Path) -> bool:
    """Whether a path is taken for an image: a known suffix, and not a hidden file."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


class ImageFiles:
    """One image file a frame, in natural order of the names.

    Names of exactly 19 digits, where all are, are times in nanoseconds.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self.files = sorted(files, key=natural_order)
        self.frame_count: int | None = len(self.files)
        self.topic: str | None = None
        self.polar = False
        self.faults: list[str] = []
        self._stamped = all(re.fullmatch(r"[0-9]{19}", f.stem) for f in self.files)

    def __iter__(self) -> Iterator[RawFrame]:
        for file in self.files:
            timestamp_ns = int(file.stem) if self._stamped else None
            try:
                pixels = decode_image(np.fromfile(file, np.uint8))
            except UnusableError as error:
                yield RawFrame(file.name, timestamp_ns, None, str(error))
            except OSError as error:
                yield RawFrame(file.name, timestamp_ns, None, f"unreadable file ({error.strerror})")
            else:
                yield RawFrame(file.name, timestamp_ns, pixels)

    def close(self) -> None:
        """Nothing stays open between frames."""
