"""A sonar.toml from what `sonarrec info` knows of a log; what is missing is marked."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sonarrec.cli.options_log import GEOMETRY_TEXTS
from sonarrec.errors import UsageError, name_as_text

if TYPE_CHECKING:
    from sonarrec.readers.info import Images, LogInfo

HEAD = "# Written by sonarrec info"
MOST_NUMBERS = 16  # of a list that the log itself states: more are not repeated


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
    lines = [f"{HEAD} for {name}.", *_lines(images)]
    write_page(path, "\n".join(lines) + "\n")
    return [line.split()[1] for line in lines if "# missing" in line]


def _lines(images: Images) -> list[str]:
    from sonarrec.sonar import Sonar

    shown = _shown(images)
    stated = {"layout": images.layout} | images.geometry
    floor = {"tilt_deg", "height_m"}
    lines = ["[sonar]"]
    for key in (field.name for field in fields(Sonar)):
        origin = images.origins.get(key, "default")
        if key in stated and origin in ("message", "header"):
            value = stated[key]
            several = isinstance(value, list) and len(value) > MOST_NUMBERS
            text = f"[{len(value)} values]" if several else _toml(value)
            lines.append(f"# {key} = {text}  # the log states it, ping by ping")
        elif key in stated:
            lines.append(f"{key} = {_toml(stated[key])}" + _origin(origin))
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
    found, stated = images.outline, images.geometry
    if found is None or not set(images.lacks) - {"tilt_deg"}:
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


def _origin(origin: str) -> str:
    names = {"flag": "option", "default": "by default", "found": "found from the first pings"}
    return f"  # {json.dumps(names.get(origin, name_as_text(origin)))[1:-1]}"
