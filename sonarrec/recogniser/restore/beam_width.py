"""The width of the sonar's beams: as the settings or the log state it, else the usual one.

Measuring it by the speckle of the first frames was tried and dropped: with beams wider than usual
it cost landmarks, and averaged pictures gave wrong widths. A width that is too narrow costs little,
one that is too wide costs much. So the spacing of the beams sets an upper bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sonarrec.config import Config
from sonarrec.sonar.frame import Fan, Frame

# (field of view up to, beam width) in degrees: acoustic cameras (DIDSON, ARIS), multibeam sonars
# of 60 deg, and those of 120 to 130.
USUAL_DEG = ((40.0, 0.4), (80.0, 0.6), (360.0, 1.0))
MOST_BEAMS = 2.0
"""Upper bound of the usual width, in spacings of the beams, where their number is known."""


def with_beams(
    configs: Sequence[Config], stated_deg: float | None, first: Frame
) -> tuple[list[Config], list[str]]:
    """The settings, with the beam width filled in where they leave it open, and notes on it.

    stated_deg: the width that the log states, if any. first: its first frame. There is no note if
    the width is the usual one.
    """
    width = usual = usual_beam_width_deg(first.fan)
    if first.polar is not None:
        width = min(usual, round(MOST_BEAMS * first.polar.beam_deg, 2))
    how = "since neighbouring beams are so close"
    if stated_deg is not None:
        width, how = stated_deg, "as stated"
    needs = [not c.features.beam_width_deg and c.features.measurement != "single" for c in configs]
    complete = [
        replace(c, features=replace(c.features, beam_width_deg=width)) if need else c
        for c, need in zip(configs, needs, strict=True)
    ]
    if width == usual or not any(needs):
        return complete, []
    note = f"beam width: {width:g} deg, {how}"
    return complete, [f"{note}; beam_width_deg in sonar.toml changes it"]


def usual_beam_width_deg(fan: Fan) -> float:
    """The usual width of sonars with the fan's field of view, between two-way half-power points."""
    view_deg = fan.bearing_max_deg - fan.bearing_min_deg
    return next(width for widest, width in USUAL_DEG if view_deg <= widest)
