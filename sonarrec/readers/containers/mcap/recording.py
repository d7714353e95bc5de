"""An MCAP file as a recording: its channels, and their messages in log-time order."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from mcap.records import Schema

from sonarrec.errors import Diagnostics
from sonarrec.readers.containers.mcap.in_order import MessageReader
from sonarrec.readers.containers.mcap.salvage import McapFile
from sonarrec.readers.containers.recording import Channel, Message, Recording

_NO_SCHEMA = Schema(id=0, name="", encoding="", data=b"")


class McapRecording(Recording):
    """A `Recording` of an MCAP file. A damaged or cut file is read as far as possible."""

    def __init__(
        self, path: Path, at: Path | None = None, diagnostics: Diagnostics | None = None
    ) -> None:
        """path: the file's name in messages. at: the file to read, if it is another one.

        Raises SonarrecError if it is no MCAP file, OSError if it cannot be read.
        """
        super().__init__(path, diagnostics)
        log = self._log = McapFile(path, at or path, self.fault)
        self.channels: dict[int, Channel] = {}
        for channel in log.channels.values():
            schema = log.schemas.get(channel.schema_id, _NO_SCHEMA)
            self.channels[channel.id] = Channel(
                channel.topic, schema.name, schema.encoding, schema.data, channel.message_encoding
            )
        self.counts = log.counts
        self.profile, self.library = (
            (log.header.profile, log.header.library) if log.header is not None else ("", "")
        )
        self.span, self.chunks, self.whole = log.span, log.chunks, log.whole

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels in log-time order; those of equal time as in the file."""
        reader = MessageReader(self._log, channels)
        yield from reader
        self.note_set_back(
            ((first, last) for _, first, last in sorted(reader.spans)), reader.back_ns
        )

    def close(self) -> None:
        """Close the file."""
        self._log.close()
