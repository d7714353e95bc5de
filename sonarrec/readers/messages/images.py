"""Reads the image channel of a recording in log-time order."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.readers.messages.fields import DefinitionError
from sonarrec.readers.messages.types import Decoder, decoder_for
from sonarrec.readers.raw import RawLog, Recording, StoredFrame, frame_of

_OF_SONARS = re.compile(
    r"sonar|ping|acoustic|oculus|gemini|aris|didson|blueview|blueprint|multibeam|mbes|fls",
    re.IGNORECASE,
)
"""In a topic or a type."""
MOST_NAMED = 5  # channels, or frame_ids, in a message


def image_decoders(log: Recording) -> dict[int, Decoder]:
    """A decoder for every channel with sonar images. If the definition of a channel's messages
    cannot be used, the recording's faults say why."""
    decoders: dict[int, Decoder] = {}
    unusable = set[tuple[str, str, bytes, str]]()  # channels may share a definition
    for number, channel in log.channels.items():
        key = channel.schema, channel.schema_encoding, channel.definition, channel.message_encoding
        try:
            if key not in unusable and (decoder := decoder_for(*key)) is not None:
                decoders[number] = decoder
        except DefinitionError as error:
            unusable.add(key)
            log.fault(f"the definition of {channel.topic} cannot be used ({error})")
    return decoders


class ChannelImages(RawLog):
    """The messages of one image topic, decoded, in log-time order."""

    def __init__(self, log: Recording, topic: str | None = None) -> None:
        """topic: the image topic; None: the only one. Closing this also closes the recording.
        Raises SonarrecError if there is no image channel, UsageError if there are several image
        topics and none is chosen, or if `topic` is none of them."""
        super().__init__(log.diagnostics)
        self._log = log
        self.close = log.close
        try:
            self._decoders = _choose(log, topic)
        except BaseException:
            log.close()
            raise
        self.topic = log.channels[next(iter(self._decoders))].topic
        self.polar = any(decoder.polar for decoder in self._decoders.values())
        self.frame_count = sum(log.counts.get(c, 0) for c in self._decoders)

    def __iter__(self) -> Iterator[StoredFrame]:
        channels, before, changes = set[int](), None, 0
        for number, message in enumerate(self._log.messages(self._decoders)):
            channels.add(message.channel)
            changes += message.channel != before
            before = message.channel
            name = f"message {number} of {self.topic}"
            if message.data is None or number in self.passed_over:
                yield StoredFrame(name, message.log_time, problem=message.problem)
            else:
                decode = self._decoders[message.channel]
                yield frame_of(name, message.log_time, decode, message.data, message.publish_time)
        if len(senders := {s for d in self._decoders.values() for s in d.senders}) > 1:
            self.diagnostics.note(
                f"{self.topic} mixes messages of frame_id {', '.join(sorted(senders)[:MOST_NAMED])}"
                "; if these are several sonars, write each to a log or topic of its own"
            )
        elif changes > 2 * len(channels):  # else they are parts of one recording
            self.diagnostics.note(
                f"messages of {len(channels)} channels take turns in {self.topic}; if these are "
                "several sonars, write each to a log or topic of its own"
            )


def _choose(log: Recording, topic: str | None) -> dict[int, Decoder]:
    """The decoder of every channel of the chosen topic."""
    decoders = image_decoders(log)
    topics = sorted({log.channels[c].topic for c in decoders})
    if not topics:
        raise SonarrecError(f"{log.path}: no image channel; {_held(log)}")
    if topic is None and len(topics) > 1:
        topics = sorted({log.channels[c].topic for c in decoders if log.counts.get(c)}) or topics
        if len(topics) > 1:
            raise UsageError(
                f"{log.path}: several image channels; choose one with --topic: {', '.join(topics)}"
            )
    if topic is not None and topic not in topics:
        kinds = [f" ({c.schema} is not read)" for c in log.channels.values() if c.topic == topic]
        kind, known = "".join(kinds[:1]), ", ".join(topics)
        raise UsageError(f"{log.path}: no image channel {topic!r}{kind}; there is {known}")
    chosen = topic or topics[0]
    unread = [c for n, c in log.channels.items() if n not in decoders and log.counts.get(n)]
    named = [f"{c.topic} ({c.schema})" for c in unread]
    if topic is None and not _OF_SONARS.search(chosen) and any(map(_OF_SONARS.search, named)):
        held = ", ".join([*filter(_OF_SONARS.search, named)][:MOST_NAMED])
        how = "`sonarrec help formats` has what to do"
        log.diagnostics.note(f"{chosen} is run, and {held} is not: a type that is not read; {how}")
    return {c: d for c, d in decoders.items() if log.channels[c].topic == chosen}


def _held(log: Recording) -> str:
    """What a recording without images holds, and what is wrong with it."""
    if not log.channels:
        deque(log.messages({}), 0)  # which tells why: chunks are looked into only now
    held = sorted(
        f"{c.topic} ({c.schema or 'no schema'}, {c.message_encoding or 'no encoding'})"
        for c in log.channels.values()
    )
    faults = [fault.removeprefix(f"{log.path.name}: ") for fault in log.diagnostics.faults]
    more = f" and {len(held) - MOST_NAMED} more" if len(held) > MOST_NAMED else ""
    holds = f"it holds {', '.join(held[:MOST_NAMED]) or 'no channel'}{more}"
    help_ = "; `sonarrec help formats` has the types that are read, and what to do with others"
    return f"{'; '.join([*faults[:1], holds])}{help_ if held else ''}"
