"""`sonarrec overlay`: results drawn onto the recording."""

from __future__ import annotations

from pathlib import Path

import click

from sonarrec.cli import options
from sonarrec.cli.bars import progress
from sonarrec.cli.endings import finish
from sonarrec.cli.groups import ANY, NEW_FILE, command, file_names, in_output
from sonarrec.cli.options_log import LogChoice, log_options
from sonarrec.errors import UsageError, number_of


@command(short_help="Draw results onto the frames of their log.")
@click.argument("log", shell_complete=file_names)
@click.argument("results", type=ANY, default=Path("sonarrec_out"))
@log_options()
@options.landmarks
@options.ground_truth("gt.csv, drawn dashed.")
@options.out(
    ANY,
    "What to write, by its ending: NAME.mcap as --mcap, NAME.mp4 as --video, else a folder as "
    "--images.",
)
@in_output(
    "--mcap",
    type=ANY,
    metavar="OUT",
    help="Write annotations and detections, for Foxglove and ROS 2.",
)
@in_output(
    "--foxglove-layout",
    type=NEW_FILE,
    metavar="OUT.json",
    help="Write a Foxglove layout that shows the file of --mcap.",
)
@in_output(
    "--video", type=ANY, metavar="OUT.mp4", help="Draw the frames into a video (MPEG-4 Part 2)."
)
@in_output("--images", type=ANY, metavar="DIR", help="Draw the frames as DIR/000000.png, ...")
@options.method
@options.frames("Draw only the frames from A up to, not including, B.", default="those of the run")
@in_output("--grid", is_flag=True, help="Draw range rings and bearings in videos and images.")
@options.quiet
# Long by its options and its help.
def overlay(
    log: str,
    results: Path,
    log_choice: LogChoice,
    landmarks: str | None,
    ground_truth: Path | None,
    out: Path | None,
    mcap: Path | None,
    foxglove_layout: Path | None,
    video: Path | None,
    images: Path | None,
    method: str | None,
    frames: str | None,
    grid: bool,
    quiet: bool,
) -> None:
    """Draw RESULTS onto the frames of LOG: outlines, IDs, probabilities, trails.

    RESULTS is the folder that `sonarrec run LOG` wrote, or one that holds it (default:
    sonarrec_out). An object is outlined in the colour of its ID if the ID is declared, else in thin
    grey. Videos and images show the probabilities of each ID below the frame.

    \b
    --mcap    Open it in Foxglove together with LOG, and show /sonarrec/annotations in the
              Image panel or import the layout. /sonarrec/detections has the declared
              landmarks as vision_msgs/Detection3DArray for ROS 2. For polar or flipped logs,
              folders and videos it also has the fan images, /sonarrec/fan.
    --video   MPEG-4 Part 2, for VLC, mpv and most desktop players. For browsers:
              ffmpeg -i OUT.mp4 -c:v libx264 -pix_fmt yuv420p WEB.mp4

    \b
    Examples:
      sonarrec overlay sample_data/pan.mcap -o overlay.mcap
      sonarrec overlay pings/ -o pings.mp4 --ground-truth gt.csv
      sonarrec overlay log.mcap results/log --images shots --frames 100:120 --method smi
    """
    from sonarrec.overlays.overlay import Targets, write_overlay
    from sonarrec.results.run_file import frame_span

    targets = {"--mcap": mcap, "--video": video, "--images": images}
    if out is not None:
        kind = {".mcap": "--mcap", ".mp4": "--video"}.get(out.suffix.lower(), "--images")
        if targets[kind] is not None:
            raise UsageError(f"--out {out} and {kind}: give one of the two")
        targets[kind] = out
        mcap, video, images = targets.values()
    if foxglove_layout is not None and mcap is None:
        raise UsageError("--foxglove-layout needs --mcap")
    if not any(targets.values()):
        raise UsageError("nothing to write: give -o OUT.mcap, -o OUT.mp4 or -o DIR")
    with progress(quiet) as step:
        report = write_overlay(
            log,
            Targets(mcap, video, images, foxglove_layout),
            results=results,
            method=method,
            span=None if frames is None else frame_span(frames),
            ground_truth=ground_truth,
            landmarks=landmarks,
            **log_choice.arguments(),
            grid=grid,
            observe=step,
        )
    frames_drawn = f"{number_of(report.frames, 'frame')}, {report.method}"
    lines = [f"{target}: {frames_drawn}" for target in filter(None, targets.values())]
    finish(report.diagnostics, quiet, lines)
