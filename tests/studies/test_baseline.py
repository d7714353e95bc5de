"""The benchmark's rival must be an honest one: it works where it should."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sonarrec.landmarks import load_landmarks
from sonarrec.sonar.geometry import pixel_from_polar
from tests.studies.baseline import HoughSmi, MajorityTracks, Settings, Sight
from tests.support.drawn import SECTORS, disc_pattern, make_fan, speckled_disc

FAN = make_fan(rows=256)
RANGE_M, BEARING_DEG = 2.1, 2.0


@pytest.mark.parametrize("landmark", [1, 2, 3, 4])
def test_finds_and_names_a_drawn_landmark(landmark: int) -> None:
    rng = np.random.default_rng(landmark)
    loop = HoughSmi(FAN, load_landmarks("basin"))
    x, y = (float(v) for v in pixel_from_polar(FAN, RANGE_M, BEARING_DEG))
    right = 0
    for turn in (0, 100, 215, 320):
        pattern = disc_pattern(SECTORS[landmark], math.radians(turn))
        sights = loop(speckled_disc(rng, FAN, RANGE_M, BEARING_DEG, 0.15, pattern))
        near = [s for s in sights if math.hypot(s.x - x, s.y - y) < 0.5 * loop.radius]
        right += any(load_landmarks("basin").ids[s.best] == landmark for s in near)
    assert right >= 3


def test_majority_outvotes_single_frames() -> None:
    settings = Settings(similarity=0.5, ring=0.5, least=3, share=0.5, most=20)
    tracks = MajorityTracks(settings, radius_px=30)
    votes = [0, 0, 2, 0, 1, 0]
    told = [tracks.step([Sight(100.0 + n, 50.0, v, 0.9, 0.9)])[0] for n, v in enumerate(votes)]
    assert {number for number, *_ in told} == {0}
    assert [claim for *_, claim in told] == [False, False, False, True, True, True]
    assert told[-1][2] == 0
    assert told[-1][3] == pytest.approx(4 / 6 * 0.81)
