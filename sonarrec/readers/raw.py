"""What all readers give: frames as the log holds them, and messages of recordings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import Diagnostics
from sonarrec.nouns import Frame, PingGeometry, Stamps
from sonarrec.sonar import MIN_WINDOW_M, Sonar

MAX_FRAME_BYTES = 48 * 2**20  # also of a message: 4096 x 4096 pixels of three bytes
CLEARLY_BACK_NS = 10**9
"""Threads of a recorder may swap messages, but not those so far apart."""
_BLOCK = 2**20


class UnusableError(Exception):
    """One frame cannot be used; the text says why. It never leaves the readers."""


def stored(name: str, time_ns: Any, pixels: Any, problem: str | None = None, **more: Any) -> Frame:
    """A frame as its log holds it.

    time_ns: None if the log keeps no time. pixels: (rows, columns) or (rows, columns, channels; BGR
    first), any dtype, which decides the usual pixel_scale (`sonarrec help geometry`); of a polar
    ping (bins, beams), also where its `beam_order` says that the samples came beam by beam; None
    if they could not be read. problem: why; None if the frame was skipped, or lost together with
    others, which the log's faults report. more: other fields of a Frame.
    """
    no_fan: Any = None
    return Frame(-1, time_ns, pixels, no_fan, name=name, problem=problem, **more)


def message_frame(
    pixels: np.ndarray, stamp_ns: int | None = None, ping: PingGeometry | None = None
) -> Frame:
    """The frame in one message. stamp_ns: the header's stamp; None if there is none."""
    return stored("", stamp_ns, pixels, stamps=Stamps(header=stamp_ns), ping=ping)


def frame_of(
    name: str,
    log_ns: int | None,
    decode: Callable[[Any], Frame],
    message: bytes | memoryview,
    publish_ns: int | None = None,
) -> Frame:
    """The frame of a message; without pixels if `decode` raises UnusableError. log_ns, publish_ns:
    when it was recorded and sent; None if the log keeps no such time."""
    try:
        frame = decode(message)
    except UnusableError as error:
        return stored(name, log_ns, None, str(error))
    time_ns = frame.timestamp_ns if log_ns is None else log_ns
    stamps = Stamps(log_ns, publish_ns, frame.stamps.header)
    return replace(frame, name=name, timestamp_ns=time_ns, stamps=stamps)


def showing(frames: Sequence[Frame]) -> Sequence[Frame]:
    """Those of the frames that show something; all of them if none does."""
    return [frame for frame in frames if frame.shows] or frames


@dataclass(frozen=True, slots=True)
class HeaderInfo:
    """What the headers of a sonar's own file say about the log as a whole. sonar: the part of the
    geometry that pings do not state (tilt, frame rate). values: other values worth knowing, by name
    and unit; None if the sonar did not measure it. sample_db: decibels from one sample value to the
    next, if samples are decibels."""

    sonar: Sonar = field(default_factory=Sonar)
    values: Mapping[str, str | float | None] = field(default_factory=dict)
    sample_db: float | None = None


class RawLog(ABC):
    """One opened log: a pass over its frames, in time order, one in memory at a time.

    A further pass begins anew.

    frame_count: number of frames; None if unknown before the end. topic: the channel read; None if
    the log has no channels. polar: whether frames state their own geometry. header_info: for a
    sonar's own file. playback_hz: of a video, the rate that its times follow. diagnostics: is told
    what is wrong or uncertain, all of it by the end of the pass. passed_over: numbers of frames
    that are not needed; they are yielded without pixels and without a problem. It may be set during
    the pass. close: closes what is open.
    """

    def __init__(self, diagnostics: Diagnostics, *, polar: bool = False) -> None:
        self.diagnostics = diagnostics
        self.frame_count: int | None = None
        self.topic: str | None = None
        self.polar = polar
        self.header_info = HeaderInfo()
        self.playback_hz: float | None = None
        self.passed_over = range(0)
        self.close: Callable[[], object] = lambda: None

    def geometry(self, stated: Sonar) -> Sonar:
        """The stated geometry, completed from the headers and with the layout of the frames."""
        sonar = self.header_info.sonar.updated(stated)
        usual = Sonar(layout="polar" if self.polar else "fan")
        return sonar if sonar.layout else sonar.updated(usual)

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """The frames, as `stored` gives them."""


