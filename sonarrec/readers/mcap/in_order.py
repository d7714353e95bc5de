"""The messages of an MCAP file in log-time order, however its chunks lie.

Chunks are opened in the order of their first message. Where they overlap in time their messages
are merged; of a message no more than its place is kept until its turn.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from mcap.opcode import Opcode

from sonarrec.readers.mcap.chunks import RECORD_HEAD, ChunkHead, Contents, DamagedError
from sonarrec.readers.mcap.salvage import CHUNK, MESSAGE_HEAD, McapFile, records_in
from sonarrec.records import SonarrecError

MAX_MESSAGE_BYTES = 48 * 2**20  # an image of 4096 x 4096 pixels of three bytes
_MAX_INDEX_BYTES = 2**20
_INDEX_HEAD = struct.Struct("<HI")  # channel, length of the entries
_INDEX_ENTRY = struct.Struct("<QQ")  # log time, offset in the chunk


@dataclass(frozen=True, slots=True)
class Message:
    """One message. Times in ns. data: None where it cannot be read, and `problem` says why;
    without a problem it went with a damaged chunk, which the file's faults tell once."""

    channel: int
    log_time: int
    publish_time: int
    data: memoryview | None
    problem: str | None = None


@dataclass(frozen=True, slots=True, order=True)
class _Place:
    """Where a message is: ordered by log time, then by its place in the file."""

    log_time: int
    position: int
    offset: int
    channel: int = field(compare=False)
    publish_time: int = field(compare=False)
    contents: Contents | None = field(compare=False)  # None: lost
    length: int = field(compare=False)


def _places(
    contents: Contents, at: int, chunk: int | None, channels: Collection[int]
) -> Iterator[_Place]:
    """The messages of some channels from `at` on. chunk: its position, None outside of any."""
    file = contents.file
    for opcode, body, length in records_in(contents, at):
        if opcode != Opcode.MESSAGE or length < MESSAGE_HEAD.size:
            continue
        file.seek(body)
        channel, _, log_time, publish_time = MESSAGE_HEAD.unpack(file.read(MESSAGE_HEAD.size))
        if channel in channels:
            position = body if chunk is None else chunk
            yield _Place(log_time, position, body, channel, publish_time, contents, length)


def _rising(places: Iterable[_Place]) -> Iterator[_Place]:
    """The places as long as their times do not go back."""
    last = 0
    for place in places:
        if place.log_time < last:
            return
        last = place.log_time
        yield place


