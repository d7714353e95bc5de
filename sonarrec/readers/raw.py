"""What every reader yields."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from sonarrec.records import NO_STAMPS, FloatArray, Stamps
from sonarrec.sonar import MIN_WINDOW_M, PingGeometry, Sonar

MAX_FRAME_BYTES = 48 * 2**20  # or of a message: an image of 4096 x 4096 pixels of three bytes


class UnusableError(Exception):
    """One frame cannot be used; the text says why. It never leaves the readers."""


@dataclass(frozen=True, slots=True)
class Ping:
    """What one message holds.

    pixels: (rows, columns) or (rows, columns, channels; BGR first), any dtype. stamp_ns: the
    header's stamp, None without one. sonar: the geometry that a polar ping tells of itself (all
    but tilt and height); None for an image that does not say what it shows.
    """

    pixels: np.ndarray
    stamp_ns: int | None = None
    sonar: PingGeometry | None = None


@dataclass(frozen=True, slots=True)
class RawFrame:
    """One frame as its log holds it.

    name: what to call it in a message. timestamp_ns: None where the log carries no time.
    pixels, sonar: as of a Ping. pixels is None where they could not be read; then `problem` says
    why. Without a problem the frame was passed over, or is one of many that were lost together,
    for which the log's `faults` have one line.
    stamps: every time that the log keeps of it. white: the value that its file calls white, None
    for the largest of its type.
    """

    name: str
    timestamp_ns: int | None
    pixels: np.ndarray | None
    problem: str | None = None
    sonar: PingGeometry | None = None
    stamps: Stamps = NO_STAMPS
    white: int | None = None


@dataclass(frozen=True, slots=True)
class HeaderInfo:
    """What the headers of a sonar's own file say about the log as a whole.

    sonar: the part of its geometry that pings do not state (tilt, frame rate). values: all that is
    worth knowing, by its name and unit, None where the sonar measured none. notes: what of all this
    is not sure. sample_db: decibels from one sample value to the next, where samples are decibels.
    """

    sonar: Sonar = field(default_factory=Sonar)
    values: Mapping[str, str | float | None] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    sample_db: float | None = None


class RawLog(ABC):
    """One opened log: a single pass over its frames, in time order, one in memory at a time.

    frame_count: frames to come, None where unknown before the end. topic: the channel read, None
    where there are none. polar: its frames state their own geometry. header_info: of a
    sonar's own file.
    faults: lines about what is wrong with the log as a whole, complete after the pass.
    passed_over: the numbers of frames that nobody asked for; they are yielded without pixels and
    without a problem. It may be set in the middle of the pass.
    """

    def __init__(self) -> None:
        self.frame_count: int | None = None
        self.topic: str | None = None
        self.polar = False
        self.faults: list[str] = []
        self.header_info = HeaderInfo()
        self.passed_over = range(0)

    def geometry(self, stated: Sonar) -> Sonar:
        """The stated geometry, completed by the headers, and by the layout of the frames."""
        sonar = self.header_info.sonar.updated(stated)
        usual = Sonar(layout="polar" if self.polar else "fan")
        return sonar if sonar.layout else sonar.updated(usual)

    @abstractmethod
    def __iter__(self) -> Iterator[RawFrame]: ...

    def close(self) -> None:  # noqa: B027 - not abstract: of some nothing is open between frames
        """Close what is open."""


def ping_geometry(ranges_m: FloatArray, bearings_deg: FloatArray) -> PingGeometry:
    """The geometry of a ping from the middles of its bins and beams.

    Raises UnusableError where they are no window in front of a sonar.
    """
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
    least = first / 64  # resampling does not resolve less
    if np.abs(ranges_m - even).max() > least:
        first, last = steps[0], steps[-1]
        ranges = tuple(ranges_m.tolist())
    elif ranges_m[0] < first / 2 - least:  # no window has half a bin before the sonar
        ranges = tuple(ranges_m.tolist())
    return PingGeometry(
        range_min_m=max(float(ranges_m[0] - first / 2), 0.0),
        range_max_m=float(ranges_m[-1] + last / 2),
        bearings_deg=tuple(bearings_deg.tolist()),
        ranges_m=ranges,
    )
