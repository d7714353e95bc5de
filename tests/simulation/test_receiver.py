"""The receiver and the grid of scatterers against sums and places worked out one by one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sonarrec.simulation.grid import PolarGrid
from sonarrec.simulation.receiver import Receiver
from sonarrec.simulation.scene import MotionSection, Scene, SonarSection, scene_bearings
from tests.support.bare import POLAR

AZIMUTHS = np.arange(-18.0, 18.05, 0.1)


def of_sonar(**changed: float) -> Scene:
    return replace(POLAR, sonar=replace(SonarSection(layout="polar", beams=24), **changed))


def amplitudes(scene: Scene, pan_deg: float = 3.21) -> np.ndarray:
    receiver = Receiver(scene, np.random.default_rng(0))
    return receiver.patterns(AZIMUTHS + pan_deg, pan_deg)


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
