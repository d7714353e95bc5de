"""Fish: where they echo, how they move, and what they hide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sonarrec.simulation.fish import Shoal
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import FishSection, Scene
from tests.support.bare import POLAR, power

BIN_M = 2.5 / 512
RANGE_M = 1.25 + (np.arange(512) + 0.5) * BIN_M

AREA = np.array([-1.5, 0.5]), np.array([1.5, 3.5])
SEEN = (5, 17, 27)  # seeds whose fish swims through the fan


def shoal_scene(seed: int, **fish: float) -> Scene:
    usual = {"number": 1, "length_m": 0.12, "bright_db": 30.0, "speed_m_s": 0.15}
    floor = replace(POLAR.floor, coherence=0.0)
    section = FishSection(**(usual | fish))
    return replace(POLAR, seed=seed, frames=24, rate_hz=4.0, floor=floor, fish=section)


@pytest.mark.parametrize("seed", SEEN)
def test_the_echo_moves_as_the_truth_says(seed: int) -> None:
    scene, seen = shoal_scene(seed), 0
    for frame in render(scene):
        (row,) = frame.distractors or (None,)
        if row is None or abs(row.bearing_deg) > 11 or not 1.5 < row.range_m < 3.4:
            continue
        assert row.kind == "fish"
        image = power(frame.image, scene)
        weight = np.where(image > 60, image, 0)
        range_m = np.average(RANGE_M, weights=weight.sum(axis=1))
        bearing = np.average((np.arange(96) - 47.5) * 0.3, weights=weight.sum(axis=0))
        assert range_m == pytest.approx(row.range_m, abs=0.02)
        assert bearing == pytest.approx(row.bearing_deg, abs=0.7)
        seen += 1
    assert seen > 6


def test_fish_swim_as_fast_as_stated_in_the_mean() -> None:
    shoal = Shoal(shoal_scene(1, number=400), *AREA)
    before, after = shoal.at(7.0), shoal.at(7.1)
    steps = np.hypot(after.x_m - before.x_m, after.y_m - before.y_m) / 0.1
    # Those that came in again at the other side went nowhere near as far.
    assert np.mean(steps[steps < 2]) == pytest.approx(0.15, rel=0.15)
    # A way of 2 m is swum in 1 / 0.15 s a metre, weaving aside.
    ahead = np.radians(before.heading_deg)
    along = (after.x_m - before.x_m) * np.sin(ahead) + (after.y_m - before.y_m) * np.cos(ahead)
    np.testing.assert_allclose((along / 0.1)[steps < 2], steps[steps < 2], rtol=0.02, atol=0.01)


def test_a_shadow_lies_where_the_ray_past_the_fish_meets_the_floor() -> None:
    for seed in range(1, 60):
        scene = replace(shoal_scene(seed, length_m=0.2, height_m=0.2), frames=1)
        (frame,) = render(scene)
        if not frame.distractors:
            continue
        row = frame.distractors[0]
        now = Shoal(scene, *AREA).at(0.0)
        floor_m = row.range_m * 0.68 / (0.68 - float(now.up_m[0]))
        if abs(row.bearing_deg) < 10 and floor_m < 3.4:
            image = power(frame.image, scene)
            beam, bin_ = round(row.bearing_deg / 0.3 + 47.5), round((floor_m - 1.25) / BIN_M)
            assert image[bin_, beam] < 0.1
            assert np.median(image) == pytest.approx(1.0, abs=0.1)
            return
    raise AssertionError("no fish came into view")


def test_a_school_stays_together_and_single_fish_do_not() -> None:
    scene = shoal_scene(3, number=24, schools=2, schooling=0.5, speed_m_s=0.3)
    shoal = Shoal(scene, *AREA)
    for school in (slice(0, 12, 2), slice(1, 12, 2)):
        for time in (0.0, 3.0, 20.0):
            now = shoal.at(time)
            spread = np.hypot(np.ptp(now.x_m[school]), np.ptp(now.y_m[school]))
            assert spread < 2.5
    apart = shoal.at(20.0)
    assert np.hypot(np.ptp(apart.x_m[12:]), np.ptp(apart.y_m[12:])) > 2.5
    assert (apart.up_m > 0).all()
    assert (apart.up_m <= scene.fish.height_m).all()


def test_the_floor_keeps_its_speckle_where_no_fish_is() -> None:
    floor = replace(POLAR.floor, coherence=1.0)
    bare = next(render(replace(POLAR, floor=floor))).image
    scene = replace(shoal_scene(5, number=6), frames=1, floor=floor)
    (frame,) = render(scene)
    same = frame.image == next(render(replace(scene, fish=FishSection()))).image
    assert bare.shape == same.shape
    assert 0.5 < same.mean() < 1
