"""Reads folders, globs and lists of images, in the order and with the times of their names."""

from __future__ import annotations

import os
import re
import stat
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from sonarrec.errors import Diagnostics
from sonarrec.readers.containers.times_in_names import date_in, times_in_names
from sonarrec.readers.decode.pixels import (
    END_BYTES,
    HEAD_BYTES,
    decode_image,
    kind_if_complete,
    pgm_maxval,
)
from sonarrec.readers.raw import RawLog, StoredFrame, UnusableError
from sonarrec.sonar.frame import date_text
from sonarrec.stretches import HOUR_NS
from sonarrec.tables import ARRAY_SUFFIX, IMAGE_SUFFIXES, natural_order

MAX_FILE_BYTES = 2**27  # an image of 4096 x 4096 pixels of eight bytes
_GAP = 20  # times the least step, from which on a counter may have reached its limit there


def names_an_image(name: str) -> bool:
    """Whether a file of this name is taken for an image: of a known suffix, and not hidden."""
    return Path(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith(".")


def is_image(path: Path) -> bool:
    """Whether a path is taken for an image: a known suffix, not hidden, and a file. A link to a
    file that is not there is an image that cannot be read: it keeps its number."""
    try:
        return names_an_image(path.name) and stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return True


def is_array(path: Path) -> bool:
    """Whether a path is taken for an array of NumPy."""
    return path.suffix.lower() == ARRAY_SUFFIX and path.name[0] != "." and path.is_file()


class ImagePaths(Sequence[Path]):
    """Images in the order of the times in their names or, without times, in the natural order of
    the names. They are kept as text: a list of a Path each takes five times as much.

    times: as the names have them; None if they have none. doubt: why the order is a guess; None if
    it is certain: by times, or where all names are the same but for counters that rise from each to
    the next."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self._texts = sorted(map(str, paths), key=_key)
        self.times = times_in_names([Path(text).stem for text in self._texts])
        if self.times is not None:
            self._texts = [self._texts[k] for k in self.times.order]
        certain = self.times is not None or len(self._texts) < 2
        self.doubt = None if certain else _doubt(self._texts)

    def __getitem__(self, index: int) -> Path:  # type: ignore[override] # there are no slices
        """An image."""
        return Path(self._texts[index])

    def __len__(self) -> int:
        """How many there are."""
        return len(self._texts)


def _key(path: str) -> str:
    """By the name without its suffix, so that Capture comes before Capture (2)."""
    return f"{natural_order(os.path.splitext(path)[0])}\0{path}"  # noqa: PTH122


def _doubt(ordered: Sequence[str]) -> str | None:
    """Why the order of these paths is a guess; None if it is certain."""
    shared = os.path.commonpath([os.path.dirname(path) for path in ordered])  # noqa: PTH120
    stems = [os.path.splitext(path[len(shared) :])[0] for path in ordered]  # noqa: PTH122
    form = re.sub("[0-9]+", "#", stems[0])
    for path, stem in zip(ordered, stems, strict=True):
        if re.sub("[0-9]+", "#", stem) != form:
            return f"{os.path.basename(path)} is not named as {os.path.basename(ordered[0])}"  # noqa: PTH119
    numbers = np.array([[int(n) for n in re.findall("[0-9]+", stem)] for stem in stems], object)
    steps = np.diff(numbers, axis=0)
    steps = steps[:, (steps != 0).any(axis=0)]
    if not steps.size:
        return "several have the same name"
    low, high, span = steps.min(axis=0), steps.max(axis=0), steps.sum(axis=0)
    if re.search(r"(?:^|[^0-9A-Za-z)#])-#", form):
        return "a dash before a number may be a minus sign"
    if len(low) > 1 and (low <= 0).any():
        return "several numbers in them change"
    if ((2 * high > span) & (high > _GAP * low)).any():
        return "a number leaves out more than half of its span, as if counting had started again"
    return None


def _not_as_numbered(stems: Sequence[str]) -> int | None:
    """The first image whose number in its name does not follow from the first's. None if there is
    none, and if the names differ in more than one number or lack more numbers than they have: then
    these are times, or every tenth frame."""
    first = number = 0
    around = uncounted = None
    for index, stem in enumerate(stems):
        parts = re.fullmatch(r"(.*?)(?<![0-9])([0-9]{1,9})([^0-9]*)", stem, re.DOTALL)
        if parts is None or parts.group(1, 3) != (around := around or parts.group(1, 3)):
            return None
        number = int(parts[2])
        first = number if index == 0 else first
        if uncounted is None and number - first != index:
            uncounted = index
    return uncounted if number - first < 2 * len(stems) else None


def _kinds(files: Iterable[Path]) -> tuple[str, str, str] | None:
    """(a name of each of two kinds, a glob of the first) if most images have a partner in their
    folder, whose name has the same numbers but other text; else None."""
    of_numbers = defaultdict[tuple[object, ...], list[str]](list)
    for file in files:
        of_numbers[file.parent, *re.findall("[0-9]+", file.name)].append(file.name)
    pairs = [(first, same[0]) for first, *same in of_numbers.values() if same]
    if 3 * len(pairs) < sum(map(len, of_numbers.values())) or not pairs:
        return None
    first, second = sorted(pairs[0], key=len)
    return first, second, re.sub("[0-9]+", "*[0-9]", first)


class ImageFiles(RawLog):
    """One image file a frame, in the order of the names. Times in the names, as `times_in_names`
    finds them, are the frames' times.

    sample: numbers of the frames that are decoded in any case. Of another, header and end are read;
    it is decoded unless both are as those of a frame that was used. None: all are decoded."""

    def __init__(self, files: Sequence[Path], diagnostics: Diagnostics) -> None:
        super().__init__(diagnostics)
        self.files = files if isinstance(files, ImagePaths) else ImagePaths(files)
        self.frame_count = len(self.files)
        self.sample: Container[int] | None = None
        self._kinds, self._decoded = set[bytes](), dict[int, bytes]()
        stems = [file.stem for file in self.files]
        self._named = self.files.times
        self._times = None if self._named is None else self._named.ns[self._named.order]
        if (note := self._about_names(stems)) is not None:
            diagnostics.note(note)
        if self._times is None and (table := self._sibling_table()) is not None:
            diagnostics.note(
                f"{table.name} has a line for each image and is not used; frames have times if "
                "the names of the images have them"
            )

    def used(self, number: int) -> None:
        """Tell that a frame could be used, and so can others of its kind if they are whole."""
        self._kinds |= {*filter(None, [self._decoded.pop(number, None)])}

    def _sibling_table(self) -> Path | None:
        """A table or text in the folder of the images, of as many lines as images or one more."""
        for path in sorted(self.files[0].parent.glob("*.[tc][xs][tv]")):
            with suppress(OSError), path.open("rb") as file:
                more = sum(1 for _ in file) - len(self.files)
                if more in (0, 1) and not path.stem.endswith(("poses", "gt", "corners")):
                    return path
        return None

    def _about_names(self, stems: Sequence[str]) -> str | None:
        """What a user should know of the frames' times and numbers. stems: names without suffix."""
        if (kinds := _kinds(self.files)) is not None:
            return (
                f"it has images of two kinds, as {kinds[0]} and {kinds[1]}, and each is a frame; "
                f"if one is no picture of the sonar, quote a glob of the other, such as "
                f"'{kinds[2]}'"
            )
        if self._times is not None:
            if re.fullmatch("[0-9]{19}", stems[0]):
                return None
            first, steps = date_text(int(self._times[0]), 3), np.diff(self._times)
            rate = f", and {1e9 / np.median(steps):.3g} a second" if len(steps) else ""
            if self._named is not None and self._named.spread:
                rate += "; names have whole seconds, in which the frames are spread evenly"
            # From 12:59:59 a clock of 12 hours goes on to 01:00:00, and names are sorted.
            step = 12 * HOUR_NS - np.ptp(self._times)
            if steps.max(initial=0) > 6 * HOUR_NS and 0 < step < 10 * np.median(steps):
                rate += "; if their clock has 12 hours, 12:59 was before 01:00: write 13 for 01"
            return f"frames have the times in the names of its images, the first {first} UTC{rate}"
        if (seen := date_in(stems[0])) is not None:
            doubt = (
                "" if self.files.doubt is None else f"; their order is a guess: {self.files.doubt}"
            )
            return (
                f"times are not read from the names of its images, though {seen} in "
                f"{self.files[0].name} looks like one{doubt}; name the images as "
                "20261120T100000.250.png in UTC if pauses and truth by time count"
            )
        if self.files.doubt is not None:
            return (
                f"the order of its {len(stems)} images, from {self.files[0].name} to "
                f"{self.files[-1].name}, is a guess: {self.files.doubt}; if it is wrong, name them "
                "by one counter (000000, 000001, ...)"
            )
        if (index := _not_as_numbered(stems)) is not None:
            return (
                "the names of its images leave out or repeat numbers, but frames are counted: "
                f"{self.files[index].name} is frame {index}"
            )
        return None

    def __iter__(self) -> Iterator[StoredFrame]:
        for number, file in enumerate(self.files):
            time_ns = None if self._times is None else int(self._times[number])
            if number in self.passed_over:
                yield StoredFrame(file.name, time_ns)
                continue
            if self.sample is not None and (kind := _kind(file)) is not None:
                if number not in self.sample and kind in self._kinds:
                    yield StoredFrame(file.name, time_ns, complete=True)
                    continue
                self._decoded[number] = kind
            try:
                pixels = decode_image(data := _contents(file))
            except UnusableError as error:
                yield StoredFrame(file.name, time_ns, problem=str(error))
            else:
                yield StoredFrame(file.name, time_ns, pixels, white=pgm_maxval(data))


def _kind(file: Path) -> bytes | None:
    """As `kind_if_complete`; also None for a file that cannot be read, or is too large."""
    with suppress(OSError), file.open("rb", buffering=0) as opened:
        head, size = opened.read(HEAD_BYTES), os.fstat(opened.fileno()).st_size
        if END_BYTES < size <= MAX_FILE_BYTES:
            opened.seek(size - END_BYTES)
            return kind_if_complete(head, opened.read(END_BYTES))
    return None


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
