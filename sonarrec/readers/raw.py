"""What every reader yields."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sonarrec.records import NO_STAMPS, Stamps
from sonarrec.sonar import PingGeometry


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
    pixels, sonar: as of a Ping; pixels is None where it could not be read, and then `problem` says
    why; without a problem it is one of many lost together, which the log's `faults` tell once.
    stamps: every time that the log keeps of it.
    """

    name: str
    timestamp_ns: int | None
    pixels: np.ndarray | None
    problem: str | None = None
    sonar: PingGeometry | None = None
    stamps: Stamps = NO_STAMPS


class RawLog(Protocol):
    """One opened log: a single pass over its frames, in time order, one in memory at a time.

    frame_count: frames to come, None where unknown before the end. topic: the channel read, None
    where there are none. polar: its frames tell their own geometry.
    faults: lines about what is wrong with the log as a whole, complete after the pass.
    """

    frame_count: int | None
    topic: str | None
    polar: bool
    faults: list[str]

    def __iter__(self) -> Iterator[RawFrame]: ...

    def close(self) -> None: ...
