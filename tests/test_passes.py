"""A pass is the same for sightings.csv, the map, the review page and evaluation."""

from __future__ import annotations

import numpy as np
import pytest

from sonarrec.arrays import Table
from sonarrec.evaluation import rows
from sonarrec.landmarks import load_landmarks
from sonarrec.mapping import landmarks as mapping
from sonarrec.mapping.path import NO_DRIFT, path_from_poses
from sonarrec.reports import review
from sonarrec.results.sightings import Sightings
from sonarrec.sonar.frame import Estimate
from sonarrec.sonar.geometry import PoseTable
from tests.support.drawn import make_fan

BASIN = load_landmarks("basin")
STEP_NS = 10**8


def in_sightings(frames: list[int]) -> int:
    sightings, found = Sightings(BASIN), []
    for frame in range(max(frames) + 1):
        beliefs = np.array([0.01, 0.01, 0.96, 0.01, 0.01])
        one = Estimate("framework", 7, *(10.0, 10.0, 2.0, 0.0, 0.0, 0.9), beliefs, 3, 0.96, True)
        found += sightings.add(frame, frame * STEP_NS, [one] if frame in frames else [])
    return len(found + sightings.close_all())


def in_map(frames: list[int]) -> int:
    every, n = np.arange(max(frames) + 1), len(frames)
    still = PoseTable("poses", {}, every * STEP_NS, np.zeros((len(every), 3)), 1e9)
    declared = mapping.DeclaredEstimates(
        row=np.array(frames),
        landmark=np.full(n, 3),
        track=np.full(n, 7),
        score=np.full(n, 0.96),
        polar=np.tile((2.0, 0.0, 0.0), (n, 1)),
        sigma=np.tile((0.01, 0.1, 1.0), (n, 1)),
        rows=n,
    )
    path = path_from_poses(every, every * STEP_NS, 0 * every, still, NO_DRIFT)
    return len(mapping.find_passes(declared, path, BASIN, make_fan()))


def in_review(frames: list[int]) -> int:
    stretch = dict.fromkeys(frames, 0)
    return len(review._split([review._Row(f, 10.0, 10.0, 1.0, []) for f in frames], stretch))


def in_evaluation(frames: list[int]) -> int:
    """Frames before the first are unusable: they are not in frames.csv."""
    n, listed = len(frames), np.arange(min(frames), max(frames) + 1)
    at = np.searchsorted(listed, frames)
    truths = Table(at=at, landmark=np.full(n, 3), strict=np.ones(n, bool))
    passes, _ = rows.find_passes(truths, listed, np.zeros(len(listed), int))
    return len(passes)


@pytest.mark.parametrize("count", [in_sightings, in_map, in_review, in_evaluation])
@pytest.mark.parametrize(("without", "passes"), [(0, 1), (9, 1), (10, 2), (11, 2)])
def test_ten_frames_without_end_a_pass(count, without: int, passes: int) -> None:
    assert count([2, 3, 4 + without, 5 + without]) == passes
