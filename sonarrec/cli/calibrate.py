"""`sonarrec calibrate`: adapt the reader of stage 3 to one's own labelled logs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sonarrec.cli import options
from sonarrec.cli.endings import finish, progress
from sonarrec.cli.groups import NEW_FILE, command, file_names
from sonarrec.errors import as_usage


@command(short_help="Learn from labelled logs how landmarks look.")
@click.argument("log", shell_complete=file_names, nargs=-1, required=True)
@options.ground_truth("gt.csv with positions, in place of each log's own NAME.gt.csv or gt.csv.")
@options.reading(time=True)
@options.landmarks
@options.settings
@options.out(NEW_FILE, "The model, for `sonarrec run --model`.", ".toml", required=True)
@options.quiet
def calibrate(
    log: tuple[str, ...],
    ground_truth: Path | None,
    reading: dict[str, Any],
    landmarks: str | None,
    settings: options.SettingsChoice,
    out: Path,
    quiet: bool,
) -> None:
    """Learn from LOG, whose landmarks are labelled, how landmarks look to this sonar.

    The model distinguishes each landmark from the others and from "none of these". It starts from
    the built-in model; a few hundred labelled frames adapt it. Truth is the gt.csv next to each
    LOG, or is given; one for several LOGs needs a log column. Frames without a row count as
    frames without a landmark, except where a track lies on a landmark before or after.

    \b
    Examples:
      sonarrec calibrate sample_data/pan -o model.toml
      sonarrec run next.mcap --model model.toml
      sonarrec calibrate day_1/ day_2/ --ground-truth both.csv -o model.toml --landmarks my.toml
    """
    from sonarrec.learning.calibrate import learn
    from sonarrec.readers.open import find_log
    from sonarrec.results.run_file import LogOptions, read_run
    from sonarrec.runs.prepare import chosen_landmarks
    from sonarrec.tables.outputs import check_output, write_text, writing

    check_output(out, "model", [*log, ground_truth])
    config = settings.config()
    # As in `run`, a run.toml also gives the landmark set and the geometry.
    first = find_log(log[0])
    with as_usage():
        earlier = read_run(settings.config_file)
        log_options = earlier.complete(LogOptions(**reading), same_log=False)
        chosen, _ = chosen_landmarks(first, landmarks, earlier)
    with progress(quiet) as step:
        report = learn(log, ground_truth, config, chosen, log_options, observe=step)
    with writing(out):
        write_text(out, report.as_toml())
    lines = [*report.summary, f"{out}: model, for `sonarrec run --model`"]
    finish(quiet, lines, report.diagnostics.problems, report.diagnostics.notes)
