"""What is in a log and how it would be read: `sonarrec info`, for programs as well."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

from sonarrec.errors import Diagnostics, SonarrecError, UsageError, name_as_text
from sonarrec.geometry import floor_depth
from sonarrec.nouns import Frame
from sonarrec.readers.log import Log
from sonarrec.readers.open import Source, find_log
from sonarrec.readers.plausible import Plausibility
from sonarrec.readers.raw import RawLog
from sonarrec.sonar import Sonar, sonar_from_table

Observe = Callable[[int | None], None]


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of an MCAP file or a bag.

    schema, schema_encoding, message_encoding: as in the file; schema is empty if there is none.
    images: whether its messages are read as sonar images.
    """

    topic: str
    schema: str
    schema_encoding: str
    message_encoding: str
    messages: int
    images: bool


@dataclass(frozen=True, slots=True)
class Container:
    """What an MCAP file or a bag says about itself.

    footer: whether it was closed: an MCAP has its footer, and a bag all its parts. chunks: number
    of chunks by compression. start_ns, end_ns: first and last log time of all channels; None
    without messages.
    """

    profile: str
    library: str
    footer: bool
    chunks: dict[str, int]
    start_ns: int | None
    end_ns: int | None
    channels: list[Channel]


@dataclass(frozen=True, slots=True)
class Images:
    """One sequence of sonar images: those of a channel, or all in a folder or video.

    topic: None outside of MCAP and bags. frames: number of frames; None if the container does not
    say. usable: how many `sonarrec run` can use once the geometry is complete; None if they were
    not read. rows, columns, pixels: the commonest stored size, and the type ("uint8", "3 x uint8").
    start_ns, end_ns: time of the first and last frame. rate_hz: frames per second between them.
    These three are None if frames carry no time.
    layout: "fan" or "polar". polar_messages: whether messages state their own geometry. header:
    other values in the headers of a sonar's own file, by name and unit; else empty. geometry: its
    keys, as stated or from the first ping. origins: where each of these keys, and the layout, comes
    from: "flag", "message", "header", "default" or the name of a file; a beam_order that nobody
    stated is "found" or "assumed". assumed: values used for keys that nobody states, if the
    geometry is complete. lacks: the missing keys. notes: contradictions and what is uncertain.
    problems: one line for each frame that cannot be used (at most 20, then a count).
    """

    topic: str | None
    frames: int | None
    usable: int | None
    rows: int | None
    columns: int | None
    pixels: str | None
    start_ns: int | None
    end_ns: int | None
    rate_hz: float | None
    layout: str
    polar_messages: bool
    header: dict[str, str | float | None]
    geometry: dict[str, Any]
    geometry_from: str | None
    origins: dict[str, str]
    assumed: dict[str, Any]
    lacks: list[str]
    notes: list[str]
    problems: list[str]


@dataclass(frozen=True, slots=True)
class LogInfo:
    """What is in one log.

    kind: "images", or as in `READERS`, such as "MCAP". size_bytes: of all files. container: None
    outside of MCAP and bags. images: each sequence of sonar images; empty if nothing can be read.
    checked: whether every frame was read and every checksum compared. faults: lines about what is
    wrong with the file as a whole.
    """

    path: str
    kind: str
    files: int
    size_bytes: int
    checked: bool
    container: Container | None
    images: list[Images]
    faults: list[str]

    @property
    def has_no_frame(self) -> bool:
        """Whether not one frame can be used."""
        return not any(i.usable if self.checked else i.rows for i in self.images)

    @property
    def has_problems(self) -> bool:
        """Whether a part of the log cannot be used."""
        return bool(self.faults) or any(i.problems for i in self.images)


@dataclass(slots=True)
class _Counts:
    """What the raw frames of a log are, by size, type and time. observe: as in `describe`."""

    frame_count: int | None
    observe: Observe | None
    frames: int = 0
    timed: int = 0
    sizes: Counter[tuple[int, int]] = field(default_factory=Counter)
    pixels: Counter[str] = field(default_factory=Counter)
    start_ns: int | None = None
    end_ns: int | None = None

    def add(self, frame: Frame) -> None:
        """Count a frame."""
        self.frames += 1
        if frame.timestamp_ns is not None:
            self.timed += 1
            self.start_ns = frame.timestamp_ns if self.start_ns is None else self.start_ns
            self.end_ns = frame.timestamp_ns
        if frame.pixels is not None:
            rows, columns, *channels = frame.pixels.shape
            self.sizes[rows, columns] += 1
            name = frame.pixels.dtype.newbyteorder("=").name
            self.pixels[f"{channels[0]} x {name}" if channels else name] += 1
        if self.observe is not None:
            self.observe(self.frame_count)

    def rate_hz(self) -> float | None:
        """Frames per second between the first and the last time; None if unknown."""
        if self.start_ns is None or self.end_ns is None or self.end_ns <= self.start_ns:
            return None
        return (self.timed - 1) / (self.end_ns - self.start_ns) * 1e9


