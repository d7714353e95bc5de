"""The width of the sonar's beams: as the settings or the log state it, else the usual one.

It was also measured, by the speckle of the first frames. Where beams were wider than usual that
cost landmarks, and in pictures that are averages it found widths that are not there. Widths that
are too narrow cost little, those that are too wide much: so the number of beams is a bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sonarrec.config import Config
from sonarrec.nouns import Fan, Frame

# (field of view up to, beam width) in degrees: acoustic cameras (DIDSON, ARIS), multibeam sonars
# of 60 deg, and those of 120 to 130.
USUAL_DEG = ((40.0, 0.4), (80.0, 0.6), (360.0, 1.0))
MOST_BEAMS = 2.0
"""The usual width is at most that of so many beams' spacings, where their number is known."""


def with_beams(
    configs: Sequence[Config], stated_deg: float | None, first: Frame
) -> tuple[list[Config], list[str]]:
    """The settings, with the beam width filled in where they leave it open, and a note on it.

    stated_deg: the width that the log states, if any. first: its first frame. There is no note if
    the width is the usual one.
    """
    width = usual = usual_beam_width_deg(first.fan)
    if first.polar is not None:
        width = min(usual, round(MOST_BEAMS * first.polar.beam_deg, 2))
    how = "as its beams are many"
    if stated_deg is not None:
        width, how = stated_deg, "as the log states"
    needs = [not c.features.beam_width_deg and c.features.measurement != "single" for c in configs]
    found = [
        replace(c, features=replace(c.features, beam_width_deg=width)) if need else c
        for c, need in zip(configs, needs, strict=True)
    ]
    if width == usual or not any(needs):
        return found, []
    note = f"beams are taken to be {width:g} deg wide, {how}"
    return found, [f"{note} (features.beam_width_deg sets another)"]


def usual_beam_width_deg(fan: Fan) -> float:
    """The usual width of sonars with the fan's field of view, between two-way half-power points."""
    view_deg = fan.bearing_max_deg - fan.bearing_min_deg
    return next(width for widest, width in USUAL_DEG if view_deg <= widest)
