"""What is in a log and how it would be read: `sonarrec info`, for programs as well."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

from sonarrec.errors import Advice, Diagnostics, SonarrecError, UsageError, name_as_text
from sonarrec.readers.containers.images import ImageFiles
from sonarrec.readers.log import FIRST_FRAMES, Log
from sonarrec.readers.open import Source, find_log
from sonarrec.readers.raw import RawLog, StoredFrame
from sonarrec.sonar.frame import Frame
from sonarrec.sonar.geometry import floor_depth
from sonarrec.sonar.stated import Sonar, sonar_from_table
from sonarrec.stretches import Rate

Observe = Callable[[int | None], None]
Advise = Callable[[Log, Sequence[Frame]], Iterable[Advice]]
SAMPLE, TOGETHER = 200, FIRST_FRAMES
"""Images of a folder that are decoded, and how many of them follow each other: so equal neighbours
are seen."""
MOST_TOPICS = 8
"""Image topics of a log that are read when none is chosen; each takes a pass over the log."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of an MCAP file or a bag."""

    topic: str
    schema: str
    schema_encoding: str
    message_encoding: str
    """schema, schema_encoding, message_encoding: as in the file; schema is empty if there is
    none."""
    messages: int
    images: bool
    """Whether its messages are read as sonar images."""


@dataclass(frozen=True, slots=True)
class Container:
    """What an MCAP file or a bag says about itself."""

    profile: str
    library: str
    footer: bool
    """Whether it was closed: an MCAP has its footer, and a bag all its parts."""
    chunks: dict[str, int]
    """Number of chunks by compression."""
    start_ns: int | None
    end_ns: int | None
    """start_ns, end_ns: first and last log time of all channels; None without messages."""
    channels: list[Channel]


@dataclass(slots=True)
class Images:
    """One sequence of sonar images: those of a channel, or all in a folder or video."""

    topic: str | None
    """None outside of MCAP and bags."""
    frames: int | None = 0
    """Number of frames; None if the container does not say."""
    usable: int | None = 0
    """How many `sonarrec run` can use once the geometry is complete; None if they were not read."""
    decoded: int | None = 0
    """How many were decoded, or could not be. Of the others in a folder of images only header and
    end were looked at. None if they were not read."""
    rows: int | None = None
    columns: int | None = None
    pixels: str | None = None
    """rows, columns, pixels: the commonest stored size, and the type ("uint8", "3 x uint8")."""
    start_ns: int | None = None
    end_ns: int | None = None
    """start_ns, end_ns: time of the first and last frame."""
    rate_hz: float | None = None
    """Frames per second, as the median step from frame to frame has it. These three are None if
    frames carry no time."""
    layout: str = "polar"
    """Either "fan" or "polar"."""
    polar_messages: bool = False
    """Whether messages state their own geometry."""
    header: dict[str, str | float | None] = field(default_factory=dict)
    """Other values in the headers of a sonar's own file, by name and unit; else empty."""
    geometry: dict[str, Any] = field(default_factory=dict)
    """Its keys, as stated or from the first ping."""
    geometry_from: str | None = None
    origins: dict[str, str] = field(default_factory=dict)
    """Where each of these keys, and the layout, comes from: "flag", "message", "header", "default"
    or the name of a file; a beam_order that nobody stated is "found" or "assumed"."""
    assumed: dict[str, Any] = field(default_factory=dict)
    """Values used for keys that nobody states, if the geometry is complete."""
    lacks: list[str] = field(default_factory=list)
    """The missing keys."""
    notes: list[str] = field(default_factory=list)
    """Contradictions and what is uncertain."""
    problems: list[str] = field(default_factory=list)
    """One line for each frame that cannot be used (at most 20, then a count)."""


