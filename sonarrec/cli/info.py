"""`sonarrec info`: the contents of a log, and how it would be read."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from sonarrec.cli import options
from sonarrec.cli.bars import fetching, progress
from sonarrec.cli.endings import FAILED, MISUSED, PARTLY, leave, say, tell
from sonarrec.cli.groups import INPUT, NEW_FILE, OUTPUT, command, file_names, option
from sonarrec.cli.info_text import lines, radii_lines
from sonarrec.cli.options_log import LogChoice, log_options, many_logs_options, named_logs
from sonarrec.errors import MissingError, SonarrecError, UsageError, name_as_text

if TYPE_CHECKING:
    from sonarrec.nouns import Origin
    from sonarrec.readers.info import LogInfo
    from sonarrec.readers.named_logs import NamedLog
    from sonarrec.remote.find import RemoteLog
    from sonarrec.runs.radii import RadiusTrials


@command(short_help="Show what is in a log, and whether it is complete.")
@click.argument("log", shell_complete=file_names, nargs=-1)
@many_logs_options
@option(
    INPUT,
    "--quick",
    is_flag=True,
    help="Read the summary and the first frames only; do not check every frame and checksum.",
)
@log_options()
@options.landmarks
@option(
    OUTPUT,
    "--preview",
    type=NEW_FILE,
    metavar="FILE.png",
    help="Draw the stated geometry, and landmarks to scale, onto the first usable frame.",
)
@option(
    OUTPUT,
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
    from sonarrec.results.run_file import PROGRAM

    logs = named_logs(log, from_file, recursive)
    names = [_name(item) for item in logs]
    if preview is not None:
        _check_preview(preview, names)
    shown = [
        _show(
            *(item, name, number),
            reading=log_choice.arguments(),
            landmarks=landmarks,
            quick=quick,
            preview=preview,
            try_radii=try_radii,
            as_json=as_json,
            cache=cache,
            quiet=quiet,
        )
        for number, (item, name) in enumerate(zip(logs, names, strict=True))
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
    from sonarrec.readers.info import describe

    with ExitStack() as stack:
        try:
            path, up_to, origin = _at_hand(log, cache, quiet, stack)
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
                    _draw_preview(path, preview, landmarks, reading)
                if try_radii:
                    trials = _try_radii(path, log_info, landmarks, reading, quiet)
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


def _name(log: NamedLog | RemoteLog) -> str:
    from sonarrec.readers.named_logs import NamedLog

    return log.path if isinstance(log, NamedLog) else log.url.redacted


def _at_hand(
    log: NamedLog | RemoteLog, cache: options.GetCache, quiet: bool, stack: ExitStack
) -> tuple[str, Path | None, Origin | None]:
    """(path to open, highest folder with companions of the log, server that it is from)."""
    from sonarrec.readers.named_logs import NamedLog
    from sonarrec.remote.fetch import fetched

    if isinstance(log, NamedLog):
        return log.path, log.up_to, None
    with fetching(quiet, log.url.redacted) as bar:
        local_log = stack.enter_context(fetched(log, cache(), bar))
    return str(local_log.path), local_log.up_to, local_log.origin


def _check_preview(preview: Path, logs: Sequence[str]) -> None:
    """Raises UsageError if the preview cannot be written there."""
    if len(logs) > 1:
        raise UsageError(f"--preview {preview}: draws one log, but {len(logs)} are given")
    if preview.suffix.lower() != ".png":
        raise UsageError(f"--preview {preview}: the name must end in .png")
    from sonarrec.tables.outputs import check_output

    check_output(preview, "picture", logs)


def _draw_preview(path: str, preview: Path, landmarks: str | None, reading: dict[str, Any]) -> None:
    """Draw the geometry onto the first usable frame. Raises SonarrecError if there is none."""
    from sonarrec.drawing.geometry import draw_preview
    from sonarrec.drawing.pen import write_png
    from sonarrec.landmarks import load_landmarks
    from sonarrec.readers import open_log

    landmark_set = load_landmarks(landmarks or "basin")
    with open_log(path, **reading) as opened:
        first = next(iter(opened))
        height_stated = opened.sonar.height_m is not None
    picture = draw_preview(first.image, first.fan, landmark_set, height_stated=height_stated)
    write_png(preview, picture)


def _try_radii(
    path: str, log_info: LogInfo, landmarks: str | None, reading: dict[str, Any], quiet: bool
) -> RadiusTrials:
    """Recognise a part of the log with several radii. Raises SonarrecError if it cannot be read."""
    from sonarrec.landmarks import load_landmarks
    from sonarrec.readers import open_log
    from sonarrec.runs.radii import try_radii

    landmark_set = load_landmarks(landmarks or "basin")
    with open_log(path, **reading) as opened, progress(quiet, title="radii") as step:
        topic = opened.reading().get("topic")
        frame_count = next((i.frames for i in log_info.images if i.topic == topic), None)
        return try_radii(opened, landmark_set, frame_count, step)
