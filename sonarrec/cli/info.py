"""`sonarrec info`: the contents of a log, and how it would be read."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from sonarrec.cli import options
from sonarrec.cli.bars import progress
from sonarrec.cli.endings import FAILED, MISUSED, PARTLY, inform, leave, say, tell
from sonarrec.cli.groups import NEW_FILE, command, file_names, in_input, in_output
from sonarrec.cli.options_log import (
    GEOMETRY_TEXTS,
    LogChoice,
    log_options,
    many_logs_options,
    named_logs,
)
from sonarrec.errors import MissingError, SonarrecError, UsageError, local, name_as_text, number_of
from sonarrec.nouns import date_text, is_date

if TYPE_CHECKING:
    from sonarrec.readers.info import Container, Images, LogInfo
    from sonarrec.readers.named_logs import NamedLog


HEAD = "# Written by sonarrec info"
MOST_NUMBERS = 16
"""Of a list that the log itself states: more are not repeated in a sonar.toml."""


@command(short_help="Show what is in a log, and whether it is complete.")
@click.argument("log", shell_complete=file_names, nargs=-1)
@many_logs_options
@in_input(
    "--quick",
    is_flag=True,
    help="Read the summary and the first frames only; do not check every frame and checksum.",
)
@log_options(flags=True)
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
    log_choice: LogChoice,
    landmarks: str | None,
    preview: Path | None,
    write_sonar: Path | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Show what is in LOG, whether it is complete, and how `run` would read it.

    LOG is as in `sonarrec run`. Every frame is read and every checksum compared to see how many
    frames can be used; --quick leaves that out. An incomplete geometry is no fault. Exit code 3:
    part of the log cannot be used; 1: none of it can.

    \b
    Examples:
      sonarrec info sample_data/pan.mcap
      sonarrec info --quick *.mcap
      sonarrec info pings/ --tilt-deg 22 --preview pings.png
      sonarrec info dive.avi --range-max-m 8 --write-sonar dive.sonar.toml
    """
    from sonarrec.results.run_file import PROGRAM
    from sonarrec.tables.outputs import check_output

    logs = named_logs(log, from_file, recursive)
    names = [local(one.path) for one in logs]
    for option, file in (("--preview", preview), ("--write-sonar", write_sonar)):
        if file is not None and len(logs) > 1:
            raise UsageError(f"{option} {file}: for one log, but {len(logs)} are given")
    if write_sonar is not None:
        check_output(write_sonar, "table", names, header=HEAD)
    if preview is not None:
        if preview.suffix.lower() != ".png":
            raise UsageError(f"--preview {preview}: the name must end in .png")
        check_output(preview, "picture", names)
    shown = [
        _show(
            *(one, name, number),
            reading=log_choice.arguments(),
            landmarks=landmarks,
            quick=quick,
            preview=preview,
            write_sonar=write_sonar,
            as_json=as_json,
            quiet=quiet,
        )
        for number, (one, name) in enumerate(zip(logs, names, strict=True))
    ]
    if as_json:
        head = {"program": PROGRAM, "version": PROGRAM["version"]}
        click.echo(json.dumps({**head, "logs": [one.table for one in shown]}, indent=2))
    undone = {str(one.undone): one.undone for one in shown if one.undone is not None}
    if undone:
        *others, last = undone.values()
        tell(map(str, others))
        if any(one.undone is None and not one.is_useless for one in shown):
            tell([str(last)])
            leave(PARTLY)
        raise last
    if all(one.is_useless for one in shown):
        leave(MISUSED if all(one.is_missing for one in shown) else FAILED)
    if any(one.is_useless or one.is_faulty for one in shown):
        leave(PARTLY)


@dataclass(slots=True)
class _Shown:
    """The outcome of one log.

    table: for JSON. is_useless: not one frame can be used. is_missing: there is no such log.
    is_faulty: a part cannot be used. undone: why the preview or the trial of radii failed.
    """

    table: dict[str, Any]
    is_useless: bool
    is_missing: bool = False
    is_faulty: bool = False
    undone: SonarrecError | None = None


