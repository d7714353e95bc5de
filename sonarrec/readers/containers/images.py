"""Reads folders, globs and lists of images."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from sonarrec.errors import Diagnostics
from sonarrec.nouns import IMAGE_SUFFIXES, date_text
from sonarrec.readers.decode.pixels import decode_image, pgm_maxval
from sonarrec.readers.guess.names import in_order, times_in_names
from sonarrec.readers.raw import RawFrame, RawLog, UnusableError

MAX_FILE_BYTES = 2**27  # an image of 4096 x 4096 pixels of eight bytes


def names_an_image(name: str) -> bool:
    """Whether a file of this name is taken for an image: of a known suffix, and not hidden."""
    return Path(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith(".")


def is_image(path: Path) -> bool:
    """Whether a path is taken for an image: a known suffix, not hidden, and a file. A link to a
    file that is not there is an image that cannot be read: it keeps its number."""
    if not names_an_image(path.name):
        return False
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return True


def _contents(file: Path) -> np.ndarray:
    """The bytes of an image file. Raises UnusableError where they cannot be had."""
    try:
        with file.open("rb", buffering=0) as opened:
            size = os.fstat(opened.fileno()).st_size
            if size > MAX_FILE_BYTES:
                raise UnusableError(f"a file of {size} bytes, more than is read")
            return np.frombuffer(opened.read(), np.uint8)
    except OSError as error:
        if file.is_symlink() and not file.exists():
            raise UnusableError("a link to a file that is not there") from None
        raise UnusableError(f"unreadable file ({error.strerror})") from None


class ImagePaths(Sequence[Path]):
    """Images in the order of their names, kept as text: a list of a Path each takes five times as
    much. doubt: why the order is a guess; None if it is certain."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self._texts, self.doubt = in_order(map(str, paths))

    def __getitem__(self, index: int) -> Path:  # type: ignore[override] # there are no slices
        """An image."""
        return Path(self._texts[index])

    def __len__(self) -> int:
        """How many there are."""
        return len(self._texts)


def _not_as_numbered(files: Sequence[Path]) -> tuple[int, str] | None:
    """(index, name) of the first image whose number in its name does not follow from the first's.
    None if there is none, and if the names differ in more than one number or lack more numbers than
    they have: then these are times, or every tenth frame."""
    first = number = 0
    around, uncounted = None, None
    for index, file in enumerate(files):
        parts = re.fullmatch(r"(.*?)(?<![0-9])([0-9]{1,9})([^0-9]*)", file.stem, re.DOTALL)
        if parts is None or parts.group(1, 3) != (around := around or parts.group(1, 3)):
            return None
        number = int(parts[2])
        if index == 0:
            first = number
        if uncounted is None and number - first != index:
            uncounted = index, file.name
    return uncounted if number - first < 2 * len(files) else None


class ImageFiles(RawLog):
    """One image file a frame, in the order of the names.

    Times in the names, as `times_in_names` finds them, are the frames' times.
    """

    def __init__(self, files: Sequence[Path], diagnostics: Diagnostics) -> None:
        super().__init__(diagnostics)
        self.files = files if isinstance(files, ImagePaths) else ImagePaths(files)
        self.frame_count = len(self.files)
        stems = [file.stem for file in self.files]
        self._times = times_in_names(stems)
        if (note := self._about_times(stems)) is not None:
            diagnostics.note(note)

    def _about_times(self, stems: Sequence[str]) -> str | None:
        """What a user should know of the frames' times and numbers. stems: names without suffix."""
        # Whether most images are named like another but for the suffix.
        if len(set(stems)) < len(stems) and 3 * len(
            {file.with_suffix("") for file in self.files}
        ) <= 2 * len(stems):
            return (
                "it has images of two kinds with the same names, and each is a frame; if they show "
                f"the same, quote a glob of one kind, such as '*{self.files[0].suffix}'"
            )
        if self._times is not None:
            if re.fullmatch("[0-9]{19}", stems[0]):
                return None
            first, steps = date_text(int(self._times[0]), 3), np.diff(self._times)
            rate = f", and {1e9 / np.median(steps):.3g} a second" if len(steps) else ""
            return f"frames have the times in the names of its images, the first {first} UTC{rate}"
        if self.files.doubt is not None:
            return (
                f"the order of its {len(stems)} images, from {self.files[0].name} to "
                f"{self.files[-1].name}, is a guess: {self.files.doubt}; if it is wrong, name them "
                "by one counter (000000, 000001, ...)"
            )
        if (uncounted := _not_as_numbered(self.files)) is not None:
            index, name = uncounted
            return (
                "the names of its images leave out or repeat numbers, but frames are counted: "
                f"{name} is frame {index}"
            )
        return None

    def __iter__(self) -> Iterator[RawFrame]:
        for number, file in enumerate(self.files):
            name = file.name
            timestamp_ns = None if self._times is None else int(self._times[number])
            if number in self.passed_over:
                yield RawFrame(name, timestamp_ns, None)
                continue
            try:
                pixels = decode_image(data := _contents(file))
            except UnusableError as error:
                yield RawFrame(name, timestamp_ns, None, str(error))
            else:
                yield RawFrame(name, timestamp_ns, pixels, white=pgm_maxval(data))
