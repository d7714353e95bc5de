"""`sonarrec info`: the contents of a log, and how it would be read."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from sonarrec.cli import options
from sonarrec.cli.endings import (
    FAILED,
    PARTLY,
    code_of,
    code_of_all,
    inform,
    leave,
    print_notes,
    progress,
    say,
)
from sonarrec.cli.groups import NEW_FILE, command, file_names, in_input, in_output
from sonarrec.errors import (
    SonarrecError,
    UsageError,
    command_line,
    name_as_text,
    number_of,
    refuse_url,
)
from sonarrec.sonar.frame import date_text, is_date

if TYPE_CHECKING:
    from sonarrec.readers.info import Container, Images, LogInfo
    from sonarrec.readers.named_logs import NamedLog

HEAD = "# Written by sonarrec info"


@command(short_help="Show what is in a log, and whether it is complete.")
@click.argument("log", shell_complete=file_names, nargs=-1)
@options.many_logs
@in_input(
    "--quick",
    is_flag=True,
    help="Read the summary and the first frames only; do not check every frame and checksum.",
)
@in_input(
    "--all every",
    is_flag=True,
    help="Decode all images of a folder, not 200 of them.",
)
@options.reading(geometry=True)
@options.landmarks
@in_output(
    "--preview",
    type=NEW_FILE,
    metavar="FILE.png",
    help="Draw range rings, bearings, the floor and three discs onto the first usable frame.",
)
@in_output(
    "--write-sonar",
    type=NEW_FILE,
    metavar="FILE",
    help="Write a sonar.toml from what is known; what is missing is marked.",
)
@options.json("Print JSON. Keys: sonarrec help info.")
@options.quiet
def info(
    log: tuple[str, ...],
    recursive: bool,
    from_file: IO[str] | None,
    quick: bool,
    every: bool,
    reading: dict[str, Any],
    landmarks: str | None,
    preview: Path | None,
    write_sonar: Path | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Show what is in LOG, whether it is complete, and how `run` would read it.

    LOG is as in `sonarrec run`; several get a row each. It is checked which frames can be used,
    unless --quick is given. An incomplete geometry is no fault. Exit code 3: part of the log cannot
    be used; 1: none can.

    \b
    Examples:
      sonarrec info sample_data/pan.mcap
      sonarrec info --quick *.mcap
      sonarrec info pings/ --tilt-deg 22 --preview pings.png
      sonarrec info dive.avi --range-max-m 8 --write-sonar dive.sonar.toml
    """
    from sonarrec.advice.log import of_log
    from sonarrec.readers.info import describe
    from sonarrec.results.identity import PROGRAM
    from sonarrec.tables.outputs import check_output

    logs = options.named_logs(log, from_file, recursive)
    names = [refuse_url(item.path) for item in logs]
    for option, file in (("--preview", preview), ("--write-sonar", write_sonar)):
        if file is not None and len(logs) > 1:
            raise UsageError(f"{option} {file}: for one log, but {len(logs)} are given")
    if write_sonar is not None:
        check_output(write_sonar, "table", names, header=HEAD)
    if preview is not None:
        if preview.suffix.lower() != ".png":
            raise UsageError(f"--preview {preview}: the name must end in .png")
        check_output(preview, "picture", names)
    about: LogInfo | None = None
    documents, codes = list[dict[str, Any]](), list[int]()
    several, width = len(logs) > 1, min(max(3, *map(len, names)), 40) if names else 3
    if several and not as_json:
        say(_row(width, ROW_HEADS))
    for item, name in zip(logs, names, strict=True):
        try:
            with progress(quiet) as step:
                about = describe(
                    item.path,
                    **reading,
                    up_to=item.up_to,
                    quick=quick,
                    every=every,
                    observe=step,
                    advise=of_log,
                )
        except SonarrecError as error:
            if several and not as_json:
                say(_row(width, (name, "-", "-", "-", "cannot be read")))
            print_notes([str(error)])
            documents.append({"path": name, "error": str(error)})
            codes.append(code_of(error))
            continue
        if several and not as_json:
            say(*(_row(width, cells) for cells in row_cells(about)))
        elif not as_json:
            say(*lines(about, reading["sonar"].as_options()))
        documents.append(asdict(about))
        codes.append(FAILED if about.has_no_frame else PARTLY * about.has_problems)
    if as_json:
        head = {"program": PROGRAM, "version": PROGRAM["version"]}
        click.echo(json.dumps({**head, "logs": documents}, indent=2))
    if write_sonar is not None and about is not None:
        missing = write_sonar_toml(write_sonar, about)
        lacks = f"now fill in {', '.join(missing)}" if missing else "nothing is missing"
        if not quiet:
            inform(f"{write_sonar}: written; {lacks}")
    if preview is not None and about is not None:
        _draw(preview, logs[0], reading, landmarks)
        if not quiet:
            inform(f"{preview}: the first usable frame with the geometry drawn onto it")
    if several and not as_json and any(codes):
        inform("`sonarrec info` of one log shows all that is known of it")
    leave(code_of_all(codes))


