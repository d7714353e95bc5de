"""Sloping floors and rolling sonars against rotations of points in space."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sonarrec.simulation.motion import Pose
from sonarrec.simulation.plane import Plane
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import PlacedLandmark, PlacedObject, Scene, scene_sonar
from tests.support.bare import POLAR, even_power, power


def in_space(x: float, y: float, slope_deg: float, towards_deg: float) -> np.ndarray:
    """A place of the floor, turned about the horizontal line across the way it rises."""
    axis = np.array(
        [-math.cos(math.radians(towards_deg)), math.sin(math.radians(towards_deg)), 0.0]
    )
    angle, flat = -math.radians(slope_deg), np.array([x, y, 0.0])
    # Rodrigues' formula.
    return np.asarray(
        flat * math.cos(angle)
        + np.cross(axis, flat) * math.sin(angle)
        + axis * (axis @ flat) * (1 - math.cos(angle))
    )


def sloping(scene: Scene, slope: float, towards: float) -> Scene:
    floor = replace(scene.floor, slope_deg=slope, slope_towards_deg=towards)
    return replace(scene, floor=floor)


def test_a_slope_rises_the_way_it_says() -> None:
    assert in_space(0, 2, 8, 0)[2] == pytest.approx(2 * math.sin(math.radians(8)))
    assert in_space(2, 0, 8, 90)[2] == pytest.approx(2 * math.sin(math.radians(8)))


@pytest.mark.parametrize("towards", [0.0, 180.0, 90.0, -140.0])
def test_truth_and_echo_lie_where_the_slope_puts_them(towards: float) -> None:
    target = PlacedObject("filled", 2.1, 7.0, size_m=0.03, bright_db=30)
    scene = replace(
        sloping(POLAR, 8.0, towards), objects=(target,), landmarks=(PlacedLandmark(1, 1.7, -6.0),)
    )
    frame = next(render(scene))
    for row, ground, azimuth in (
        (frame.distractors[0], 2.1, math.radians(7)),
        (frame.truth[0], 1.7, math.radians(-6)),
    ):
        place = in_space(ground * math.sin(azimuth), ground * math.cos(azimuth), 8.0, towards)
        seen = place - [0, 0, 0.68]
        assert row.range_m == pytest.approx(np.linalg.norm(seen), abs=1e-4)
        assert row.bearing_deg == pytest.approx(
            math.degrees(math.atan2(seen[0], seen[1])), abs=1e-3
        )
    bright = even_power(scene) > 100
    bin_, beam = (v.mean() for v in np.nonzero(bright))
    seen = frame.distractors[0]
    assert 1.25 + (bin_ + 0.5) * 2.5 / 512 == pytest.approx(seen.range_m, abs=0.008)
    assert (beam - 47.5) * 0.3 == pytest.approx(seen.bearing_deg, abs=0.15)
    # What is stated is the height and the tilt, over a floor that nobody says slopes.
    assert scene_sonar(scene) == scene_sonar(POLAR)


@pytest.mark.parametrize(("towards", "slope"), [(0.0, 6.0), (180.0, 4.0)])
def test_the_axis_meets_the_slope_where_a_triangle_says(towards: float, slope: float) -> None:
    scene = sloping(POLAR, slope, towards)
    scene = replace(scene, sonar=replace(scene.sonar, vertical_beam_deg=8.0))
    # The beam's axis is 20 deg down, and the floor rises or falls to meet it.
    sine = math.sin(math.radians(20 + (slope if towards == 0 else -slope)))
    expected = 0.68 * math.cos(math.radians(slope)) / sine
    seen = even_power(scene)[:, 40:56].mean(axis=1)
    range_m = 1.25 + (np.arange(512) + 0.5) * 2.5 / 512
    log = 10 * np.log10(np.maximum(seen, 1e-6))
    near = np.abs(range_m - expected) < 0.25
    # Decibels of a Gaussian beam are a parabola of the depression.
    depression = np.degrees(np.arcsin(expected * sine / range_m[near]))
    curve = np.polyfit(depression, log[near], 2)
    top = -curve[1] / (2 * curve[0])
    assert expected * sine / math.sin(math.radians(top)) == pytest.approx(expected, abs=0.06)


def test_shading_follows_the_angle_at_which_the_slope_is_met() -> None:
    flat = replace(POLAR, floor=replace(POLAR.floor, angle_exponent=1.5))
    seen = [even_power(s).mean() for s in (flat, sloping(flat, 8.0, 90.0))]
    # Sideways slopes turn the floor away by the cosine alone.
    assert seen[1] / seen[0] == pytest.approx(math.cos(math.radians(8)) ** 1.5, rel=0.03)


def test_what_is_looked_at_is_what_is_seen_there() -> None:
    rng = np.random.default_rng(3)
    range_m, bearing = np.linspace(1.3, 3.7, 9), np.linspace(-14, 14, 7)
    for _ in range(20):
        pan, height, x, y, pitch, roll = rng.uniform(
            [-180, 0.6, -3, -3, -3, -5], [180, 0.8, 3, 3, 3, 5]
        )
        plane = Plane(rng.uniform(0, 10), rng.uniform(-180, 180))
        pose = Pose(pan, height, x, y, pitch, roll)
        look = plane.look(pose, range_m, bearing + pan)
        slant, seen = plane.seen(pose, look.x_m.astype(float), look.y_m.astype(float))
        there = look.sine > 0
        np.testing.assert_allclose(slant[there], np.tile(range_m[:, None], 7)[there], atol=2e-5)
        np.testing.assert_allclose(seen[there], np.tile(bearing, (9, 1))[there], atol=1e-3)


def test_a_roll_turns_the_world_about_the_heading() -> None:
    pose = Pose(30.0, 0.7, 0.4, -0.2, 0.0, 3.0)
    slant, bearing = Plane().seen(pose, 1.5, 2.0)
    heading = math.radians(30)
    ahead = np.array([math.sin(heading), math.cos(heading), 0])
    level = np.array([math.cos(heading), -math.sin(heading), 0])
    # With the right side down, the sonar's own right points below the horizon.
    right = level * math.cos(math.radians(3)) - [0, 0, math.sin(math.radians(3))]
    way = np.array([1.5, 2.0, 0]) - [0.4, -0.2, 0.7]
    assert slant == pytest.approx(np.linalg.norm(way))
    assert bearing == pytest.approx(math.degrees(math.atan2(way @ right, way @ ahead)))
    target = PlacedObject("filled", 2.1, 4.0, size_m=0.03, bright_db=30)
    scene = replace(POLAR, objects=(target,), floor=replace(POLAR.floor, coherence=0.0))
    (frame,) = render(scene, [Pose(0.0, 0.68, 0.0, 0.0, 0.0, 3.0)])
    beam = np.nonzero(power(frame.image, scene) > 100)[1].mean()
    assert (beam - 47.5) * 0.3 == pytest.approx(frame.distractors[0].bearing_deg, abs=0.25)
    assert frame.distractors[0].bearing_deg > 4.9
