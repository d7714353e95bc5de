"""What the mean of many frames shows that no single frame does."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.arrays import ByteImage
from sonarrec.config import preset
from sonarrec.landmarks import load_landmarks
from sonarrec.recogniser.plane import FloorPlane
from sonarrec.recogniser.presets.mosaic import Pose
from sonarrec.recogniser.presets.second_view import (
    MOST_STEP_ERROR,
    SecondView,
    has_second_view,
)
from sonarrec.recogniser.stage1 import CandidateSelector
from sonarrec.records import FrameResult, Motion
from tests.studies.learning.random_scenes import random_scene
from tests.support.drawn import SECTORS, disc_pattern, draw_on_floor, make_fan, speckled
from tests.support.simulated import Job, recognise, score

BASIN = load_landmarks("basin")
FAN = make_fan(512)
OFFLINE = preset("offline")
PLANE = FloorPlane(FAN, BASIN.radius_m, OFFLINE.candidates.disc_radius_px)
STILL = Motion(0.0)


def frames(n: int, seed: int, *, landmark: bool = True) -> list[ByteImage]:
    """Frames of ID 3 at 2.1 m on its dark plate, or of the floor, with new speckle in each."""
    rng = np.random.default_rng(seed)
    at = (FAN, 2.1, 3.0, BASIN.radius_m)
    pattern = disc_pattern(SECTORS[3], math.radians(40))
    disc, seen = draw_on_floor(*at, pattern if landmark else lambda x, _: 0 * x)
    plate, _ = draw_on_floor(*at, lambda x, y: (np.hypot(x, y) <= 1) * float(landmark))
    return [PLANE.warp(speckled(disc, seen, rng, dark=plate)) for _ in range(n)]


def looked(images: list[ByteImage], motions: list[Motion | None]) -> list[FrameResult]:
    """The frames' results, none of which has an object before the look."""
    look = SecondView("m", OFFLINE, FAN, BASIN, None)
    select = CandidateSelector(OFFLINE.candidates, PLANE, BASIN, 0.4)
    results = [FrameResult(i, i * 10**8, 0, 0, ()) for i in range(len(images))]
    for i, (image, motion) in enumerate(zip(images, motions, strict=True)):
        look.add(i, motion, image, select(image))
    look.finish()
    return [look.revised(result) for result in results]


@pytest.mark.parametrize("preset_name", ["default", "paper"])
def test_only_what_waits_for_later_frames_has_second_view(preset_name: str) -> None:
    assert has_second_view(OFFLINE)
    assert not has_second_view(preset(preset_name))


def test_a_landmark_on_which_no_track_is_is_found_in_the_mean() -> None:
    """Where it lies, in every frame."""
    found = looked(frames(40, 1), [STILL] * 40)
    claims = [e for result in found for e in result.estimates if e.declared]
    assert len(claims) == 40
    for claim in claims:
        assert claim.landmark == 3
        assert claim.range_m == pytest.approx(2.1, abs=0.03)
        assert claim.bearing_deg == pytest.approx(3.0, abs=0.8)
        assert claim.object == claims[0].object


def test_speckle_alone_shows_nothing() -> None:
    found = looked(frames(40, 2, landmark=False), [STILL] * 40)
    assert not any(e.declared for result in found for e in result.estimates)


def test_frames_are_not_laid_on_each_other_where_the_motion_is_not_known() -> None:
    """Not measured, or with a standard error of half a radius."""
    images = frames(40, 1)
    wide = Motion(0.0, right_sigma_m=2 * MOST_STEP_ERROR * BASIN.radius_m)
    for motion in (None, replace(STILL, known=False), wide):
        found = looked(images, [motion] * 40)
        assert not any(e.declared for result in found for e in result.estimates)


@settings(max_examples=30)
@given(st.floats(-3, 3), st.floats(-500, 500), st.floats(-500, 500), st.integers(0, 2**31))
def test_positions_on_the_grid_and_in_the_frame_are_each_other_s_inverse(
    yaw: float, x: float, y: float, seed: int
) -> None:
    pixels = np.random.default_rng(seed).uniform(0, 300, (5, 2))
    pose = Pose(yaw, x, y)
    matrix = pose.to_mosaic(PLANE.apex)
    on_grid = pixels @ matrix[:, :2].T + matrix[:, 2]
    in_frame = pose.to_frame(on_grid, PLANE.apex)
    np.testing.assert_allclose(in_frame, pixels, atol=1e-8)


@pytest.mark.slow
def test_faint_landmarks_are_found_in_more_frames_than_they_show_in(tmp_path: Path) -> None:
    """Simulated, with the motion measured: offline with its second look, and without."""
    scene = random_scene(3100, "any_floor", frames=96)
    found = {}
    for name, lag in (("default", 0), ("offline", OFFLINE.features.lag_frames)):
        config = preset(name)
        recognise(Job(scene, tmp_path / name, [config]))
        assert config.features.lag_frames == lag
        found[name] = score([tmp_path / name]).count("framework", "strict")
    assert found["offline"].tp > 1.5 * found["default"].tp > 0
    assert found["offline"].fp <= found["default"].fp