def _draw(preview: Path, log: NamedLog, reading: dict[str, Any], landmarks: str | None) -> None:
    """Draw the geometry onto the first usable frame. Raises SonarrecError if there is none."""
    from sonarrec.drawing.geometry import draw_preview
    from sonarrec.drawing.pen import write_png
    from sonarrec.readers import open_log
    from sonarrec.readers.open import find_log
    from sonarrec.results.run_file import read_run
    from sonarrec.runs.prepare import chosen_landmarks

    landmark_set, _ = chosen_landmarks(find_log(log.path, log.up_to), landmarks, read_run(None))
    with open_log(log.path, **reading, up_to=log.up_to) as opened:
        first = next(iter(opened))
        stated = opened.sonar
    write_png(preview, draw_preview(first.image, first.fan, landmark_set, stated))


# What is printed of many logs: a row each
ROW_HEADS = ("log", "frames", "span", "geometry", "state")
BRIEFLY = ("range_min_m", "range_max_m", "field_of_view_deg")
"""Keys of the geometry that the row has."""


def _row(width: int, cells: Sequence[str]) -> str:
    """A row of the table. width: of the names of logs."""
    log, frames, span, geometry, state = cells
    return f"{log:<{width}}  {frames:>9}  {span:>9}  {geometry:<26}  {state}"


def row_cells(info: LogInfo) -> Iterator[tuple[str, str, str, str, str]]:
    """The cells of a log, of each of its sequences of images: those of ROW_HEADS."""
    faulty = bool(info.faults) or (info.container is not None and not info.container.footer)
    broken = ["cut short or damaged"] if faulty else []
    if not info.images:
        yield info.path, "0", "-", "-", "; ".join([*broken, "no images"])
    for images in info.images:
        frames = "?" if images.frames is None else str(images.frames)
        if images.usable is not None and images.usable != images.frames:
            frames = f"{images.usable} of {frames}"
        span = "-"
        if images.start_ns is not None and images.end_ns is not None:
            span = f"{(images.end_ns - images.start_ns) / 1e9:.1f} s"
        elif images.frames and (rate_hz := images.geometry.get("frame_rate_hz")):
            span = f"{(images.frames - 1) / rate_hz:.1f} s"
        lacks = [f"lacks {', '.join(images.lacks)}"] if images.lacks else []
        notes = [number_of(len(images.notes), "note")] if images.notes else []
        name = info.path if images.topic is None or not info.images[1:] else images.topic
        sound = ["whole" if info.checked else "not checked"]
        state = "; ".join([*(broken + lacks or sound), *notes])
        brief = {key: images.geometry[key] for key in BRIEFLY if key in images.geometry}
        if beams := images.geometry.get("bearings_deg"):
            brief["field_of_view_deg"] = round(max(beams) - min(beams), 2)
        yield name, frames, span, ", ".join(_stated(brief)) or "-", state


# What is printed of a log: what is wrong first, notes last


def lines(info: LogInfo, given: Sequence[str] = ()) -> list[str]:
    """A log described in lines of text. given: the options of the geometry."""
    size = f"{info.size_bytes / 1e6:.1f} MB" if info.size_bytes >= 1e5 else f"{info.size_bytes} B"
    kind = number_of(info.files, "image") if info.kind == "images" else info.kind
    name = f"{Path(info.path).name}: "
    out = [
        f"{info.path}: {kind}, {size}",
        *_entry("whole", _completeness(info)),
        *_entry("faults", [fault.removeprefix(name) for fault in info.faults]),
        *_entry("problems", [line for images in info.images for line in images.problems]),
    ]
    if info.container is None:
        for images in info.images:
            out += _recorded(images.start_ns, images.end_ns)
    else:
        by_topic = {images.topic: images.rate_hz for images in info.images}
        out += _container_lines(info.container, by_topic)
    for images in info.images:
        out += _images_lines(images, Path(info.path), given)
    if not info.images:
        out += _entry("images", ["none: no channel holds messages that are read"])
    return out


