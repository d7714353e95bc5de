"""Reads DDF files, frame by frame: DIDSON's (DDF_03, DDF_04) and those of ARIS (DDF_05).

A file is a header and then frames of equal length; a frame is a header and its samples.
`ddf_headers.py` says what the headers mean.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.readers.containers.ddf_headers import LAYOUTS
from sonarrec.readers.raw import MAX_FRAME_BYTES, FileBytes, RawLog, StoredFrame, UnusableError
from sonarrec.sonar.frame import Stamps

_VERSION_AT = 12  # in a frame's header
_HEADERS_READ = 32  # spread over the file, for the tilt


class DdfFrames(RawLog):
    """The frames of one DDF file, in the order of the file."""

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        """Raises SonarrecError if the file is not a DDF file or has no whole frame."""
        super().__init__(diagnostics, polar=True)
        self._name, self._file = path.name, FileBytes(path)
        self.close = self._file.close
        self._mark = self._file.read(0, 4)
        version = self._mark[3] if len(self._mark) == 4 and self._mark[:3] == b"DDF" else -1
        if version not in LAYOUTS:
            what = "not a DDF file" if version < 0 else f"DDF_{version:02d}"
            known = ", ".join(f"DDF_{n:02d} ({layout.name})" for n, layout in LAYOUTS.items())
            raise SonarrecError(f"{path}: {what}, by its first bytes; this reads {known}")
        self._layout = LAYOUTS[version]
        self._head_bytes = self._layout.frame_header.itemsize
        self._start = self._layout.file_header.itemsize
        room = self._file.size - self._start
        if room < 0:
            raise SonarrecError(f"{path}: cut short inside the header of the file")
        self._header = np.frombuffer(self._file.read(0, self._start), self._layout.file_header)[0]
        self._shape = self._layout.shape(self._header, self._frame_header(self._start))
        samples, beams = self._shape
        self._length = self._head_bytes + samples * beams
        if min(samples, beams) < 2 or self._length > MAX_FRAME_BYTES:
            raise SonarrecError(
                f"{path}: damaged: its header states frames of {samples} samples in {beams} beams"
            )
        if room < self._length:
            raise SonarrecError(
                f"{path}: holds no whole frame: a frame takes {self._length} bytes, and {room} "
                "follow the header of the file"
            )
        self.frame_count = room // self._length
        step = math.ceil(self.frame_count / _HEADERS_READ)
        starts = (self._start + k * self._length for k in range(0, self.frame_count, step))
        headers = [header for start in starts if (header := self._frame_header(start)) is not None]
        if headers:
            self.header_info = self._layout.header_info(self._header, headers, diagnostics)
        count = int(self._header["FrameCount"])
        if count > self.frame_count:  # a note: its maker advises against believing it
            diagnostics.note(
                f"its header counts {number_of(count, 'frame')}, {self.frame_count} are there"
            )

    def _frame_header(self, start: int) -> np.void | None:
        """The header of the frame at `start`; None if no frame begins there."""
        contents = self._file.read(start, self._head_bytes)
        is_one = contents[_VERSION_AT : _VERSION_AT + 4] == self._mark
        if not is_one or len(contents) < self._head_bytes:
            return None
        header: np.void = np.frombuffer(contents, self._layout.frame_header)[0]
        return header

    def __iter__(self) -> Iterator[StoredFrame]:
        start, number = self._start, 0
        while (room := self._file.size - start) > 0:
            header, end, name = self._frame_header(start), start + self._length, f"frame {number}"
            if room < self._length:
                self._fault(
                    f"cut short: the last frame has only {room} of its {self._length} bytes"
                )
                return
            next_start = end if self._in_step(end) else self._next_frame(start + 1)
            # Of two recordings in one file the second begins with a header of the file.
            joined = next_start == end + self._start and self._file.read(end, 4) == self._mark
            if next_start == end or joined or (next_start is None and header is not None):
                skip = number in self.passed_over
                yield StoredFrame(name) if skip else self._frame(name, start, header)
                start, number = next_start or end, number + 1
                continue
            if next_start is None:
                self._fault(f"no frame begins in the last {room} bytes")
                return
            problem = f"{next_start - start} bytes up to the next frame, in place of {self._length}"
            if next_start < end:
                problem = f"only {next_start - start} of its {self._length} bytes are there"
            time_ns = None if header is None else self._layout.times(header)[0]
            yield StoredFrame(name, time_ns, problem=problem)
            lost = max(1, round((next_start - start) / self._length))
            yield from (StoredFrame(name) for _ in range(lost - 1))
            if lost > 1:
                self._fault(
                    f"about {lost} frames are lost from {name} on; the numbers of later ones may "
                    "be wrong"
                )
            start, number = next_start, number + lost

    def _fault(self, text: str) -> None:
        self.diagnostics.fault(text, self._name)

    def _in_step(self, start: int) -> bool:
        """Whether a frame begins at `start` as expected, or the next one does, or the file ends."""
        after = start + self._length
        return (
            start + self._head_bytes > self._file.size
            or after == self._file.size
            or any(self._frame_header(position) is not None for position in (start, after))
        )

    def _next_frame(self, start: int) -> int | None:
        """Where the next frame of this file's size begins; None if there is none."""

        def is_one(mark: int) -> bool:
            header = self._frame_header(mark - _VERSION_AT)
            return header is not None and self._layout.shape(self._header, header) == self._shape

        mark = self._file.find(self._mark, start + _VERSION_AT, self._file.size, is_one)
        return None if mark is None else mark - _VERSION_AT

    def _frame(self, name: str, start: int, header: np.void | None) -> StoredFrame:
        if header is None:
            return StoredFrame(name, problem="its header is damaged")
        time_ns, sonar_ns = self._layout.times(header)
        try:
            if self._layout.shape(self._header, header) != self._shape:
                raise UnusableError("its header states another number of samples or beams")
            contents = self._file.read(start, self._length)[self._head_bytes :]
            with np.errstate(all="ignore"):  # damaged numbers overflow; results are checked
                ping = self._layout.geometry(self._header, header, self._shape)
            samples = np.frombuffer(contents, np.uint8).reshape(self._shape)
            pixels = self._layout.pixels(header, samples)
        except UnusableError as error:
            return StoredFrame(name, time_ns, problem=str(error))
        return StoredFrame(name, time_ns, pixels, ping=ping, stamps=Stamps(time_ns, None, sonar_ns))
