"""What the containers give: frames as the log holds them, and messages of recordings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import Diagnostics
from sonarrec.sonar.frame import NO_STAMPS, BeamOrder, Stamps
from sonarrec.sonar.stated import MIN_WINDOW_M, Sonar
from sonarrec.stretches import CLEARLY_BACK_NS

MAX_FRAME_BYTES = 48 * 2**20  # also of a message: 4096 x 4096 pixels of three bytes
_BLOCK = 2**20


class UnusableError(Exception):
    """One frame cannot be used; the text says why. It never leaves the readers."""


@dataclass(frozen=True, slots=True)
class PingGeometry:
    """The geometry that a polar ping states: everything except tilt and height."""

    range_min_m: float
    """The window's slant ranges."""
    range_max_m: float
    bearings_deg: tuple[float, ...]
    """Of the beams' middles."""
    ranges_m: tuple[float, ...] | None
    """Of the bins' middles; None: evenly spaced."""
    beam_order: BeamOrder | None = None
    """None: to be found from the samples."""
    beam_width_deg: float | None = None
    """Between half-power points; None: not stated."""
    pitch_deg: float = 0.0
    """Of the beams' plane in the axes of the message."""


@dataclass(frozen=True, slots=True)
class StoredFrame:
    """A frame as its log holds it."""

    name: str = ""
    """In messages."""
    time_ns: int | None = None
    """None if the log keeps no time."""
    pixels: np.ndarray | None = None
    """(rows, columns) or (rows, columns, channels; BGR first), any dtype, which decides the usual
    pixel_scale (`sonarrec help geometry`); of a polar ping (bins, beams), also where its
    `beam_order` says that the samples came beam by beam; None if they could not be read."""
    problem: str | None = None
    """Why; None if the frame was passed over, or lost together with others, which the log's faults
    report."""
    stamps: Stamps = NO_STAMPS
    ping: PingGeometry | None = None
    """The geometry that a polar ping states."""
    white: int | None = None
    """The pixel value that its file calls white; None: the largest of the type."""
    complete: bool = False
    """Whether its file looks complete and like others that were used, and so was not decoded."""

    @property
    def has_content(self) -> bool:
        """Whether it could be read, and is not blank."""
        return self.pixels is not None and bool(self.pixels.any())

    @property
    def is_lost(self) -> bool:
        """Whether it needs no line of its own: it was passed over, or lost together with others."""
        return self.pixels is None and self.problem is None and not self.complete


@dataclass(frozen=True, slots=True)
class Decoded:
    """What is in one message."""

    pixels: np.ndarray
    stamp_ns: int | None = None
    """The header's stamp; None if there is none."""
    ping: PingGeometry | None = None


def frame_of(
    name: str,
    log_ns: int | None,
    decode: Callable[[Any], Decoded],
    message: bytes | memoryview,
    publish_ns: int | None = None,
) -> StoredFrame:
    """The frame of a message; without pixels if `decode` raises UnusableError. log_ns, publish_ns:
    when it was recorded and sent; None if the log keeps no such time."""
    try:
        decoded = decode(message)
    except UnusableError as error:
        return StoredFrame(name, log_ns, problem=str(error))
    time_ns = decoded.stamp_ns if log_ns is None else log_ns
    stamps = Stamps(log_ns, publish_ns, decoded.stamp_ns)
    return StoredFrame(name, time_ns, decoded.pixels, stamps=stamps, ping=decoded.ping)


@dataclass(frozen=True, slots=True)
class HeaderInfo:
    """What the headers of a sonar's own file say about the log as a whole."""

    sonar: Sonar = field(default_factory=Sonar)
    """The part of the geometry that pings do not state (tilt, frame rate)."""
    values: Mapping[str, str | float | None] = field(default_factory=dict)
    """Other values worth knowing, by name and unit; None if the sonar did not measure it."""
    sample_db: float | None = None
    """Decibels from one sample value to the next, if samples are decibels."""


class RawLog(ABC):
    """One opened log: a pass over its frames, in time order, one in memory at a time.

    Each pass begins at the first frame.

    frame_count: number of frames; None if unknown before the end. topic: the channel read; None if
    the log has no channels. polar: whether frames state their own geometry. header_info: for a
    sonar's own file. playback_hz: of a video, the rate that its times follow. diagnostics:
    receives what is wrong or uncertain, all of it by the end of the pass. passed_over: numbers of
    frames that are not needed; they are yielded without pixels and without a problem. It may be set
    during the pass. close: closes what is open.
    """

    def __init__(self, diagnostics: Diagnostics, *, polar: bool = False) -> None:
        self.diagnostics = diagnostics
        self.frame_count: int | None = None
        self.topic: str | None = None
        self.polar = polar
        self.header_info = HeaderInfo()
        self.playback_hz: float | None = None
        self.passed_over: Container[int] = range(0)
        self.close: Callable[[], object] = lambda: None

    def geometry(self, stated: Sonar) -> Sonar:
        """The stated geometry, completed from the headers and with the layout of the frames."""
        sonar = self.header_info.sonar.updated(stated)
        usual = Sonar(layout="polar" if self.polar else "fan")
        return sonar if sonar.layout else sonar.updated(usual)

    @abstractmethod
    def __iter__(self) -> Iterator[StoredFrame]:
        """The frames in the order of the log: the n-th yielded has the number n."""