class FileBytes:
    """A file of any length, opened for reading at any position. size: in bytes, when opened."""

    def __init__(self, path: Path) -> None:
        """Raises OSError if the file cannot be opened."""
        self._file = path.open("rb")
        self.size = self._file.seek(0, 2)
        self.close = self._file.close

    def at(self, offset: int, count: int) -> bytes:
        """`count` bytes from `offset` on; fewer if the file ends before."""
        self._file.seek(offset)
        return self._file.read(max(min(count, self.size - offset), 0))

    def find(self, mark: bytes, start: int, end: int) -> int | None:
        """Where `mark` first begins, at `start` or later and before `end`; None if nowhere."""
        while start < end:
            block = self.at(start, min(_BLOCK, end - start) + len(mark) - 1)
            if (position := block.find(mark)) >= 0:
                return start + position
            start += _BLOCK
        return None


@dataclass(frozen=True, slots=True)
class Message:
    """One message. Times in ns; publish_time is None if the container does not store it. data is
    None if it cannot be read; then `problem` says why. If `problem` is None too, it was lost
    together with others, which the recording's faults report in one line."""

    channel: int
    log_time: int
    publish_time: int | None
    data: memoryview | None
    problem: str | None = None


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel, and the type of its messages. schema: name of the type; empty if there is none.
    schema_encoding, definition: as stored in the container ("ros2msg", ...)."""

    topic: str
    schema: str
    schema_encoding: str
    definition: bytes
    message_encoding: str


class Recording(ABC):
    """An open container of messages: an MCAP file or a ROS bag.

    channels: by the container's own numbers. counts: number of messages of each. profile, library:
    what wrote it; empty if not stated. span: first and last log time in ns; None without messages.
    chunks: number of chunks by compression. whole: whether its writer closed it and it is not cut.
    diagnostics: is told what is wrong or uncertain, all of it by the end of a pass. close: closes
    what is open.
    """

    def __init__(self, path: Path, diagnostics: Diagnostics, profile: str = "") -> None:
        self.path, self.diagnostics = path, diagnostics
        self.channels = dict[int, Channel]()
        self.counts, self.chunks = Counter[int](), Counter[str]()
        self.profile, self.library = profile, ""
        self.span: tuple[int, int] | None = None
        self.whole = True
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
                f"log times go back by {back_ns / 1e9:.1f} s (was the clock set?); frames come in "
                "the order of log time, so those recorded before and after that may be mixed",
                about=self.path,
            )


def ping_geometry(ranges_m: FloatArray, bearings_deg: FloatArray) -> PingGeometry:
    """The geometry of a ping from the ranges of its bins' middles and its beams' bearings. Raises
    UnusableError if these are impossible."""
    steps, turns = np.diff(ranges_m), np.diff(bearings_deg)
    if len(ranges_m) < 2 or ranges_m[0] < 0 or not np.all(steps > 0):
        raise UnusableError("ranges do not rise from bin to bin")
    if ranges_m[-1] - ranges_m[0] < MIN_WINDOW_M:
        raise UnusableError(f"a window of {ranges_m[-1] - ranges_m[0]:g} m")
    if len(bearings_deg) < 2 or not (np.all(turns > 0) or np.all(turns < 0)):
        raise UnusableError("bearings do not run one way from beam to beam")
    if np.abs(bearings_deg).max() >= 90:
        raise UnusableError("bearings of 90 deg and more")
    even = np.linspace(ranges_m[0], ranges_m[-1], len(ranges_m))
    first = last = even[1] - even[0]
    ranges = None
    least = first / 64  # resampling cannot show smaller differences
    if np.abs(ranges_m - even).max() > least:
        first, last = steps[0], steps[-1]
        ranges = tuple(ranges_m.tolist())
    elif ranges_m[0] < first / 2 - least:  # else the first bin would begin behind the sonar
        ranges = tuple(ranges_m.tolist())
    return PingGeometry(
        range_min_m=max(float(ranges_m[0] - first / 2), 0.0),
        range_max_m=float(ranges_m[-1] + last / 2),
        bearings_deg=tuple(bearings_deg.tolist()),
        ranges_m=ranges,
    )
