"""`sonarrec truth check`: what cannot be true in a gt.csv."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from sonarrec.cli.options import (
    FILE,
    PARTLY,
    landmarks_option,
    pixel_options,
    sonar_from_flags,
    sonar_options,
    topic_option,
)
from sonarrec.records import Clock

_MOST_LINES = 20  # told of one kind of fault


@click.command()
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
@click.option(
    "--time",
    "clock",
    type=click.Choice(["log", "publish", "header"]),
    help="Which time of an MCAP message timestamp_ns means.  [default: log]",
)
@landmarks_option
@topic_option
@sonar_options
@pixel_options
def check(
    ground_truth: Path,
    log: str,
    sheet: Path,
    max_pan_deg: float,
    landmarks: str,
    topic: str | None,
    clock: Clock | None,
    sonar_file: Path | None,
    **flags: Any,
) -> None:
    """Find what cannot be true in GT.CSV, and draw it on LOG.

    Told, line by line: IDs that are not in the set, frames that are not in the log, discs wholly
    outside the fan, `visible` outside 0 to 1 or above the share of the disc inside the fan,
    repeated rows, landmarks that lie on each other or change their ID, pixels that contradict
    range and bearing, and jumps that no pan explains. The contact sheet shows every pass of a
    landmark at a few frames, outlined. Exit code 3: something was found.

    \b
    Examples:
      sonarrec truth check gt.csv log.mcap
      sonarrec truth check gt_proposed.csv pings/ --sheet look.png --max-pan 10
    """
    from sonarrec.landmarks import load_landmarks
    from sonarrec.readers import open_log
    from sonarrec.truth.check import check_truth
    from sonarrec.truth.contact_sheet import draw_contact_sheet

    landmark_set, sonar = load_landmarks(landmarks), sonar_from_flags(flags)
    reopen = partial(
        open_log, log, sonar=sonar, sonar_file=sonar_file, topic=topic, time=clock or "log"
    )
    with reopen() as opened:
        checked = check_truth(ground_truth, opened, landmark_set, max_pan_deg=max_pan_deg)
    with reopen() as opened:
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
    click.echo(f"{ground_truth}: {checked.told()}")
    if checked.others:
        click.echo(f"note: {checked.others} rows of other logs were not looked at")
    if strips:
        click.echo(f"{sheet}: contact sheet")
    else:
        click.echo("note: no row has a position on a frame of the log, so there is no sheet")
    if checked.faults or checked.problems:
        click.get_current_context().exit(PARTLY)