@dataclass(frozen=True, slots=True)
class LogInfo:
    """What is in one log."""

    path: str
    kind: str
    """Either "images", or as in `READERS`, such as "MCAP"."""
    files: int
    size_bytes: int
    """Of all files."""
    checked: bool
    """Whether every frame was looked at and every checksum compared."""
    container: Container | None
    """None outside of MCAP and bags."""
    images: list[Images]
    """Each sequence of sonar images; empty if nothing can be read."""
    faults: list[str]
    """Lines about what is wrong with the file as a whole."""

    @property
    def has_no_frame(self) -> bool:
        """Whether not one frame can be used."""
        return not any(i.usable if self.checked else i.rows for i in self.images)

    @property
    def has_problems(self) -> bool:
        """Whether a part of the log cannot be used."""
        return bool(self.faults) or any(i.problems for i in self.images)


def describe(
    path: str | Path,
    *,
    sonar: Sonar | None = None,
    sonar_file: Path | None = None,
    topic: str | None = None,
    quick: bool = False,
    every: bool = False,
    observe: Observe | None = None,
    up_to: Path | None = None,
    advise: Advise | None = None,
) -> LogInfo:
    """Find out what is in a log: images, a video, an MCAP, a ROS bag or a sonar's own file.

    sonar, sonar_file: the geometry, as for `open_log`. topic: only this channel. quick: read only
    the first frame, instead of reading and checking all. every: decode every image of a folder,
    not a sample of SAMPLE. observe: called at each frame with the
    number of frames, or None if that is unknown. up_to: the highest folder searched for sonar.toml.
    advise: called with each log whose geometry is complete, for its notes.
    Raises SonarrecError if there is no log or its geometry cannot be read, UsageError if there is
    no such topic.
    """
    source = find_log(path, up_to)
    source.check_topic(topic, path)
    flags = sonar or Sonar()
    stated = source.stated_sonar(flags, sonar_file)
    container: Container | None = None
    topics: Sequence[str | None] = [None]
    all_topics: Sequence[str] = ()
    if source.reader.has_topics:
        container = _container(source)
        topics = all_topics = sorted({c.topic for c in container.channels if c.images})
        if topic is not None and topic not in topics:
            known = ", ".join(map(str, topics)) or "none"
            raise UsageError(f"{path}: no image channel {topic!r}; there is {known}")
    images, faults = [], source.diagnostics.faults
    if len(topics) > MOST_TOPICS and topic is None and container is not None:
        counts = Counter({c.topic: c.messages for c in container.channels if c.images})
        topics = sorted(name for name, _ in counts.most_common(MOST_TOPICS))
    for name in [topic] if topic is not None else topics:
        of_topic = replace(source, diagnostics=Diagnostics(source.path))
        raw = of_topic.open(name)
        if isinstance(raw, ImageFiles) and not every:
            raw.sample = _sample(len(raw.files))
        images.append(_images(of_topic, raw, stated, flags, quick, observe, advise))
        faults += [f for f in of_topic.diagnostics.faults if f not in faults]
    if len(images) < len(all_topics) and topic is None:
        more = f"{len(all_topics)} image topics, of which {len(images)} are read here"
        images[0].notes.insert(0, f"{more}, those with most messages; --topic reads another")
    size = sum(map(_size, source.files))
    kind = "images" if source.reader.kind == "image" else source.reader.kind
    name, files = name_as_text(source.path), len(source.files)
    return LogInfo(name, kind, files, size, not quick, container, images, faults)


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return 0


def _sample(count: int) -> set[int] | None:
    """Numbers of SAMPLE frames, spread evenly, TOGETHER at a time; None: all."""
    if count <= SAMPLE:
        return None
    steps = SAMPLE // TOGETHER - 1
    firsts = [n * (count - TOGETHER) // steps for n in range(steps + 1)]
    return {first + n for first in firsts for n in range(TOGETHER)}


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
            topic=c.topic,
            schema=c.schema,
            schema_encoding=c.schema_encoding,
            message_encoding=c.message_encoding,
            messages=log.counts.get(number, 0),
            images=number in decoders,
        )
        for number, c in sorted(log.channels.items(), key=lambda c: (c[1].topic, c[0]))
    ]
    chunks = dict(sorted(log.chunks.items()))
    start, end = log.span or (None, None)
    return Container(log.profile, log.library, log.complete, chunks, start, end, channels)


