"""`sonarrec truth convert`: ground truth from annotations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sonarrec.cli.endings import end, say, tell
from sonarrec.cli.groups import ANY, INPUT, NEW_FILE, command, file_names, option
from sonarrec.cli.options import landmarks_option, out_option, quiet_option
from sonarrec.cli.options_log import LogChoice, log_options
from sonarrec.errors import UsageError, number_of


def _label_map(_: click.Context, __: click.Parameter, texts: tuple[str, ...]) -> Any:
    labels: dict[str, int | None] = {}
    for assignment in texts:
        label, equals, landmark = assignment.rpartition("=")
        if not equals or not label or not (landmark == "none" or landmark.isdecimal()):
            raise UsageError(f"--map {assignment}: expected LABEL=ID, or LABEL=none")
        labels[label] = None if landmark == "none" else int(landmark)
    return labels


@command(short_help="Write annotations as a gt.csv.")
@click.argument("annotations", type=ANY)
@option(INPUT, "--log", shell_complete=file_names, help="The log that was annotated.")
@option(
    INPUT,
    "--map",
    "labels",
    multiple=True,
    metavar="LABEL=ID",
    callback=_label_map,
    help="ID of a label, or none to leave it out; repeatable. Labels 1, ID.1 and landmark_1 need "
    "no --map.",
)
@option(
    INPUT,
    "--first-frame",
    type=int,
    metavar="N",
    help="Number of the log's first frame in the annotations.  [default: 0; mot 1]",
)
@option(
    INPUT,
    "--format",
    "format_name",
    type=click.Choice(["cvat", "coco", "mot", "labelme"]),
    help="Format of ANNOTATIONS.  [default: detected from the content]",
)
@log_options()
@landmarks_option
@out_option(
    NEW_FILE,
    "A new file; an existing one is not overwritten.",
    default=Path("gt.csv"),
    show_default=True,
)
@quiet_option
def convert(
    annotations: Path,
    log: str | None,
    labels: dict[str, int | None],
    first_frame: int | None,
    format_name: str | None,
    log_choice: LogChoice,
    landmarks: str | None,
    out: Path,
    quiet: bool,
) -> None:
    """Write ANNOTATIONS as a gt.csv.

    ANNOTATIONS is a CVAT XML 1.1 (video or images), a COCO JSON, a MOTChallenge gt.txt, or a
    LabelMe JSON or a folder of them. With --log, frames are found by image name, shapes drawn on
    polar images are converted to the fan, and `visible` is at most the share of the disc inside the
    fan. Exit code 3: labels or images that could not be used were left out, or frames lie beyond
    the log.

    \b
    Examples:
      sonarrec truth convert annotations.xml --log pings/
      sonarrec truth convert coco.json --map "half ring=none" --map north=3 -o gt.csv
    """
    from sonarrec.landmarks import load_landmarks
    from sonarrec.readers import open_log
    from sonarrec.truth.convert import convert as convert_annotations
    from sonarrec.truth.convert import look_at

    landmark_set, images = load_landmarks(landmarks or "basin"), None
    if log is not None:
        with open_log(log, **log_choice.arguments()) as opened:
            images = look_at(opened)
    report = convert_annotations(
        annotations,
        out,
        landmark_set,
        format_name=format_name,
        labels=labels,
        first_frame=first_frame,
        log=images,
    )
    tell(report.diagnostics.problems)
    counts = ", ".join(f"ID.{i} {count}" for i, count in report.counts.items()) or "no landmark"
    if not quiet:
        rows = sum(report.counts.values())
        say(f"{out}: {number_of(rows, 'row')} from {report.format} ({counts})")
    for line in report.diagnostics.notes:
        say(f"note: {line}")
    end(report.diagnostics.problems)