def describe(
    path: str | Path,
    *,
    sonar: Sonar | None = None,
    sonar_file: Path | None = None,
    topic: str | None = None,
    quick: bool = False,
    observe: Observe | None = None,
    up_to: Path | None = None,
) -> LogInfo:
    """Find out what is in a log: images, a video, an MCAP, a ROS bag or a sonar's own file.

    sonar, sonar_file: the geometry, as for `open_log`. topic: only this channel. quick: read only
    the first frame, instead of reading and checking all. observe: called at each frame with the
    number of frames, or None if that is unknown. up_to: the highest folder searched for sonar.toml.
    Raises SonarrecError if there is no log or its geometry cannot be read, UsageError if there is
    no such topic.
    """
    source = find_log(path, up_to)
    source.check_topic(topic, path)
    flags = sonar or Sonar()
    stated, where = source.stated_sonar(flags, sonar_file)
    container: Container | None = None
    topics: Sequence[str | None] = [None]
    if source.reader.has_topics:
        container = _container(source)
        topics = sorted({c.topic for c in container.channels if c.images})
        if topic is not None and topic not in topics:
            there = ", ".join(map(str, topics)) or "none"
            raise UsageError(f"{path}: no image channel {topic!r}; there is {there}")
    images, faults = [], source.diagnostics.faults
    for name in [topic] if topic is not None else topics:
        of_topic = replace(source, diagnostics=Diagnostics(source.path))
        images.append(_images(of_topic, of_topic.open(name), stated, where, flags, quick, observe))
        faults += [f for f in of_topic.diagnostics.faults if f not in faults]
    size = 0
    for file in source.files:
        with suppress(OSError):  # reported as an unusable frame
            size += file.stat().st_size
    return LogInfo(
        path=name_as_text(source.path),
        kind="images" if source.reader.kind == "image" else source.reader.kind,
        files=len(source.files),
        size_bytes=size,
        checked=not quick,
        container=container,
        images=images,
        faults=faults,
    )


def _container(source: Source) -> Container:
    """What a recording says about itself; its messages are read only if no channel is found."""
    from sonarrec.readers.messages.images import image_decoders

    log = source.recording()
    if not log.channels:
        deque(log.messages({}), 0)  # which tells why: chunks are looked into only now
    log.close()
    decoders = image_decoders(log)
    channels = [
        Channel(
            channel.topic,
            channel.schema,
            channel.schema_encoding,
            channel.message_encoding,
            log.counts.get(number, 0),
            number in decoders,
        )
        for number, channel in sorted(log.channels.items(), key=lambda c: (c[1].topic, c[0]))
    ]
    start, end = log.span or (None, None)
    chunks = dict(sorted(log.chunks.items()))
    return Container(log.profile, log.library, log.whole, chunks, start, end, channels)


def _images(
    source: Source,
    raw: RawLog,
    stated: Sonar,
    where: str,
    flags: Sonar,
    quick: bool,
    observe: Observe | None,
) -> Images:
    """Read one sequence of images as `sonarrec run` would, with stand-ins for missing geometry.
    stated: the geometry by file and flags. where: its name in messages. flags: what they state."""
    sonar = raw.geometry(stated)
    lacks = [key for key in sonar.missing() if key == "tilt_deg" or not raw.polar]
    # Which frames can be used does not depend on the stand-ins.
    stand_ins = {
        "range_min_m": 0.0,
        "range_max_m": max(sonar.range_min_m or 0.0, sonar.height_m or 0.0) + 1.0,
        "tilt_deg": 0.0,
        "field_of_view_deg": 30.0,
    }
    complete = sonar.updated(sonar_from_table({k: stand_ins[k] for k in lacks}, "stand-ins"))
    usable, plausibility, why = 0, Plausibility(), []
    counts = _Counts(raw.frame_count, observe)
    with Log(source, complete, raw, "log", counts.add) as log:
        try:
            if not raw.polar:
                complete.complete(where)
            for frame in islice(log, 1 if quick else None):
                usable += 1
                plausibility.look(frame)
        except SonarrecError as error:
            why = [] if log.diagnostics.problems else [error.line]
    geometry = log.sonar.as_table()
    theirs = "header" if raw.header_info.values else "message" if raw.polar else "default"
    origins = {
        key: "flag" if getattr(flags, key) is not None
        else where if getattr(stated, key) is not None
        else theirs
        for key in geometry
        if key not in lacks
    }  # fmt: skip
    if log.order_from is not None:
        origins["beam_order"] = log.order_from
    layout = geometry.pop("layout")
    polar = raw.polar or layout == "polar"
    doubts = [] if lacks else plausibility.contradictions()
    assumed: dict[str, Any] = {}
    if not lacks and log.fan is not None:
        fan = log.fan
        if not polar:
            assumed["metres_per_pixel"] = fan.metres_per_pixel
            assumed["apex_px"] = [fan.apex_column, fan.apex_row]
        assumed["tilt_deg"], assumed["height_m"] = fan.tilt_deg, floor_depth(fan)
        if not counts.timed:
            assumed["frame_rate_hz"] = 1.0
    rows, columns = next(iter(counts.sizes.most_common(1)), ((None, None), 0))[0]
    return Images(
        topic=raw.topic,
        frames=raw.frame_count if quick else counts.frames,
        usable=None if quick else usable,
        rows=rows,
        columns=columns,
        pixels=next((name for name, _ in counts.pixels.most_common(1)), None),
        start_ns=None if quick else counts.start_ns,
        end_ns=None if quick else counts.end_ns,
        rate_hz=None if quick else counts.rate_hz(),
        layout="polar" if raw.polar else layout,
        polar_messages=raw.polar,
        header=dict(raw.header_info.values),
        geometry={key: value for key, value in geometry.items() if key not in lacks},
        geometry_from=where if where != name_as_text(source.path) else None,
        origins=origins,
        assumed={k: value for k, value in assumed.items() if getattr(log.sonar, k) is None},
        lacks=lacks,
        notes=[*log.diagnostics.notes, *doubts],
        problems=log.diagnostics.skipped or why,
    )
