"""`sonarrec report`: one page that shows what was recognised, and how well."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sonarrec.cli.options import (
    FILE,
    PARTLY,
    landmarks_of_results_option,
    min_visible_option,
    sonar_from_flags,
    sonar_options,
    tolerance_option,
)


@click.command(short_help="Write results as one HTML page.")
@click.argument("results", type=click.Path(path_type=Path), default=Path("sonarrec_out"))
@click.option("--ground-truth", type=FILE, help="gt.csv; without it nothing is scored.")
@click.option(
    "--log",
    "recordings",
    type=click.Path(path_type=Path),
    multiple=True,
    help="The log that RESULTS came from, for frames on the page; once for each of several.",
)
@click.option(
    "-o",
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    help="The page.  [default: RESULTS/report.html]",
)
@min_visible_option
@tolerance_option
@click.option(
    "--method",
    help="Whose sightings and tracks are shown.  [default: framework, or the first preset]",
)
@landmarks_of_results_option
@click.option("--topic", help="Channel of an MCAP --log, where run.toml does not tell it.")
@sonar_options
@click.option("-q", "--quiet", is_flag=True, help="Write the page only; print nothing.")
def report(
    results: Path,
    ground_truth: Path | None,
    recordings: tuple[Path, ...],
    out: Path | None,
    min_visible: float,
    tolerance: float | None,
    method: str | None,
    landmarks: str | None,
    topic: str | None,
    sonar_file: Path | None,
    quiet: bool,
    **flags: Any,
) -> None:
    """Write RESULTS as one HTML page that needs nothing else: no network, no other file.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). The page
    shows what was seen, when and how surely, and the probabilities along each track; with ground
    truth also the paper's tables, the ROC and the worst mistakes; with the log also its frames.
    The geometry matters only where run.toml does not tell it.

    \b
    Examples:
      sonarrec report
      sonarrec report sonarrec_out/log_7 --log log_7.mcap
      sonarrec report --ground-truth gt.csv --log pings/ -o report.html
    """
    from sonarrec.report.build import write_report
    from sonarrec.sonar import Sonar, load_sonar

    stated = load_sonar(sonar_file) if sonar_file else Sonar()
    written = write_report(
        out or results / "report.html",
        results,
        ground_truth=ground_truth,
        recordings=recordings,
        min_visible=min_visible,
        tolerance_s=tolerance,
        landmarks=landmarks,
        sonar=stated.updated(sonar_from_flags(flags)),
        topic=topic,
        method=method,
    )
    for problem in written.unused:
        click.echo(f"sonarrec: {problem}", err=True)
    if not quiet:
        size = written.path.stat().st_size / 1e6
        frames = "1 frame" if written.pictures == 1 else f"{written.pictures} frames"
        click.echo(f"{written.path}: {size:.1f} MB, {frames} of the log")
    if written.unused:
        click.get_current_context().exit(PARTLY)
