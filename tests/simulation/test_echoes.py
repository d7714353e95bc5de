"""Fish, multipath and beams against levels and places worked out one by one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sonarrec.simulation.fish import Shoal
from sonarrec.simulation.grid import PolarGrid
from sonarrec.simulation.receiver import Receiver
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import MotionSection, Scene, SonarSection, scene_bearings
from tests.support.bare import BIN_M, POLAR, RANGE_M, changed, mean_power, power
from tests.support.slow import but_first

AREA = np.array([-1.5, 0.5]), np.array([1.5, 3.5])
SEEN = (5, 17, 27)  # seeds whose fish swims through the fan
AZIMUTHS = np.arange(-18.0, 18.05, 0.1)


def shoal_scene(seed: int, **fish: float) -> Scene:
    fish = {"number": 1, "length_m": 0.12, "bright_db": 30.0, "speed_m_s": 0.15} | fish
    even = {"coherence": 0.0}
    return changed(POLAR, seed=seed, frames=24, rate_hz=4.0, floor=even, fish=fish)


@pytest.mark.parametrize("seed", but_first(SEEN))
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


def test_a_shadow_lies_where_the_ray_past_the_fish_meets_the_floor() -> None:
    for seed in range(1, 60):
        scene = replace(shoal_scene(seed, length_m=0.2, height_m=0.2), frames=1)
        (frame,) = render(scene)
        if not frame.distractors:
            continue
        row = frame.distractors[0]
        now = Shoal(scene, *AREA).positions(0.0)
        floor_m = row.range_m * 0.68 / (0.68 - float(now.up_m[0]))
        if abs(row.bearing_deg) < 10 and floor_m < 3.4:
            image = power(frame.image, scene)
            beam, bin_ = round(row.bearing_deg / 0.3 + 47.5), round((floor_m - 1.25) / BIN_M)
            assert image[bin_, beam] < 0.1
            assert np.median(image) == pytest.approx(1.0, abs=0.1)
            return
    raise AssertionError("no fish came into view")


def with_late(**late: float) -> Scene:
    """A patchy floor, so that a copy can be told from what it copies."""
    return changed(POLAR, floor={"texture_db": 4.0, "texture_m": 0.06}, multipath=late)


def delay_of(seen: np.ndarray) -> float:
    """Where, beyond its middle, the autocorrelation along range is largest (m)."""
    even = seen - seen.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(even, 1024, axis=0)) ** 2
    correlation = np.fft.irfft(spectrum, axis=0).sum(axis=1)
    first, last = round(0.2 / BIN_M), round(0.9 / BIN_M)
    return float((first + np.argmax(correlation[first:last])) * BIN_M)


@pytest.mark.parametrize("delay", [0.3, 0.55])
def test_the_copy_comes_as_late_as_stated(delay: float) -> None:
    scene = with_late(copy_db=-3.0, delay_m=delay, blur_m=0.01)
    assert delay_of(mean_power(scene, 20)) == pytest.approx(delay, abs=0.02)


@pytest.mark.slow
def test_the_copy_is_as_weak_as_stated_and_behind_the_delay() -> None:
    scene = changed(POLAR, multipath={"copy_db": -6.0, "delay_m": 0.5})
    late = mean_power(scene, 20).mean(axis=1) - mean_power(POLAR, 20).mean(axis=1)
    begins = round(0.5 / BIN_M)
    assert late[begins + 15 :].mean() == pytest.approx(10**-0.6, rel=0.08)
    assert abs(late[: begins - 15].mean()) < 0.03


def test_its_speckle_is_new_in_every_frame() -> None:
    still = changed(POLAR, frames=2, multipath={"band_db": 20.0, "band_width_m": 5.0})
    first, second = (power(f.image, still) for f in render(still))
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.05
    assert np.mean(first**2) / first.mean() ** 2 == pytest.approx(2.0, rel=0.05)


def of_sonar(**levels: float) -> Scene:
    return replace(POLAR, sonar=SonarSection(layout="polar", beams=24, **levels))


def amplitudes(scene: Scene, pan_deg: float = 3.21) -> np.ndarray:
    return Receiver(scene).patterns(AZIMUTHS + pan_deg, pan_deg)


def lobe(sonar: SonarSection, off_deg: float) -> float:
    """Amplitude: half the power at half the beam's width from the axis, and side lobes beyond."""
    scaled = off_deg / sonar.beam_width_deg
    main = 0.5 ** (2 * scaled**2)
    side = 10 ** (sonar.side_lobe_db / 20) * math.cos(math.pi * scaled)
    return main + (1 - main) * side / math.sqrt(1 + (scaled / 6) ** 2)


def test_a_beam_receives_an_azimuth_by_its_distance_from_the_axis() -> None:
    scene = of_sonar(cross_talk_db=-200.0, stray_db=-200.0)
    expected = np.array(
        [[lobe(scene.sonar, b - a) for b in scene_bearings(scene)] for a in AZIMUTHS]
    )
    # Scaled so that in the mean beam unit scatterers sum to unit power.
    expected /= np.sqrt((expected**2).sum(axis=0).mean())
    found = amplitudes(scene)
    assert found.shape == (len(AZIMUTHS), 24)
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("pan_deg", [0.0, 3.2, -31.9])
def test_of_beams_that_leak_each_gets_the_others_at_the_level_stated(pan_deg: float) -> None:
    alone = amplitudes(of_sonar(cross_talk_db=-200.0, stray_db=-200.0), pan_deg)
    leaking = amplitudes(of_sonar(cross_talk_db=-30.0, stray_db=-26.0), pan_deg)
    # What each beam adds to each other: one matrix, from all azimuths at once.
    mixed, *_ = np.linalg.lstsq(alone, leaking, rcond=None)
    apart = np.abs(np.subtract.outer(np.arange(24), np.arange(24)))
    np.testing.assert_allclose(np.diag(mixed), 1, atol=1e-3)
    others = np.abs(mixed)[(apart > 0) & (apart % 8 != 0)]
    np.testing.assert_allclose(others, 10 ** (-30 / 20), rtol=0.02)
    for beams, times in ((8, 1), (16, 2)):
        level = 10 ** (-30 / 20) + 10 ** (-26 / 20) / times
        np.testing.assert_allclose(np.abs(mixed)[apart == beams], level, rtol=0.02)


@pytest.mark.parametrize("pan_deg", [-40.0, -3.3, 25.0, 44.0])
def test_from_the_origin_cells_are_those_at_the_places(pan_deg: float) -> None:
    """Runs of rows, and beyond the grid's edge (at 44 deg, for the pan ends at 40) the nearest."""
    grid = PolarGrid(replace(POLAR, motion=MotionSection(pan_min_deg=-40.0, pan_max_deg=40.0)))
    azimuth, ground = grid.azimuths(pan_deg), np.linspace(0.9, 3.7, 300)[:, None]
    radians = np.radians(azimuth)
    places = grid.index(ground * np.sin(radians), ground * np.cos(radians))
    found = grid.index_from_origin(ground, azimuth)
    assert isinstance(found, tuple) == (pan_deg < 44)
    if isinstance(found, tuple):
        found = np.arange(math.prod(grid.shape)).reshape(grid.shape)[found]
    np.testing.assert_array_equal(found, places)
