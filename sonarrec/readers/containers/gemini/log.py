"""A `.glf` of a Gemini as a RawLog."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.nouns import Stamps
from sonarrec.readers.containers.gemini.archive import pieces, records
from sonarrec.readers.containers.gemini.pings import Header, decoded, device_of, time_ns
from sonarrec.readers.raw import HeaderInfo, RawFrame, RawLog, UnusableError

_NOTES = (
    "left and right are as free readers show them; if a landmark lies on the wrong side, state "
    "bearings_deg in reverse order",
    "times are those of the recording computer, whose time zone is not stated; UTC is assumed",
)


class GeminiPings(RawLog):
    """The images of one sonar, the first in the file, in the order of the file."""

    def __init__(self, path: Path, diagnostics: Diagnostics | None = None) -> None:
        """Raises SonarrecError if the file holds no image that can be read."""
        super().__init__(diagnostics or Diagnostics(path))
        self.polar = True
        self._path = path
        self._device, header = self._first()
        self.header_info = HeaderInfo(values=header)
        self.diagnostics.note(*_NOTES)

    def _first(self) -> tuple[int, Header]:
        """The number of the first sonar, and the header of its first image that can be read."""
        problem = ""
        try:
            for _, record, reason in records(pieces(self._path)):
                if record is not None:
                    try:
                        return device_of(record), decoded(record)[1]
                    except UnusableError as error:
                        reason = str(error)
                problem = problem or f" ({reason})"
        except UnusableError as error:
            problem = problem or f" ({error})"
        raise SonarrecError(f"{self._path}: no image of a Gemini can be read in it{problem}")

    def __iter__(self) -> Iterator[RawFrame]:
        number, others = 0, 0
        try:
            for place, record, problem in records(pieces(self._path)):
                if record is not None and device_of(record) != self._device:
                    others += 1
                    continue
                yield self._frame(number, place, record, problem)
                number += 1
        except UnusableError as error:
            self.diagnostics.fault(f"{error}; what comes before is read", self._path.name)
        if others:
            self.diagnostics.fault(
                f"{number_of(others, 'image')} of other sonars than device {self._device} are not "
                "read; record one sonar to a file",
                self._path.name,
            )

    def _frame(self, number: int, place: int, record: bytes | None, problem: str) -> RawFrame:
        name = f"image {number} at byte {place}"
        logged_ns = None if record is None else time_ns(record)
        if record is None or number in self.passed_over:
            return RawFrame(name, logged_ns, None, problem or None)
        try:
            ping, _ = decoded(record)
        except UnusableError as error:
            return RawFrame(name, logged_ns, None, str(error))
        stamps = Stamps(logged_ns, None, ping.stamp_ns)
        timestamp_ns = ping.stamp_ns if logged_ns is None else logged_ns
        return RawFrame(name, timestamp_ns, ping.pixels, None, ping.sonar, stamps)
