"""`sonarrec simulate`: render a recording with known truth."""

from __future__ import annotations

from pathlib import Path

import click

from sonarrec.cli.bars import progress
from sonarrec.cli.options import ANY, INPUT, OUTPUT, command, option, out_option, quiet_option
from sonarrec.records import UsageError


@command(short_help="Render a recording with known truth.")
@option(
    INPUT,
    "--scene",
    "source",
    default="paper",
    show_default=True,
    help="Built-in name (paper, basin, sample_pan, sample_polar) or a TOML file.",
)
@option(INPUT, "--seed", type=click.IntRange(min=0), help="In place of the scene's own.")
@option(INPUT, "--frames", type=click.IntRange(min=1), help="In place of the scene's own number.")
@option(
    OUTPUT,
    "--format",
    "image_format",
    type=click.Choice(["png", "mcap"]),
    default="png",
    show_default=True,
    help="A folder of images, or one MCAP file.",
)
@option(
    OUTPUT,
    "--schema",
    metavar="NAME",
    help="Message type of an MCAP, such as sensor_msgs/msg/Image, with +ros1 or +json for another "
    "encoding than CDR (ROS) or protobuf (Foxglove); a wrong name lists them all.  "
    "[default: sensor_msgs/msg/Image]",
)
@option(
    OUTPUT,
    "--compression",
    type=click.Choice(["none", "lz4", "zstd"]),
    help="Of an MCAP.  [default: zstd]",
)
@out_option(
    ANY,
    "Folder for the recording; NAME.mcap for one file with its companions beside it.",
    required=True,
)
@quiet_option
def simulate(
    source: str,
    seed: int | None,
    frames: int | None,
    image_format: str,
    schema: str | None,
    compression: str | None,
    out: Path,
    quiet: bool,
) -> None:
    """Render a recording with known truth: frames, sonar.toml, gt.csv and the scene itself.

    \b
    Examples:
      sonarrec simulate --scene paper -o paper_log
      sonarrec simulate --scene my_scene.toml --frames 200 --format mcap -o log.mcap
      sonarrec simulate --scene sample_polar --format mcap -o pings.mcap \\
        --schema marine_acoustic_msgs/msg/ProjectedSonarImage
    """
    if image_format != "mcap" and (schema or compression):
        raise UsageError("--schema and --compression are for --format mcap")
    from dataclasses import replace

    from sonarrec.simulation.simulate import load_scene, write_recording

    scene = load_scene(source)
    scene = replace(
        scene,
        seed=scene.seed if seed is None else seed,
        frames=scene.frames if frames is None else frames,
    )
    with progress(quiet, scene.frames) as step:
        write_recording(
            scene,
            out,
            image_format,
            progress=lambda _: step(),
            schema=schema or "sensor_msgs/msg/Image",
            compression=compression or "zstd",
        )
    if not quiet:
        click.echo(f"{out}: {scene.frames} frames of scene {scene.name!r}")
