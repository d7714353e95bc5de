"""What is in a log and how it would be read: `sonarrec info`, for programs as well."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any

from sonarrec.geometry import Sonar, check_sonar, missing_keys, sonar_from_table
from sonarrec.readers import Log, Source, find_log
from sonarrec.readers.raw import RawFrame, RawLog
from sonarrec.records import SonarrecError, UsageError

Observe = Callable[[int | None], None]
_YEAR_2000_NS = 946_684_800 * 10**9


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of an MCAP file. schema, schema_encoding, message_encoding: as the file names
    them, schema empty where there is none. images: its messages are read as sonar images."""

    topic: str
    schema: str
    schema_encoding: str
    message_encoding: str
    messages: int
    images: bool


@dataclass(frozen=True, slots=True)
class Container:
    """What an MCAP file says of itself. footer: it has one, so it was closed. chunks: how many, by
    compression. start_ns, end_ns: first and last log time of all channels, None without a message.
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
    """One sequence of sonar images: of a channel, or all that a folder or video holds.

    topic: None outside of MCAP. frames: how many there are, None where the container does not
    tell. usable: how many `sonarrec run` can use once the geometry is complete, None where they
    were not read. rows, columns, pixels: the commonest size as stored, and the type ("uint8",
    "3 x uint8"). start_ns, end_ns: time of the first and last frame, rate_hz: frames a second
    between them, None where frames carry no time.
    layout: "fan" or "polar". polar_messages: the messages tell their own geometry. geometry: its
    keys as stated, or told by the first ping. lacks: the keys that are missing.
    notes: what was stated against the messages. problems: one line for each frame that cannot be
    used (at most 20, then a count).
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
    geometry: dict[str, Any]
    geometry_from: str | None
    lacks: list[str]
    notes: list[str]
    problems: list[str]


@dataclass(frozen=True, slots=True)
class LogInfo:
    """What is in one log.

    kind: "MCAP", "video" or "images". size_bytes: of all its files. container: None outside of
    MCAP. images: each sequence of sonar images; none where nothing can be read. checked: every
    frame was read and every checksum compared. faults: lines about what is wrong with the file as
    a whole.
    """

    path: str
    kind: str
    files: int
    size_bytes: int
    checked: bool
    container: Container | None
    images: list[Images]
    faults: list[str]

    def as_table(self) -> dict[str, Any]:
        """For JSON: every field by its name."""
        return asdict(self)

    @property
    def nothing(self) -> bool:
        """Whether not one frame can be used."""
        return not any(i.usable if self.checked else i.rows for i in self.images)

    @property
    def partly(self) -> bool:
        """Whether something cannot be used."""
        return bool(self.faults) or any(i.problems for i in self.images)


class _Watched:
    """A RawLog that keeps count of what passes through it."""

    def __init__(self, raw: RawLog, observe: Observe | None) -> None:
        self._raw = raw
        self._observe = observe
        self.frame_count, self.topic = raw.frame_count, raw.topic
        self.polar, self.faults = raw.polar, raw.faults
        self.frames = self.timed = 0
        self.sizes: Counter[tuple[int, int]] = Counter()
        self.pixels: Counter[str] = Counter()
        self.start_ns: int | None = None
        self.end_ns: int | None = None

    def __iter__(self) -> Iterator[RawFrame]:
        for frame in self._raw:
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
            if self._observe is not None:
                self._observe(self.frame_count)
            yield frame

    def close(self) -> None:
        """Close what is watched."""
        self._raw.close()

    def rate_hz(self) -> float | None:
        """Frames a second between the first and the last time."""
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
) -> LogInfo:
    """What is in a log: a folder or glob of images, a video or an MCAP file.

    sonar, sonar_file: the geometry, as of `open_log`. topic: look at this channel alone.
    quick: look at the first frame only, in place of reading and checking every one.
    observe: told at each frame how many there are, where that is known.
    Raises SonarrecError where there is no log or its geometry cannot be read, UsageError for a
    topic that is not there.
    """
    source = find_log(path)
    if topic is not None and not source.reader.has_topics:
        raise UsageError(f"{path}: --topic chooses a channel of an MCAP file; this is none")
    stated, where = source.stated_sonar(sonar or Sonar(), sonar_file)
    container: Container | None = None
    topics: Sequence[str | None] = [None]
    faults: list[str] = []
    if source.reader.has_topics:
        container, faults = _container(source.path)
        topics = sorted({c.topic for c in container.channels if c.images})
        if topic is not None and topic not in topics:
            there = ", ".join(map(str, topics)) or "none"
            raise UsageError(f"{path}: no image channel {topic!r}; there is {there}")
    images = []
    for each in [topic] if topic is not None else topics:
        found, more = _images(source, stated, where, each, quick, observe)
        images.append(found)
        faults += [fault for fault in more if fault not in faults]
    return LogInfo(
        path=str(source.path),
        kind="images" if source.reader.kind == "image" else source.reader.kind,
        files=len(source.files),
        size_bytes=sum(file.stat().st_size for file in source.files),
        checked=not quick,
        container=container,
        images=images,
        faults=faults,
    )


