"""`sonarrec report`: one HTML page about the results."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sonarrec.cli import options
from sonarrec.cli.endings import end, say, tell
from sonarrec.cli.groups import command, in_input
from sonarrec.cli.options_log import topic_option
from sonarrec.errors import UsageError, number_of

if TYPE_CHECKING:
    from sonarrec.evaluation.match import ScoringOptions


@command(short_help="Write results as one HTML page.")
@click.argument("results", type=options.ANY_OR_URL, nargs=-1)
@options.ground_truth("gt.csv; without it nothing is scored.", kind=options.FILE_OR_URL)
@options.compare(
    "A page on what got better or worse from OLD to NEW; RESULTS are then further ones, a page "
    "each. Truth is given, or found beside each log."
)
@options.pairs
@in_input(
    "--log recordings",
    type=options.ANY_OR_URL,
    multiple=True,
    help="The log that RESULTS came from, or a folder of logs, to show frames on the page; "
    "repeatable.",
)
@topic_option
@options.scoring
@options.out(
    options.NEW_FILE_OR_URL,
    "The page.  [default: report.html in RESULTS or beside PAIRS; compare.html in NEW]",
)
@options.cache
@options.quiet
def report(
    results: tuple[Path | str, ...],
    ground_truth: Path | str | None,
    compare: tuple[Path | str, Path | str] | None,
    pairs: Path | None,
    recordings: tuple[Path | str, ...],
    topic: str | None,
    scoring: ScoringOptions,
    out: Path | str | None,
    cache: options.GetCache,
    quiet: bool,
) -> None:
    """Write RESULTS as one HTML page that needs no network and no other file.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). The page
    shows which landmarks were seen, when and with what score, and the probabilities along each
    track. With ground truth it also shows the paper's tables, the ROC and the worst mistakes; with
    the log also its frames, on a click on a bar, a track or a mistake. The geometry is needed only
    if run.toml does not state it. All inputs, and the page, may be on a server (`sonarrec help
    remote`).

    \b
    Examples:
      sonarrec report
      sonarrec report sonarrec_out/pan --log sample_data/pan.mcap
      sonarrec report --ground-truth gt.csv --log pings/ -o report.html
      sonarrec report --pairs pairs.csv --log recordings/
      sonarrec report --compare before after --ground-truth gt.csv
    """
    if compare is not None and (recordings or topic):
        raise UsageError("--compare takes results and truth; leave out --log and --topic")
    if compare is None and results[1:]:
        raise UsageError("several RESULTS need --compare; a folder that holds several logs is one")
    if compare is not None and out and results:
        raise UsageError("--out names one page; without it each lies in its results")
    if pairs is not None and (ground_truth or results) and compare is None:
        raise UsageError("--pairs names results and truth; leave out RESULTS and --ground-truth")
    if pairs is not None and ground_truth is not None:
        raise UsageError("--pairs names the truth of each log; leave out --ground-truth")

    from sonarrec.remote.run import RemoteFiles, inside
    from sonarrec.reports.build import write_report

    shown = results[0] if results else Path("sonarrec_out")
    with ExitStack() as stack:  # the page is uploaded as this closes
        remote = RemoteFiles(stack, cache)
        truth = remote.file(ground_truth)
        unused, lines = list[str](), list[str]()
        if compare is not None:
            from sonarrec.cli.evaluate import compare_sides
            from sonarrec.evaluation.pairs import read_pairs
            from sonarrec.reports.compare import write_comparison_page
            from sonarrec.tables.outputs import check_output

            known = truth if pairs is None else read_pairs(pairs)
            for new in (compare[1], *results):
                path = remote.output(out or inside(new, "compare.html"), "compare.html")
                check_output(path, "comparison", [truth, pairs])
                comparison = compare_sides(compare[0], new, known, scoring, remote)
                write_comparison_page(path, comparison)
                unused += [line for line in comparison.unused if line not in unused]
                lines.append(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
        else:
            beside = shown if pairs is None else pairs.parent
            page = write_report(
                remote.output(out or inside(beside, "report.html"), "report.html"),
                remote.results(shown) if pairs is None else None,
                ground_truth=truth,
                pairs=pairs,
                recordings=[remote.log(recording) for recording in recordings],
                topic=topic,
                options=scoring,
            )
            unused, size = [*page.unused], f"{page.path.stat().st_size / 1e6:.1f} MB"
            clickable = f", {number_of(page.held, 'frame')} to click" if page.held else ""
            lines = [f"{page.path}: {size}, {number_of(page.pictures, 'picture')}{clickable}"]
        unused = [*remote.unused, *map(remote.with_server_names, unused)]
        tell(unused)
        if not quiet:
            say(*map(remote.with_server_names, lines))
    end(unused)
