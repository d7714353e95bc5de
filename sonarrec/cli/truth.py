"""`sonarrec truth`: ground truth from elsewhere, checked, and proposed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sonarrec.cli.options import FILE, PARTLY, sonar_from_flags, sonar_options
from sonarrec.records import UsageError

_MOST_LINES = 20  # told of one kind of fault

_landmarks_option = click.option(
    "--landmarks", default="basin", show_default=True, help="A built-in set or a TOML file."
)
_topic_option = click.option("--topic", help="Channel of an MCAP that holds several.")
_out_option = click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    default=Path("gt.csv"),
    show_default=True,
    help="A new file; one that exists is not touched.",
)


@click.group()
def truth() -> None:
    """Ground truth: convert annotations, check a gt.csv, propose one from results."""


def _label_map(_: click.Context, __: click.Parameter, given: tuple[str, ...]) -> Any:
    labels: dict[str, int | None] = {}
    for assignment in given:
        label, equals, landmark = assignment.rpartition("=")
        if not equals or not label or not (landmark == "none" or landmark.isdecimal()):
            raise UsageError(f"--map {assignment}: expected LABEL=ID, or LABEL=none")
        labels[label] = None if landmark == "none" else int(landmark)
    return labels


@truth.command()
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
@_out_option
@_landmarks_option
@_topic_option
@sonar_options
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
    from sonarrec.annotations.convert import convert as convert_annotations
    from sonarrec.annotations.convert import look_at
    from sonarrec.landmarks import load_landmarks
    from sonarrec.readers import open_log

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


@truth.command()
@click.argument("ground_truth", type=FILE, metavar="GT.CSV")
@click.argument("log")
@click.option(
    "--sheet",
    type=click.Path(dir_okay=False, path_type=Path),
    default=Path("truth_check.png"),
    show_default=True,
    help="Where the contact sheet goes.",
)
@click.option(
    "--max-pan",
    "max_pan_deg",
    type=click.FloatRange(min=0, min_open=True),
    default=5.0,
    show_default=True,
    metavar="DEG",
    help="By how much the sonar may turn from one frame to the next.",
)
@_landmarks_option
@_topic_option
@sonar_options
def check(
    ground_truth: Path,
    log: str,
    sheet: Path,
    max_pan_deg: float,
    landmarks: str,
    topic: str | None,
    sonar_file: Path | None,
    **flags: Any,
) -> None:
    """Find what cannot be true in GT.CSV, and draw it on LOG for a look.

    Told, line by line: IDs that are not in the set, frames that are not in the log, discs wholly
    outside the fan, `visible` outside 0 to 1 or above the share of the disc inside the fan,
    repeated rows, landmarks that lie on each other, pixels that contradict range and bearing,
    and jumps that no pan explains. The contact sheet shows every pass of a landmark at a few
    frames, outlined. Exit code 3: something was found.

    \b
    Examples:
      sonarrec truth check gt.csv log.mcap
      sonarrec truth check gt_proposed.csv pings/ --sheet look.png --max-pan 10
    """
    from sonarrec.evaluation.contact_sheet import draw_contact_sheet
    from sonarrec.evaluation.truth_check import check_truth
    from sonarrec.landmarks import load_landmarks
    from sonarrec.readers import open_log

    landmark_set, sonar = load_landmarks(landmarks), sonar_from_flags(flags)
    with open_log(log, sonar=sonar, sonar_file=sonar_file, topic=topic) as opened:
        checked = check_truth(ground_truth, opened, landmark_set, max_pan_deg=max_pan_deg)
    with open_log(log, sonar=sonar, sonar_file=sonar_file, topic=topic) as opened:
        strips = draw_contact_sheet(checked, opened, sheet)
    told: dict[str, int] = {}
    for fault in checked.faults:
        told[fault.kind] = told.get(fault.kind, 0) + 1
        if told[fault.kind] <= _MOST_LINES:
            click.echo(f"{ground_truth} line {fault.line}: {fault.text}")
    for kind, count in told.items():
        if count > _MOST_LINES:
            click.echo(f"... and {count - _MOST_LINES} more of the kind: {kind}")
    for problem in checked.problems:
        click.echo(f"sonarrec: {problem}", err=True)
    click.echo(f"{ground_truth}: {len(checked.line)} rows, {len(checked.faults)} faults")
    if checked.others:
        click.echo(f"note: {checked.others} rows of other logs were not looked at")
    if strips:
        click.echo(f"{sheet}: contact sheet")
    else:
        click.echo("note: no row has a position on a frame of the log, so there is no sheet")
    if checked.faults or checked.problems:
        click.get_current_context().exit(PARTLY)


@truth.command()
@click.argument("results", type=click.Path(path_type=Path), default=Path("sonarrec_out"))
@click.option("--method", default="framework", show_default=True, help="Whose tracks.")
@click.option(
    "--min-score",
    type=float,
    default=0.9,
    show_default=True,
    help="That a track must reach at its best.",
)
@click.option(
    "--max-gap",
    type=click.IntRange(min=0),
    default=8,
    show_default=True,
    help="Frames missing from a track that are filled in.",
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    default=Path("gt_proposed.csv"),
    show_default=True,
    help="A new file; one that exists is not touched.",
)
def propose(results: Path, method: str, min_score: float, max_gap: int, out: Path) -> None:
    """Write a gt.csv from the confident tracks of RESULTS, for a person to correct.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). Look at
    the proposal with `sonarrec truth check`, add what the tracks missed, remove what is wrong.
    Scoring the same results against an uncorrected proposal says nothing about them.

    \b
    Examples:
      sonarrec truth propose sonarrec_out/log_7
      sonarrec truth propose --min-score 0.95 --max-gap 0 --out gt.csv
    """
    from sonarrec.evaluation.truth_propose import propose as propose_truth

    tracks = propose_truth(results, out, method=method, min_score=min_score, max_gap=max_gap)
    rows = sum(track.rows for track in tracks)
    click.echo(f"{out}: {rows} rows from {sum(bool(t.rows) for t in tracks)} tracks")
    for t in sorted(tracks, key=lambda t: (t.log, t.frames)):
        span = f"frames {t.frames[0]}-{t.frames[1]}"
        told = t.left_out and f"left out: {t.left_out}"
        told = told or f"{t.rows} rows, {t.interpolated} of them filled in"
        score = f"best score {t.best_score:.3f}"
        click.echo(f"  {t.log}  ID.{t.landmark}  track {t.track:<4} {span:<15} {score}  {told}")
