"""`sonarrec report`: one HTML page about the results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sonarrec.cli import options
from sonarrec.cli.endings import finish
from sonarrec.cli.groups import ANY, NEW_FILE, command, in_input
from sonarrec.errors import number_of

if TYPE_CHECKING:
    from sonarrec.evaluation.rows import ScoringOptions


@command(short_help="Write results as one HTML page.")
@click.argument("results", type=ANY, required=False)
@options.ground_truth("gt.csv, in place of each log's own NAME.gt.csv or gt.csv.")
@in_input(
    "--log recordings",
    type=ANY,
    multiple=True,
    help="The log that RESULTS came from, or a folder of logs, where it is no longer in its place; "
    "repeatable.",
)
@options.topic
@options.scoring
@options.out(NEW_FILE, "The page.  [default: report.html in RESULTS]", ".html", ".htm")
@options.quiet
def report(
    results: Path | None,
    ground_truth: Path | None,
    recordings: tuple[Path, ...],
    topic: str | None,
    scoring: ScoringOptions,
    out: Path | None,
    quiet: bool,
) -> None:
    """Write RESULTS as one HTML page that needs no network and no other file.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). The page
    shows which landmarks were seen, when and with what score, and the probabilities along each
    track; with ground truth also the paper's tables, the ROC and the worst mistakes; with the log
    also its frames, on a click on a bar, a track or a mistake. Both are found as by `evaluate`. The
    geometry is needed only if run.toml does not state it.

    \b
    Examples:
      sonarrec report
      sonarrec report sonarrec_out/pan
      sonarrec report --ground-truth gt.csv --log pings/ -o report.html
    """
    from sonarrec.reports import build

    page = build.report(
        results or "sonarrec_out",
        out,
        ground_truth=ground_truth,
        logs=recordings,
        topic=topic,
        options=scoring,
    )
    clickable = f", {number_of(page.held, 'frame')} to click" if page.held else ""
    pictures = f"{number_of(page.pictures, 'picture')}{clickable}"
    line = f"{page.path}: {page.path.stat().st_size / 1e6:.1f} MB, {pictures}"
    finish(quiet, [line], page.unused, page.notes)
