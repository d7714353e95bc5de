"""ROS 1 bags (.bag), by `rosbags`."""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import lz4.frame

from sonarrec.errors import Diagnostics, SonarrecError, name_as_text
from sonarrec.readers.containers.recording import Channel, Message, Recording
from sonarrec.readers.raw import MAX_FRAME_BYTES

MAX_CHUNK_BYTES = 2**27  # inflated, in memory; recorders write chunks of less than 1 MB


class RosBag(Recording):
    """A `Recording` of one bag of ROS 1."""

    def __init__(
        self, path: Path, at: Path | None = None, diagnostics: Diagnostics | None = None
    ) -> None:
        """path: the file's name in messages. at: the file to read, if it is another one. Raises
        SonarrecError if it is no bag or is damaged, OSError if it cannot be read."""
        from rosbags.rosbag1 import Reader

        super().__init__(path, diagnostics)
        reader: Any = Reader(at or path)
        self._reader = reader
        try:
            reader.open()
            for position, chunk in reader.chunks.items():
                name, bounded = _bounded(chunk)
                self.chunks[name] += 1
                reader.chunks[position] = chunk._replace(decompressor=bounded)
            for c in reader.connections:
                definition = c.msgdef.data.encode(errors="replace")
                self.channels[c.id] = Channel(c.topic, c.msgtype, "ros1msg", definition, "ros1")
            self.counts = Counter({c.id: c.msgcount for c in reader.connections})
            if reader.message_count:
                self.span = reader.start_time, reader.end_time - 1
        except OSError:
            raise
        except Exception as error:  # rosbags does not list what it raises for damaged bags
            hint = "; `rosbag reindex` repairs it" if "not indexed" in str(error) else ""
            raise SonarrecError(
                f"{path}: not a whole bag of ROS 1 ({_line(error)}){hint}"
            ) from None
        self.profile = "ros1"

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels in log-time order."""
        read = 0
        try:
            for message in self._messages(channels):
                read += 1
                yield message
        except Exception as error:
            count = sum(self.counts[c] for c in channels)
            self.whole = False
            self.fault(f"damaged ({_line(error)}): {count - read} of {count} frames are lost")

    def _messages(self, channels: Collection[int]) -> Iterator[Message]:
        connections = [c for c in self._reader.connections if c.id in channels]
        if not connections:
            return  # for rosbags, no connections means all
        for connection, time, data in self._reader.messages(connections):
            if len(data) > MAX_FRAME_BYTES:
                problem = f"a message of {len(data)} bytes, more than is read"
                yield Message(connection.id, time, None, None, problem)
            else:
                yield Message(connection.id, time, None, memoryview(data))
        entries = chain.from_iterable(self._reader.indexes[c.id] for c in connections)
        recorded = sorted((entry.chunk_pos, entry.offset, entry.time) for entry in entries)
        self.note_set_back((time, time) for _, _, time in recorded)

    def close(self) -> None:
        """Close the file."""
        if self._reader.bio is not None:
            self._reader.close()


def _bounded(chunk: Any) -> tuple[str, Callable[[bytes], bytes]]:
    """(compression, decompressor) of a chunk. rosbags inflates it in one go, however large."""
    plain = chunk.decompressor
    if chunk.datasize > MAX_CHUNK_BYTES:
        return "none", partial(_inflated, None)
    if plain is bz2.decompress:
        return "bz2", partial(_inflated, bz2.BZ2Decompressor)
    if plain is lz4.frame.decompress:
        return "lz4", partial(_inflated, lz4.frame.LZ4FrameDecompressor)
    return "none", plain


def _inflated(decompressor: Callable[[], Any] | None, stored: bytes) -> bytes:
    if decompressor is not None:
        inflate = decompressor()
        inflated: bytes = inflate.decompress(stored, max_length=MAX_CHUNK_BYTES)
        if inflate.eof:
            return inflated
    raise ValueError(f"a chunk of more than {MAX_CHUNK_BYTES} bytes")


def _line(error: BaseException) -> str:
    text = str(error).partition("\n")[0]
    return name_as_text(text or type(error).__name__)[:200]
