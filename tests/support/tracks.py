"""Tracks as stage 2 leaves them, made up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sonarrec.arrays import Table
from sonarrec.recogniser.stage2 import REPORTED
from sonarrec.recogniser.tracks import Tracks


def made_up_tracks() -> Tracks:
    """Of a log that has not begun, with the columns that stage 3 needs of stage 2."""
    tracks = Tracks()
    nowhere = np.zeros(2)
    tracks.declare(position=nowhere, spread=nowhere, existence=0.9, sight_deg=0.0, shown=True)
    return tracks


def follow(
    tracks: Tracks,
    *numbers: int,
    away: Sequence[int] = (),
    positions: Sequence[Sequence[float]] | None = None,
    sight_deg: Sequence[float] | None = None,
) -> Table:
    """Go on to a frame with these tracks in view, by rising number, and others away; all others
    end. By default they stay where they are, at first at (0, 0), and their lines of sight too."""
    tracks.keep(np.isin(tracks["number"], [*numbers, *away]))
    new = [number for number in numbers if number not in tracks["number"]]
    rows = tracks.begin(len(new))
    tracks["number"][rows] = new
    tracks["remembered"] = np.isin(tracks["number"], away)
    rows = tracks.in_view
    assert tracks["number"][rows].tolist() == list(numbers)
    if positions is not None:
        tracks["position"][rows] = positions
    if sight_deg is not None:
        tracks["sight_deg"][rows] = sight_deg
    return tracks.select(REPORTED)[rows]
