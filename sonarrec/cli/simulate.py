"""`sonarrec simulate`: render a recording with ground truth."""

from __future__ import annotations

from pathlib import Path

from sonarrec.cli import options
from sonarrec.cli.endings import print_notes, progress, say
from sonarrec.cli.groups import ANY, IntegerRange, command, file_names, in_input
from sonarrec.errors import number_of


@command(short_help="Render a recording with ground truth.")
@in_input(
    "--scene source",
    shell_complete=file_names,
    default="paper",
    help="Scene: a built-in name (paper, basin, plates, sample_pan, sample_polar) or a TOML file.",
)
@in_input("--seed", type=IntegerRange(min=0), help="Seed, in place of that of the scene.")
@in_input(
    "--frames",
    type=IntegerRange(1, 10**9),
    metavar="N",
    help="Number of frames, in place of that of the scene.",
)
@options.out(
    ANY,
    "Folder for the recording, or NAME.mcap for one file with its companions next to it.",
    ".mcap",
    required=True,
)
@options.quiet
def simulate(source: str, seed: int | None, frames: int | None, out: Path, quiet: bool) -> None:
    """Render a recording with ground truth: frames, sonar.toml, gt.csv and the scene itself.

    An MCAP holds images (sensor_msgs/msg/Image) or, of a polar scene, pings
    (marine_acoustic_msgs/msg/ProjectedSonarImage).

    \b
    Examples:
      sonarrec simulate --scene paper -o paper_log
      sonarrec simulate --scene my_scene.toml --frames 200 -o log.mcap
    """
    from dataclasses import replace

    from sonarrec.simulation.scene import load_scene
    from sonarrec.simulation.simulate import write_recording

    scene = load_scene(source)
    if seed is not None:
        scene = replace(scene, seed=seed)
    if frames is not None:
        scene = replace(scene, frames=frames)
    with progress(quiet, scene.frames) as step:
        seen = write_recording(scene, out, progress=lambda _: step())
    if not quiet:
        say(f"{out}: {number_of(scene.frames, 'frame')} of scene {scene.name!r}")
    if not seen:
        why = "check the positions (m) in the scene and the sonar's window"
        print_notes((), [f"{out}: no landmark comes into view in any frame; {why}"])
