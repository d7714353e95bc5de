"""A raw stream or an `.oculus` log of an Oculus as a RawLog."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.nouns import Stamps
from sonarrec.readers.containers.file_bytes import FileBytes
from sonarrec.readers.containers.oculus.framing import framing_of, messages
from sonarrec.readers.containers.oculus.pings import (
    FULL_PING,
    SIMPLE_PING,
    Header,
    decoded,
    message_number,
)
from sonarrec.readers.raw import MAX_FRAME_BYTES, HeaderInfo, RawFrame, RawLog, UnusableError

_LOOKED_THROUGH = 2 * MAX_FRAME_BYTES  # for a first ping, since the file may be of another kind


class OculusPings(RawLog):
    """The pings of a raw stream or of an `.oculus` log, in the order of the file."""

    def __init__(self, path: Path, diagnostics: Diagnostics | None = None) -> None:
        """Raises SonarrecError if the file holds no ping that can be read."""
        super().__init__(diagnostics or Diagnostics(path))
        self.polar = True
        self._name = path.name
        self._file = FileBytes(path)
        with self._file.closed_on_error():
            self._framing, self._start = framing_of(self._file, str(path))
            self.header_info = HeaderInfo(values=self._first_header(str(path)))

    def _first_header(self, where: str) -> Header:
        """The header of the first ping that can be read. where: names the file."""
        problem, untold = "", Diagnostics("")
        within = min(self._file.size, _LOOKED_THROUGH)
        for _, _, message, reason in self._read(untold, within):
            if message is not None:
                try:
                    return decoded(message)[1]
                except UnusableError as error:
                    reason = str(error)
            problem = problem or f" ({reason})"
        raise SonarrecError(f"{where}: no ping of an Oculus can be read in it{problem}")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __iter__(self) -> Iterator[RawFrame]:
        for number, (at, time_ns, message, problem) in enumerate(
            self._read(self.diagnostics, self._file.size)
        ):
            name = f"ping {number} at byte {at}"
            if message is None or number in self.passed_over:
                yield RawFrame(name, time_ns, None, problem or None)
                continue
            try:
                ping, _ = decoded(message)
            except UnusableError as error:
                yield RawFrame(name, time_ns, None, str(error))
                continue
            stamps = Stamps(time_ns, None, ping.stamp_ns)
            timestamp_ns = ping.stamp_ns if time_ns is None else time_ns
            yield RawFrame(name, timestamp_ns, ping.pixels, None, ping.sonar, stamps)

    def _read(
        self, diagnostics: Diagnostics, limit: int
    ) -> Iterator[tuple[int, int | None, bytes | None, str]]:
        """Yield (place, time in ns, message, problem) of every ping; no message if it is damaged.

        limit: where in the file to stop. diagnostics: after all is read, it is told of bytes that
        belong to no message, and of pings in a format that is not read.
        """
        stray_bytes = stray_places = full = 0
        for at, length, whole in messages(self._file, self._framing, self._start, limit):
            if self._framing.length_at(self._file, at) is None:
                stray_bytes += length
                stray_places += 1
                continue
            if not whole:
                yield at, None, None, f"only {length} bytes of it are there"
                continue
            try:
                message, time_ns = self._framing.contents(self._file.at(at, length))
            except UnusableError as error:
                yield at, None, None, str(error)
                continue
            number = message_number(message)
            full += number == FULL_PING
            if number == SIMPLE_PING:
                yield at, time_ns, message, ""
        if stray_places:
            diagnostics.fault(
                f"{stray_bytes} bytes in {stray_places} places belong to no message; damaged, so "
                "pings may be missing there, or wrong before them",
                self._name,
            )
        if full:
            diagnostics.fault(
                f"{number_of(full, 'ping')} in the full format, which is not public, cannot be "
                "read; let the sonar send simple results",
                self._name,
            )
