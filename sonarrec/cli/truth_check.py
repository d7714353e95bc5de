"""`sonarrec truth check`: find errors in a gt.csv."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path

import click

from sonarrec.cli.endings import end, say, tell
from sonarrec.cli.groups import (
    FILE,
    NEW_FILE,
    OUTPUT,
    SCORING,
    FiniteRange,
    command,
    file_names,
    option,
)
from sonarrec.cli.options import landmarks_option, quiet_option
from sonarrec.cli.options_log import LogChoice, log_options
from sonarrec.errors import number_of

_MOST_LINES = 20  # printed for one kind of fault


@command(short_help="Find errors in a gt.csv.")
@click.argument("ground_truth", type=FILE, metavar="GT.CSV")
@click.argument("log", shell_complete=file_names)
@log_options(time=True)
@landmarks_option
@option(
    SCORING,
    "--max-pan",
    "max_pan_deg",
    type=FiniteRange(min=0, min_open=True),
    default=5.0,
    show_default=True,
    metavar="DEG",
    help="Largest turn of the sonar from one frame to the next that counts as possible.",
)
@option(
    OUTPUT,
    "-o",
    "--sheet",
    type=NEW_FILE,
    default=Path("truth_check.png"),
    show_default=True,
    help="File for the contact sheet.",
)
@quiet_option
def check(
    ground_truth: Path,
    log: str,
    log_choice: LogChoice,
    landmarks: str | None,
    max_pan_deg: float,
    sheet: Path,
    quiet: bool,
) -> None:
    """Find errors in GT.CSV, and draw its landmarks on frames of LOG.

    It reports, with the line: IDs not in the set, frames not in the log, discs wholly outside the
    fan, `visible` outside 0 to 1 or above the share of the disc in the fan image, repeated rows,
    landmarks that overlap or change their ID, pixels that contradict range and bearing, and jumps
    that no turn of the sonar explains. The contact sheet shows every pass of a landmark at a few
    frames, outlined. Exit code 3: something was found.

    \b
    Examples:
      sonarrec truth check sample_data/pan.gt.csv sample_data/pan.mcap
      sonarrec truth check gt_proposed.csv pings/ --sheet look.png --max-pan 10
    """
    from sonarrec.files.outputs import check_output
    from sonarrec.landmarks import load_landmarks
    from sonarrec.readers import open_log
    from sonarrec.truth.check import check_truth
    from sonarrec.truth.contact_sheet import draw_contact_sheet

    check_output(sheet, "picture", [ground_truth, log])
    landmark_set = load_landmarks(landmarks or "basin")
    reopen = partial(open_log, log, **log_choice.arguments())
    with reopen() as opened:
        checked = check_truth(ground_truth, opened, landmark_set, max_pan_deg=max_pan_deg)
    with reopen() as opened:
        strips = draw_contact_sheet(checked, opened, sheet)
    counts = Counter[str]()
    for fault in checked.faults:
        counts[fault.kind] += 1
        if counts[fault.kind] <= _MOST_LINES:
            say(f"{ground_truth} line {fault.line}: {fault.text}")
    for kind, count in counts.items():
        if count > _MOST_LINES:
            say(f"... and {count - _MOST_LINES} more of this kind: {kind}")
    tell(checked.diagnostics.problems)
    if not quiet:
        say(f"{ground_truth}: {checked.summary()}")
    for line in checked.diagnostics.notes:
        say(f"note: {line}")
    if checked.others:
        say(f"note: {number_of(checked.others, 'row')} of other logs not checked")
    if strips and not quiet:
        say(f"{sheet}: contact sheet")
    elif not strips:
        say("note: no row has a position on a frame of the log, so there is no sheet")
    end(checked.faults or checked.diagnostics.problems)
