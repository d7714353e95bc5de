"""`sonarrec report`: one page that shows what was recognised, and how well."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from sonarrec.cli.options import (
    ANY_OR_URL,
    FILE_OR_URL,
    INPUT,
    NEW_FILE_OR_URL,
    OUTPUT,
    PARTLY,
    CacheChoice,
    cache_options,
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


@command(short_help="Write results as one HTML page.")
@click.argument("results", type=ANY_OR_URL, default=Path("sonarrec_out"))
@ground_truth_option("gt.csv; without it nothing is scored.", kind=FILE_OR_URL)
@option(
    INPUT,
    "--log",
    "recordings",
    type=ANY_OR_URL,
    multiple=True,
    help="The log that RESULTS came from, for frames on the page; once for each of several.",
)
@topic_option
@scoring_options
@option(
    OUTPUT,
    "--method",
    help="Whose sightings and tracks are shown.  [default: framework, or the first preset]",
)
@out_option(NEW_FILE_OR_URL, "The page.  [default: RESULTS/report.html]")
@cache_options
@quiet_option
def report(
    results: Path | str,
    ground_truth: Path | str | None,
    recordings: tuple[Path | str, ...],
    topic: str | None,
    scoring: dict[str, Any],
    method: str | None,
    out: Path | str | None,
    cache: CacheChoice,
    quiet: bool,
) -> None:
    """Write RESULTS as one HTML page that needs nothing else: no network, no other file.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). The page
    shows what was seen, when and how surely, and the probabilities along each track; with ground
    truth also the paper's tables, the ROC and the worst mistakes; with the log also its frames.
    The geometry matters only where run.toml does not tell it.

    \b
    Examples:
      sonarrec report
      sonarrec report sonarrec_out/pan --log sample_data/pan.mcap
      sonarrec report --ground-truth gt.csv --log pings/ -o report.html
    """
    from sonarrec.remote.run import Here, inside
    from sonarrec.report.build import write_report

    with ExitStack() as held:  # the page is uploaded as it closes
        here = Here(held, cache.cache)
        written = write_report(
            here.output(out or inside(results, "report.html"), "report.html"),
            here.results(results),
            ground_truth=here.file(ground_truth),
            recordings=[here.log(recording) for recording in recordings],
            topic=topic,
            method=method,
            **scoring,
        )
        unused = [*here.unused, *map(here.told, written.unused)]
        tell(unused)
        if not quiet:
            size = written.path.stat().st_size / 1e6
            frames = "1 frame" if written.pictures == 1 else f"{written.pictures} frames"
            click.echo(f"{here.told(str(written.path))}: {size:.1f} MB, {frames} of the log")
    if unused:
        leave(PARTLY)
