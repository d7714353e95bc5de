"""Reads DDF files, frame by frame: DIDSON's (DDF_03, DDF_04) and those of ARIS (DDF_05).

A file is a header and then frames of equal length; a frame is a header and its samples. `didson.py`
and `aris.py` say what the headers mean.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.nouns import Stamps
from sonarrec.readers.containers.ddf.aris import Aris
from sonarrec.readers.containers.ddf.didson import Didson
from sonarrec.readers.containers.file_bytes import FileBytes
from sonarrec.readers.raw import MAX_FRAME_BYTES, RawFrame, RawLog, UnusableError

_VERSION_AT = 12  # in a frame's header
_HEADERS_LOOKED_AT = 32  # spread over the file, for the tilt


LAYOUTS: dict[int, Didson | Aris] = {3: Didson(3), 4: Didson(4), 5: Aris()}
"""What the headers of each version mean. The version is the fourth byte of the file."""


class DdfFrames(RawLog):
    """The frames of one DDF file, in the order of the file."""

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        """Raises SonarrecError if the file is not a DDF file or has no whole frame."""
        super().__init__(diagnostics)
        self.polar = True
        self._name = path.name
        self._file = FileBytes(path)
        with self._file.closed_on_error():
            self._open(str(path))

    def _open(self, where: str) -> None:
        self._mark = self._file.at(0, 4)
        version = self._mark[3] if len(self._mark) == 4 and self._mark[:3] == b"DDF" else None
        layout = None if version is None else LAYOUTS.get(version)
        if layout is None:
            version_text = "not a DDF file" if version is None else f"DDF_{version:02d}"
            known = ", ".join(f"DDF_{n:02d} ({layout.name})" for n, layout in LAYOUTS.items())
            raise SonarrecError(f"{where}: {version_text}, by its first bytes; this reads {known}")
        self._layout = layout
        self._start = layout.file_header.itemsize
        if self._file.size < self._start:
            raise SonarrecError(f"{where}: cut short inside the header of the file")
        self._header = np.frombuffer(self._file.at(0, self._start), layout.file_header)[0]
        self._shape = layout.shape(self._header, self._frame_header(self._start))
        self._length = layout.frame_header.itemsize + math.prod(self._shape)
        samples, beams = self._shape
        room = self._file.size - self._start
        if min(samples, beams) < 2 or self._length > MAX_FRAME_BYTES:
            raise SonarrecError(
                f"{where}: damaged: its header states frames of {samples} samples in {beams} beams"
            )
        if room < self._length:
            raise SonarrecError(
                f"{where}: holds no whole frame: a frame takes {self._length} bytes, and {room} "
                "follow the header of the file"
            )
        self.frame_count = room // self._length
        step = math.ceil(self.frame_count / _HEADERS_LOOKED_AT)
        starts = (self._start + k * self._length for k in range(0, self.frame_count, step))
        headers = [header for at in starts if (header := self._frame_header(at)) is not None]
        if headers:
            self.header_info = layout.header_info(self._header, headers, self.diagnostics)
        count = int(self._header["FrameCount"])
        if count > self.frame_count:  # a note: its maker advises against believing it
            self.diagnostics.note(
                f"its header counts {number_of(count, 'frame')}, {self.frame_count} are there"
            )

    def _frame_header(self, at: int) -> np.void | None:
        """The header of the frame at `at`; None if no frame begins there."""
        contents = self._file.at(at, self._layout.frame_header.itemsize)
        if len(contents) < self._layout.frame_header.itemsize:
            return None
        if contents[_VERSION_AT : _VERSION_AT + 4] != self._mark:
            return None
        header: np.void = np.frombuffer(contents, self._layout.frame_header)[0]
        return header

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __iter__(self) -> Iterator[RawFrame]:
        at, number = self._start, 0
        while at < self._file.size:
            bytes_left = self._file.size - at
            if bytes_left < self._length:
                self.diagnostics.fault(
                    f"cut short: the last frame has only {bytes_left} of its {self._length} bytes",
                    self._name,
                )
                return
            header, end = self._frame_header(at), at + self._length
            next_at = end if self._in_step(end) else self._next_frame(at + 1)
            name = f"frame {number}"
            if next_at == end or (next_at is None and header is not None):
                passed_over = number in self.passed_over
                yield RawFrame(name, None, None) if passed_over else self._frame(name, at, header)
                at, number = end, number + 1
                continue
            if next_at is None:
                self.diagnostics.fault(
                    f"no frame begins in the last {bytes_left} bytes", self._name
                )
                return
            few = f"only {next_at - at} of its {self._length} bytes are there"
            many = f"{next_at - at} bytes up to the next frame, in place of {self._length}"
            time_ns = None if header is None else self._layout.times(header)[0]
            yield RawFrame(name, time_ns, None, few if next_at < end else many)
            lost = max(1, round((next_at - at) / self._length))
            for _ in range(lost - 1):
                yield RawFrame(name, None, None)
            if lost > 1:
                self.diagnostics.fault(
                    f"about {lost} frames are lost from {name} on; the numbers of later ones may "
                    "be wrong",
                    self._name,
                )
            at, number = next_at, number + lost

    def _in_step(self, at: int) -> bool:
        """Whether a frame begins at `at` as expected, or the next one does, or the file ends."""
        if at + self._layout.frame_header.itemsize > self._file.size:
            return True
        after = at + self._length
        return after == self._file.size or any(
            self._frame_header(place) is not None for place in (at, after)
        )

    def _next_frame(self, start: int) -> int | None:
        """Where the next frame of this file's size begins; None if there is none."""
        mark = self._file.find(self._mark, start + _VERSION_AT, self._file.size)
        while mark is not None:
            at = mark - _VERSION_AT
            header = self._frame_header(at)
            if header is not None and self._layout.shape(self._header, header) == self._shape:
                return at
            mark = self._file.find(self._mark, mark + 1, self._file.size)
        return None

    def _frame(self, name: str, at: int, header: np.void | None) -> RawFrame:
        if header is None:
            return RawFrame(name, None, None, "its header is damaged")
        time_ns, sonar_ns = self._layout.times(header)
        try:
            if self._layout.shape(self._header, header) != self._shape:
                raise UnusableError("its header states another number of samples or beams")
            contents = self._file.at(at, self._length)[self._layout.frame_header.itemsize :]
            with np.errstate(all="ignore"):  # damaged numbers overflow; results are checked
                sonar = self._layout.geometry(self._header, header, self._shape)
            pixels = self._layout.pixels(
                header, np.frombuffer(contents, np.uint8).reshape(self._shape)
            )
        except UnusableError as error:
            return RawFrame(name, time_ns, None, str(error))
        return RawFrame(name, time_ns, pixels, None, sonar, Stamps(time_ns, None, sonar_ns))
