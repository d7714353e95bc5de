"""`sonarrec info`: the contents of a log, and how it would be read."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from sonarrec.cli import options
from sonarrec.cli.bars import fetching, progress
from sonarrec.cli.endings import FAILED, MISUSED, PARTLY, leave, say, tell
from sonarrec.cli.groups import NEW_FILE, command, file_names, in_input, in_output
from sonarrec.cli.options_log import LogChoice, log_options, many_logs_options, named_logs
from sonarrec.errors import MissingError, SonarrecError, UsageError, name_as_text, number_of
from sonarrec.times import date_text, is_date

if TYPE_CHECKING:
    from sonarrec.readers.info import Container, Images, LogInfo
    from sonarrec.readers.named_logs import NamedLog
    from sonarrec.remote.find import RemoteLog
    from sonarrec.runs.radii import RadiusTrials


@command(short_help="Show what is in a log, and whether it is complete.")
@click.argument("log", shell_complete=file_names, nargs=-1)
@many_logs_options
@in_input(
    "--quick",
    is_flag=True,
    help="Read the summary and the first frames only; do not check every frame and checksum.",
)
@log_options()
@options.landmarks
@in_output(
    "--preview",
    type=NEW_FILE,
    metavar="FILE.png",
    help="Draw the stated geometry, and landmarks to scale, onto the first usable frame.",
)
@in_output(
    "--try-radii",
    is_flag=True,
    help="Recognise a part of the log with radii from half to twice the landmark set's, and print "
    "in how many frames landmarks are declared with each.",
)
@options.json("Print JSON. Keys: sonarrec help info.")
@options.cache
@options.quiet
def info(
    log: tuple[str, ...],
    recursive: bool,
    from_file: IO[str] | None,
    quick: bool,
    log_choice: LogChoice,
    landmarks: str | None,
    preview: Path | None,
    try_radii: bool,
    as_json: bool,
    cache: options.GetCache,
    quiet: bool,
) -> None:
    """Show what is in LOG, whether it is complete, and how `run` would read it.

    LOG is an MCAP file, a bag of ROS 1 or 2, a folder of images, a video, a sonar's own file (ARIS,
    DIDSON, Oculus, Gemini), a folder of logs, or a quoted glob of these. Every frame is read and
    every checksum compared to see how many frames can be used; --quick leaves that out. An
    incomplete geometry is reported but is not a fault. Exit code 3: part of the log cannot be used;
    1: none of it can. LOG may be on a server (`sonarrec help remote`).

    --preview draws range rings, bearings, the near edge of the stated floor and three discs of the
    landmark set onto the first usable frame, so that a wrong geometry is easy to see. --try-radii
    is for logs in which `run` declares nothing: it shows whether it would with discs of another
    size.

    \b
    Examples:
      sonarrec info sample_data/pan.mcap
      sonarrec info --quick *.mcap
      sonarrec info pings/ --tilt-deg 22 --preview pings.png
      sonarrec info dive.mcap --landmarks ours.toml --try-radii
      sonarrec info --json dive.mcap | jq '.logs[0].images[].usable'
    """
    from sonarrec.remote.find import RemoteLog
    from sonarrec.results.run_file import PROGRAM
    from sonarrec.tables.outputs import check_output

    logs = named_logs(log, from_file, recursive)
    names = [one.url.redacted if isinstance(one, RemoteLog) else one.path for one in logs]
    if preview is not None:
        if len(logs) > 1:
            raise UsageError(f"--preview {preview}: draws one log, but {len(logs)} are given")
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
            try_radii=try_radii,
            as_json=as_json,
            cache=cache,
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
    log: NamedLog | RemoteLog,
    name: str,
    number: int,
    *,
    reading: dict[str, Any],
    landmarks: str | None,
    quick: bool,
    preview: Path | None,
    try_radii: bool,
    as_json: bool,
    cache: options.GetCache,
    quiet: bool,
) -> _Shown:
    """Describe a log and print it. number: how many logs come before. reading: as for `open_log`.

    A fault of the log is printed; raises UsageError for options that cannot be used with it.
    """
    from sonarrec.landmarks import load_landmarks
    from sonarrec.readers import open_log
    from sonarrec.readers.info import describe
    from sonarrec.remote.fetch import fetched
    from sonarrec.remote.find import RemoteLog

    with ExitStack() as stack:
        try:
            path, up_to, origin = str(log.path), log.up_to, None
            if isinstance(log, RemoteLog):
                with fetching(quiet, name) as bar:
                    copy = stack.enter_context(fetched(log, cache(), bar))
                path, up_to, origin = str(copy.path), copy.up_to, copy.origin
            reading = {**reading, "up_to": up_to}
            with progress(quiet) as step, origin.translated() if origin else nullcontext():
                log_info = describe(path, **reading, quick=quick, observe=step)
        except SonarrecError as error:
            is_missing = isinstance(error, MissingError)
            if isinstance(error, UsageError) and not is_missing:
                raise
            tell([str(error)])
            return _Shown({"path": name, "error": str(error)}, True, is_missing)
        renamed = origin.with_server_names if origin else str
        if origin:
            log_info = replace(log_info, path=origin.url)
        table = _renamed(asdict(log_info), renamed)
        shown = _Shown(table, log_info.has_no_frame, is_faulty=log_info.has_problems)
        if not as_json:
            say(*([""] if number else []), *map(renamed, lines(log_info)))
        try:
            with origin.translated() if origin else nullcontext():
                if preview is not None:
                    from sonarrec.drawing.geometry import draw_preview
                    from sonarrec.drawing.pen import write_png

                    landmark_set = load_landmarks(landmarks or "basin")
                    with open_log(path, **reading) as opened:
                        first = next(iter(opened))
                        stated = opened.sonar.height_m is not None
                    picture = draw_preview(
                        first.image, first.fan, landmark_set, height_stated=stated
                    )
                    write_png(preview, picture)
                if try_radii:
                    from sonarrec.runs.radii import try_radii as try_each

                    landmark_set = load_landmarks(landmarks or "basin")
                    with (
                        open_log(path, **reading) as opened,
                        progress(quiet, title="radii") as step,
                    ):
                        topic = opened.reading().get("topic")
                        counts = (i.frames for i in log_info.images if i.topic == topic)
                        trials = try_each(opened, landmark_set, next(counts, None), step)
                    shown.table["radii"] = trials.as_table()
                    if not as_json:
                        say(*radii_lines(trials))
        except SonarrecError as error:
            shown.undone = error  # told after all logs
    return shown


def _renamed(value: Any, rename: Callable[[str], str]) -> Any:
    """A table for JSON with other names of files in its texts, which become valid Unicode."""
    if isinstance(value, dict):
        return {key: _renamed(one, rename) for key, one in value.items()}
    if isinstance(value, list):
        return [_renamed(one, rename) for one in value]
    return rename(name_as_text(value)) if isinstance(value, str) else value


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
        out.append(f"lacks {', '.join(images.lacks)}")
        out.append(f"give {flags}, or put a sonar.toml beside the log, or into it if a folder:")
        out.append("`sonarrec help geometry` has one to copy")
    return [text for text in out if text]


def _outline_lines(images: Images) -> list[str]:
    """The fan in the images, if something of the geometry that it tells is not stated."""
    found = images.outline
    if found is None or not set(images.lacks) - {"tilt_deg"}:
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


def radii_lines(trials: RadiusTrials) -> list[str]:
    """In how many frames landmarks are declared, by radius."""
    rows = [["radius_m", "frames", "of which with"]]
    for trial in trials.trials:
        stated = trial.radius_m == trials.stated_m
        if stated or trial.frames_declared:
            ids = ", ".join(f"ID.{one}: {count}" for one, count in trial.ids.items())
            remark = "  (stated)" if stated else ""
            rows.append([f"{trial.radius_m:.3g}", str(trial.frames_declared), ids + remark])
    low, high = trials.trials[0].radius_m, trials.trials[-1].radius_m
    texts = [
        f"frames of {trials.frames} with a landmark declared ({low:.3g} to {high:.3g} m tried; "
        "not listed: 0)",
        *_columns(rows),
    ]
    if trials.better is not None:
        texts.append(
            f"about {trials.better.radius_m:.3g} m fits better than the {trials.stated_m:g} m "
            "stated: check radius_m and the range window"
        )
    return _entry("radii", texts)