class FileBytes:
    """A file of any length, opened for reading at any position. size: in bytes, when opened."""

    def __init__(self, path: Path) -> None:
        """Raises OSError if the file cannot be opened."""
        self._file = path.open("rb")
        self.size = self._file.seek(0, 2)
        self.close = self._file.close

    def read(self, offset: int, count: int) -> bytes:
        """`count` bytes from `offset` on; fewer if the file ends before."""
        self._file.seek(min(offset, self.size))
        return self._file.read(max(min(count, self.size - offset), 0))

    def find(
        self, mark: bytes, start: int, end: int, is_one: Callable[[int], bool] = lambda _: True
    ) -> int | None:
        """Where `mark` first begins, at `start` or later and before `end`; None if nowhere. is_one:
        whether what begins there is what is looked for."""
        while start < end:
            block = self.read(start, min(_BLOCK, end - start) + len(mark) - 1)
            position = start + block.find(mark)
            if position >= start and is_one(position):
                return position
            start = position + 1 if position >= start else start + _BLOCK
        return None


@dataclass(frozen=True, slots=True)
class Message:
    """One message. Times in ns."""

    channel: int
    log_time: int
    publish_time: int | None
    """None if the container does not store it."""
    data: memoryview | None
    """None if it cannot be read."""
    problem: str | None = None
    """Why it cannot be read. If there are neither data nor a problem, it was lost together with
    others, which the recording's faults report in one line."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel, and the type of its messages."""

    topic: str
    schema: str
    """Name of the type; empty if there is none."""
    schema_encoding: str
    definition: bytes
    """schema_encoding, definition: as stored in the container ("ros2msg", ...)."""
    message_encoding: str


class Recording(ABC):
    """An open container of messages: an MCAP file or a ROS bag.

    channels: by the container's own numbers. counts: number of messages of each. profile, library:
    what wrote it; empty if not stated. span: first and last log time in ns; None without messages.
    chunks: number of chunks by compression. complete: whether its writer closed it and it is not
    cut. diagnostics: receives what is wrong or uncertain, all of it by the end of a pass.
    close: closes what is open.
    """

    def __init__(self, path: Path, diagnostics: Diagnostics, profile: str = "") -> None:
        self.path, self.diagnostics = path, diagnostics
        self.channels = dict[int, Channel]()
        self.counts, self.chunks = Counter[int](), Counter[str]()
        self.profile, self.library = profile, ""
        self.span: tuple[int, int] | None = None
        self.complete = True
        self.close: Callable[[], object] = lambda: None

    @abstractmethod
    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """One pass over the messages of some channels, in the order of log time. Raises
        SonarrecError if nothing more can be read."""

    def fault(self, text: str) -> None:
        """Tell what is wrong."""
        self.diagnostics.fault(text, self.path.name)

    def note_set_back(self, spans: Iterable[tuple[int, int]], within_ns: int = 0) -> None:
        """Tell if the clock was clearly set back during the recording. spans: first and last log
        time, ns, of its parts, in the order of recording. within_ns: by how much times go back
        within a part."""
        latest, back_ns = 0, within_ns
        for first, last in spans:
            back_ns = max(back_ns, latest - first)
            latest = max(latest, last)
        if back_ns > CLEARLY_BACK_NS:
            self.diagnostics.note(
                f"log times go back by {back_ns / 1e9:.1f} s (was the clock set?); they give "
                "the frames' order; if that mixes two parts, export images in the file's order",
                about=self.path,
            )


def ping_geometry(ranges_m: FloatArray, bearings_deg: FloatArray) -> PingGeometry:
    """The geometry of a ping from the ranges of its bins' middles and its beams' bearings. Raises
    UnusableError if these are impossible."""
    range_steps, bearing_steps = np.diff(ranges_m), np.diff(bearings_deg)
    if len(ranges_m) < 2 or ranges_m[0] < 0 or not np.all(range_steps > 0):
        raise UnusableError("ranges do not rise from bin to bin")
    if ranges_m[-1] - ranges_m[0] < MIN_WINDOW_M:
        raise UnusableError(f"a window of {ranges_m[-1] - ranges_m[0]:g} m")
    if len(bearings_deg) < 2 or not (np.all(bearing_steps > 0) or np.all(bearing_steps < 0)):
        raise UnusableError("bearings do not run one way from beam to beam")
    if np.abs(bearings_deg).max() >= 90:
        raise UnusableError("bearings of 90 deg and more")
    even = np.linspace(ranges_m[0], ranges_m[-1], len(ranges_m))
    first = last = even[1] - even[0]
    ranges = None
    least = first / 64  # resampling cannot show smaller differences
    if np.abs(ranges_m - even).max() > least:
        first, last = range_steps[0], range_steps[-1]
        ranges = tuple(ranges_m.tolist())
    elif ranges_m[0] < first / 2 - least:  # else the first bin would begin behind the sonar
        ranges = tuple(ranges_m.tolist())
    return PingGeometry(
        range_min_m=max(float(ranges_m[0] - first / 2), 0.0),
        range_max_m=float(ranges_m[-1] + last / 2),
        bearings_deg=tuple(bearings_deg.tolist()),
        ranges_m=ranges,
    )
