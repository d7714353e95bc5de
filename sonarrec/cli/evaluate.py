"""`sonarrec evaluate`: score results against ground truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sonarrec.cli import options
from sonarrec.cli.endings import PARTLY, WORSE, leave, say, tell
from sonarrec.cli.groups import ANY, command, in_batch, in_output
from sonarrec.errors import UsageError, number_of

if TYPE_CHECKING:
    from sonarrec.evaluation.compare import Limits
    from sonarrec.evaluation.match import ScoringOptions

MOST_NOTES = 5


@command(short_help="Score results against ground truth, or compare them.")
@click.argument("results", type=ANY, nargs=-1)
@options.ground_truth("gt.csv, in place of the NAME.gt.csv or gt.csv beside each log.")
@options.pairs
@options.compare(
    "What got better or worse from OLD to NEW; RESULTS are then further ones to compare with OLD."
)
@options.limits
@options.scoring
@in_batch(
    "-j --jobs",
    type=click.IntRange(min=1),
    help="How many logs are read at once.  [default: as many as cores; 1 for a few small]",
)
@in_output(
    "-v --verbose --details details",
    is_flag=True,
    help="Print the figures of both protocols, per ID and per log.",
)
@in_output(
    "--json as_json",
    is_flag=True,
    help="Print evaluation.json, and nothing else, on stdout.",
)
@options.out(ANY, "Folder for the files.  [default: evaluation in RESULTS, in NEW or beside PAIRS]")
@options.quiet
def evaluate(
    results: tuple[Path, ...],
    ground_truth: Path | None,
    pairs: Path | None,
    compare: tuple[Path, Path] | None,
    limits: Limits,
    jobs: int | None,
    scoring: ScoringOptions,
    details: bool,
    as_json: bool,
    out: Path | None,
    quiet: bool,
) -> None:
    """Score RESULTS against ground truth: rates, ROC, intervals and tests.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). Truth is
    found beside each log, or given. Files go to RESULTS/evaluation. Intervals and tests treat whole
    passes of a landmark through the view, or whole logs, as independent; never frames.

    \b
    Examples:
      sonarrec evaluate sonarrec_out/pan
      sonarrec evaluate --ground-truth gt.csv sonarrec_out/log_7 --min-visible 0.5
      sonarrec evaluate --compare before after
      sonarrec evaluate sonarrec_out/pan --least-tpr 0.95 --most-fpr 0.01
    """
    if as_json and compare is not None:
        raise UsageError("--json is not available with --compare; compare.csv has the rates")
    if pairs is not None and (ground_truth or (results and compare is None)):
        raise UsageError("--pairs names results and truth; leave out RESULTS and --ground-truth")
    if compare is None and results[1:]:
        raise UsageError("several RESULTS need --compare; a folder that holds several logs is one")
    if compare is not None and details:
        raise UsageError("--details is not available with --compare")
    limits = replace(limits, methods=scoring.methods)
    from sonarrec.evaluation.pairs import read_pairs

    folder_of_logs = results[0] if results else Path("sonarrec_out")
    beside = folder_of_logs if pairs is None else pairs.parent
    truth = ground_truth if pairs is None else read_pairs(pairs)
    worse: list[str] = []
    if compare is not None:
        from sonarrec.evaluation import compare as comparing

        old, *news = (*compare, *results)
        found, written, screens = [], [], []
        for n, new in enumerate(news, 1):
            one = comparing.compare(old, new, truth, scoring, jobs=jobs)
            place = out / f"{n}-{new.name}" if out and news[1:] else out
            folder = place or new / "evaluation"
            written.append((folder, comparing.write_comparison(folder, one)))
            judged = comparing.judge(one, limits)
            worse += judged.faults if limits.are_given else ()
            found.append(one)
            screens.append(f"{new} against {old}: {comparing.screen(one, judged)}")
        notes = tuple(dict.fromkeys(note for one in found for note in one.notes))
        unused = tuple(dict.fromkeys(line for one in found for line in one.unused))
        document = ""
    else:
        from sonarrec.evaluation.evaluate import evaluate_logs
        from sonarrec.evaluation.screen import screen
        from sonarrec.evaluation.write import json_text, write_evaluation

        scored = evaluate_logs(  # pairs name the results too
            truth if isinstance(truth, list) else folder_of_logs,
            None if isinstance(truth, list) else truth,
            scoring,
            jobs=jobs,
        )
        notes, unused = tuple(scored.notes), tuple(scored.unused)
        folder = out or beside / "evaluation"
        written = [(folder, write_evaluation(folder, scored))]
        worse += limits.broken(scored.counts.scored) if limits.are_given else []
        document = json_text(scored) if as_json else ""
        screens = [screen(scored, details), ""]
    tell(unused, notes if quiet and not as_json else ())
    if as_json:
        click.echo(document, nl=False)
    elif not quiet:
        click.echo("\n".join(screens))
        more = len(notes) - MOST_NOTES
        if more > 0 and compare is None and not details:
            notes = (*notes[:MOST_NOTES], f"and {number_of(more, 'more note')}; see --details")
        lines = (f"note: {note}" for note in notes)
        say(*lines, *(f"{folder}: {', '.join(files)}" for folder, files in written))
    tell(worse)
    if code := WORSE if worse else PARTLY if unused else 0:
        leave(code)
