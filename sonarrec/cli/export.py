"""`sonarrec export`: results for other programs."""

from __future__ import annotations

from pathlib import Path

import click

from sonarrec.cli import options
from sonarrec.cli.endings import finish
from sonarrec.cli.groups import ANY, command, in_output


@command(short_help="Write results for annotation tools, as COCO.")
@click.argument("results", type=ANY, nargs=-1)
@options.method
@in_output(
    "--to", type=click.Choice(["coco"]), default="coco", expose_value=False, help="The format."
)
@options.out(
    ANY,
    "A new file; for several logs a folder, in which each has LOG.json. An existing file is not "
    "overwritten.  [default: coco.json, or the folder coco]",
    ".json",
)
@options.quiet
def export(results: tuple[Path, ...], method: str | None, out: Path | None, quiet: bool) -> None:
    """Write the declared claims of RESULTS as boxes with scores, for CVAT, Label Studio, FiftyOne.

    RESULTS are folders that `sonarrec run` wrote, of one log or of several (default:
    sonarrec_out). The images listed are the log's own image files, else its fan images, named
    LOG_NNNNNN.png after the frame. A box is as large as the whole disc. `truth convert` reads such
    a file, corrected or not, as a gt.csv.

    \b
    Examples:
      sonarrec export sonarrec_out/pan --to coco
      sonarrec export day1 day2 --to coco --method smi -o claims
    """
    from sonarrec.overlays.coco import export_coco

    lines, diagnostics = export_coco(results or (Path("sonarrec_out"),), out, method)
    finish(quiet, lines, diagnostics.problems, diagnostics.notes)
