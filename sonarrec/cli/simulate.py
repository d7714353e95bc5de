"""`sonarrec simulate`: render a recording with ground truth."""

from __future__ import annotations

from pathlib import Path

import click

from sonarrec.cli import options
from sonarrec.cli.bars import progress
from sonarrec.cli.endings import end, naming_leftovers, say, tell
from sonarrec.cli.groups import ANY, command, file_names, in_input, in_output
from sonarrec.cli.options_background import LayoutChoice, laying_options
from sonarrec.cli.options_log import LogChoice, log_options
from sonarrec.errors import UsageError, number_of


@command(short_help="Render a recording with ground truth.")
@in_input(
    "--scene source",
    shell_complete=file_names,
    help="Scene: a built-in name (paper, basin, plates, sample_pan, sample_polar) or a TOML file.  "
    "[default: paper]",
)
@in_input(
    "--background",
    shell_complete=file_names,
    metavar="LOG",
    help="In place of a scene: a recording without landmarks, into which landmarks are laid; it is "
    "read as in `sonarrec run`.",
)
@in_input(
    "--seed",
    type=click.IntRange(min=0),
    help="Seed, in place of that of the scene; with --background, of the positions of the discs.",
)
@in_input(
    "--frames",
    metavar="N",
    help="Number of frames, in place of that of the scene; with --background A:B: use only these "
    "frames.",
)
@laying_options("6")
@log_options(flags=True, time=True)
@in_output(
    "--format image_format",
    type=click.Choice(["png", "mcap"]),
    help="A folder of images, or one MCAP file; with --background images.  "
    "[default: mcap if OUT ends in .mcap, else png]",
)
@in_output(
    "--schema",
    metavar="NAME",
    help="Message type of an MCAP, such as sensor_msgs/msg/Image; add +ros1 or +json for another "
    "encoding than CDR (ROS) or protobuf (Foxglove). The message for a wrong name lists all.  "
    "[default: sensor_msgs/msg/Image]",
)
@in_output(
    "--compression",
    type=click.Choice(["none", "lz4", "zstd"]),
    help="Compression of an MCAP.  [default: zstd]",
)
@options.out(
    ANY,
    "Folder for the recording, or NAME.mcap for one file with its companions beside it.",
    required=True,
)
@options.quiet
# Long by its options and its help.
def simulate(
    source: str | None,
    background: str | None,
    seed: int | None,
    frames: str | None,
    laying: LayoutChoice,
    log_choice: LogChoice,
    image_format: str | None,
    schema: str | None,
    compression: str | None,
    out: Path,
    quiet: bool,
) -> None:
    """Render a recording with ground truth: frames, sonar.toml, gt.csv and the scene itself.

    With --background landmarks are laid into a recording of your own that holds none. They lie at
    random positions on the floor and stay there as the sonar moves; speckle, light and motion are
    those of the recording.

    \b
    Examples:
      sonarrec simulate --scene paper -o paper_log
      sonarrec simulate --scene my_scene.toml --frames 200 -o log.mcap
      sonarrec simulate --scene sample_polar -o pings.mcap \\
        --schema marine_acoustic_msgs/msg/ProjectedSonarImage
      sonarrec simulate --background dive.mcap --tilt-deg 20 --contrast 6 -o dive_6db
      sonarrec simulate --background dive.mcap --contrast 0,3,6,10 -o series
    """
    if background is not None:
        of_scenes = {"scene": source, "format": image_format, "schema": schema}
        for name, value in (of_scenes | {"compression": compression}).items():
            if value is not None:
                raise UsageError(f"--{name} is for scenes; leave it out with --background")
        _lay(background, seed or 0, frames, laying, log_choice, out, quiet)
        return
    for name, value in (*laying.values.items(), *log_choice.values.items()):
        if value is not None:
            flag = f"--{name.replace('_', '-')}"
            raise UsageError(f"{flag} is for --background LOG; a scene has its own")
    if image_format is None and out.suffix == ".mcap":
        image_format = "mcap"
    if image_format != "mcap" and (schema or compression):
        raise UsageError("--schema and --compression are for --format mcap")
    from dataclasses import replace

    from sonarrec.simulation.plates import PlateScene, plate_scene
    from sonarrec.simulation.scene import Scene, load_scene
    from sonarrec.simulation.simulate import write_recording

    scene: Scene | PlateScene = plate_scene(source or "paper") or load_scene(source or "paper")
    if seed is not None:
        scene = replace(scene, seed=seed)
    if frames is not None:
        if not frames.isdecimal() or not 1 <= int(frames) < 10**9:
            raise UsageError(
                f"--frames {frames}: for a scene, expected a number of frames, 1 or more"
            )
        scene = replace(scene, frames=int(frames))
    outputs = [out, out.with_suffix(".gt.csv")] if out.suffix == ".mcap" else [out]
    with naming_leftovers(*outputs), progress(quiet, scene.frames) as step:
        write_recording(
            scene,
            out,
            image_format or "png",
            progress=lambda _: step(),
            schema=schema or "sensor_msgs/msg/Image",
            compression=compression or "zstd",
        )
    if not quiet:
        say(f"{out}: {number_of(scene.frames, 'frame')} of scene {scene.name!r}")


def _lay(
    log: str,
    seed: int,
    frames: str | None,
    laying: LayoutChoice,
    log_choice: LogChoice,
    out: Path,
    quiet: bool,
) -> None:
    """Lay landmarks into a recording, at one contrast or several."""
    from sonarrec.config import preset
    from sonarrec.landmarks import DrawnSet
    from sonarrec.readers.open import find_log
    from sonarrec.results.run_file import read_run
    from sonarrec.runs.basis import chosen_landmarks
    from sonarrec.simulation.background_files import write_backgrounds
    from sonarrec.simulation.layout import draw_layout, without_room
    from sonarrec.simulation.simulate import check_free

    if out.suffix == ".mcap":
        raise UsageError(f"{out}: --background writes a folder of images; give a folder")
    contrasts = laying.contrasts()
    landmarks, _ = chosen_landmarks(find_log(log), laying.values["landmarks"], read_run(None))
    if isinstance(landmarks, DrawnSet):
        raise UsageError(f"{landmarks.name}: --background lays discs alone, no drawn plates")
    config = preset("default")
    folders = {db: out / f"contrast_{db:g}" for db in contrasts}
    if len(contrasts) == 1:
        folders = {contrasts[0]: out}
    check_free(*folders.values())
    with progress(quiet, title="motion") as step:
        log_options = log_choice.log_options(
            laying.values["odometry"], laying.values["odometry_topic"], frames
        )
        background = laying.survey(log, log_options, landmarks, config, step)
    layout = draw_layout(background, landmarks, seed, laying.values["count"])
    with (
        naming_leftovers(*folders.values()),
        progress(quiet, len(background.path), "discs") as step,
    ):
        write_backgrounds(background, layout, laying.look(background), folders, step)
    told = background.diagnostics
    tell(told.problems, [*told.notes, *without_room([layout], laying.values["count"])])
    if not quiet:
        frames = number_of(len(background.path), "frame")
        count = number_of(layout.landmark_count, "landmark")
        fakes = number_of(len(layout.discs) - layout.landmark_count, "fake")
        for db, folder in folders.items():
            say(f"{folder}: {frames}, {count} and {fakes} at {db:g} dB")
    end(told.problems)