def _images(
    source: Source,
    raw: RawLog,
    stated: tuple[Sonar, str],
    flags: Sonar,
    quick: bool,
    observe: Observe | None,
    advise: Advise | None,
) -> Images:
    """Read one sequence of images as `sonarrec run` would, with stand-ins for missing geometry.
    stated: the geometry by file and flags, its name in messages. flags: what they state."""
    sonar, where = raw.geometry(stated[0]), stated[1]
    lacks = [key for key in sonar.missing() if key == "tilt_deg" or not raw.polar]
    bins = sonar.ranges_m or (0.0,)
    # Which frames can be used does not depend on the stand-ins.
    stand_ins = {
        "range_min_m": 0.0,
        "range_max_m": 1 + max(sonar.range_min_m or 0.0, sonar.height_m or 0.0, *bins[-1:]),
        "tilt_deg": 0.0,
        "field_of_view_deg": 30.0,
    }
    complete = sonar.updated(sonar_from_table({k: stand_ins[k] for k in lacks}, "stand-ins"))
    images = Images(raw.topic, lacks=lacks, polar_messages=raw.polar)
    sizes, types, times = Counter[tuple[int, ...]](), Counter[str](), list[int]()
    count = usable = decoded = 0
    rate = Rate()

    def inspect(frame: StoredFrame) -> None:
        nonlocal count, decoded, usable
        count += 1
        decoded += not frame.complete
        usable += frame.complete
        if frame.time_ns is not None:
            rate.add(frame.time_ns)
            times[1:] = [frame.time_ns]  # the first and the last
        if frame.pixels is not None:
            shape, name = frame.pixels.shape, frame.pixels.dtype.newbyteorder("=").name
            sizes[shape[:2]] += 1
            types[f"{shape[2]} x {name}" if len(shape) > 2 else name] += 1
        if observe is not None:
            observe(raw.frame_count)

    first = list[Frame]()
    with Log(source, complete, raw, "log", inspect) as log:
        try:
            if not raw.polar:
                complete.complete(where)
            for frame in islice(log, 1 if quick else None):
                usable += 1
                if isinstance(raw, ImageFiles):
                    raw.used(frame.index)
                first += [frame] if len(first) < FIRST_FRAMES else []
        except SonarrecError as error:
            images.problems = [] if log.diagnostics.problems else [str(error)]
    images.problems = log.diagnostics.skipped or images.problems
    images.frames = raw.frame_count if quick else count
    images.usable, images.decoded = (None, None) if quick else (usable, decoded)
    for (rows, columns), _ in sizes.most_common(1):
        images.rows, images.columns, images.pixels = rows, columns, types.most_common(1)[0][0]
    if times and not quick:
        images.start_ns, images.end_ns = times[0], times[-1]
        images.rate_hz = rate.hz
    geometry = log.sonar.as_table()
    default = "header" if raw.header_info.values else "message" if raw.polar else "default"
    for key in (key for key in geometry if key not in lacks):
        origin = where if getattr(stated[0], key) is not None else default
        images.origins[key] = "flag" if getattr(flags, key) is not None else origin
    if log.order_from is not None:
        images.origins["beam_order"] = log.order_from
    layout = geometry.pop("layout")
    images.layout = "polar" if raw.polar else layout
    images.header = dict(raw.header_info.values)
    images.geometry = {key: value for key, value in geometry.items() if key not in lacks}
    images.geometry_from = where if where != name_as_text(source.path) else None
    images.notes = [*log.diagnostics.notes]
    if advise is not None and not lacks:
        images.notes += (line.text for line in advise(log, first))
    if not lacks and (fan := log.fan) is not None:
        if images.layout != "polar":
            images.assumed["metres_per_pixel"] = fan.metres_per_pixel
            images.assumed["apex_px"] = [fan.apex_column, fan.apex_row]
        images.assumed |= {"tilt_deg": fan.tilt_deg, "height_m": floor_depth(fan)}
        if not times:
            images.assumed["frame_rate_hz"] = 1.0
        images.assumed = {k: v for k, v in images.assumed.items() if getattr(log.sonar, k) is None}
    return images