def _container(path: Path) -> tuple[Container, list[str]]:
    """An MCAP file's own account of itself, and what is wrong with it at first sight."""
    from sonarrec.readers.mcap.images import image_decoders, schema_of
    from sonarrec.readers.mcap.salvage import McapFile

    try:
        log = McapFile(path)
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    log.close()
    decoders = image_decoders(log)
    channels = []
    for channel in sorted(log.channels.values(), key=lambda c: (c.topic, c.id)):
        schema = schema_of(log, channel)
        channels.append(
            Channel(
                channel.topic,
                schema.name,
                schema.encoding,
                channel.message_encoding,
                log.counts[channel.id],
                channel.id in decoders,
            )
        )
    start, end = log.span or (None, None)
    header = log.header
    profile, library = (header.profile, header.library) if header is not None else ("", "")
    chunks = dict(sorted(log.chunks.items()))
    return Container(profile, library, log.whole, chunks, start, end, channels), log.faults


def _images(
    source: Source,
    stated: Sonar,
    where: str,
    topic: str | None,
    quick: bool,
    observe: Observe | None,
) -> tuple[Images, list[str]]:
    """Read one sequence of images as `sonarrec run` would, with stand-ins for missing geometry.

    where: names the geometry. Returns also the faults of the file that reading it brought up.
    """
    raw = _Watched(source.open(topic), observe)
    if stated.layout is None:
        stated = replace(stated, layout="polar" if raw.polar else "fan")
    lacks = [key for key in missing_keys(stated) if key == "tilt_deg" or not raw.polar]
    complete = _with_stand_ins(stated, lacks)
    problems: list[str] = []
    used = 0
    with Log(source.path, source.name, source.files, complete, raw, "log") as log:
        try:
            if not raw.polar:
                check_sonar(complete, where)
            for _ in islice(log, 1 if quick else None):
                used += 1
        except SonarrecError as error:
            problems += log.problems or [str(error).partition("\n")[0]]
        else:
            problems += log.problems
    size = raw.sizes.most_common(1)
    geometry = log.sonar.as_table()
    layout = geometry.pop("layout")
    images = Images(
        topic=topic,
        frames=raw.frame_count if quick else raw.frames,
        usable=None if quick else used,
        rows=size[0][0][0] if size else None,
        columns=size[0][0][1] if size else None,
        pixels=raw.pixels.most_common(1)[0][0] if size else None,
        start_ns=None if quick else raw.start_ns,
        end_ns=None if quick else raw.end_ns,
        rate_hz=None if quick else raw.rate_hz(),
        layout="polar" if raw.polar else layout,
        polar_messages=raw.polar,
        geometry={key: value for key, value in geometry.items() if key not in lacks},
        geometry_from=where if where != str(source.path) else None,
        lacks=lacks,
        notes=log.notes,
        problems=[p for p in problems if p not in raw.faults],
    )
    return images, raw.faults


def _with_stand_ins(stated: Sonar, lacks: list[str]) -> Sonar:
    """A geometry with something in place of what it lacks: which frames can be used does not
    depend on it."""
    near = stated.range_min_m if stated.range_min_m is not None else 0.0
    values = {
        "range_min_m": 0.0,
        "range_max_m": max(near, stated.height_m or 0.0) + 1.0,
        "tilt_deg": 0.0,
        "field_of_view_deg": 30.0,
    }
    return stated.updated(sonar_from_table({key: values[key] for key in lacks}, "stand-ins"))


# On the screen


def lines(info: LogInfo) -> list[str]:
    """The account of a log as text, for the screen."""
    size = f"{info.size_bytes / 1e6:.1f} MB" if info.size_bytes >= 1e5 else f"{info.size_bytes} B"
    kind = f"{info.files} images" if info.kind == "images" else info.kind
    out = [f"{info.path}: {kind}, {size}"]
    if info.container is not None:
        out += _container_lines(info.container)
        out += _entry("whole", [_whole(info, info.container)])
    out += _entry(
        "faults", [fault.removeprefix(f"{Path(info.path).name}: ") for fault in info.faults]
    )
    for images in info.images:
        out += _images_lines(images)
    if not info.images:
        out += _entry("images", ["none: no channel holds messages that are read"])
    return out