def _show(
    log: NamedLog,
    name: str,
    number: int,
    *,
    reading: dict[str, Any],
    landmarks: str | None,
    quick: bool,
    preview: Path | None,
    write_sonar: Path | None,
    as_json: bool,
    quiet: bool,
) -> _Shown:
    """Describe a log and print it. number: how many logs come before. reading: as for `open_log`.

    A fault of the log is printed; raises UsageError for options that cannot be used with it.
    """
    from sonarrec.readers import open_log
    from sonarrec.readers.info import describe
    from sonarrec.readers.open import find_log
    from sonarrec.results.run_file import read_run
    from sonarrec.runs.basis import chosen_landmarks

    path, reading = log.path, {**reading, "up_to": log.up_to}
    try:
        with progress(quiet) as step:
            log_info = describe(path, **reading, quick=quick, observe=step)
    except SonarrecError as error:
        is_missing = isinstance(error, MissingError)
        if isinstance(error, UsageError) and not is_missing:
            raise
        tell([str(error)])
        return _Shown({"path": name, "error": str(error)}, True, is_missing)
    table = _as_text(asdict(log_info))
    shown = _Shown(table, log_info.has_no_frame, is_faulty=log_info.has_problems)
    if not as_json:
        say(*([""] if number else []), *lines(log_info))
    try:
        if write_sonar is not None:
            missing = write_sonar_toml(write_sonar, log_info)
            lacks = f"complete {', '.join(missing)}" if missing else "nothing is missing"
            if not quiet:
                inform(f"{write_sonar}: written; {lacks}")
        if preview is not None:
            from sonarrec.drawing.geometry import draw_preview
            from sonarrec.drawing.pen import write_png

            source = find_log(path, reading["up_to"])
            landmark_set, _ = chosen_landmarks(source, landmarks, read_run(None))
            with open_log(path, **reading) as opened:
                first = next(iter(opened))
                stated = opened.sonar.height_m is not None
            picture = draw_preview(first.image, first.fan, landmark_set, height_stated=stated)
            write_png(preview, picture)
    except SonarrecError as error:
        shown.undone = error  # told after all logs
    return shown


def _as_text(value: Any) -> Any:
    """A table for JSON whose names of files are valid Unicode."""
    if isinstance(value, dict):
        return {key: _as_text(one) for key, one in value.items()}
    if isinstance(value, list):
        return [*map(_as_text, value)]
    return name_as_text(value) if isinstance(value, str) else value


def lines(info: LogInfo) -> list[str]:
    """A log described in lines of text."""
    size = f"{info.size_bytes / 1e6:.1f} MB" if info.size_bytes >= 1e5 else f"{info.size_bytes} B"
    kind = number_of(info.files, "image") if info.kind == "images" else info.kind
    out = [f"{info.path}: {kind}, {size}"]
    if info.container is None:
        for images in info.images:
            out += _recorded(images.start_ns, images.end_ns)
    else:
        out += _container_lines(info.container)
        container = info.container
        if not container.footer:
            whole = "no: cut short or damaged"
        elif info.faults:
            whole = "no: damaged"
        elif container.library == "SQLite":  # which has neither footer nor checksums
            sight = "yes: nothing is missing", "nothing is missing at first sight"
            whole = sight[not info.checked]
        elif not info.checked or not info.images:
            whole = "it has a footer; checksums not compared"
        else:
            whole = "yes: footer and checksums"
        out += _entry("whole", [whole])
    out += _entry(
        "faults", [fault.removeprefix(f"{Path(info.path).name}: ") for fault in info.faults]
    )
    for images in info.images:
        out += _images_lines(images)
    if not info.images:
        out += _entry("images", ["none: no channel holds messages that are read"])
    return out


def _entry(name: str, texts: list[str]) -> list[str]:
    """Lines under one heading."""
    return [f"  {name if n == 0 else '':<10}{text}" for n, text in enumerate(texts)]


def _container_lines(container: Container) -> list[str]:
    out = _recorded(container.start_ns, container.end_ns)
    writer = ", ".join(text for text in (container.profile, container.library) if text)
    out += _entry("writer", [writer] if writer else [])
    chunks = ", ".join(f"{count} {name}" for name, count in container.chunks.items())
    out += _entry("chunks", [chunks or "none"])
    rows = []
    for channel in container.channels:
        rate = ""
        start, end = container.start_ns, container.end_ns
        if start is not None and end is not None:
            more = channel.messages - 1
            rate = f"{more / (end - start) * 1e9:.4g} Hz" if end > start and more > 0 else ""
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
    return out + (_entry("channels", _columns(rows)) if rows else [])


