"""`sonarrec evaluate`: score results against ground truth."""

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
from sonarrec.records import UsageError

FOLDER = click.Path(path_type=Path)


@click.command(short_help="Score results against ground truth, or compare two.")
@click.argument("results", type=FOLDER, required=False)
@click.option("--ground-truth", type=FILE, help="gt.csv; its columns are in the README.")
@click.option(
    "--pairs",
    type=FILE,
    help="In place of RESULTS and truth: a CSV of results,ground_truth[,log], a row per log.",
)
@click.option(
    "--compare",
    type=(FOLDER, FOLDER),
    metavar="OLD NEW",
    help="In place of RESULTS: what got better or worse from OLD to NEW, frame by frame.",
)
@click.option(
    "--fail-on-regression",
    "band",
    type=click.FloatRange(0, 1),
    metavar="BAND",
    help="With --compare: exit 1 where a rate is worse by more than BAND (and two frames).",
)
@min_visible_option
@tolerance_option
@click.option(
    "--unit",
    type=click.Choice(["pass", "log"]),
    help="What is independent: passes of landmarks, or logs.  [default: log from ten logs on]",
)
@click.option("--details", is_flag=True, help="Print both protocols' figures, per ID and per log.")
@click.option("--det", is_flag=True, help="Draw det.png, the detection error trade-off, too.")
@landmarks_of_results_option
@sonar_options
@click.option(
    "--out", type=FOLDER, help="Folder for the files.  [default: RESULTS, NEW or PAIRS' evaluation]"
)
@click.option("-q", "--quiet", is_flag=True, help="Write the files only; print no tables.")
def evaluate(
    results: Path | None,
    ground_truth: Path | None,
    pairs: Path | None,
    compare: tuple[Path, Path] | None,
    band: float | None,
    unit: Any,
    details: bool,
    det: bool,
    sonar_file: Path | None,
    out: Path | None,
    quiet: bool,
    min_visible: float,
    tolerance: float | None,
    landmarks: str | None,
    **flags: Any,
) -> None:
    """Score RESULTS against ground truth: rates, ROC, intervals and tests, per method and ID.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). The
    geometry matters only where positions are in pixels and run.toml does not tell it. Files go
    to RESULTS/evaluation. Intervals and tests take whole passes of a landmark through the view,
    or whole logs, for independent, never frames.

    \b
    Examples:
      sonarrec evaluate --ground-truth gt.csv
      sonarrec evaluate --ground-truth gt.csv sonarrec_out/log_7 --min-visible 0.5
      sonarrec evaluate --pairs pairs.csv --details
      sonarrec evaluate --ground-truth gt.csv --compare before after --fail-on-regression 0.02
    """
    if pairs is not None and (ground_truth or results or compare):
        raise UsageError("--pairs names results and truth itself; give neither beside it")
    if compare is not None and results is not None:
        raise UsageError("--compare takes OLD and NEW; give no RESULTS beside it")
    if band is not None and compare is None:
        raise UsageError("--fail-on-regression goes with --compare")

    from sonarrec.sonar import Sonar, load_sonar

    stated = load_sonar(sonar_file) if sonar_file else Sonar()
    options: dict[str, Any] = {
        "min_visible": min_visible,
        "tolerance_s": tolerance,
        "landmarks": landmarks,
        "sonar": stated.updated(sonar_from_flags(flags)),
    }
    if ground_truth is not None and compare is not None:
        _compare(*compare, ground_truth, out or compare[1] / "evaluation", band, quiet, options)
        return

    from sonarrec.evaluation import tabulate, write
    from sonarrec.evaluation.evaluate import evaluate as score
    from sonarrec.evaluation.evaluate import evaluate_pairs, read_pairs
    from sonarrec.evaluation.summary import summarise

    if ground_truth is not None:
        results = results or Path("sonarrec_out")
        found = score(results, ground_truth, **options)
        folder = out or results / "evaluation"
    elif pairs is not None:
        found = evaluate_pairs(read_pairs(pairs), **options)
        folder = out or pairs.parent / "evaluation"
    else:
        raise UsageError("nothing to score against: give --ground-truth, or --pairs")
    summary = summarise(found, unit)
    written = write.write_evaluation(folder, found, summary, det)
    for problem in found.unused:
        click.echo(f"sonarrec: {problem}", err=True)
    if not quiet:
        click.echo(tabulate.screen(found))
        click.echo(tabulate.summary_screen(found, summary, details))
        for note in (*found.notes, *summary.notes):
            click.echo(f"note: {note}")
        click.echo(f"{folder}: {', '.join(written)}")
    if found.unused:
        click.get_current_context().exit(PARTLY)


def _compare(
    old: Path,
    new: Path,
    ground_truth: Path,
    folder: Path,
    band: float | None,
    quiet: bool,
    options: dict[str, Any],
) -> None:
    from sonarrec.evaluation import compare, write

    found = compare.compare(old, new, ground_truth, **options)
    write.write_comparison(folder, found)
    for problem in found.unused:
        click.echo(f"sonarrec: {problem}", err=True)
    if not quiet:
        click.echo(compare.screen(found))
        click.echo(f"{folder}: compare.csv, changes.csv")
    regressions = [] if band is None else found.regressions(band)
    for line in regressions:
        click.echo(f"sonarrec: worse: {line}", err=True)
    if regressions or found.unused:
        click.get_current_context().exit(1 if regressions else PARTLY)
