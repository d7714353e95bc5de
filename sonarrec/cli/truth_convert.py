"""`sonarrec truth convert`: ground truth from annotations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sonarrec.cli.options import (
    PARTLY,
    landmarks_option,
    pixel_options,
    sonar_from_flags,
    sonar_options,
    topic_option,
)
from sonarrec.records import UsageError


def _label_map(_: click.Context, __: click.Parameter, given: tuple[str, ...]) -> Any:
    labels: dict[str, int | None] = {}
    for assignment in given:
        label, equals, landmark = assignment.rpartition("=")
        if not equals or not label or not (landmark == "none" or landmark.isdecimal()):
            raise UsageError(f"--map {assignment}: expected LABEL=ID, or LABEL=none")
        labels[label] = None if landmark == "none" else int(landmark)
    return labels


@click.command()
@click.argument("annotations", type=click.Path(path_type=Path))
@click.option("--log", help="The log that was annotated.")
@click.option(
    "--map",
    "labels",
    multiple=True,
    metavar="LABEL=ID",
    callback=_label_map,
    help="ID of a label; none leaves it out. 1, ID.1 and landmark_1 need no such line.",
)
@click.option(
    "--first-frame",
    type=int,
    metavar="N",
    help="What the annotations call the log's first frame.  [default: 0; mot 1]",
)
@click.option(
    "--format",
    "format_name",
    type=click.Choice(["cvat", "coco", "mot", "labelme"]),
    help="In place of what the content shows.",
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    default=Path("gt.csv"),
    show_default=True,
    help="A new file; one that exists is not touched.",
)
@landmarks_option
@topic_option
@sonar_options
@pixel_options
def convert(
    annotations: Path,
    log: str | None,
    labels: dict[str, int | None],
    first_frame: int | None,
    format_name: str | None,
    out: Path,
    landmarks: str,
    topic: str | None,
    sonar_file: Path | None,
    **flags: Any,
) -> None:
    """Write ANNOTATIONS as a gt.csv.

    ANNOTATIONS is a CVAT XML 1.1 (video or images), a COCO JSON, a MOTChallenge gt.txt, or a
    LabelMe JSON or folder of them. With --log, frames are found by image name, shapes drawn on
    polar images are moved to the fan, and `visible` is at most the share of the disc inside the
    fan. Exit code 3: labels or images that could not be used were left out.

    \b
    Examples:
      sonarrec truth convert annotations.xml --log pings/
      sonarrec truth convert coco.json --map "half ring=none" --map north=3 --out gt.csv
    """
    from sonarrec.landmarks import load_landmarks
    from sonarrec.readers import open_log
    from sonarrec.truth.convert import convert as convert_annotations
    from sonarrec.truth.convert import look_at

    landmark_set, images = load_landmarks(landmarks), None
    if log is not None:
        sonar = sonar_from_flags(flags)
        with open_log(log, sonar=sonar, sonar_file=sonar_file, topic=topic) as opened:
            images = look_at(opened)
    done = convert_annotations(
        annotations,
        out,
        landmark_set,
        format_name=format_name,
        labels=labels,
        first_frame=first_frame,
        log=images,
    )
    for line in done.unused:
        click.echo(f"sonarrec: {line}", err=True)
    counts = ", ".join(f"ID.{i} {count}" for i, count in done.counts.items()) or "no landmark"
    click.echo(f"{out}: {sum(done.counts.values())} rows from {done.format} ({counts})")
    for line in done.notes:
        click.echo(f"note: {line}")
    if done.unused:
        click.get_current_context().exit(PARTLY)
