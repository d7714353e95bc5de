"""`sonarrec site`: would landmarks be recognised at the site of a recording?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sonarrec.cli import options
from sonarrec.cli.bars import progress
from sonarrec.cli.endings import finish, naming_leftovers
from sonarrec.cli.groups import FOLDER, command, file_names, in_background, in_output
from sonarrec.cli.options_background import LayoutChoice, laying_options
from sonarrec.cli.options_log import LogChoice, log_options
from sonarrec.errors import number_of

if TYPE_CHECKING:
    from sonarrec.simulation.site.results import Site


@command(short_help="Estimate at which contrast and range landmarks would be recognised.")
@click.argument("log", shell_complete=file_names)
@log_options(flags=True, time=True)
@options.frames("Use only the frames from A up to, not including, B.")
@laying_options("0,3,6,10")
@in_background(
    "--layouts",
    type=click.IntRange(min=1),
    default=4,
    help="How many times discs are laid, each time at other positions; more give narrower "
    "intervals.",
)
@options.model
@options.settings
@options.out(FOLDER, "Folder for the output.  [default: sonarrec_site/<log name>]")
@in_output("--keep", is_flag=True, help="Keep the images in OUT/recordings.")
@options.quiet
# Long by its options and its help.
def site(
    log: str,
    log_choice: LogChoice,
    frames: str | None,
    laying: LayoutChoice,
    layouts: int,
    model: Path | None,
    settings: options.SettingsChoice,
    out: Path | None,
    keep: bool,
    quiet: bool,
) -> None:
    """Estimate whether landmarks would be recognised at the site of LOG, a recording without any.

    Landmarks and blank and filled discs are laid into LOG at several contrasts, as by `sonarrec
    simulate --background`. Each recording made like this is run and scored. Writes site.html (open
    it in a browser), site.csv and site.json.

    \b
    Examples:
      sonarrec site dive.mcap --tilt-deg 20 --height-m 0.7
      sonarrec site river.avi --contrast 0,6,12 --layouts 8 -o river_site
    """
    from sonarrec.readers.open import find_log
    from sonarrec.results.run_file import read_run
    from sonarrec.runs.prepare import RunOptions, digest_asked, is_same_log
    from sonarrec.simulation.simulate import check_free
    from sonarrec.simulation.site.assess import assess
    from sonarrec.simulation.site.page import render
    from sonarrec.simulation.site.results import write_site

    config = settings.config()
    contrasts, values = laying.contrasts(), laying.values
    earlier, source = read_run(settings.file), find_log(log)
    landmarks = earlier.landmark_set(values["landmarks"])
    given = log_choice.log_options(values["odometry"], values["odometry_topic"], frames)
    # As in `run`, except that a run.toml does not give the frames.
    same_log = is_same_log(earlier, source, digest_asked(earlier, source))
    log_options = replace(earlier.complete(given, same_log=same_log), frames=given.frames)
    if same_log:
        earlier.check_poses(log_options)
    out = out or Path("sonarrec_site") / source.name
    check_free(out)
    with progress(quiet, title="motion") as step:
        background = laying.survey(log, log_options, landmarks, config, step)
    # One pass to run the recording as it is; per layout one for the discs and one per contrast.
    passes = 1 + layouts * (1 + len(contrasts))
    with naming_leftovers(out), progress(quiet, passes * len(background.path)) as step:
        site_result = assess(
            Path(log),
            replace(log_options, frames=background.span),  # not those of the run.toml
            out,
            background,
            landmarks,
            laying.look(background),
            RunOptions([config], values["landmarks"], model, settings.file),
            contrasts=contrasts,
            layouts=layouts,
            count=laying.values["count"],
            seed=settings.values["seed"] or 0,
            keep=keep,
            step=lambda doing: step(note=doing),
        )
    write_site(out, site_result, render(site_result))
    finish(site_result.diagnostics, quiet, _lines(site_result, out / "site.html", layouts))


def _lines(site_result: Site, page: Path, layouts: int) -> Iterator[str]:
    """The lines to print: one for each contrast, then the answer."""
    extent = f"{number_of(site_result.about['frames'], 'frame')}, {number_of(layouts, 'layout')}"
    yield f"{page}: {extent}"
    for one in site_result.contrasts:
        rate = one.rates.tpr
        false = one.rates.false_per_100.value
        far = f", 90% from {one.span}" if one.reaches else ""
        yield (
            f"  {one.contrast_db:4g} dB: TPR {rate.value:.3f} over "
            f"{number_of(rate.units, 'pass', 'es')}, "
            f"{false:.2f} false claims in 100 frames{far}"
        )
    yield from (f"  {sentence}" for sentence in site_result.sentences)
