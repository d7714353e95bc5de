"""The command line: parse, call one function, print. One command, one screen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from sonarrec import __version__
from sonarrec.records import FrameResult, SonarrecError, UsageError

PARTLY = 3  # exit code: finished, but part of the input could not be used
FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
Command = TypeVar("Command", bound=Callable[..., Any])


class _Program(click.Group):
    def invoke(self, ctx: click.Context) -> Any:
        """Faults of the input become one line; our own bugs keep their traceback."""
        try:
            return super().invoke(ctx)
        except SonarrecError as error:
            click.echo(f"sonarrec: {error}", err=True)
            ctx.exit(2 if isinstance(error, UsageError) else 1)


@click.group(
    cls=_Program,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="sonarrec")
def main() -> None:
    """Recognise landmarks in recorded imaging-sonar logs, and score it against ground truth.

    \b
    Exit codes: 0 done; 1 failed; 2 bad usage; 3 finished, but part of the input
    could not be used.
    """


def sonar_options(command: Command) -> Command:
    """The flags that set keys of the sonar geometry, over what sonar.toml says."""
    numbers = {
        "range_min_m": "Slant range of the window's near end, m.",
        "range_max_m": "Slant range of the window's far end, m.",
        "field_of_view_deg": "Horizontal field of view, deg.",
        "tilt_deg": "Downward tilt of the sonar, deg.",
        "height_m": "Height of the sonar above the floor, m.",
        "frame_rate_hz": "Frames per second, where frames carry no time.",
        "metres_per_pixel": "Scale of a fan image.",
    }
    options = [
        click.option(
            "--sonar", "sonar_file", type=FILE, help="Sonar geometry; see FORMATS in the README."
        ),
        click.option("--layout", type=click.Choice(["fan", "polar"]), help="Layout of the images."),
        *(
            click.option(f"--{key.replace('_', '-')}", key, type=float, help=text)
            for key, text in numbers.items()
        ),
        click.option(
            "--apex-px", type=float, nargs=2, metavar="COLUMN ROW", help="Apex of a fan image."
        ),
        click.option(
            "--bearings-deg", metavar="B,B,...", help="One bearing per beam of a polar image."
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def _sonar_from_flags(flags: dict[str, Any]) -> Any:
    from sonarrec.geometry import sonar_from_table

    stated = {key: value for key, value in flags.items() if value is not None}
    if "bearings_deg" in stated:
        try:
            stated["bearings_deg"] = [float(b) for b in stated["bearings_deg"].split(",")]
        except ValueError:
            raise UsageError("--bearings-deg: expected numbers with commas between") from None
    return sonar_from_table(stated, "command line")


preset_option = click.option(
    "--preset", default=None, help="default, or paper: every rule as published."
)
config_option = click.option(
    "--config", "config_file", type=FILE, help="Settings (TOML), or the run.toml of an earlier run."
)
set_option = click.option(
    "--set", "assignments", multiple=True, metavar="STAGE.KEY=VALUE", help="Change one setting."
)
seed_option = click.option("--seed", type=click.IntRange(min=0), help="Of all that is random.")


def _settings(
    preset: str | None, config_file: Path | None, assignments: tuple[str, ...], seed: int | None
) -> Any:
    """Preset, then file, then --set, then --seed: the later wins."""
    from dataclasses import replace

    from sonarrec import config

    settings = config.preset(preset or "default")
    if config_file is not None:
        settings = config.load_config(config_file, settings, keep_preset=preset is not None)
    settings = config.with_assignments(settings, assignments)
    return settings if seed is None else replace(settings, seed=seed)


@main.command()
@click.argument("log", nargs=-1, required=True)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("sonarrec_out"),
    show_default=True,
    help="Results go to OUT/<log name>.",
)
@click.option("--topic", help="Channel of an MCAP that holds several image channels.")
@click.option("--landmarks", help="Landmark set: a built-in name or a TOML file.  [default: basin]")
@preset_option
@config_option
@set_option
@seed_option
@sonar_options
@click.option("-q", "--quiet", is_flag=True, help="No progress bar and no summary.")
def run(
    log: tuple[str, ...],
    out: Path,
    topic: str | None,
    landmarks: str | None,
    preset: str | None,
    config_file: Path | None,
    assignments: tuple[str, ...],
    seed: int | None,
    sonar_file: Path | None,
    quiet: bool,
    **flags: Any,
) -> None:
    """Recognise landmarks in LOG, frame by frame.

    LOG is an MCAP file, a folder of images, a quoted glob of images or a video. The sonar's
    geometry is read from sonar.toml beside it (NAME.sonar.toml for one file), from --sonar, or
    from the flags. Several LOGs are processed one after the other.

    \b
    Examples:
      sonarrec run log.mcap
      sonarrec run pings/ --tilt-deg 22 --height-m 0.7
      sonarrec run 'dump/*.png' --preset paper --out results
    """
    from sonarrec.pipeline import process

    settings = _settings(preset, config_file, assignments, seed)
    sonar = _sonar_from_flags(flags)
    partly = False
    for path in log:
        summary = process(
            path,
            out,
            settings,
            landmarks=landmarks,
            sonar=sonar,
            sonar_file=sonar_file,
            earlier_run=config_file,
            topic=topic,
            observe=_progress_bar(quiet),
        )
        for problem in summary.problems:
            click.echo(f"sonarrec: {problem}", err=True)
        partly |= bool(summary.problems)
        if not quiet:
            click.echo(f"{summary.folder}: {summary.frames} frames")
            for line in summary.sightings:
                click.echo(f"  {line}")
    if partly:
        click.get_current_context().exit(PARTLY)


def _progress_bar(quiet: bool) -> Callable[[FrameResult, int | None], None]:
    """A tqdm bar on stderr; silent when quiet and where stderr is no terminal."""
    from tqdm import tqdm

    bar = tqdm(unit="frame", leave=False, disable=True if quiet else None)

    def observe(result: FrameResult, total: int | None) -> None:
        bar.total = total
        bar.set_postfix_str(f"{result.tracks} tracks in view", refresh=False)
        bar.update()

    return observe


@main.command()
@preset_option
@config_option
@set_option
@seed_option
def config(
    preset: str | None, config_file: Path | None, assignments: tuple[str, ...], seed: int | None
) -> None:
    """Print the configuration, with units and meanings, as a file for --config.

    \b
    Examples:
      sonarrec config > my.toml
      sonarrec config --preset paper
    """
    from sonarrec.config import as_commented_toml

    click.echo(as_commented_toml(_settings(preset, config_file, assignments, seed)), nl=False)


@main.command()
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
    out: Path,
    quiet: bool,
) -> None:
    """Render a recording with known truth: frames, sonar.toml, gt.csv and the scene itself.

    \b
    Examples:
      sonarrec simulate --scene paper --out paper_log
      sonarrec simulate --scene my_scene.toml --frames 200 --format mcap --out log.mcap
    """
    from dataclasses import replace

    from tqdm import tqdm

    from sonarrec.simulate import load_scene, write_recording

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
            scene, out, image_format, progress=lambda done: bar.update(done - bar.n) and None
        )
    if not quiet:
        click.echo(f"{out}: {scene.frames} frames of scene {scene.name!r}")


@main.command()
@click.argument("results", type=click.Path(path_type=Path), default=Path("sonarrec_out"))
@click.option("--ground-truth", type=FILE, required=True, help="gt.csv; see FORMATS in the README.")
@click.option(
    "--min-visible",
    type=float,
    default=0.9,
    show_default=True,
    help="Share of the disc in view from which a landmark counts; with less it is ignored.",
)
@click.option(
    "--tolerance",
    type=float,
    metavar="SECONDS",
    help="For truth matched by timestamp_ns.  [default: half the time between frames]",
)
@click.option("--landmarks", help="Landmark set.  [default: that of run.toml, else basin]")
@sonar_options
@click.option("-q", "--quiet", is_flag=True, help="Write the files only; print no tables.")
def evaluate(
    results: Path,
    ground_truth: Path,
    min_visible: float,
    tolerance: float | None,
    landmarks: str | None,
    sonar_file: Path | None,
    quiet: bool,
    **flags: Any,
) -> None:
    """Score RESULTS against ground truth: TPR, FPR and ROC, per method and ID.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). The
    geometry matters only where positions are in pixels and run.toml does not tell it. Files go
    to RESULTS/evaluation.

    \b
    Examples:
      sonarrec evaluate --ground-truth gt.csv
      sonarrec evaluate --ground-truth gt.csv sonarrec_out/log_7 --min-visible 0.5
    """
    from sonarrec import evaluation, tabulate
    from sonarrec.geometry import Sonar, load_sonar

    stated = load_sonar(sonar_file) if sonar_file else Sonar()
    found = evaluation.evaluate(
        results,
        ground_truth,
        min_visible=min_visible,
        tolerance_s=tolerance,
        landmarks=landmarks,
        sonar=stated.updated(_sonar_from_flags(flags)),
    )
    tabulate.write_evaluation(results / "evaluation", found)
    for problem in found.unused:
        click.echo(f"sonarrec: {problem}", err=True)
    if not quiet:
        click.echo(tabulate.screen(found))
        for note in found.notes:
            click.echo(f"note: {note}")
        click.echo(f"{results / 'evaluation'}: confusion.csv, roc.csv, roc.png, evaluation.json")
    if found.unused:
        click.get_current_context().exit(PARTLY)
