"""ROS 1 bags (.bag), by `rosbags`."""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Collection, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import lz4.frame

from sonarrec.errors import Diagnostics, SonarrecError, name_as_text
from sonarrec.readers.raw import MAX_FRAME_BYTES, Channel, FileBytes, Message, Recording

_MAGIC = b"#ROSBAG V2.0\n"


class RosBag(Recording):
    """A `Recording` of one bag of ROS 1."""

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        """Raises SonarrecError if it is no bag or is damaged, OSError if it cannot be read."""
        from rosbags.rosbag1 import Reader

        super().__init__(path, diagnostics, "ros1")
        self._reader: Any = Reader(path)
        try:
            self._reader.open()
            self.close = self._reader.close
            names = {bz2.decompress: "bz2", lz4.frame.decompress: "lz4"}
            chunks = self._reader.chunks.values()
            self.chunks.update(names.get(chunk.decompressor, "none") for chunk in chunks)
            for c in self._reader.connections:
                definition = c.msgdef.data.encode(errors="replace")
                self.channels[c.id] = Channel(c.topic, c.msgtype, "ros1msg", definition, "ros1")
            self.counts = Counter({c.id: c.msgcount for c in self._reader.connections})
            file = FileBytes(path)
            if file.find(_MAGIC, max(self._reader.chunks, default=len(_MAGIC)), file.size):
                self.fault("several bags in one file, of which only the first is read")
            file.close()
            if self._reader.message_count:
                self.span = self._reader.start_time, self._reader.end_time - 1
        except OSError:
            raise
        except Exception as error:  # rosbags does not list what it raises for damaged bags
            hint = "; `rosbag reindex` repairs it" if "not indexed" in str(error) else ""
            raise SonarrecError(
                f"{path}: not a whole bag of ROS 1 ({_line(error)}){hint}"
            ) from None

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels in log-time order."""
        connections = [c for c in self._reader.connections if c.id in channels]
        if not connections:
            return  # for rosbags, no connections means all
        read = 0
        try:
            for connection, time, data in self._reader.messages(connections):
                read += 1
                if len(data) > MAX_FRAME_BYTES:
                    problem = f"a message of {len(data)} bytes, more than is read"
                    yield Message(connection.id, time, None, None, problem)
                else:
                    yield Message(connection.id, time, None, memoryview(data))
            entries = chain.from_iterable(self._reader.indexes[c.id] for c in connections)
            recorded = sorted((entry.chunk_pos, entry.offset, entry.time) for entry in entries)
            self.note_set_back((time, time) for _, _, time in recorded)
        except Exception as error:
            count = sum(self.counts[c] for c in channels)
            self.complete = False
            self.fault(f"damaged ({_line(error)}): {count - read} of {count} frames are lost")


def _line(error: BaseException) -> str:
    text = str(error).partition("\n")[0]
    return name_as_text(text or type(error).__name__)[:200]
