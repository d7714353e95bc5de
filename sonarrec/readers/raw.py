"""What every reader yields: raw frames, as the log holds them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import Diagnostics
from sonarrec.nouns import NO_STAMPS, Stamps
from sonarrec.sonar import MIN_WINDOW_M, PingGeometry, Sonar

MAX_FRAME_BYTES = 48 * 2**20  # also of a message: 4096 x 4096 pixels of three bytes


class UnusableError(Exception):
    """One frame cannot be used; the text says why. It never leaves the readers."""


@dataclass(frozen=True, slots=True)
class Ping:
    """The image in one message.

    pixels: (rows, columns) or (rows, columns, channels; BGR first), any dtype; of a polar ping
    (bins, beams), also where its `beam_order` says that the samples came beam by beam. Their dtype
    decides the usual pixel_scale (`sonarrec help geometry`). stamp_ns: the
    header's stamp; None if there is none. sonar: the geometry that a polar ping states (all but
    tilt and height); None for an image without its geometry.
    """

    pixels: np.ndarray
    stamp_ns: int | None = None
    sonar: PingGeometry | None = None


@dataclass(frozen=True, slots=True)
class RawFrame:
    """One frame as its log holds it.

    name: for messages. timestamp_ns: None if the log keeps no time. pixels, sonar: as in Ping.
    pixels is None if the frame could not be read; `problem` says why. If `problem` is None too, the
    frame was skipped, or it was lost together with others, which the log's faults report.
    stamps: every time that the log keeps of it. white: the pixel value that its file calls white;
    None for the largest value of the type.
    """

    name: str
    timestamp_ns: int | None
    pixels: np.ndarray | None
    problem: str | None = None
    sonar: PingGeometry | None = None
    stamps: Stamps = NO_STAMPS
    white: int | None = None

    @property
    def shows(self) -> bool:
        """Whether it could be read, and is not blank."""
        return self.pixels is not None and bool(self.pixels.any())


def frame_of(
    name: str, log_ns: int | None, decode: Callable[[], Ping], publish_ns: int | None = None
) -> RawFrame:
    """The frame of a ping; without pixels if `decode` raises UnusableError. log_ns, publish_ns:
    when it was recorded and sent; None if the log keeps no such time."""
    try:
        ping = decode()
    except UnusableError as error:
        return RawFrame(name, log_ns, None, str(error))
    timestamp_ns = ping.stamp_ns if log_ns is None else log_ns
    stamps = Stamps(log_ns, publish_ns, ping.stamp_ns)
    return RawFrame(name, timestamp_ns, ping.pixels, None, ping.sonar, stamps)


def showing(frames: Sequence[RawFrame]) -> Sequence[RawFrame]:
    """Those of the frames that show something; all of them if none does."""
    return [frame for frame in frames if frame.shows] or frames


@dataclass(frozen=True, slots=True)
class HeaderInfo:
    """What the headers of a sonar's own file say about the log as a whole.

    sonar: the part of the geometry that pings do not state (tilt, frame rate). values: other values
    worth knowing, by name and unit; None if the sonar did not measure it. sample_db: decibels from
    one sample value to the next, if samples are decibels.
    """

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
    the pass.
    """

    def __init__(self, diagnostics: Diagnostics) -> None:
        self.diagnostics = diagnostics
        self.frame_count: int | None = None
        self.topic: str | None = None
        self.polar = False
        self.header_info = HeaderInfo()
        self.playback_hz: float | None = None
        self.passed_over = range(0)

    def geometry(self, stated: Sonar) -> Sonar:
        """The stated geometry, completed from the headers and with the layout of the frames."""
        sonar = self.header_info.sonar.updated(stated)
        usual = Sonar(layout="polar" if self.polar else "fan")
        return sonar if sonar.layout else sonar.updated(usual)

    @abstractmethod
    def __iter__(self) -> Iterator[RawFrame]: ...

    def close(self) -> None:  # noqa: B027 - not abstract: of some nothing is open between frames
        """Close the files that are open."""


def ping_geometry(ranges_m: FloatArray, bearings_deg: FloatArray) -> PingGeometry:
    """The geometry of a ping from the ranges of its bins' middles and its beams' bearings. Raises
    UnusableError if these are impossible."""
    steps = np.diff(ranges_m)
    if len(ranges_m) < 2 or ranges_m[0] < 0 or not np.all(steps > 0):
        raise UnusableError("ranges do not rise from bin to bin")
    if ranges_m[-1] - ranges_m[0] < MIN_WINDOW_M:
        raise UnusableError(f"a window of {ranges_m[-1] - ranges_m[0]:g} m")
    turns = np.diff(bearings_deg)
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
