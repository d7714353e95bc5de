"""`sonarrec overlay`: results drawn onto the recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sonarrec.cli import options
from sonarrec.cli.endings import finish, progress
from sonarrec.cli.groups import ANY, command, file_names
from sonarrec.errors import number_of


@command(short_help="Draw results onto the frames of their log.")
@click.argument("log", shell_complete=file_names)
@click.argument("results", type=ANY, default=Path("sonarrec_out"))
@options.reading()
@options.landmarks
@options.ground_truth("gt.csv, drawn dashed.")
@options.out(
    ANY,
    "What to write, by its ending: NAME.mcap (annotations for Foxglove), NAME.mp4 (a video), else "
    "a folder of images.",
    required=True,
)
@options.method
@options.frames("Draw the frames from A up to, not including, B, in place of those of the run.")
@options.quiet
def overlay(
    log: str,
    results: Path,
    reading: dict[str, Any],
    landmarks: str | None,
    ground_truth: Path | None,
    out: Path,
    method: str | None,
    frames: tuple[int, int | None] | None,
    quiet: bool,
) -> None:
    """Draw RESULTS onto the frames of LOG: outlines, IDs, probabilities, trails.

    RESULTS is the folder that `sonarrec run LOG` wrote, or one that holds it (default:
    sonarrec_out). An object is outlined in the colour of its ID if the ID is declared, else in thin
    grey. Videos and images show the probabilities of each ID below the frame.

    Open NAME.mcap in Foxglove together with LOG, and show /sonarrec/annotations in the Image panel;
    for polar or flipped logs, folders and videos it also has the fan images, /sonarrec/fan.
    NAME.mp4 is MPEG-4 Part 2, for VLC, mpv and most desktop players. For browsers: `ffmpeg -i
    NAME.mp4 -c:v libx264 -pix_fmt yuv420p WEB.mp4`.

    \b
    Examples:
      sonarrec overlay sample_data/pan.mcap -o overlay.mcap
      sonarrec overlay pings/ -o pings.mp4 --ground-truth gt.csv
      sonarrec overlay log.mcap results/log -o shots --frames 100:120 --method smi
    """
    from sonarrec.overlays import overlay as overlays

    with progress(quiet) as step:
        report = overlays.overlay(
            log,
            out,
            results=results,
            method=method,
            frames=frames,
            ground_truth=ground_truth,
            landmarks=landmarks,
            **reading,
            observe=step,
        )
    line = f"{out}: {number_of(report.frames, 'frame')}, {report.method}"
    finish(quiet, [line], report.diagnostics.problems, report.diagnostics.notes)
