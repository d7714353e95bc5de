"""What `sonarrec info` prints of a log, and the sonar.toml that it writes."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sonarrec.cli.options_log import GEOMETRY_TEXTS
from sonarrec.errors import UsageError, name_as_text, number_of
from sonarrec.times import date_text, is_date

if TYPE_CHECKING:
    from sonarrec.readers.guess.outline import FanOutline
    from sonarrec.readers.info import Container, Images, LogInfo

HEAD = "# Written by sonarrec info"
MOST_NUMBERS = 16
"""Of a list that the log itself states: more are not repeated in a sonar.toml."""


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
    out += _entry("outline", _outline_lines(images))
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


def _untold_outline(images: Images) -> FanOutline | None:
    """The fan in the images, if something of the geometry that it tells is not stated."""
    return images.outline if set(images.lacks) - {"tilt_deg"} else None


def _outline_lines(images: Images) -> list[str]:
    found = _untold_outline(images)
    if found is None:
        return []
    lines = [
        f"the images show a fan of {found.view_deg:.1f} deg with "
        f"apex_px = [{found.apex_column:.1f}, {found.apex_row:.1f}]",
        f"and {found.ends}",
    ]
    if found.far_px is None:
        return lines
    near = None if found.near_px is None else found.near_px / found.far_px
    less = ", or less if it is dark or cut off there"
    range_max_m = images.geometry.get("range_max_m")
    if range_max_m is None:
        lines.append(f"metres_per_pixel is range_max_m / {found.far_px:.1f}")
        if near is not None:
            lines.append(f"range_min_m is about {near:.3f} of range_max_m{less}")
    else:
        lines.append(f"metres_per_pixel is {range_max_m / found.far_px:.4g}")
        if near is not None:
            lines.append(f"range_min_m is about {near * range_max_m:.3g}{less}")
    return lines


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

    shown = _shown(images)
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
        elif key in shown:
            lines.append(shown[key])
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


def _shown(images: Images) -> dict[str, str]:
    """Lines on keys that are missing but that the pictures show."""
    found, stated = _untold_outline(images), images.geometry
    if found is None:
        return {}
    sure = "  # as the images show"
    apex = _toml([round(found.apex_column, 1), round(found.apex_row, 1)])
    lines = {"apex_px": f"apex_px = {apex}{sure}"}
    if "field_of_view_deg" in images.lacks:
        lines["field_of_view_deg"] = f"field_of_view_deg = {found.view_deg:.1f}{sure}"
    if found.far_px is not None and "metres_per_pixel" not in stated:
        far = stated.get("range_max_m")
        scale = f"range_max_m / {found.far_px:.1f}" if far is None else f"{far / found.far_px:.4g}"
        comment = "# " if far is None else ""
        lines["metres_per_pixel"] = f"{comment}metres_per_pixel = {scale}{sure}"
        if found.near_px is not None and "range_min_m" in images.lacks:
            share = f"{found.near_px / found.far_px:.3f} range_max_m or less"
            lines["range_min_m"] = f"# range_min_m =  # missing: {share}, as the images show"
    return lines


def _toml(value: Any) -> str:
    """A value as TOML writes it; JSON writes texts, numbers, lists and truth values alike."""
    return json.dumps(list(value) if isinstance(value, tuple) else value)
