"""Options of `sonarrec simulate` and `sonarrec site` for laying landmarks into a recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from sonarrec.cli.groups import Decorator, FiniteRange, as_one, file_names, in_background
from sonarrec.cli.options_log import odometry_options
from sonarrec.errors import UsageError

if TYPE_CHECKING:
    from sonarrec.config import Config
    from sonarrec.landmarks import LandmarkSet
    from sonarrec.results.run_file import LogOptions
    from sonarrec.simulation.background import Background
    from sonarrec.simulation.background_files import DiscLook

MOST_DB = 60.0

_LAYING = {
    "plate": in_background(
        "--plate",
        type=FiniteRange(-MOST_DB, MOST_DB),
        metavar="DB",
        help="The same for the plate between ring and sectors; negative if it is darker than the "
        "floor.  [default: -6]",
    ),
    "landmarks": in_background(
        "--landmarks",
        shell_complete=file_names,
        help="Landmark set: a built-in name or a TOML file.  [default: basin]",
    ),
    "count": in_background(
        "--count",
        type=click.IntRange(min=1),
        help="Number of landmarks; a blank and a filled disc are added for each round of the IDs.  "
        "[default: at most six discs in view]",
    ),
    "beam_width": in_background(
        "--beam-width",
        type=FiniteRange(0, 5),
        metavar="DEG",
        help="Width of the beams that smear the discs.  [default: as in `sonarrec run`]",
    ),
    **odometry_options(in_background),
}


@dataclass(frozen=True, slots=True)
class LayoutChoice:
    """The landmarks to lay, as given on the command line."""

    values: Mapping[str, Any]
    default_contrast: str

    def contrasts(self) -> list[float]:
        """dB, rising. Raises UsageError if they are invalid."""
        text = self.values["contrast"] or self.default_contrast
        try:
            contrasts = sorted(float(number) for number in text.split(","))
        except ValueError:
            contrasts = [math.nan]
        if not all(abs(db) <= MOST_DB for db in contrasts):
            raise UsageError(
                f"--contrast {text}: expected numbers from -{MOST_DB:g} to {MOST_DB:g} dB, "
                "separated by commas, such as 0,3,6,10"
            )
        if len({f"{db:g}" for db in contrasts}) < len(contrasts):  # as folders are named
            raise UsageError(f"--contrast {text}: a value is given twice")
        return contrasts

    def look(self, background: Background) -> DiscLook:
        """How the discs look; by default smeared as by the recording's own beams."""
        from sonarrec.simulation.background_files import DiscLook

        plate_db, width_deg = self.values["plate"], self.values["beam_width"]
        return DiscLook(
            -6.0 if plate_db is None else plate_db,
            background.beam_width_deg if width_deg is None else width_deg,
        )

    def survey(
        self,
        log: str,
        log_options: LogOptions,
        landmarks: LandmarkSet,
        config: Config,
        step: Callable[..., None],
    ) -> Background:
        """Read the recording once, for its path."""
        from sonarrec.readers import open_log
        from sonarrec.simulation.background import poses_of, survey

        arguments, frames = log_options.arguments(), log_options.frames or (0, None)
        poses = poses_of(log, log_options.odometry, log_options.odometry_topic, arguments["time"])
        return survey(lambda: open_log(log, **arguments), landmarks, config, poses, frames, step)


def laying_options(contrast: str) -> Decorator:
    """These options, as one argument `laying`. contrast: the default."""
    text = (
        "How much brighter ring and sectors are than the floor, dB of power; several values, "
        f"separated by commas, make a series.  [default: {contrast}]"
    )
    series = in_background("--contrast", metavar="DB[,DB]", help=text)
    return as_one(
        "laying", {"contrast": series} | _LAYING, lambda values: LayoutChoice(values, contrast)
    )
