"""A vehicle's run against closed forms, and its images against its truth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sonarrec.errors import SonarrecError
from sonarrec.simulation.motion import poses
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import PlacedLandmark, PlacedObject, Scene
from sonarrec.simulation.simulate import write_recording
from tests.support.bare import BIN_M, POLAR, changed, power


def on_vehicle(frames: int = 40, **motion: float) -> Scene:
    return changed(POLAR, frames=frames, motion=motion)


def path_of(scene: Scene) -> np.ndarray:
    """(frames, 3) yaw (deg), x, y."""
    return np.array([(p.pan_deg, p.x_m, p.y_m) for p in poses(scene)])


def test_steady_speed_and_turn_are_a_circle() -> None:
    path = path_of(on_vehicle(surge_m_s=0.3, yaw_deg_s=12.0))
    turn = np.radians(path[:, 0])
    np.testing.assert_allclose(path[:, 0], 3.0 * np.arange(40), atol=1e-9)
    radius = 0.3 / math.radians(12)
    np.testing.assert_allclose(path[:, 1], radius * (1 - np.cos(turn)), atol=1e-4)
    np.testing.assert_allclose(path[:, 2], radius * np.sin(turn), atol=1e-4)


def test_a_swing_comes_back_and_crabs_to_the_right() -> None:
    path = path_of(on_vehicle(surge_swing_m_s=0.4, crab_m_s=0.1, swing_period_s=5.0))
    np.testing.assert_allclose(path[20:, 2], path[:20, 2], atol=1e-6)
    assert np.ptp(path[:, 2]) == pytest.approx(0.4 * 5 / math.pi, rel=0.02)
    np.testing.assert_allclose(path[:, 1], 0.1 * np.arange(40) / 4, atol=1e-9)


def test_truth_and_echo_follow_the_vehicle() -> None:
    # Lies off to the right; the vehicle runs on and turns to it.
    place = (0.9, 2.6)
    polar = math.hypot(*place), math.degrees(math.atan2(*place))
    target = PlacedObject("filled", *polar, size_m=0.03, bright_db=30)
    scene = on_vehicle(14, surge_m_s=0.25, crab_m_s=-0.05, yaw_deg_s=8.0, roll_deg=2.0)
    scene = changed(scene, floor={"coherence": 0.0}, objects=(target,))
    scene = replace(scene, landmarks=(PlacedLandmark(2, 3.5, 10.0),))
    path, seen = path_of(scene), 0
    for frame, (yaw, x, y), pose in zip(render(scene), path, poses(scene), strict=True):
        for row in frame.distractors:
            way = np.array([place[0] - x, place[1] - y])
            assert row.range_m == pytest.approx(math.hypot(*way, 0.68), abs=1e-4)
            heading = math.radians(yaw)
            right = way @ [math.cos(heading), -math.sin(heading)]
            ahead = way @ [math.sin(heading), math.cos(heading)]
            tossed = math.radians(pose.roll_deg)
            right = right * math.cos(tossed) + 0.68 * math.sin(tossed)
            bearing_deg = math.degrees(math.atan2(right, ahead))
            assert row.bearing_deg == pytest.approx(bearing_deg, abs=0.01)
            if row.visible == 1 and abs(row.bearing_deg) < 13.5:
                bright = power(frame.image, scene) > 60
                bin_, beam = (v.mean() for v in np.nonzero(bright))
                assert 1.25 + (bin_ + 0.5) * BIN_M == pytest.approx(row.range_m, abs=0.008)
                assert (beam - 47.5) * 0.3 == pytest.approx(row.bearing_deg, abs=0.2)
                seen += 1
    assert seen > 5


@pytest.mark.slow
def test_the_floor_is_even_though_cells_are_shared_nearby() -> None:
    scene = on_vehicle(30, surge_m_s=0.3)
    seen = np.mean([power(f.image, scene) for f in render(scene)], axis=0)
    parts = [seen[part].mean() for part in (slice(0, 100), slice(100, 250), slice(300, 512))]
    np.testing.assert_allclose(parts, 1.0, rtol=0.15)
    assert np.mean(power(next(render(scene)).image, scene) ** 2) == pytest.approx(2.0, rel=0.25)


@pytest.mark.slow
def test_shadows_fall_away_from_where_the_vehicle_is_now() -> None:
    stone = PlacedObject("stone", 3.0, 0.0, size_m=0.06)
    # It sets out to the right of the stone, and turns to see it from there.
    scene = on_vehicle(33, crab_m_s=0.25, yaw_deg_s=-5.5)
    scene = changed(scene, floor={"coherence": 0.0}, objects=(stone,))
    frames = list(render(scene))
    for frame in (frames[0], frames[-1]):
        (row,) = frame.distractors
        image = power(frame.image, scene)
        behind = round((row.range_m + 0.1 - 1.25) / BIN_M)
        dark = np.flatnonzero(image[behind] < 0.3)
        assert dark.mean() == pytest.approx(row.bearing_deg / 0.3 + 47.5, abs=2)


def test_too_long_a_run_is_one_clear_line_and_leaves_nothing(tmp_path) -> None:
    scene = on_vehicle(4000, surge_m_s=0.5)
    with pytest.raises(SonarrecError, match="512 range bins"):
        write_recording(scene, tmp_path / "log")
    assert not (tmp_path / "log").exists()
