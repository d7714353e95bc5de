"""`sonarrec evaluate`: score results against ground truth."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sonarrec.cli import options
from sonarrec.cli.endings import PARTLY, WORSE, leave, say, tell
from sonarrec.cli.groups import FiniteRange, command, in_batch, in_output, in_scoring
from sonarrec.errors import SonarrecError, UsageError

if TYPE_CHECKING:
    from sonarrec.evaluation.comparison import Comparison
    from sonarrec.evaluation.limits import Limits
    from sonarrec.evaluation.match import ScoringOptions
    from sonarrec.evaluation.pairs import Pair
    from sonarrec.remote.run import RemoteFiles


@command(short_help="Score results against ground truth, or compare them.")
@click.argument("results", type=options.ANY_OR_URL, nargs=-1)
@options.ground_truth(
    "gt.csv, in place of the NAME.gt.csv or gt.csv beside each log.", kind=options.FILE_OR_URL
)
@options.pairs
@options.compare(
    "What got better or worse from OLD to NEW, frame by frame; RESULTS are then further ones to "
    "compare with OLD."
)
@options.baseline
@in_scoring(
    "--fail-on-regression band",
    type=FiniteRange(0, 1),
    metavar="BAND",
    help="With --compare: exit with 4 if a rate is worse by more than BAND and more than two "
    "frames.",
)
@options.limits
@in_scoring(
    "--unit",
    type=click.Choice(["pass", "log"]),
    help="Independent unit: a pass of a landmark, or a log.  "
    "[default: log if there are ten or more]",
)
@in_scoring(
    "--bound share",
    type=FiniteRange(0, 1, min_open=True, max_open=True),
    metavar="SHARE",
    help="Find the least declare at which, with 95 % confidence over passes, at most SHARE of the "
    "claims are false, and write it as bound.toml, for `sonarrec run --config`; exit with 4 if "
    "there is none.",
)
@options.scoring
@in_batch(
    "-j --jobs",
    type=click.IntRange(min=1),
    help="How many logs are read at once, each in its own process; this does not change the "
    "figures.  [default: the number of cores; 1 for a few small logs]",
)
@in_output(
    "-v --verbose --details details",
    is_flag=True,
    help="Print the figures of both protocols, per ID and per log.",
)
@in_output("--det", is_flag=True, help="Also draw det.png, the detection error trade-off.")
@in_output(
    "--json as_json",
    is_flag=True,
    help="Print evaluation.json (compare.json with --compare), and nothing else, on stdout.",
)
@options.out(
    options.ANY_OR_URL,
    "Folder for the files.  [default: evaluation in RESULTS, in NEW or beside PAIRS]",
)
@options.cache
@options.quiet
def evaluate(
    results: tuple[Path | str, ...],
    ground_truth: Path | str | None,
    pairs: Path | None,
    compare: tuple[Path | str, Path | str] | None,
    baseline: bool,
    band: float | None,
    limits: Limits,
    unit: Any,
    share: float | None,
    jobs: int | None,
    scoring: ScoringOptions,
    details: bool,
    det: bool,
    as_json: bool,
    out: Path | str | None,
    cache: options.GetCache,
    quiet: bool,
) -> None:
    """Score RESULTS against ground truth: rates, ROC, intervals and tests, per method and ID.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). Truth is
    found beside each log, or given; both may be on a server (`sonarrec help remote`). The geometry
    is needed only if positions are in pixels and run.toml does not state it. Files go to
    RESULTS/evaluation. Intervals and tests treat whole passes of a landmark through the view, or
    whole logs, as independent; never frames.

    \b
    Examples:
      sonarrec evaluate sonarrec_out/pan
      sonarrec evaluate --ground-truth gt.csv sonarrec_out/log_7 --min-visible 0.5
      sonarrec evaluate --pairs pairs.csv --details
      sonarrec evaluate --compare before after
      sonarrec evaluate sonarrec_out/pan --least-tpr 0.95 --most-fpr 0.01
      sonarrec evaluate sonarrec_out --bound 0.02
      sonarrec evaluate --ground-truth gt.csv --compare before after --fail-on-regression 0.02
    """
    if pairs is not None and (ground_truth or (results and compare is None)):
        raise UsageError("--pairs names results and truth; leave out RESULTS and --ground-truth")
    if compare is None and results[1:]:
        raise UsageError("several RESULTS need --compare; a folder that holds several logs is one")
    if compare is not None and (details or det or share):
        raise UsageError("--details, --det and --bound are not available with --compare")
    if band is not None and compare is None:
        raise UsageError("--fail-on-regression needs --compare")
    limits = replace(limits, band=band, methods=scoring.methods, baseline=baseline)
    from sonarrec.evaluation.pairs import read_pairs
    from sonarrec.remote.run import RemoteFiles, inside

    folder_of_logs = results[0] if results else Path("sonarrec_out")
    beside = folder_of_logs if pairs is None else pairs.parent
    worse: list[str] = []
    with ExitStack() as stack:  # outputs are uploaded as it closes, so leave() comes after it
        remote = RemoteFiles(stack, cache)
        truth = remote.file(ground_truth) if pairs is None else read_pairs(pairs)
        if compare is not None:
            from sonarrec.evaluation.compare_screen import screen
            from sonarrec.evaluation.compare_write import comparison_json, write_comparison
            from sonarrec.evaluation.limits import judge_by

            old, *news = (*compare, *results)
            found, written = [], []
            for n, new in enumerate(news, 1):
                one = compare_sides(old, new, truth, scoring, remote, unit, jobs, baseline)
                place = inside(out, f"{n}-{Path(str(new)).name}") if out and news[1:] else out
                folder = remote.output(place or inside(new, "evaluation"))
                written.append((folder, write_comparison(folder, one)))
                worse += judge_by(one, limits).faults if limits.are_given else ()
                found.append(one)
            notes = tuple(dict.fromkeys(note for one in found for note in one.notes))
            left_out = (line for one in found for line in one.unused)
            unused = tuple(dict.fromkeys((*remote.unused, *left_out)))
            document: Iterable[str] = comparison_json(*found)
            screens = [] if quiet or as_json else [screen(found)]
        else:
            from sonarrec.evaluation import tabulate, write
            from sonarrec.evaluation.bound import bound_table
            from sonarrec.evaluation.evaluate import evaluate_logs
            from sonarrec.results.bound import Bound

            scored = evaluate_logs(  # pairs name the results too
                truth if isinstance(truth, list) else remote.results(folder_of_logs),
                None if isinstance(truth, list) else truth,
                scoring,
                unit=unit,
                jobs=jobs,
                find_beside=remote.beside,
            )
            there = remote.with_server_names
            notes, unused = tuple(map(there, scored.notes)), tuple(map(there, scored.unused))
            scored = replace(scored, notes=notes, unused=unused)
            folder = remote.output(out or inside(beside, "evaluation"))
            files = write.write_evaluation(folder, scored, det)
            said = ""
            if share is not None:
                bound = None
                try:
                    bound = bound_table(scored.counts, scored.folders, share)
                    declare = bound["config"]["features"]["declare"]
                    said = f"\ndeclare {declare:g}: {Bound(**bound['bound']).text()}\n"
                except SonarrecError as refusal:
                    worse.append(there(str(refusal)))
                files += write.write_bound(folder, bound)
            written = [(folder, files)]
            unused = (*remote.unused, *unused)
            worse += limits.broken(scored.counts.scored) if limits.are_given else []
            document = [write.json_text(write.as_json(scored))] if as_json else []
            screens = [tabulate.screen(scored.counts), tabulate.summary_screen(scored, details)]
            screens += [said] if said else []
        tell(unused, notes if quiet and not as_json else ())
        if as_json:
            for piece in document:
                click.echo(piece, nl=False)
        elif not quiet:
            click.echo("\n".join(screens))
            lines = (f"note: {note}" for note in notes)
            there = remote.with_server_names
            say(*lines, *(f"{there(str(folder))}: {', '.join(files)}" for folder, files in written))
        tell(worse)
    if code := WORSE if worse else PARTLY if unused else 0:
        leave(code)


def compare_sides(
    old: Path | str,
    new: Path | str,
    truth: Path | list[Pair] | None,
    scoring: ScoringOptions,
    remote: RemoteFiles,
    unit: Any = None,
    jobs: int | None = None,
    baseline: bool = False,
) -> Comparison:
    """Compare two results, local or on servers, as `evaluation.compare.compare`.

    truth: one table, pairs, or None: that beside each log.
    """
    from sonarrec.evaluation.compare import compare

    result = compare(
        remote.results(old),
        remote.results(new),
        truth,
        scoring,
        baseline=baseline,
        unit=unit,
        jobs=jobs,
        find_beside=remote.beside,
    )
    there = remote.with_server_names
    return replace(
        result,
        old=there(result.old),
        new=there(result.new),
        notes=tuple(map(there, result.notes)),
        unused=tuple(map(there, result.unused)),
    )