class MessageReader:
    """One pass over the messages of some channels of a file."""

    def __init__(self, log: McapFile, channels: Collection[int]) -> None:
        self._log = log
        self._channels = frozenset(channels)
        self._runs: list[tuple[_Place, Iterator[_Place]]] = []  # a heap, by their next message
        self._runs_left: Counter[int] = Counter()  # by chunk
        self._passed = self._lost = 0
        self._last_time, self._in_order = 0, True
        self._all_checked = True  # by a checksum of its chunk

    def __iter__(self) -> Iterator[Message]:
        """The messages in log-time order; those at one time in the file's order.

        What is found wrong is added to the file's faults. Raises SonarrecError where the file
        cannot be read any more.
        """
        log = self._log
        times = np.frombuffer(log.times, np.uint64)
        try:
            for unit in np.lexsort((np.frombuffer(log.positions, np.uint64), times)):
                channel, position = log.channels_of_units[unit], log.positions[unit]
                if channel != CHUNK and channel not in self._channels:
                    continue
                while self._runs and self._runs[0][0].log_time < log.times[unit]:
                    yield self._next()
                if channel == CHUNK:
                    self._open_chunk(position)
                else:
                    self._all_checked = False
                    everything = Contents(log.file, 0, log.size)
                    self._add_run(_places(everything, position, None, {channel}))
            while self._runs:
                yield self._next()
            self._tell_what_is_wrong()
        except OSError as error:
            raise SonarrecError(f"{log.path}: cannot be read ({error.strerror})") from None

    def _next(self) -> Message:
        place, run = self._runs[0]
        message = self._message(place)
        self._in_order &= place.log_time >= self._last_time
        self._last_time = place.log_time
        following = next(run, None)
        if following is not None:
            heapq.heapreplace(self._runs, (following, run))
            return message
        heapq.heappop(self._runs)
        if place.position in self._runs_left:
            self._runs_left[place.position] -= 1
            if not self._runs_left[place.position]:
                del self._runs_left[place.position]
                assert place.contents is not None
                self._log.store.release(place.contents)
        return message

    def _message(self, place: _Place) -> Message:
        data, problem = None, None
        self._passed += 1
        if place.contents is None:
            self._lost += 1
        elif place.length > MAX_MESSAGE_BYTES:
            problem = f"a message of {place.length} bytes, more than is read"
        else:
            place.contents.file.seek(place.offset + MESSAGE_HEAD.size)
            data = memoryview(place.contents.file.read(place.length - MESSAGE_HEAD.size))
        return Message(place.channel, place.log_time, place.publish_time, data, problem)

    def _add_run(self, places: Iterable[_Place]) -> None:
        run = _rising(places)
        first = next(run, None)
        if first is not None:
            heapq.heappush(self._runs, (first, run))

    def _open_chunk(self, position: int) -> None:
        log = self._log
        chunk = log.chunk_at(position)
        try:
            contents = log.store.open(chunk)
        except DamagedError as error:
            lost = self._indexed(chunk)
            number = f"{len(lost)} " if lost else ""
            log.fault(f"the chunk at byte {position} {error}; its {number}frames are lost")
            self._add_run(lost)
            return
        self._all_checked &= chunk.crc != 0
        starts, last, end, count = [], -1, contents.start, 0
        for place in _places(contents, contents.start, position, self._channels):
            if place.log_time < last or last < 0:
                starts.append(place.offset - RECORD_HEAD.size)
            last, end = place.log_time, place.offset + place.length
            count += 1
        if chunk.cut and count:
            more = round(count * (chunk.size / (end - contents.start) - 1))
            if more:
                log.fault(f"by its size, the chunk that is cut held {more} more frames")
        if not starts:
            log.store.release(contents)
            return
        self._runs_left[position] = len(starts)
        for start in starts:
            self._add_run(_places(contents, start, position, self._channels))

    def _indexed(self, chunk: ChunkHead) -> list[_Place]:
        """What the message indexes behind a damaged chunk say it held, in the order of time."""
        log, lost = self._log, []
        behind = Contents(log.file, chunk.data_start + chunk.stored, log.size)
        for opcode, body, length in records_in(behind, behind.start):
            if opcode != Opcode.MESSAGE_INDEX or length > _MAX_INDEX_BYTES:
                break
            log.file.seek(body)
            record = log.file.read(length)
            if len(record) < _INDEX_HEAD.size:
                break
            channel, size = _INDEX_HEAD.unpack_from(record)
            entries = record[_INDEX_HEAD.size : _INDEX_HEAD.size + size]
            if channel in self._channels and len(entries) % _INDEX_ENTRY.size == 0:
                lost += [
                    _Place(time, chunk.position, offset, channel, time, None, 0)
                    for time, offset in _INDEX_ENTRY.iter_unpack(entries)
                ]
        return sorted(lost)

    def _tell_what_is_wrong(self) -> None:
        log = self._log
        if log.stated is not None:
            stated = sum(log.stated[c] for c in self._channels)
            if self._passed < stated:
                lost = stated - self._passed + self._lost
                log.fault(f"in all, {lost} of {stated} frames are lost")
        if not self._in_order:
            log.fault("a chunk states a later time than it holds; frames are out of order there")
        if not self._all_checked and not log.data_are_sound():
            log.fault("its data fail their checksum; which frames are wrong cannot be known")
