"""Reads the image channel of an MCAP file, whole or cut short, in log-time order.

The `mcap` package reads whole files well, but loses the messages of a chunk that is cut, and
inflates chunks without a bound. This walks over the records itself, which needs no index: one
path for indexed, unindexed and cut files, holding one chunk at a time. The records' own layouts
come from the package.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics

from sonarrec.readers.messages import READABLE, Decoder, decoder_for
from sonarrec.readers.raw import RawFrame, UnusableError
from sonarrec.records import SonarrecError, Stamps, UsageError

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 256 * 2**20
_MAX_DEFINITION_BYTES = 16 * 2**20
_RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, inflated size, CRC, length of compression


class _DamagedError(Exception):
    """A record or chunk that cannot be used; the text says why."""


@dataclass(frozen=True, slots=True, order=True)
class _Message:
    """One message, ordered by log time, then by its place in the file."""

    log_time: int
    position: int
    offset: int
    channel: int
    publish_time: int
    data: memoryview


def _inflate(compression: str, data: bytes, size: int) -> bytes:
    """The contents of a chunk, at most one byte more than `size`; of cut data, what is whole.

    Raises _DamagedError where the data are no such compression.
    """
    try:
        if compression == "":
            return data
        if compression == "zstd":
            reader = zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True)
            return reader.read(size + 1)
        if compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise _DamagedError(f"does not inflate ({error})") from None
    raise _DamagedError(f"has the unknown compression {compression!r}")


def _records_in(chunk: bytes) -> Iterator[tuple[int, int, memoryview]]:
    """(opcode, offset, body) of every whole record in an inflated chunk."""
    view, at = memoryview(chunk), 0
    while at + _RECORD_HEAD.size <= len(view):
        opcode, length = _RECORD_HEAD.unpack_from(view, at)
        body = at + _RECORD_HEAD.size
        if opcode == 0 or body + length > len(view):
            return
        yield opcode, at, view[body : body + length]
        at = body + length


class McapImages:
    """The messages of one image topic, decoded, in log-time order.

    Chunks are read in the order of their first message; where they overlap in time, as many are
    held as overlap.
    """

    def __init__(self, path: Path, topic: str | None = None) -> None:
        """Choose the channel: the only image topic, or `topic`.

        Raises SonarrecError where the file is no MCAP or has no image channel, UsageError where
        several image topics ask for a choice or the topic chosen is none of them.
        """
        self._path = path
        self.faults: list[str] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] | None = None
        # Chunks, and messages outside of any, by first log time and position in the file.
        self._times, self._positions = array("Q"), array("Q")
        self._loose_channels = array("l")
        self._file = path.open("rb")
        try:
            self._scan()
            self._decoders = self._choose(topic)
        except BaseException:
            self._file.close()
            raise
        self.frame_count: int | None = (
            None if self._counts is None else sum(self._counts[c] for c in self._decoders)
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    # The first pass: seek from record to record, to find what there is.

    def _scan(self) -> None:
        size = self._file.seek(0, 2)
        self._file.seek(0)
        if self._file.read(len(MAGIC)) != MAGIC:
            raise SonarrecError(f"{self._path}: not an MCAP file (it does not begin like one)")
        at, whole = len(MAGIC), False
        loose: Counter[int] = Counter()
        while at + _RECORD_HEAD.size <= size:
            self._file.seek(at)
            opcode, length = _RECORD_HEAD.unpack(self._file.read(_RECORD_HEAD.size))
            end = at + _RECORD_HEAD.size + length
            if opcode == Opcode.CHUNK and at + _RECORD_HEAD.size + _CHUNK_HEAD.size <= size:
                start_time = _CHUNK_HEAD.unpack(self._file.read(_CHUNK_HEAD.size))[0]
                self._add_unit(start_time, at, -1)
            if opcode == 0 or end > size:
                break
            if opcode == Opcode.MESSAGE and length >= _MESSAGE_HEAD.size:
                channel, _, log_time, _ = _MESSAGE_HEAD.unpack(self._file.read(_MESSAGE_HEAD.size))
                self._add_unit(log_time, at, channel)
                loose[channel] += 1
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
                self._define(opcode, self._file.read(min(length, _MAX_DEFINITION_BYTES)))
            elif opcode == Opcode.FOOTER:
                self._file.seek(end)
                whole = self._file.read(len(MAGIC)) == MAGIC
                break
            at = end
        if not whole:
            self.faults.append(
                f"{self._path.name}: cut short or damaged at byte {at} (file ends at {size}, "
                "without a footer); everything whole before that was read"
            )
        if not whole or not self._channels:
            # No summary to tell what the chunks hold: look into each.
            self._counts = loose
            for position, channel in zip(self._positions, self._loose_channels, strict=True):
                if channel < 0:
                    self._look_into(position)
        elif self._counts is None and loose.total() == len(self._positions):
            self._counts = loose

    def _add_unit(self, time: int, position: int, channel: int) -> None:
        self._times.append(time)
        self._positions.append(position)
        self._loose_channels.append(channel)

    def _define(self, opcode: int, body: bytes | memoryview) -> None:
        """Take note of a schema, a channel or the message counts; a damaged one is left out."""
        stream = ReadDataStream(BytesIO(body))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                self._channels[channel.id] = channel
            else:
                self._counts = Counter(Statistics.read(stream).channel_message_counts)
        except (struct.error, UnicodeDecodeError, McapError):
            return

    def _look_into(self, position: int) -> None:
        assert self._counts is not None
        try:
            chunk = self._chunk(position)
        except _DamagedError:
            return  # told when the frames are read
        for opcode, _, body in _records_in(chunk):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, body)
            elif opcode == Opcode.MESSAGE and len(body) >= _MESSAGE_HEAD.size:
                self._counts[_MESSAGE_HEAD.unpack_from(body)[0]] += 1

    def _choose(self, topic: str | None) -> dict[int, Decoder]:
        """The decoder of every channel of the chosen topic."""
        decoders = {}
        none = Schema(id=0, name="", encoding="", data=b"")
        for channel in self._channels.values():
            schema = self._schemas.get(channel.schema_id, none)
            decoder = decoder_for(
                schema.name, schema.encoding, schema.data, channel.message_encoding
            )
            if decoder is not None:
                decoders[channel.id] = decoder
        topics = sorted({self._channels[c].topic for c in decoders})
        if not topics:
            there = sorted(
                f"{c.topic} ({self._schemas.get(c.schema_id, none).name or 'no schema'}, "
                f"{c.message_encoding or 'no encoding'})"
                for c in self._channels.values()
            )
            raise SonarrecError(
                f"{self._path}: no image channel; it holds {', '.join(there) or 'no channel'}, "
                f"and this reads {READABLE}"
            )
        if topic is None and len(topics) > 1:
            raise UsageError(
                f"{self._path}: several image channels; choose one with --topic: "
                f"{', '.join(topics)}"
            )
        if topic is not None and topic not in topics:
            raise UsageError(
                f"{self._path}: no image channel {topic!r}; there is {', '.join(topics)}"
            )
        chosen = topic or topics[0]
        return {c: d for c, d in decoders.items() if self._channels[c].topic == chosen}

    # The second pass: the frames.

    def __iter__(self) -> Iterator[RawFrame]:
        for number, message in enumerate(self._in_time_order()):
            name = f"message {number} of {self._channels[message.channel].topic}"
            try:
                ping = self._decoders[message.channel](message.data)
            except UnusableError as error:
                yield RawFrame(name, message.log_time, None, str(error))
            else:
                stamps = Stamps(message.log_time, message.publish_time, ping.stamp_ns)
                yield RawFrame(name, message.log_time, ping.pixels, None, ping.grid, stamps)

    def _in_time_order(self) -> Iterator[_Message]:
        times = np.frombuffer(self._times, np.uint64)
        pending: list[_Message] = []
        for unit in np.lexsort((np.frombuffer(self._positions, np.uint64), times)):
            channel, start = self._loose_channels[unit], self._times[unit]
            if channel >= 0 and channel not in self._decoders:
                continue
            while pending and pending[0].log_time < start:
                yield heapq.heappop(pending)
            for message in self._messages_at(self._positions[unit], is_chunk=channel < 0):
                heapq.heappush(pending, message)
        while pending:
            yield heapq.heappop(pending)

    def _messages_at(self, position: int, is_chunk: bool) -> Iterator[_Message]:
        """The chosen topic's messages in the chunk, or of the one message, at a position."""
        try:
            if is_chunk:
                contents = self._chunk(position)
            else:
                self._file.seek(position)
                head = self._file.read(_RECORD_HEAD.size)
                contents = head + self._file.read(_RECORD_HEAD.unpack(head)[1])
        except _DamagedError as error:
            self.faults.append(
                f"{self._path.name}: the chunk at byte {position} {error}; its frames are lost"
            )
            return
        for opcode, offset, body in _records_in(contents):
            if opcode != Opcode.MESSAGE or len(body) < _MESSAGE_HEAD.size:
                continue
            channel, _, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
            if channel in self._decoders:
                data = body[_MESSAGE_HEAD.size :]
                yield _Message(log_time, position, offset, channel, publish_time, data)

    def _chunk(self, position: int) -> bytes:
        """The inflated contents of the chunk at a position; of the file's cut end, what is whole.

        Raises _DamagedError where they cannot be used.
        """
        self._file.seek(position)
        length = _RECORD_HEAD.unpack(self._file.read(_RECORD_HEAD.size))[1]
        _, _, size, crc, name_length = _CHUNK_HEAD.unpack(self._file.read(_CHUNK_HEAD.size))
        name = self._file.read(min(name_length, 32))
        field = self._file.read(8)
        if name_length > 32:
            raise _DamagedError("has no readable head")
        if len(field) < 8:
            return b""
        stored = struct.unpack("<Q", field)[0]
        if stored != length - _CHUNK_HEAD.size - name_length - 8:
            raise _DamagedError("contradicts its own length")
        if max(size, stored) > MAX_CHUNK_BYTES:
            raise _DamagedError(f"declares {max(size, stored)} bytes, more than is read at once")
        data = self._file.read(stored)
        cut = len(data) < stored
        contents = _inflate(name.decode(errors="replace"), data, size)
        if len(contents) > size or (len(contents) < size and not cut):
            raise _DamagedError(f"does not inflate to the {size} bytes it declares")
        if crc and not cut and zlib.crc32(contents) != crc:
            raise _DamagedError("fails its checksum")
        return contents
