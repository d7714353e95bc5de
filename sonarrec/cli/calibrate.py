"""`sonarrec calibrate`: learn the appearance model from one's own labelled logs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sonarrec.cli.options import (
    FILE,
    PARTLY,
    chosen_settings,
    config_option,
    landmarks_option,
    pixel_options,
    preset_option,
    seed_option,
    set_option,
    sonar_from_flags,
    sonar_options,
    topic_option,
)
from sonarrec.records import Clock, SonarrecError, UsageError


@click.command(short_help="Learn from labelled logs how landmarks look.")
@click.argument("log", nargs=-1, required=True)
@click.option(
    "--ground-truth", type=FILE, required=True, help="gt.csv; its columns are in the README."
)
@click.option(
    "-o",
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    required=True,
    help="The model, for `sonarrec run --model`.",
)
@click.option(
    "--from-scratch",
    is_flag=True,
    help="Forget the built-in model, in place of starting from it: for thousands of labelled "
    "frames of all that may be met.",
)
@topic_option
@click.option(
    "--time",
    "clock",
    type=click.Choice(["log", "publish", "header"]),
    help="Which time of an MCAP message timestamp_ns means.  [default: log]",
)
@landmarks_option
@preset_option
@config_option
@set_option
@seed_option
@sonar_options
@pixel_options
@click.option("-q", "--quiet", is_flag=True, help="No progress bar and no summary.")
def calibrate(
    log: tuple[str, ...],
    ground_truth: Path,
    out: Path,
    from_scratch: bool,
    topic: str | None,
    clock: Clock | None,
    landmarks: str,
    preset: str | None,
    config_file: Path | None,
    assignments: tuple[str, ...],
    seed: int | None,
    sonar_file: Path | None,
    quiet: bool,
    **flags: Any,
) -> None:
    """Learn from LOG, whose landmarks are labelled, how landmarks look to this sonar.

    The model tells each landmark from the others and from "none of these". It starts from the
    built-in one: a few hundred labelled frames adapt it. Of several LOGs the ground truth names
    each in a log column. Frames without a row count as frames without a landmark, save where a
    track was on one before or after.

    \b
    Examples:
      sonarrec calibrate log.mcap --ground-truth gt.csv -o model.toml
      sonarrec run next.mcap --model model.toml
      sonarrec calibrate day_1/ day_2/ --ground-truth both.csv -o model.toml --landmarks my.toml
    """
    from tqdm import tqdm

    from sonarrec.landmarks import load_landmarks
    from sonarrec.learning.calibrate import learn

    if not out.parent.is_dir():
        raise UsageError(f"--out {out}: there is no folder {out.parent}")
    settings, *more = chosen_settings(preset, config_file, assignments, seed)
    if more:
        raise UsageError("several presets: a model is learned for one; choose it with --preset")
    with tqdm(unit="frame", leave=False, disable=True if quiet else None) as bar:
        lesson = learn(
            log,
            ground_truth,
            settings,
            load_landmarks(landmarks),
            sonar=sonar_from_flags(flags),
            sonar_file=sonar_file,
            topic=topic,
            time=clock,
            from_scratch=from_scratch,
            observe=bar.update,
        )
    try:
        out.write_text(lesson.as_toml(), encoding="utf-8")
    except OSError as error:
        raise SonarrecError(f"{out}: cannot be written ({error.strerror})") from None
    for note in lesson.notes:
        click.echo(f"sonarrec: note: {note}", err=True)
    for problem in lesson.problems:
        click.echo(f"sonarrec: {problem}", err=True)
    if not quiet:
        for line in lesson.told():
            click.echo(line)
        click.echo(f"{out}: model, for `sonarrec run --model`")
    if lesson.problems:
        click.get_current_context().exit(PARTLY)
