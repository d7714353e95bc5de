"""`sonarrec evaluate`: score results against ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sonarrec.cli import options
from sonarrec.cli.endings import MOST_NOTES, PARTLY, WORSE, leave, print_notes, say
from sonarrec.cli.groups import ANY, command, in_output, in_scoring
from sonarrec.errors import UsageError, number_of

if TYPE_CHECKING:
    from sonarrec.evaluation.compare import Limits
    from sonarrec.evaluation.rows import ScoringOptions


@command(short_help="Score results against ground truth, or compare them.")
@click.argument("results", type=ANY, required=False)
@options.ground_truth(
    "gt.csv, or a folder of NAME.gt.csv, in place of each log's own NAME.gt.csv or gt.csv.",
    of_each=True,
)
@options.pairs
@options.compare("What got better or worse from OLD to NEW, in place of RESULTS.")
@options.limits
@options.scoring
@in_scoring(
    "--labelled-only",
    is_flag=True,
    help="Score only frames that have a row of truth, of a landmark or `none`.",
)
@in_output(
    "-v --verbose --details details",
    is_flag=True,
    help="Print the figures of both protocols, per ID and per log.",
)
@in_output(
    "--json as_json", is_flag=True, help="Print evaluation.json, and nothing else, on stdout."
)
@options.out(
    ANY, "Folder for the files.  [default: evaluation in RESULTS, in NEW or next to PAIRS]"
)
@options.quiet
def evaluate(
    results: Path | None,
    ground_truth: Path | None,
    pairs: Path | None,
    compare: tuple[Path, Path] | None,
    limits: Limits,
    scoring: ScoringOptions,
    labelled_only: bool,
    details: bool,
    as_json: bool,
    out: Path | None,
    quiet: bool,
) -> None:
    """Score RESULTS against ground truth: rates, ROC, intervals and tests.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). Truth is
    the gt.csv next to each log, or is given. Files go to RESULTS/evaluation.
    Intervals and tests treat whole passes of a landmark through the view, or whole logs, as
    independent; never frames.

    \b
    Examples:
      sonarrec evaluate sonarrec_out/pan
      sonarrec evaluate --ground-truth gt.csv sonarrec_out/log_7 --min-visible 0.5
      sonarrec evaluate --compare before after
      sonarrec evaluate sonarrec_out/pan --least-tpr 0.95 --most-fpr 0.01
    """
    if as_json and compare is not None:
        raise UsageError("--json is not available with --compare; compare.csv has the rates")
    if pairs is not None and (ground_truth or results):
        raise UsageError("--pairs names results and truth; leave out RESULTS and --ground-truth")
    if compare is not None and results:
        raise UsageError(f"--compare names both results; leave out {results}")
    if compare is not None and details:
        raise UsageError(
            "--compare names both results, and compare.csv has all; leave out -v (--details)"
        )
    limits = replace(limits, methods=scoring.methods)
    scoring = replace(scoring, labelled_only=labelled_only)
    from sonarrec.advice.results import of_results
    from sonarrec.evaluation.pairs import read_pairs
    from sonarrec.reports.screen import comparison, screen
    from sonarrec.tables.outputs import below

    folder_of_logs = results or Path("sonarrec_out")
    parent = folder_of_logs if pairs is None else pairs.parent
    truth = ground_truth if pairs is None else read_pairs(pairs)
    worse: Sequence[str]
    if compare is not None:
        from sonarrec.evaluation import compare as comparing

        old, new = compare
        if old.exists() and old.resolve() == new.resolve():
            raise UsageError(f"{old} and {new}: one folder; give old results, then new ones")
        compared = comparing.compare(old, new, truth, scoring, of_results)
        notes, unused, folder = compared.notes, compared.unused, out or below(new, "evaluation")
        files = comparing.write_comparison(folder, compared)
        judged = comparing.judge(compared, limits)
        worse = judged.faults if limits.are_given else ()
        shown = f"{new} against {old}: {comparison(compared, judged)}"
        document = ""
    else:
        from sonarrec.evaluation.evaluate import evaluate_logs
        from sonarrec.evaluation.write import json_text, write_evaluation

        scored = evaluate_logs(  # pairs name the results too
            truth if isinstance(truth, list) else folder_of_logs,
            None if isinstance(truth, list) else truth,
            scoring,
            of_results,
        )
        notes, unused, folder = scored.notes, scored.unused, out or below(parent, "evaluation")
        files = write_evaluation(folder, scored)
        worse = limits.broken(scored.counts)
        document = json_text(scored) if as_json else ""
        shown = screen(scored, details) + "\n"
    print_notes(unused)
    if as_json:
        click.echo(document, nl=False)
    elif not quiet:
        click.echo(shown)
        more = len(notes) - MOST_NOTES
        if more > 0 and compare is None and not details:
            notes = (*notes[:MOST_NOTES], f"and {number_of(more, 'more note')}; see --details")
        lines = (f"note: {note}" for note in notes)
        say(*lines, f"{folder}: {', '.join(files)}")
    else:
        print_notes((), notes)
    print_notes(worse)
    if code := WORSE if worse else PARTLY if unused else 0:
        leave(code)
