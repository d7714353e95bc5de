"""`sonarrec evaluate`: score results against ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sonarrec.cli.endings import PARTLY, leave, say, tell
from sonarrec.cli.groups import BATCH, OUTPUT, SCORING, FiniteRange, command, option
from sonarrec.cli.options import (
    compare_option,
    ground_truth_option,
    out_option,
    pairs_option,
    quiet_option,
    scoring_options,
)
from sonarrec.cli.options_remote import ANY_OR_URL, FILE_OR_URL, CacheChoice, cache_options
from sonarrec.errors import UsageError

if TYPE_CHECKING:
    from sonarrec.evaluation.compare.compare import Comparison
    from sonarrec.evaluation.matching.options import ScoringOptions
    from sonarrec.evaluation.matching.pairs import Pair
    from sonarrec.remote.run import RemoteFiles

    Truth = Path | list[Pair] | None  # one table, pairs, or None: that beside each log


@command(short_help="Score results against ground truth, or compare two.")
@click.argument("results", type=ANY_OR_URL, required=False)
@ground_truth_option(
    "gt.csv, in place of the NAME.gt.csv or gt.csv beside each log.", kind=FILE_OR_URL
)
@pairs_option
@compare_option("what got better or worse from OLD to NEW, frame by frame.")
@option(
    SCORING,
    "--fail-on-regression",
    "band",
    type=FiniteRange(0, 1),
    metavar="BAND",
    help="With --compare: exit with 1 if a rate is worse by more than BAND and more than two "
    "frames.",
)
@option(
    SCORING,
    "--unit",
    type=click.Choice(["pass", "log"]),
    help="Independent unit: a pass of a landmark, or a log.  "
    "[default: log if there are ten or more]",
)
@scoring_options
@option(
    BATCH,
    "-j",
    "--jobs",
    type=click.IntRange(min=1),
    help="How many logs are read at once, each in its own process; this does not change the "
    "figures.  [default: the number of cores; 1 for a few small logs]",
)
@option(
    OUTPUT,
    "-v",
    "--details",
    is_flag=True,
    help="Print the figures of both protocols, per ID and per log.",
)
@option(OUTPUT, "--det", is_flag=True, help="Also draw det.png, the detection error trade-off.")
@option(
    OUTPUT,
    "--json",
    "as_json",
    is_flag=True,
    help="Print evaluation.json (compare.json with --compare), and nothing else, on stdout.",
)
@out_option(
    ANY_OR_URL, "Folder for the files.  [default: evaluation in RESULTS, in NEW or beside PAIRS]"
)
@cache_options
@quiet_option
def evaluate(
    results: Path | str | None,
    ground_truth: Path | str | None,
    pairs: Path | None,
    compare: tuple[Path | str, Path | str] | None,
    band: float | None,
    unit: Any,
    jobs: int | None,
    scoring: ScoringOptions,
    details: bool,
    det: bool,
    as_json: bool,
    out: Path | str | None,
    cache: CacheChoice,
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
      sonarrec evaluate --ground-truth gt.csv --compare before after --fail-on-regression 0.02
    """
    if pairs is not None and (ground_truth or results):
        raise UsageError("--pairs names results and truth; leave out RESULTS and --ground-truth")
    if compare is not None and results is not None:
        raise UsageError("--compare takes OLD and NEW; leave out RESULTS")
    if compare is not None and (details or det):
        raise UsageError("--details and --det are not available with --compare")
    if band is not None and compare is None:
        raise UsageError("--fail-on-regression needs --compare")
    from sonarrec.evaluation.matching.pairs import read_pairs
    from sonarrec.remote.run import RemoteFiles, inside

    results = results or Path("sonarrec_out")
    beside = results if pairs is None else pairs.parent
    with ExitStack() as stack:  # outputs are uploaded as it closes, so leave() comes after it
        remote = RemoteFiles(stack, cache.cache)
        call = _Call(
            truth=remote.file(ground_truth) if pairs is None else read_pairs(pairs),
            scoring=scoring,
            unit=unit,
            jobs=jobs,
            out=out or inside(beside if compare is None else compare[1], "evaluation"),
            remote=remote,
            as_json=as_json,
            quiet=quiet,
        )
        if compare is not None:
            code = _compare(call, compare, band)
        else:
            code = _score(call, results, details=details, det=det)
    if code:
        leave(code)


