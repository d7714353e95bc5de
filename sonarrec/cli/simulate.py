"""`sonarrec simulate`: render a recording with known truth."""

from __future__ import annotations

from pathlib import Path

import click

from sonarrec.records import UsageError


@click.command(short_help="Render a recording with known truth.")
@click.option(
    "--scene", "source", default="paper", show_default=True, help="Built-in name or a TOML file."
)
@click.option("--seed", type=click.IntRange(min=0), help="In place of the scene's own.")
@click.option("--frames", type=click.IntRange(min=1), help="In place of the scene's own number.")
@click.option(
    "--format",
    "image_format",
    type=click.Choice(["png", "mcap"]),
    default="png",
    show_default=True,
    help="A folder of images, or one MCAP file.",
)
@click.option(
    "--schema",
    metavar="NAME",
    help="Message type of an MCAP, such as sensor_msgs/msg/Image, with +ros1 or +json for another "
    "encoding than CDR (ROS) or protobuf (Foxglove); a wrong name lists them all.  "
    "[default: sensor_msgs/msg/Image]",
)
@click.option(
    "--compression",
    type=click.Choice(["none", "lz4", "zstd"]),
    help="Of an MCAP.  [default: zstd]",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="Folder for the recording; NAME.mcap for one file with its companions beside it.",
)
@click.option("-q", "--quiet", is_flag=True, help="No progress bar and no summary.")
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
      sonarrec simulate --scene paper --out paper_log
      sonarrec simulate --scene my_scene.toml --frames 200 --format mcap --out log.mcap
      sonarrec simulate --scene sample_polar --format mcap --out pings.mcap \\
        --schema marine_acoustic_msgs/msg/ProjectedSonarImage
    """
    if image_format != "mcap" and (schema or compression):
        raise UsageError("--schema and --compression are for --format mcap")
    from dataclasses import replace

    from tqdm import tqdm

    from sonarrec.simulation.simulate import load_scene, write_recording

    scene = load_scene(source)
    scene = replace(
        scene,
        seed=scene.seed if seed is None else seed,
        frames=scene.frames if frames is None else frames,
    )
    with tqdm(
        total=scene.frames, unit="frame", leave=False, disable=True if quiet else None
    ) as bar:
        write_recording(
            scene,
            out,
            image_format,
            progress=lambda done: bar.update(done - bar.n) and None,
            schema=schema or "sensor_msgs/msg/Image",
            compression=compression or "zstd",
        )
    if not quiet:
        click.echo(f"{out}: {scene.frames} frames of scene {scene.name!r}")
