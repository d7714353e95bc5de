"""The SQLite storage of ROS 2 bags (.db3), by `rosbags`."""

from __future__ import annotations

import os
import sqlite3
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from sonarrec.errors import Diagnostics, SonarrecError, name_as_text
from sonarrec.readers.containers.recording import Channel, Message, Recording
from sonarrec.readers.raw import MAX_FRAME_BYTES


class Db3Recording(Recording):
    """A `Recording` of one database. If it is cut, only the messages before the cut are read."""

    def __init__(
        self, path: Path, at: Path | None = None, diagnostics: Diagnostics | None = None
    ) -> None:
        """path: the file's name in messages. at: the file to read, if it is another one.

        Raises SonarrecError if it is no such database, or nothing in it can be read.
        """
        super().__init__(path, diagnostics)
        self.profile, self.library = "ros2", "SQLite"
        self.chunks: dict[str, int] = {}
        # Quoted, because the name becomes part of a URI, in which ? and # have a meaning.
        name = quote(os.fsencode(at or path))
        self._database: _WholeDatabase | _CutDatabase
        try:
            self._database = _WholeDatabase(name)
        except Exception as error:  # rosbags does not list what it raises for damaged databases
            whole = _line(error)
            try:
                self._database = _CutDatabase(name)
            except (sqlite3.Error, TypeError, ValueError, OverflowError):
                raise SonarrecError(f"{path}: not a database of a ROS 2 bag ({whole})") from None
            self.whole = False
            self.fault(f"cut short or damaged ({whole}); what is whole before that is read")
        self.channels, self.counts = self._database.channels, self._database.counts
        self.span = self._database.span
        log = path.with_name(f"{path.name}-wal")
        if log.exists() and log.stat().st_size:
            self.fault(
                f"what its recorder left in {log.name} is not read; "
                f"`sqlite3 {path.name} .tables` merges it"
            )

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels in log-time order."""
        count = sum(self.counts[c] for c in channels)
        return self.up_to_damage(self._messages(channels), count, _line)

    def _messages(self, channels: Collection[int]) -> Iterator[Message]:
        for number, time, data in self._database.rows(channels):
            if isinstance(time, int) and time >= 0 and isinstance(data, bytes):
                yield Message(number, time, None, memoryview(data))
            else:
                time = time if isinstance(time, int) and time >= 0 else 0
                yield Message(number, time, None, None, "malformed row in its database")
        self.note_set_back(
            (time, time)
            for number, time in self._database.recorded()
            if number in channels and isinstance(time, int)
        )

    def close(self) -> None:
        """Close the database."""
        self._database.close()


class _WholeDatabase:
    """A database without damage, read by rosbags. channels, counts, span: as in a Recording."""

    def __init__(self, name: str) -> None:
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

        reader: Any = Sqlite3Reader(Path(name))
        self._reader = reader
        reader.open()
        # SQLite returns rows whole, so no row may be longer than the longest message.
        reader.dbconn.limit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_FRAME_BYTES)
        self.channels = {c.id: _channel(c) for c in reader.connections}
        self.counts = Counter({c.id: int(c.msgcount) for c in reader.connections})
        metadata = reader.metadata
        self.span = (
            (int(metadata.start_time), int(metadata.end_time) - 1)
            if metadata.message_count
            else None
        )

    def rows(self, channels: Collection[int]) -> Iterator[tuple[int, Any, Any]]:
        """(channel, log time in ns, message) of some channels, in order of time."""
        connections = [c for c in self._reader.connections if c.id in channels]
        for connection, time, data in self._reader.messages(connections):
            yield connection.id, time, data

    def recorded(self) -> Iterator[tuple[int, Any]]:
        """(channel, log time in ns) of all messages, in the order of recording."""
        yield from self._reader.dbconn.execute(
            "SELECT topic_id, timestamp FROM messages ORDER BY rowid"
        )

    def close(self) -> None:
        self._reader.close()


class _CutDatabase:
    """A database whose end is missing: the rows before the cut, as _WholeDatabase has them.

    rosbags cannot read it: it counts all rows first, which SQLite refuses for a cut file.
    """

    def __init__(self, name: str) -> None:
        self._db = sqlite3.connect(f"file:{name}?immutable=1", uri=True)
        try:
            self._db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_FRAME_BYTES)
            self._db.execute("PRAGMA writable_schema = ON")  # else a short file is not opened
            known = self._definitions()
            self.channels = {
                int(number): Channel(
                    str(topic), str(kind), *known.get(kind, ("", b"")), str(encoding)
                )
                for number, topic, kind, encoding in self._db.execute(
                    "SELECT id, name, type, serialization_format FROM topics"
                )
            }
            self._times, self._places = array("q"), array("q")
            self._channels = array("q")
            self._find_rows()
        except BaseException:
            self._db.close()
            raise
        self.counts = Counter(self._channels)
        self.span = (min(self._times), max(self._times)) if self._times else None

    def _definitions(self) -> dict[str, tuple[str, bytes]]:
        """(encoding, text) of the definitions by message type; older databases have none."""
        try:
            return {
                kind: (str(encoding), str(text).encode(errors="replace"))
                for kind, encoding, text in self._db.execute(
                    "SELECT topic_type, encoding, encoded_message_definition "
                    "FROM message_definitions"
                )
            }
        except sqlite3.Error:
            return {}

    def _find_rows(self) -> None:
        """Remember place, channel and time of each message up to the cut: 24 bytes each."""
        rows = self._db.execute("SELECT rowid, topic_id, timestamp FROM messages ORDER BY rowid")
        try:
            for place, channel, time in rows:
                if isinstance(time, int) and time >= 0 and channel in self.channels:
                    self._places.append(place)
                    self._channels.append(channel)
                    self._times.append(time)
        except sqlite3.Error:  # the cut
            pass

    def rows(self, channels: Collection[int]) -> Iterator[tuple[int, Any, Any]]:
        for turn in np.argsort(np.frombuffer(self._times, np.int64), kind="stable"):
            if self._channels[turn] in channels:
                rows = self._db.execute(
                    "SELECT data FROM messages WHERE rowid = ?", (self._places[turn],)
                )
                try:
                    (data,) = rows.fetchone()
                except sqlite3.Error:  # the row reaches beyond the cut
                    data = None
                yield self._channels[turn], self._times[turn], data

    def recorded(self) -> Iterator[tuple[int, Any]]:
        yield from zip(self._channels, self._times, strict=True)

    def close(self) -> None:
        self._db.close()


def _channel(connection: Any) -> Channel:
    return Channel(
        str(connection.topic),
        str(connection.msgtype),
        "ros2msg" if connection.msgdef.format.name == "MSG" else connection.msgdef.format.name,
        str(connection.msgdef.data).encode(errors="replace"),
        str(connection.ext.serialization_format),
    )


def _line(error: BaseException) -> str:
    """The text of an error of the library, without its names of files."""
    text = str(error.__cause__ or error).partition("\n")[0]
    return name_as_text(text.rpartition(": ")[2] or type(error).__name__)[:200]