@dataclass(frozen=True, slots=True)
class _Call:
    """What scoring and comparing have in common. unit: None to choose it by the number of logs."""

    truth: Truth
    scoring: ScoringOptions
    unit: Any
    jobs: int | None
    out: Path | str
    remote: RemoteFiles
    as_json: bool
    quiet: bool

    def tell(self, unused: Sequence[str], notes: Sequence[str]) -> None:
        """Print on stderr what could not be used, and the notes if stdout does not show them."""
        tell(unused, notes if self.quiet and not self.as_json else ())

    def say_written(self, notes: Sequence[str], folder: Path, files: Sequence[str]) -> None:
        """Print the notes and the files that were written."""
        for note in notes:
            say(f"note: {note}")
        say(f"{self.remote.with_server_names(str(folder))}: {', '.join(files)}")


def _score(call: _Call, results: Path | str, *, details: bool, det: bool) -> int:
    """Score and print; returns the exit code. results: not used if the truth is a list of pairs."""
    from sonarrec.evaluation import tabulate, write
    from sonarrec.evaluation.evaluate import evaluate_many
    from sonarrec.evaluation.summary import summarise

    truth, remote = call.truth, call.remote
    if isinstance(truth, list):  # pairs name the results too
        result = evaluate_many(truth, None, call.scoring, jobs=call.jobs)
    else:
        result = evaluate_many(
            remote.results(results),
            truth,
            call.scoring,
            jobs=call.jobs,
            find_beside=remote.beside,
        )
    folder = remote.output(call.out)
    result = replace(
        result,
        notes=tuple(map(remote.with_server_names, result.notes)),
        unused=tuple(map(remote.with_server_names, result.unused)),
    )
    summary = summarise(result, call.unit)
    files = write.write_evaluation(folder, result, summary, det)
    unused, notes = [*remote.unused, *result.unused], [*result.notes, *summary.notes]
    call.tell(unused, notes)
    if call.as_json:
        click.echo(write.json_text(write.as_json(result, summary)), nl=False)
    elif not call.quiet:
        click.echo(tabulate.screen(result))
        click.echo(tabulate.summary_screen(result, summary, details))
        call.say_written(notes, folder, files)
    return PARTLY if unused else 0


def _compare(call: _Call, sides: tuple[Path | str, Path | str], band: float | None) -> int:
    """Compare and print; returns the exit code. band: of --fail-on-regression."""
    from sonarrec.evaluation.compare.screen import screen
    from sonarrec.evaluation.compare.write import comparison_json, write_comparison

    remote = call.remote
    result = compare_sides(sides, call.truth, call.scoring, remote, call.unit, call.jobs)
    folder = remote.output(call.out)
    files = write_comparison(folder, result)
    unused = [*remote.unused, *result.unused]
    call.tell(unused, result.notes)
    if call.as_json:
        for piece in comparison_json(result):
            click.echo(piece, nl=False)
    elif not call.quiet:
        click.echo(screen(result))
        call.say_written(result.notes, folder, files)
    regressions = [] if band is None else result.regressions(band)
    tell(f"worse: {line}" for line in regressions)
    return 1 if regressions else PARTLY if unused else 0


def compare_sides(
    sides: tuple[Path | str, Path | str],
    truth: Truth,
    scoring: ScoringOptions,
    remote: RemoteFiles,
    unit: Any = None,
    jobs: int | None = None,
) -> Comparison:
    """Compare two results, local or on servers, as `evaluation.compare.compare.compare`."""
    from sonarrec.evaluation.compare.compare import compare

    old, new = map(remote.results, sides)
    result = compare(old, new, truth, scoring, unit=unit, jobs=jobs, find_beside=remote.beside)
    return replace(
        result,
        old=remote.with_server_names(result.old),
        new=remote.with_server_names(result.new),
        notes=tuple(map(remote.with_server_names, result.notes)),
        unused=tuple(map(remote.with_server_names, result.unused)),
    )