def _whole(info: LogInfo, container: Container) -> str:
    if not container.footer:
        return "no: cut short or damaged"
    if info.faults:
        return "no: damaged"
    return (
        "yes: footer and checksums" if info.checked else "it has a footer; checksums not compared"
    )


def _entry(name: str, texts: list[str]) -> list[str]:
    """Lines under one heading."""
    return [f"  {name if n == 0 else '':<10}{text}" for n, text in enumerate(texts)]


def _container_lines(container: Container) -> list[str]:
    out = []
    if container.start_ns is not None and container.end_ns is not None:
        seconds = (container.end_ns - container.start_ns) / 1e9
        out += _entry("recorded", [f"{_moment(container.start_ns)}, {seconds:.1f} s long"])
    writer = ", ".join(text for text in (container.profile, container.library) if text)
    out += _entry("writer", [writer] if writer else [])
    chunks = ", ".join(f"{count} {name}" for name, count in container.chunks.items())
    out += _entry("chunks", [chunks or "none"])
    if container.channels:
        out += _entry(
            "channels", _columns([_channel_row(c, container) for c in container.channels])
        )
    return out


def _channel_row(channel: Channel, container: Container) -> list[str]:
    rate = ""
    if container.start_ns is not None and container.end_ns is not None and channel.messages > 1:
        span = container.end_ns - container.start_ns
        rate = f"{(channel.messages - 1) / span * 1e9:.4g} Hz" if span > 0 else ""
    return [
        channel.topic,
        channel.schema or "no schema",
        channel.message_encoding or "no encoding",
        f"{channel.messages} messages",
        rate,
        "images" if channel.images else "",
    ]


def _columns(rows: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _images_lines(images: Images) -> list[str]:
    out = ["", f"  {images.topic}"] if images.topic is not None else []
    if images.usable is None:
        text = f"{'?' if images.frames is None else images.frames}, not checked"
    else:
        once = ", once the geometry is complete" if images.lacks else ""
        text = f"{images.usable} of {images.frames} can be used{once}"
    out += _entry("frames", [text])
    if images.rows is not None:
        text = f"{images.columns} x {images.rows}, {images.pixels}, {images.layout}"
        if images.rate_hz is not None:
            text += f", {images.rate_hz:.4g} Hz"
        elif "frame_rate_hz" in images.geometry:
            text += f", {images.geometry['frame_rate_hz']:g} Hz as stated"
        out += _entry("images", [text])
    out += _entry("geometry", _geometry_lines(images))
    out += _entry("notes", images.notes)
    return out + _entry("problems", images.problems)


def _geometry_lines(images: Images) -> list[str]:
    known = Sonar(**images.geometry)
    parts = []
    if known.range_min_m is not None and known.range_max_m is not None:
        parts.append(f"{known.range_min_m:.4g} to {known.range_max_m:.4g} m")
    if known.bearings_deg is not None:
        low, high = min(known.bearings_deg), max(known.bearings_deg)
        parts.append(f"{len(known.bearings_deg)} beams from {low:.4g} to {high:.4g} deg")
    elif known.field_of_view_deg is not None:
        parts.append(f"{known.field_of_view_deg:g} deg")
    if known.tilt_deg is not None:
        parts.append(f"tilt {known.tilt_deg:g} deg")
    if known.height_m is not None:
        parts.append(f"height {known.height_m:g} m")
    sources = ["the messages"] if images.polar_messages and images.rows is not None else []
    sources += [images.geometry_from] if images.geometry_from is not None else []
    out = [", ".join(parts) + (f" (from {' and '.join(sources)})" if sources else "")]
    if images.lacks:
        flags = " ".join(f"--{key.replace('_', '-')}" for key in images.lacks)
        out.append(f"lacks {', '.join(images.lacks)}")
        out.append(f"give {flags}, or put a sonar.toml beside the log")
    return [text for text in out if text]


def _moment(time_ns: int) -> str:
    """A time as a date where it can be one, else in seconds."""
    if time_ns < _YEAR_2000_NS:
        return f"clock at {time_ns / 1e9:.3f} s"
    return f"{datetime.fromtimestamp(time_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"