def _entry(name: str, texts: Iterable[str]) -> list[str]:
    """Lines under one heading."""
    return [f"  {name if n == 0 else '':<10}{text}" for n, text in enumerate(filter(None, texts))]


def _completeness(info: LogInfo) -> Iterator[str]:
    """Whether an MCAP or a bag is complete."""
    if info.container is None:
        return
    if not info.container.footer:
        yield "no: cut short or damaged"
    elif info.faults:
        yield "no: damaged"
    elif info.container.library == "SQLite":  # which has neither footer nor checksums
        yield "yes: nothing is missing" if info.checked else "nothing is missing at first sight"
    elif not info.checked or not info.images:
        yield "it has a footer; checksums not compared"
    else:
        yield "yes: it has a footer, and its chunks fit the checksums they have"


def _recorded(start_ns: int | None, end_ns: int | None) -> list[str]:
    if start_ns is None or end_ns is None:
        return []
    clock = f"clock at {start_ns / 1e9:.3f} s"
    start = f"{date_text(start_ns)} UTC" if is_date(start_ns) else clock
    return _entry("recorded", [f"{start}, {(end_ns - start_ns) / 1e9:.1f} s long"])


def _container_lines(container: Container, by_topic: dict[str | None, float | None]) -> list[str]:
    """by_topic: rates of images, which pauses do not change."""
    start, end, rows = container.start_ns, container.end_ns, list[list[str]]()
    for channel in container.channels:
        intervals = channel.messages - 1
        rate = ""
        if hz := by_topic.get(channel.topic):
            rate = f"{hz:.4g} Hz"
        elif start is not None and end is not None and end > start and intervals > 0:
            rate = f"{intervals / (end - start) * 1e9:.4g} Hz"
        rows.append(
            [
                channel.topic,
                channel.schema or "no schema",
                channel.message_encoding or "no encoding",
                number_of(channel.messages, "message"),
                rate,
                "images" if channel.images else "",
            ]
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    chunks = ", ".join(f"{count} {name}" for name, count in container.chunks.items())
    return [
        *_recorded(start, end),
        *_entry("writer", [", ".join(filter(None, (container.profile, container.library)))]),
        *_entry("chunks", [chunks or "none"]),
        *_entry("channels", ("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)),
    ]


def _images_lines(images: Images, log: Path, given: Sequence[str]) -> list[str]:
    if images.usable is None:
        frames = f"{'?' if images.frames is None else images.frames}, not checked"
    else:
        once = ", once the geometry is complete" if images.lacks else ""
        frames = f"{images.usable} of {images.frames} can be used{once}"
        if images.decoded != images.frames:
            frames += f"; {images.decoded} of {images.frames} decoded (--all: every one)"
    size = ""
    if images.rows is not None:
        size = f"{images.columns} x {images.rows}, {images.pixels}, {images.layout}"
        if images.rate_hz is not None:
            size += f", {images.rate_hz:.4g} Hz"
        elif "frame_rate_hz" in images.geometry:
            size += f", {images.geometry['frame_rate_hz']:g} Hz as stated"
    header = {key: value for key, value in images.header.items() if value is not None}
    sonar = str(header.pop("sonar", ""))
    cells = [f"{k} = {v}" if isinstance(v, str) else f"{k} = {v:.6g}" for k, v in header.items()]
    rows = (", ".join(cells[i : i + 3]) for i in range(0, len(cells), 3))
    return [
        *(["", f"  {images.topic}"] if images.topic is not None else []),
        *_entry("frames", [frames]),
        *_entry("images", [size]),
        *_entry("header", [sonar, *rows]),
        *_entry("geometry", _geometry_lines(images, log, given)),
        *_entry("notes", images.notes),
    ]


def _geometry_lines(images: Images, log: Path, given: Sequence[str]) -> Iterator[str]:
    """The geometry, where each key is from, and what it lacks."""
    from sonarrec.readers.open import SONAR_FILE, misnamed, own_file

    known = images.geometry
    yield ", ".join(_stated(known))
    names = {"flag": "by flag", "message": "from the messages", "default": "by default"}
    names |= {"header": "from the headers", "found": "found from the pings", "assumed": "assumed"}
    by_origin: dict[str, list[str]] = {}
    for key, origin in images.origins.items():
        value = f" = {images.layout}" if key == "layout" and origin == "default" else ""
        value = f" = {known[key]}" if origin in ("found", "assumed") else value
        by_origin.setdefault(names.get(origin, f"from {origin}"), []).append(key + value)
    for key, value in images.assumed.items():
        text = ", ".join(f"{x:.4g}" for x in (value if isinstance(value, list) else [value]))
        text = f"[{text}]" if isinstance(value, list) else text
        by_origin.setdefault(names["default"], []).append(f"{key} = {text}")
    yield from (f"{origin}: {', '.join(keys)}" for origin, keys in by_origin.items())
    if images.lacks:
        flags = ", ".join(f"--{key.replace('_', '-')}" for key in images.lacks)
        flags = flags.replace("--tilt-deg", "--tilt-deg (or --height-m)")
        other = "" if images.geometry_from else misnamed(log, SONAR_FILE)
        yield f"lacks {', '.join(images.lacks)}{other}"
        if images.geometry_from is not None:
            yield f"give {flags}, or fill in {images.geometry_from}"
        else:
            topic = [] if images.topic is None else ["--topic", images.topic]
            yield f"give {flags}, or write a sonar.toml; to begin one:"
            file = own_file(log, SONAR_FILE)
            yield command_line("info", log, *topic, *given, "--write-sonar", file)


def _stated(known: dict[str, Any]) -> list[str]:
    """The values of a geometry in words: window, bearings, tilt and height, those that there are.

    known: keys of sonar.toml.
    """
    parts = []
    if {"range_min_m", "range_max_m"} <= set(known):
        parts.append(f"{known['range_min_m']:.4g} to {known['range_max_m']:.4g} m")
    if "bearings_deg" in known:
        beams = known["bearings_deg"]
        parts.append(f"{len(beams)} beams from {min(beams):.4g} to {max(beams):.4g} deg")
    elif "field_of_view_deg" in known:
        parts.append(f"{known['field_of_view_deg']:g} deg")
    parts += [f"tilt {known['tilt_deg']:g} deg"] if "tilt_deg" in known else []
    parts += [f"height {known['height_m']:g} m"] if "height_m" in known else []
    return parts


# A sonar.toml to complete


def write_sonar_toml(path: Path, info: LogInfo) -> list[str]:
    """Write the file; the keys that are still missing. Raises UsageError if the log holds several
    sequences of images, or none."""
    from sonarrec.tables.outputs import write_page

    if len(info.images) != 1:
        topics = ", ".join(str(images.topic) for images in info.images)
        several = f"several image channels; choose with --topic: {topics}"
        raise UsageError(
            f"--write-sonar {path}: the log holds {several if topics else 'no images'}"
        )
    # A rename or a note may carry any character; a comment ends at the line's end.
    name = json.dumps(name_as_text(Path(info.path).name))
    text = [f"{HEAD} for {name}.", "[sonar]", *_sonar_lines(info.images[0])]
    write_page(path, "\n".join(text) + "\n")
    return [line.split()[1] for line in text if "# missing" in line]


def _sonar_lines(images: Images) -> Iterator[str]:
    """A line for each key that is stated or missing; what the log states is a comment, since in a
    file it would overrule pings of other windows."""
    stated = {"layout": images.layout} | images.geometry
    for key, value in stated.items():
        by_log = images.origins.get(key) in ("message", "header")
        yield f"# {key}: the log states it" if by_log else f"{key} = {json.dumps(value)}"
    for key in images.lacks:
        yield f"# {key} =  # missing: {options.GEOMETRY_TEXTS[key]}"
    if "tilt_deg" in images.lacks:
        yield f"# height_m =  # in place of tilt_deg, or both: {options.GEOMETRY_TEXTS['height_m']}"
    if images.usable and images.start_ns is None and "frame_rate_hz" not in stated:
        yield "# frame_rate_hz =  # frames carry no time; without it 1 Hz is assumed"
