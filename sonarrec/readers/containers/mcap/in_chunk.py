"""Finds the messages of one chunk, and compares them with the message index behind the chunk.

In a chunk without a checksum, damage may go unnoticed: after a wrong record length, everything that
follows is hidden. Messages are then found by the index. Messages that the index names but that
cannot be read are counted as lost.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from mcap.opcode import Opcode

from sonarrec.readers.containers.mcap.chunks import RECORD_HEAD, ChunkHead, Contents
from sonarrec.readers.containers.mcap.salvage import (
    FIRST_PRIVATE,
    MESSAGE_HEAD,
    McapFile,
    records_in,
)

_MAX_INDEX_BYTES = 2**20
_INDEX_HEAD = struct.Struct("<HI")  # channel, length of the entries
_INDEX_ENTRY = struct.Struct("<QQ")  # log time, offset in the chunk
_OF_CHUNKS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)


@dataclass(frozen=True, slots=True, order=True)
class Place:
    """Where a message is. Places are ordered by log time, then by place in the file.

    log_time, publish_time: ns. position: of the message's chunk in the file, or of the message
    itself if it is in no chunk. contents: what it is read from; None if the message is lost.
    offset, length: of the message's body in `contents`, bytes.
    """

    log_time: int
    position: int
    offset: int
    channel: int = field(compare=False)
    publish_time: int = field(compare=False)
    contents: Contents | None = field(compare=False)
    length: int = field(compare=False)


@dataclass(slots=True)
class Scan:
    """What one pass over a chunk found.

    end: where the last whole record ends. count: number of messages of the chosen channels.
    earliest, latest: their times; back_ns: by how much these go back at most. short: messages too
    short for a head. undefined: messages of channels without a definition. foreign: records that
    are not allowed in a chunk.
    """

    end: int
    count: int = 0
    earliest: int = 2**64
    latest: int = 0
    back_ns: int = 0
    short: int = 0
    undefined: int = 0
    foreign: int = 0

    def oddities(self) -> list[str]:
        """A text for each kind of record that should not be in the chunk."""
        counts = (
            (self.short, "messages too short for a head"),
            (self.undefined, "messages of channels that nothing defines"),
            (self.foreign, "records that no chunk may hold"),
        )
        return [f"{count} {what}" for count, what in counts if count]


def places(
    contents: Contents, at: int, chunk: int | None, channels: Collection[int]
) -> Iterator[Place]:
    """The messages of some channels from `at` on.

    chunk: position of the chunk; None for messages that are in no chunk.
    """
    file = contents.file
    for opcode, body, length in records_in(contents, at):
        if opcode != Opcode.MESSAGE or length < MESSAGE_HEAD.size:
            continue
        file.seek(body)
        head = file.read(MESSAGE_HEAD.size)
        if len(head) < MESSAGE_HEAD.size:  # the file has become shorter
            return
        channel, _, log_time, publish_time = MESSAGE_HEAD.unpack(head)
        if channel in channels:
            position = body if chunk is None else chunk
            yield Place(log_time, position, body, channel, publish_time, contents, length)


def in_time_order(
    contents: Contents, chunk: ChunkHead, channels: Collection[int]
) -> Iterator[Place]:
    """The messages of a chunk, sorted by log time. It takes 24 bytes of memory per message."""
    times, offsets = array("Q"), array("Q")
    for place in places(contents, contents.start, chunk.position, channels):
        times.append(place.log_time)
        offsets.append(place.offset - RECORD_HEAD.size)
    for turn in np.argsort(np.frombuffer(times, np.uint64), kind="stable"):
        if (message := _message_at(contents, offsets[turn], chunk, channels)) is not None:
            yield message


def _message_at(
    contents: Contents, at: int, chunk: ChunkHead, channels: Collection[int]
) -> Place | None:
    """The message of these channels whose record begins at `at`; None if there is none."""
    place = next(places(contents, at, chunk.position, channels), None)
    return place if place is not None and place.offset == at + RECORD_HEAD.size else None


def scan(contents: Contents, channels: Collection[int], defined: Collection[int]) -> Scan:
    """Count the messages of a chunk, and check its records, without keeping any.

    defined: the channels that the file defines.
    """
    result, file = Scan(contents.start), contents.file
    for opcode, body, length in records_in(contents, contents.start):
        result.end = body + length
        if opcode != Opcode.MESSAGE:
            result.foreign += opcode not in _OF_CHUNKS and opcode < FIRST_PRIVATE
            continue
        file.seek(body)
        head = file.read(min(length, MESSAGE_HEAD.size))
        if len(head) < MESSAGE_HEAD.size:
            result.short += 1
            continue
        channel, _, time, _ = MESSAGE_HEAD.unpack(head)
        if channel in channels:
            result.count += 1
            result.back_ns = max(result.back_ns, result.latest - time)
            result.earliest, result.latest = min(result.earliest, time), max(result.latest, time)
        elif channel not in defined:
            result.undefined += 1
    return result


def indexed(log: McapFile, chunk: ChunkHead) -> list[tuple[int, int, int]]:
    """Read the message indexes behind a chunk; empty if there are none.

    Returns (offset of the record in the chunk, channel, log time in ns), by rising offset.
    """
    entries: list[tuple[int, int, int]] = []
    behind = Contents(log.file, chunk.data_start + chunk.stored, log.size)
    for opcode, body, length in records_in(behind, behind.start):
        if opcode != Opcode.MESSAGE_INDEX or length > _MAX_INDEX_BYTES:
            break
        log.file.seek(body)
        record = log.file.read(length)
        if len(record) < _INDEX_HEAD.size:
            break
        channel, size = _INDEX_HEAD.unpack_from(record)
        pairs = record[_INDEX_HEAD.size : _INDEX_HEAD.size + size]
        if len(pairs) % _INDEX_ENTRY.size == 0:
            entries += [(offset, channel, time) for time, offset in _INDEX_ENTRY.iter_unpack(pairs)]
    return sorted(entries)


def lost_places(
    chunk: ChunkHead, index: list[tuple[int, int, int]], channels: Collection[int]
) -> list[Place]:
    """The messages that an unreadable chunk held according to its index, by log time."""
    return sorted(
        Place(time, chunk.position, offset, channel, time, None, 0)
        for offset, channel, time in index
        if channel in channels
    )


def agrees(
    contents: Contents,
    chunk: ChunkHead,
    index: list[tuple[int, int, int]],
    channels: Collection[int],
) -> bool:
    """Whether the messages of some channels have the offsets and times that the index states."""
    at = contents.start + RECORD_HEAD.size
    places_read = places(contents, contents.start, chunk.position, channels)
    entries = (entry for entry in index if entry[1] in channels)
    return all(
        (place.offset - at, place.channel, place.log_time) == entry
        for place, entry in zip(places_read, entries, strict=False)
    )


def by_index(
    contents: Contents,
    chunk: ChunkHead,
    index: list[tuple[int, int, int]],
    channels: Collection[int],
) -> tuple[list[Place], int]:
    """Find the messages of a damaged chunk by its index.

    Returns (the messages by log time, with the lost ones; how many have another time in the index).
    A message that reaches into the next one has a wrong length and counts as lost. A message's own
    time is used if it lies within the times that the chunk states, otherwise that of the index.
    """
    result, retimed = [], 0
    ends = [contents.start + offset for offset, _, _ in index[1:]] + [contents.end]
    for (offset, channel, time), end in zip(index, ends, strict=True):
        if channel not in channels:
            continue
        place = _message_at(contents, contents.start + offset, chunk, {channel})
        if place is None or place.offset + place.length > end:
            result += lost_places(chunk, [(offset, channel, time)], channels)
            continue
        retimed += place.log_time != time
        if not chunk.start_time <= place.log_time <= chunk.end_time:
            place = replace(place, log_time=time)
        result.append(place)
    return sorted(result), retimed
