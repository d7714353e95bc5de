"""`sonarrec info`: what is in a log, and how it would be read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from sonarrec.cli.bars import fetching, progress
from sonarrec.cli.endings import PARTLY, leave, tell
from sonarrec.cli.groups import INPUT, NEW_FILE, OUTPUT, command, file_names, option
from sonarrec.cli.options import landmarks_option, quiet_option
from sonarrec.cli.options_log import LogChoice, log_options, many_logs_options, named_logs
from sonarrec.cli.options_remote import CacheChoice, cache_options
from sonarrec.cli.passes import YEAR_2000_NS
from sonarrec.records import MissingError, SonarrecError, UsageError

if TYPE_CHECKING:
    from sonarrec.readers.info import Channel, Container, Images, LogInfo
    from sonarrec.readers.many import NamedLog
    from sonarrec.records import Origin
    from sonarrec.remote.find import RemoteLog


@command(short_help="Show what is in a log, and whether it is whole.")
@click.argument("log", shell_complete=file_names, nargs=-1)
@many_logs_options
@option(
    INPUT,
    "--quick",
    is_flag=True,
    help="Read the summary and the first frames only; do not check every frame and checksum.",
)
@log_options()
@landmarks_option
@option(
    OUTPUT,
    "--preview",
    type=NEW_FILE,
    metavar="FILE.png",
    help="Draw the stated geometry, and discs of the set to scale, onto the first usable frame.",
)
@option(OUTPUT, "--json", "as_json", is_flag=True, help="Print JSON. Keys: sonarrec help info.")
@cache_options
@quiet_option
# Long by its options and its help.
def info(
    log: tuple[str, ...],
    recursive: bool,
    from_file: IO[str] | None,
    quick: bool,
    log_choice: LogChoice,
    landmarks: str | None,
    preview: Path | None,
    as_json: bool,
    cache: CacheChoice,
    quiet: bool,
) -> None:
    """Show what is in LOG, whether it is whole, and how `run` would read it.

    LOG is an MCAP file, a bag of ROS 1 or 2, a folder of images, a video, a sonar's own file (ARIS,
    DIDSON, Oculus), a folder of logs, or a quoted glob of these. Every frame is read, and every
    checksum compared, to tell how many frames can be used; --quick leaves that out. A geometry that
    is incomplete is reported, but is no fault. Exit code 3: part of the log cannot be used; 1: none
    of it can. LOG may be on a server (`sonarrec help remote`).

    --preview draws range rings, bearings, the near edge of the stated floor and three discs of the
    landmark set onto the first usable frame: what is wrong with a geometry shows at a glance.

    \b
    Examples:
      sonarrec info sample_data/pan.mcap
      sonarrec info --quick *.mcap
      sonarrec info pings/ --tilt-deg 22 --preview pings.png
      sonarrec info --json dive.mcap | jq '.logs[0].images[].usable'
    """
    from sonarrec.results.run_file import PROGRAM

    tables: list[dict[str, Any]] = []
    useless = missing = faulty = 0
    undrawn: SonarrecError | None = None
    logs = named_logs(log, from_file, recursive)
    names = [_name(one) for one in logs]
    if preview is not None:
        _check_preview(preview, names)
    stated = log_choice.arguments()
    for number, (name, one) in enumerate(zip(names, logs, strict=True)):
        reading = {**stated}
        with ExitStack() as held:
            try:
                path, reading["up_to"], origin = _at_hand(one, cache, quiet, held)
                found = _described(path, reading, origin, quick, quiet)
            except SonarrecError as error:
                if isinstance(error, UsageError) and not isinstance(error, MissingError):
                    raise
                useless += 1
                missing += isinstance(error, MissingError)
                tables.append({"path": name, "error": str(error)})
                tell([str(error)])
                continue
            useless += found.nothing
            faulty += found.partly
            tables.append(found.as_table())
            if not as_json:
                click.echo("\n".join(["", *lines(found)] if number else lines(found)))
            if preview is not None:
                try:
                    _draw_preview(path, preview, landmarks, reading)
                except SonarrecError as error:  # told after the account, which says more
                    undrawn = error
    if as_json:
        head = {"program": PROGRAM, "version": PROGRAM["version"]}
        click.echo(json.dumps({**head, "logs": tables}, indent=2))
    if undrawn is not None:
        raise undrawn
    if useless == len(logs):
        leave(2 if missing == useless else 1)
    if useless or faulty:
        leave(PARTLY)


def _name(log: NamedLog | RemoteLog) -> str:
    from sonarrec.readers.many import NamedLog

    return log.path if isinstance(log, NamedLog) else log.shown


def _at_hand(
    log: NamedLog | RemoteLog, cache: CacheChoice, quiet: bool, held: ExitStack
) -> tuple[str, Path | None, Origin | None]:
    """(what to open, up to where what belongs to it lies, where it was fetched from)."""
    from sonarrec.readers.many import NamedLog
    from sonarrec.remote.fetch import fetched

    if isinstance(log, NamedLog):
        return log.path, log.up_to, None
    with fetching(quiet, log.shown) as came:
        found = held.enter_context(fetched(log, cache.cache(), came))
    return str(found.path), found.up_to, found.origin


def _described(
    path: str, reading: dict[str, Any], origin: Origin | None, quick: bool, quiet: bool
) -> LogInfo:
    from sonarrec.readers.info import describe

    with progress(quiet) as step, origin.translated() if origin else nullcontext():
        found = describe(path, **reading, quick=quick, observe=step)
    return found.fetched_from(origin) if origin else found


def _check_preview(preview: Path, logs: Sequence[str]) -> None:
    """Raises UsageError where the picture has no place of its own."""
    if len(logs) > 1:
        raise UsageError(f"--preview {preview}: draws one log; {len(logs)} are given")
    if preview.suffix.lower() != ".png":
        raise UsageError(f"--preview {preview}: a picture is written as NAME.png")
    from sonarrec.files.outputs import check_output

    check_output(preview, "picture", logs)


def _draw_preview(path: str, preview: Path, landmarks: str | None, reading: dict[str, Any]) -> None:
    """Write the first usable frame under its geometry. Raises SonarrecError where there is none."""
    from sonarrec.drawing.geometry import draw_preview
    from sonarrec.drawing.pen import write_png
    from sonarrec.landmarks import load_landmarks
    from sonarrec.readers import open_log

    landmark_set = load_landmarks(landmarks or "basin")
    with open_log(path, **reading) as opened:
        first = next(iter(opened))
    write_png(preview, draw_preview(first.image, first.fan, landmark_set))


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
    out += _entry("header", _header_lines(images))
    out += _entry("geometry", _geometry_lines(images))
    out += _entry("notes", images.notes)
    return out + _entry("problems", images.problems)


def _geometry_lines(images: Images) -> list[str]:
    from sonarrec.sonar import Sonar

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
    out = [", ".join(parts), *_origin_lines(images)]
    if images.lacks:
        flags = " ".join(f"--{key.replace('_', '-')}" for key in images.lacks)
        out.append(f"lacks {', '.join(images.lacks)}")
        out.append(f"give {flags}, or put a sonar.toml beside the log:")
        out.append("`sonarrec help geometry` has one to copy")
    return [text for text in out if text]


def _header_lines(images: Images) -> list[str]:
    """What the headers of a sonar's own file tell, but for what it did not measure."""
    known = {key: value for key, value in images.header.items() if value is not None}
    sonar = [str(known.pop("sonar"))] if "sonar" in known else []
    parts = [f"{k} = {v}" if isinstance(v, str) else f"{k} = {v:.6g}" for k, v in known.items()]
    return sonar + [", ".join(parts[i : i + 3]) for i in range(0, len(parts), 3)]


def _origin_lines(images: Images) -> list[str]:
    """Which values are from where, a line for each origin."""
    names = {"flag": "by flag", "message": "from the messages", "default": "by default"}
    names |= {"header": "from the headers", "found": "found from the pings", "assumed": "assumed"}
    lines: dict[str, list[str]] = {}
    for key, origin in images.origins.items():
        value = f" = {images.layout}" if key == "layout" and origin == "default" else ""
        value = f" = {images.geometry[key]}" if origin in ("found", "assumed") else value
        lines.setdefault(names.get(origin, f"from {origin}"), []).append(key + value)
    for key, value in images.assumed.items():
        numbers = value if isinstance(value, list) else [value]
        text = ", ".join(f"{number:.4g}" for number in numbers)
        text = f"[{text}]" if isinstance(value, list) else text
        lines.setdefault(names["default"], []).append(f"{key} = {text}")
    return [f"{origin}: {', '.join(keys)}" for origin, keys in lines.items()]


def _moment(time_ns: int) -> str:
    """A time as a date where it can be one, else in seconds."""
    if time_ns < YEAR_2000_NS:
        return f"clock at {time_ns / 1e9:.3f} s"
    return f"{datetime.fromtimestamp(time_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"
