"""`sonarrec overlay`: results drawn onto the recording."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import click

from sonarrec.cli.options import (
    FILE,
    PARTLY,
    landmarks_of_results_option,
    sonar_from_flags,
    sonar_options,
    topic_option,
)
from sonarrec.records import UsageError

OUT = click.Path(path_type=Path)


@click.command(short_help="Draw results onto the frames of their log.")
@click.argument("log")
@click.argument("results", type=OUT, default=Path("sonarrec_out"))
@click.option("--mcap", type=OUT, metavar="OUT", help="Annotations for Foxglove.")
@click.option("--video", type=OUT, metavar="OUT.mp4", help="The frames drawn, as MPEG-4.")
@click.option("--images", type=OUT, metavar="DIR", help="The frames drawn, as DIR/000000.png, ...")
@click.option("--method", help="Method of estimates.csv.  [default: framework]")
@click.option(
    "--frames", metavar="A:B", help="From frame A up to, not including, B; either may be left out."
)
@click.option("--ground-truth", type=FILE, help="gt.csv, drawn dashed.")
@topic_option
@landmarks_of_results_option
@sonar_options
@click.option("-q", "--quiet", is_flag=True, help="No progress bar and no summary.")
def overlay(
    log: str,
    results: Path,
    mcap: Path | None,
    video: Path | None,
    images: Path | None,
    method: str | None,
    frames: str | None,
    ground_truth: Path | None,
    topic: str | None,
    landmarks: str | None,
    sonar_file: Path | None,
    quiet: bool,
    **flags: Any,
) -> None:
    """Draw RESULTS onto the frames of LOG: outlines, IDs, probabilities, trails.

    RESULTS is the folder that `sonarrec run LOG` wrote, or one that holds it (default:
    sonarrec_out). An object is outlined in its ID's colour where the ID is declared, else thin
    and grey; below the frames of videos and images run the probabilities of each ID.

    \b
    --mcap    Open it in Foxglove together with LOG, show /sonarrec/annotations in the
              Image panel. Of polar logs, and of logs that are no MCAP, it also holds the
              fan images, /sonarrec/fan.
    --video   MPEG-4 Part 2, for VLC, mpv and most desktop players. For browsers:
              ffmpeg -i OUT.mp4 -c:v libx264 -pix_fmt yuv420p WEB.mp4

    \b
    Examples:
      sonarrec overlay log.mcap --mcap overlay.mcap
      sonarrec overlay pings/ --video pings.mp4 --ground-truth gt.csv
      sonarrec overlay log.mcap results/log --images shots --frames 100:120 --method smi
    """
    from tqdm import tqdm

    from sonarrec.overlay.overlay import Targets, write_overlay

    targets = {"--mcap": mcap, "--video": video, "--images": images}
    if not any(targets.values()):
        raise UsageError("nothing to write: give --mcap OUT, --video OUT.mp4 or --images DIR")
    with tqdm(unit="frame", leave=False, disable=True if quiet else None) as bar:

        def observe(total: int | None) -> None:
            bar.total = total
            bar.update()

        done = write_overlay(
            log,
            Targets(mcap, video, images),
            results=results,
            method=method,
            span=_span(frames),
            ground_truth=ground_truth,
            landmarks=landmarks,
            sonar=sonar_from_flags(flags),
            sonar_file=sonar_file,
            topic=topic,
            observe=observe,
        )
    for problem in done.problems:
        click.echo(f"sonarrec: {problem}", err=True)
    if not quiet:
        for target in filter(None, targets.values()):
            click.echo(f"{target}: {done.frames} frames, {done.method}")
    if done.problems:
        click.get_current_context().exit(PARTLY)


def _span(text: str | None) -> tuple[int, int | None]:
    """(first, one past the last or None) of "A:B", either of which may be left out."""
    match = re.fullmatch(r"(\d*):(\d*)", text or ":")
    if match is None:
        raise UsageError(f"--frames: expected A:B, two frame numbers, not {text!r}")
    first, end = int(match[1] or 0), int(match[2]) if match[2] else None
    if end is not None and end <= first:
        raise UsageError(
            f"--frames {text}: there is no frame from {first} up to, not including, {end}"
        )
    return first, end