def _recorded(start_ns: int | None, end_ns: int | None) -> list[str]:
    if start_ns is None or end_ns is None:
        return []
    clock = f"clock at {start_ns / 1e9:.3f} s"
    start = f"{date_text(start_ns)} UTC" if is_date(start_ns) else clock
    return _entry("recorded", [f"{start}, {(end_ns - start_ns) / 1e9:.1f} s long"])


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
    header = {key: value for key, value in images.header.items() if value is not None}
    sonar = [str(header.pop("sonar"))] if "sonar" in header else []
    cells = [f"{k} = {v}" if isinstance(v, str) else f"{k} = {v:.6g}" for k, v in header.items()]
    rows = [", ".join(cells[i : i + 3]) for i in range(0, len(cells), 3)]
    out += _entry("header", sonar + rows)
    out += _entry("geometry", _geometry_lines(images))
    out += _entry("notes", images.notes)
    return out + _entry("problems", images.problems)


def _geometry_lines(images: Images) -> list[str]:
    from sonarrec.sonar import Sonar

    geometry = Sonar(**images.geometry)
    parts = []
    if geometry.range_min_m is not None and geometry.range_max_m is not None:
        parts.append(f"{geometry.range_min_m:.4g} to {geometry.range_max_m:.4g} m")
    if geometry.bearings_deg is not None:
        low, high = min(geometry.bearings_deg), max(geometry.bearings_deg)
        parts.append(f"{len(geometry.bearings_deg)} beams from {low:.4g} to {high:.4g} deg")
    elif geometry.field_of_view_deg is not None:
        parts.append(f"{geometry.field_of_view_deg:g} deg")
    if geometry.tilt_deg is not None:
        parts.append(f"tilt {geometry.tilt_deg:g} deg")
    if geometry.height_m is not None:
        parts.append(f"height {geometry.height_m:g} m")
    out = [", ".join(parts), *_origin_lines(images)]
    if images.lacks:
        flags = " ".join(f"--{key.replace('_', '-')}" for key in images.lacks)
        or_height = " (or --height-m)" if "tilt_deg" in images.lacks else ""
        out.append(f"lacks {', '.join(images.lacks)}")
        out.append(
            f"give {flags}{or_height}, or put a sonar.toml beside the log, or into it if a folder:"
        )
        out.append("`sonarrec help geometry` has one to copy")
    return [text for text in out if text]


def _origin_lines(images: Images) -> list[str]:
    """The keys of the geometry by origin, a line each."""
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


def write_sonar_toml(path: Path, info: LogInfo) -> list[str]:
    """Write the file; the keys that are still missing. Raises UsageError if the log holds several
    sequences of images, or none."""
    from sonarrec.tables.outputs import write_page

    if len(info.images) != 1:
        topics = ", ".join(str(images.topic) for images in info.images)
        raise UsageError(
            f"--write-sonar {path}: the log holds "
            + (f"several image channels; choose with --topic: {topics}" if topics else "no images")
        )
    (images,) = info.images
    # A rename or a note may carry any character; a comment ends at the line's end.
    name = json.dumps(name_as_text(Path(info.path).name))
    lines = [f"{HEAD} for {name}.", *_sonar_lines(images)]
    write_page(path, "\n".join(lines) + "\n")
    return [line.split()[1] for line in lines if "# missing" in line]


def _sonar_lines(images: Images) -> list[str]:
    from sonarrec.sonar import Sonar

    stated = {"layout": images.layout} | images.geometry
    floor = {"tilt_deg", "height_m"}
    names = {"flag": "option", "default": "by default", "found": "found from the first pings"}
    lines = ["[sonar]"]
    for key in (field.name for field in fields(Sonar)):
        origin = images.origins.get(key, "default")
        if key in stated and origin in ("message", "header"):
            value = stated[key]
            several = isinstance(value, list) and len(value) > MOST_NUMBERS
            text = f"[{len(value)} values]" if several else _toml(value)
            lines.append(f"# {key} = {text}  # the log states it, ping by ping")
        elif key in stated:
            told = json.dumps(names.get(origin, name_as_text(origin)))[1:-1]
            lines.append(f"{key} = {_toml(stated[key])}  # {told}")
        elif key in images.lacks or (key in floor & set(GEOMETRY_TEXTS) and images.lacks):
            one_of = " One of tilt_deg and height_m is needed." if key in floor else ""
            if key in floor and floor & set(stated):
                lines.append(f"# {key} =  # not stated: {GEOMETRY_TEXTS[key]}")
            else:
                lines.append(f"# {key} =  # missing: {GEOMETRY_TEXTS[key]}{one_of}")
        elif key in images.assumed:
            value = images.assumed[key]
            lines.append(f"# {key} = {_toml(value)}  # assumed; state it if you know better")
    return lines


def _toml(value: Any) -> str:
    """A value as TOML writes it; JSON writes texts, numbers, lists and truth values alike."""
    return json.dumps(list(value) if isinstance(value, tuple) else value)
