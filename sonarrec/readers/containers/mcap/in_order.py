"""Reads the messages of an MCAP file in log-time order, whatever the order of its chunks.

Chunks are opened in the order of their first messages. Messages of chunks that overlap in time are
merged. Only the place of a message is kept until it is read.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterable, Iterator

import numpy as np

from sonarrec.errors import SonarrecError, number_of
from sonarrec.readers.containers.mcap.chunks import ChunkHead, Contents, DamagedError
from sonarrec.readers.containers.mcap.in_chunk import (
    Place,
    Scan,
    agrees,
    by_index,
    in_time_order,
    indexed,
    lost_places,
    places,
    scan,
)
from sonarrec.readers.containers.mcap.salvage import CHUNK, MESSAGE_HEAD, McapFile
from sonarrec.readers.containers.recording import Message
from sonarrec.readers.raw import MAX_FRAME_BYTES


class MessageReader:
    """One pass over the messages of some channels of a file.

    spans: (position, first log time, last log time) of each chunk that was read, and of each run of
    messages in no chunk. back_ns: by how much times go back at most within a chunk.
    """

    def __init__(self, log: McapFile, channels: Collection[int]) -> None:
        self._log = log
        self._channels = frozenset(channels)
        # A heap, sorted by the next message of each run: (next message, the others, contents). A
        # chunk is one run, or none; its contents are released after its last message.
        self._runs: list[tuple[Place, Iterator[Place], Contents | None]] = []
        self._passed_count = self._lost_count = 0
        self._last_time, self._in_order = 0, True
        self._all_checked = True  # by a checksum of its chunk
        self.spans: list[tuple[int, int, int]] = []
        self.back_ns = 0

    def __iter__(self) -> Iterator[Message]:
        """Yield the messages in log-time order; messages of equal time in the file's order.

        Damage is reported in the file's faults. Raises SonarrecError if the file cannot be read
        any more.
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
                    self._add_run(self._rising(everything, position, channel))
            while self._runs:
                yield self._next()
            self._report_faults()
        except OSError as error:
            raise SonarrecError(f"{log.path}: cannot be read ({error.strerror})") from None

    def _rising(self, contents: Contents, position: int, channel: int) -> Iterator[Place]:
        """The messages of a channel in no chunk, up to the first whose time goes back."""
        first, last = 2**64, 0
        for place in places(contents, position, None, {channel}):
            if place.log_time < last:
                break
            first, last = min(first, place.log_time), place.log_time
            yield place
        self.spans.append((position, first, last))

    def _next(self) -> Message:
        place, run, contents = self._runs[0]
        message = self._message(place)
        self._in_order &= place.log_time >= self._last_time
        self._last_time = place.log_time
        following = next(run, None)
        if following is not None:
            heapq.heapreplace(self._runs, (following, run, contents))
            return message
        heapq.heappop(self._runs)
        if contents is not None:
            self._log.store.release(contents)
        return message

    def _message(self, place: Place) -> Message:
        data, problem = None, None
        self._passed_count += 1
        if place.contents is None:
            self._lost_count += 1
        elif place.length > MAX_FRAME_BYTES:
            problem = f"a message of {place.length} bytes, more than is read"
        else:
            place.contents.file.seek(place.offset + MESSAGE_HEAD.size)
            data = memoryview(place.contents.file.read(place.length - MESSAGE_HEAD.size))
        return Message(place.channel, place.log_time, place.publish_time, data, problem)

    def _add_run(self, run: Iterable[Place], contents: Contents | None = None) -> None:
        """Merge in a run of messages. contents: of its chunk, to be released at its end."""
        run = iter(run)
        first = next(run, None)
        if first is not None:
            heapq.heappush(self._runs, (first, run, contents))
        elif contents is not None:
            self._log.store.release(contents)

    def _open_chunk(self, position: int) -> None:
        log = self._log
        try:
            chunk = log.chunk_at(position)
        except DamagedError as error:  # overwritten since the file was opened
            log.fault(f"the chunk at byte {position} {error}; its frames are lost")
            return
        try:
            contents = log.store.open(chunk)
        except DamagedError as error:
            gone = lost_places(chunk, indexed(log, chunk), self._channels)
            number = f"{len(gone)} " if gone else ""
            log.fault(f"the chunk at byte {position} {error}; its {number}frames are lost")
            self._add_run(gone)
            return
        self._all_checked &= chunk.crc != 0
        scanned = scan(contents, self._channels, log.channels)
        if chunk.cut:
            if scanned.count:
                share = chunk.size / (scanned.end - contents.start)
                if more := round(scanned.count * (share - 1)):
                    log.fault(
                        f"by its size, the chunk that is cut held {number_of(more, 'more frame')}"
                    )
        elif (mended := self._mended(chunk, contents, scanned)) is not None:
            self._add_run(mended, contents)
            return
        for oddity in scanned.oddities():
            log.fault(f"not read: {oddity}, in the chunk at byte {position}")
        if not scanned.count:
            log.store.release(contents)
            return
        self.spans.append((position, scanned.earliest, scanned.latest))
        self.back_ns = max(self.back_ns, scanned.back_ns)
        if not scanned.back_ns:
            self._add_run(places(contents, contents.start, position, self._channels), contents)
        else:
            self._add_run(in_time_order(contents, chunk, self._channels), contents)

    def _mended(self, chunk: ChunkHead, contents: Contents, scanned: Scan) -> list[Place] | None:
        """The messages of a damaged chunk, found by its index; the damage is reported.

        None if the chunk is sound, or if its index does not help: then it is read as it is.
        """
        log, where = self._log, f"the chunk at byte {chunk.position}"
        stopped = scanned.end < contents.end
        if chunk.crc and not stopped:
            return None
        index = indexed(log, chunk)
        count = sum(channel in self._channels for _, channel, _ in index)
        if not stopped and (
            count < scanned.count
            or (count == scanned.count and agrees(contents, chunk, index, self._channels))
        ):
            return None
        mended, retimed = by_index(contents, chunk, index, self._channels) if index else ([], 0)
        gone = sum(place.contents is None for place in mended)
        if not index or len(mended) - gone < scanned.count:  # an index that knows less is no help
            if not stopped:
                return None
            log.fault(
                f"{where} is damaged at byte {scanned.end - contents.start} of its contents; "
                "the frames behind it are lost"
            )
            return None
        if stopped or gone:
            number = f"{gone} of its {count} frames are lost" if gone else "no frame is lost"
            log.fault(f"{where} is damaged; by its index {number}")
        if retimed:
            subject = "1 message has" if retimed == 1 else f"{retimed} messages have"
            log.fault(f"{where}: {subject} another log time in its index")
        return mended

    def _report_faults(self) -> None:
        log = self._log
        if log.file.seek(0, 2) < log.size:
            log.fault("the file became shorter while it was read")
        count = sum(log.counts[c] for c in self._channels)
        if self._passed_count < count:
            gone = count - self._passed_count + self._lost_count
            log.fault(f"in all, {gone} of {count} frames are lost")
        if not self._in_order:
            log.fault("a chunk states a later time than it holds; frames are out of order there")
        if not self._all_checked and not log.data_are_sound():
            log.fault("its data fail their checksum; which frames are wrong cannot be known")
