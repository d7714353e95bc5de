"""`sonarrec info`: the contents of a log, and how it would be read."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from sonarrec.cli import options
from sonarrec.cli.bars import progress
from sonarrec.cli.endings import FAILED, MISUSED, PARTLY, inform, leave, say, tell
from sonarrec.cli.groups import NEW_FILE, command, file_names, in_input, in_output
from sonarrec.cli.info_lines import HEAD, lines, write_sonar_toml
from sonarrec.cli.options_log import LogChoice, log_options, many_logs_options, named_logs
from sonarrec.errors import MissingError, SonarrecError, UsageError, local, name_as_text

if TYPE_CHECKING:
    from sonarrec.readers.named_logs import NamedLog


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
