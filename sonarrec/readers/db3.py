"""The SQLite storage of ROS 2 bags (.db3), by `rosbags`."""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sonarrec.readers.recording import MAX_MESSAGE_BYTES, Channel, Message
from sonarrec.records import SonarrecError, shown


class Db3Recording:
    """A `Recording` of one database."""

    def __init__(self, path: Path, at: Path | None = None) -> None:
        """at: where its bytes are, if not at `path`.

        Raises SonarrecError where it is none or is damaged.
        """
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

        self.path = path
        self.faults: list[str] = []
        # Its name goes into a URI, in which ? and # have meanings of their own.
        self._reader: Any = Sqlite3Reader(Path(quote(os.fsencode(at or path))))
        try:
            self._reader.open()
            # A row comes whole: no longer than a message may be.
            assert self._reader.dbconn is not None
            self._reader.dbconn.limit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
            connections, told = self._reader.connections, self._reader.metadata
            self.channels = {c.id: _channel(c) for c in connections}
            self.counts = Counter({c.id: int(c.msgcount) for c in connections})
            self.span = (
                (int(told.start_time), int(told.end_time) - 1) if told.message_count else None
            )
        except Exception as error:  # what a damaged database raises is nowhere listed
            raise SonarrecError(
                f"{shown(path)}: not a whole database of a ROS 2 bag ({_line(error)})"
            ) from None
        self.profile, self.library = "ros2", "SQLite"
        self.chunks: dict[str, int] = {}
        self.whole = True
        log = path.with_name(f"{path.name}-wal")
        if log.exists() and log.stat().st_size:
            self.fault(
                f"what its recorder left in {shown(log.name)} is not read; "
                f"`sqlite3 {shown(path.name)} .tables` puts it in"
            )

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels in log-time order."""
        chosen = [c for c in self._reader.connections if c.id in channels]
        read, held = 0, sum(self.counts[c] for c in channels)
        try:
            for connection, time, data in self._reader.messages(chosen):
                if not isinstance(time, int) or not time >= 0 or not isinstance(data, bytes):
                    time = time if isinstance(time, int) and time >= 0 else 0
                    yield Message(connection.id, time, None, None, "malformed row in its database")
                else:
                    yield Message(connection.id, time, None, memoryview(data))
                read += 1
        except Exception as error:
            self.whole = False
            self.fault(f"damaged ({_line(error)}): {held - read} of {held} frames are lost")

    def fault(self, text: str) -> None:
        """Add a line about what is wrong."""
        self.faults.append(f"{shown(self.path.name)}: {text}")

    def close(self) -> None:
        """Close the database."""
        if self._reader.dbconn is not None:
            self._reader.close()


def _channel(connection: Any) -> Channel:
    return Channel(
        str(connection.topic),
        str(connection.msgtype),
        "ros2msg" if connection.msgdef.format.name == "MSG" else connection.msgdef.format.name,
        str(connection.msgdef.data).encode(errors="replace"),
        str(connection.ext.serialization_format),
    )


def _line(error: BaseException) -> str:
    """What an error of the library says, without its names of files."""
    told = str(error.__cause__ or error).partition("\n")[0]
    return shown(told.rpartition(": ")[2] or type(error).__name__)[:200]
