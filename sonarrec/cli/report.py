"""`sonarrec report`: one page that shows what was recognised, and how well."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sonarrec.cli.options import (
    ANY,
    FILE,
    INPUT,
    NEW_FILE,
    OUTPUT,
    PARTLY,
    command,
    ground_truth_option,
    leave,
    option,
    out_option,
    quiet_option,
    scoring_options,
    tell,
    topic_option,
)
from sonarrec.records import UsageError


@command(short_help="Write results as one HTML page.")
@click.argument("results", type=ANY, required=False)
@ground_truth_option("gt.csv; without it nothing is scored.")
@option(
    INPUT,
    "--compare",
    type=(ANY, ANY),
    metavar="OLD NEW",
    help="In place of RESULTS: a page on what got better or worse from OLD to NEW. Truth is given, "
    "or found beside each log.",
)
@option(
    INPUT,
    "--pairs",
    type=FILE,
    help="In place of RESULTS and truth: a CSV of results,ground_truth[,log], a row per log. With "
    "--compare: the truth of each log.",
)
@option(
    INPUT,
    "--log",
    "recordings",
    type=ANY,
    multiple=True,
    help="The log that RESULTS came from, for frames on the page; once for each of several, or a "
    "folder that holds them.",
)
@topic_option
@scoring_options
@option(
    OUTPUT,
    "--method",
    help="Whose sightings and tracks are shown.  [default: framework, or the first preset]",
)
@out_option(
    NEW_FILE,
    "The page.  [default: report.html in RESULTS or beside PAIRS; compare.html in NEW]",
)
@quiet_option
def report(
    results: Path | None,
    ground_truth: Path | None,
    compare: tuple[Path, Path] | None,
    pairs: Path | None,
    recordings: tuple[Path, ...],
    topic: str | None,
    scoring: dict[str, Any],
    method: str | None,
    out: Path | None,
    quiet: bool,
) -> None:
    """Write RESULTS as one HTML page that needs nothing else: no network, no other file.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). The page
    shows what was seen, when and how surely, and the probabilities along each track; with ground
    truth also the paper's tables, the ROC and the worst mistakes; with the log also its frames,
    of which a click on a bar, a track or a mistake shows the one meant.
    The geometry matters only where run.toml does not tell it.

    \b
    Examples:
      sonarrec report
      sonarrec report sonarrec_out/pan --log sample_data/pan.mcap
      sonarrec report --ground-truth gt.csv --log pings/ -o report.html
      sonarrec report --pairs pairs.csv --log recordings/
      sonarrec report --compare before after --ground-truth gt.csv
    """
    if compare is not None:
        if results or recordings or topic or method:
            raise UsageError("--compare takes OLD and NEW and truth; no RESULTS, --log, --method")
        _compare(*compare, ground_truth, pairs, out, quiet, scoring)
        return
    if pairs is not None and (ground_truth or results):
        raise UsageError("--pairs names results and truth itself; give neither beside it")

    from sonarrec.report.build import write_report

    results = None if pairs else results or Path("sonarrec_out")
    beside = pairs.parent if pairs else results
    assert beside is not None
    written = write_report(
        out or beside / "report.html",
        results,
        ground_truth=ground_truth,
        pairs=pairs,
        recordings=recordings,
        topic=topic,
        method=method,
        **scoring,
    )
    tell(written.unused)
    if not quiet:
        size = written.path.stat().st_size / 1e6
        shown = f"{written.pictures} picture" + "s" * (written.pictures != 1)
        held = f", {written.held} frames to click" if written.held else ""
        click.echo(f"{written.path}: {size:.1f} MB, {shown}{held}")
    if written.unused:
        leave(PARTLY)


def _compare(
    old: Path,
    new: Path,
    ground_truth: Path | None,
    pairs: Path | None,
    out: Path | None,
    quiet: bool,
    scoring: dict[str, Any],
) -> None:
    from sonarrec.evaluation.pairs import read_pairs
    from sonarrec.report.compare import write_comparison_page

    if pairs is not None and ground_truth is not None:
        raise UsageError("--pairs names the truth of each log; give no --ground-truth beside it")
    truth = read_pairs(pairs) if pairs is not None else ground_truth
    written = write_comparison_page(out or new / "compare.html", old, new, truth, **scoring)
    tell(written.unused)
    if not quiet:
        click.echo(f"{written.path}: {written.path.stat().st_size / 1e6:.2f} MB")
    if written.unused:
        leave(PARTLY)
