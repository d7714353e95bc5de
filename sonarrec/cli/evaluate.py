"""`sonarrec evaluate`: score results against ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sonarrec.cli.options import (
    FILE,
    PARTLY,
    sonar_from_flags,
    sonar_options,
)


@click.command()
@click.argument("results", type=click.Path(path_type=Path), default=Path("sonarrec_out"))
@click.option("--ground-truth", type=FILE, required=True, help="gt.csv; see FORMATS in the README.")
@click.option(
    "--min-visible",
    type=float,
    default=0.9,
    show_default=True,
    help="Share of the disc in view from which a landmark counts; with less it is ignored.",
)
@click.option(
    "--tolerance",
    type=float,
    metavar="SECONDS",
    help="For truth matched by timestamp_ns.  [default: half the time between frames]",
)
@click.option("--landmarks", help="Landmark set.  [default: that of run.toml, else basin]")
@sonar_options
@click.option("-q", "--quiet", is_flag=True, help="Write the files only; print no tables.")
def evaluate(
    results: Path,
    ground_truth: Path,
    min_visible: float,
    tolerance: float | None,
    landmarks: str | None,
    sonar_file: Path | None,
    quiet: bool,
    **flags: Any,
) -> None:
    """Score RESULTS against ground truth: TPR, FPR and ROC, per method and ID.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). The
    geometry matters only where positions are in pixels and run.toml does not tell it. Files go
    to RESULTS/evaluation.

    \b
    Examples:
      sonarrec evaluate --ground-truth gt.csv
      sonarrec evaluate --ground-truth gt.csv sonarrec_out/log_7 --min-visible 0.5
    """
    from sonarrec.evaluation import scoring, tabulate
    from sonarrec.geometry import Sonar, load_sonar

    stated = load_sonar(sonar_file) if sonar_file else Sonar()
    found = scoring.evaluate(
        results,
        ground_truth,
        min_visible=min_visible,
        tolerance_s=tolerance,
        landmarks=landmarks,
        sonar=stated.updated(sonar_from_flags(flags)),
    )
    tabulate.write_evaluation(results / "evaluation", found)
    for problem in found.unused:
        click.echo(f"sonarrec: {problem}", err=True)
    if not quiet:
        click.echo(tabulate.screen(found))
        for note in found.notes:
            click.echo(f"note: {note}")
        click.echo(f"{results / 'evaluation'}: confusion.csv, roc.csv, roc.png, evaluation.json")
    if found.unused:
        click.get_current_context().exit(PARTLY)
