"""The SQLite storage of ROS 2 bags (.db3)."""

from __future__ import annotations

import os
import sqlite3
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

import numpy as np

from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.readers.raw import MAX_FRAME_BYTES, Channel, Message, Recording


class Db3Recording(Recording):
    """A `Recording` of one database. Of one that is cut, the messages before the cut are read. Not
    by rosbags, which counts all rows first: SQLite refuses that for a cut file."""

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        """Raises SonarrecError if it is no such database, or nothing in it can be read."""
        super().__init__(path, diagnostics, "ros2")
        self.library = "SQLite"
        # Row, topic and time (ns) of each message in the order of recording: 24 bytes each.
        self._rows, self._topics, self._times = array("q"), array("q"), array("q")
        # Quoted, because the name becomes part of a URI, in which ? and # have a meaning.
        self._db = sqlite3.connect(f"file:{quote(os.fsencode(path))}?immutable=1", uri=True)
        self.close = self._db.close
        try:
            # SQLite returns rows whole, so no row may be longer than the longest message.
            self._db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_FRAME_BYTES)
            self._db.text_factory = lambda text: text.decode(errors="replace")
            self._db.execute("PRAGMA writable_schema = ON")  # else a short file is not opened
            self._read_channels()
        except (sqlite3.Error, TypeError, ValueError) as error:
            self.close()
            raise SonarrecError(f"{path}: not a database of a ROS 2 bag ({error})") from None
        self._find_rows()
        self.counts = Counter(self._topics)
        if self._times:
            self.span = min(self._times), max(self._times)
        for ending in ("-wal", "-journal"):
            log = path.with_name(f"{path.name}{ending}")
            if log.exists() and log.stat().st_size:
                self.fault(
                    f"what its recorder left in {log.name} is not read; "
                    f"`sqlite3 {path.name} .tables` merges it"
                )

    def _read_channels(self) -> None:
        select = "SELECT name FROM sqlite_master WHERE type = 'view'"  # may have no end
        if {"messages", "topics"} & {name for (name,) in self._db.execute(select)}:
            raise ValueError("a view stands in place of a table")
        definitions: dict[str, tuple[str, bytes]] = {}
        columns = "topic_type, encoding, encoded_message_definition"
        with suppress(sqlite3.Error):  # older databases have none
            for kind, encoding, text in self._db.execute(
                f"SELECT {columns} FROM message_definitions"
            ):
                definitions[kind] = str(encoding), str(text).encode(errors="replace")
        columns = "id, name, type, serialization_format"
        for number, topic, kind, encoding in self._db.execute(f"SELECT {columns} FROM topics"):
            definition = definitions.get(kind, ("", b""))
            self.channels[int(number)] = Channel(str(topic), str(kind), *definition, str(encoding))

    def _find_rows(self) -> None:
        """Remember where each message is, up to the cut if there is one."""
        unlisted = 0
        select = "SELECT rowid, topic_id, timestamp FROM messages ORDER BY rowid"
        try:
            for row, topic, time in self._db.execute(select):
                if topic not in self.channels:
                    unlisted += 1
                    continue
                self._rows.append(row)
                self._topics.append(topic)
                self._times.append(time if isinstance(time, int) and time >= 0 else 0)
        except sqlite3.Error as error:
            self.complete = False
            self.fault(f"cut short or damaged ({error}); what is whole before that is read")
        if unlisted:
            self.fault(
                f"{number_of(unlisted, 'message')} of topics that it does not list, not read"
            )

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels in log-time order."""
        select = "SELECT timestamp, data FROM messages WHERE rowid = ?"
        for k in np.argsort(np.frombuffer(self._times, np.int64), kind="stable"):
            if (topic := self._topics[k]) not in channels:
                continue
            time, data = None, None
            with suppress(sqlite3.Error):  # the row reaches beyond the cut
                time, data = self._db.execute(select, (self._rows[k],)).fetchone() or (None, None)
            if isinstance(time, int) and time >= 0 and isinstance(data, bytes):
                yield Message(topic, time, None, memoryview(data))
            else:
                yield Message(topic, self._times[k], None, None, "malformed row in its database")
        recorded = zip(self._topics, self._times, strict=True)
        self.note_set_back((time, time) for topic, time in recorded if topic in channels)
