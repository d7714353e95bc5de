"""Pan between frames against a floor whose speckle is known everywhere."""

import math
import warnings

import cv2
import numpy as np
import pytest

from sonarrec.recogniser.motion.pan import PanEstimator
from sonarrec.recogniser.plane import working_plane
from sonarrec.sonar.geometry import fan_mask
from tests.support.drawn import make_fan

FAN = make_fan(300)
PER_DEG = 20  # samples of the floor's speckle per degree of bearing


def floor_speckle(seed: int) -> np.ndarray:
    """(ranges, bearings) amplitude of a floor seen from its middle, beams .3 deg wide."""
    rng = np.random.default_rng(seed)
    shape = (400, 120 * PER_DEG)
    field = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    parts = (
        cv2.GaussianBlur(f, (0, 0), sigmaX=0.15 * PER_DEG, sigmaY=0.8)
        for f in (field.real, field.imag)
    )
    amplitude = np.hypot(*parts)
    return amplitude / amplitude.mean()


def seen_from(floor: np.ndarray, heading_deg: float, gain=None, noise=0.0, seed=0) -> np.ndarray:
    """uint8 fan image with the sonar turned to `heading_deg`; gain: of each degree of bearing."""
    row, column = np.mgrid[0 : FAN.rows, 0 : FAN.columns].astype(float)
    across, ahead = column - FAN.apex_column, FAN.apex_row - row
    range_m = np.hypot(across, ahead) * FAN.metres_per_pixel
    bearing = np.degrees(np.arctan2(across, ahead))
    sample_row = (range_m - FAN.range_min_m) / FAN.window_m * floor.shape[0] - 0.5
    sample_column = (bearing + heading_deg + 60) * PER_DEG
    samples = sample_column.astype(np.float32), sample_row.astype(np.float32)
    amplitude = cv2.remap(floor, *samples, cv2.INTER_LINEAR)
    rng = np.random.default_rng(seed)
    amplitude = np.abs(amplitude + noise * rng.normal(size=amplitude.shape)) * 1.6 / range_m
    if gain is not None:
        amplitude *= gain(bearing)
    grey = 140 + 60 * np.log10(np.maximum(amplitude, 1e-3))
    return np.where(fan_mask(FAN) > 0, np.clip(grey, 1, 255), 0).astype(np.uint8)


def steps_of_eight_beams(bearing: np.ndarray) -> np.ndarray:
    """Gain steps of up to 6 dB from one group of eight beams to the next, and a hot beam."""
    level = np.array([1.0, 1.7, 0.7, 1.4, 0.8, 2.0, 1.0, 1.3, 0.6, 1.8, 0.9, 1.2, 1.5])
    group = np.clip(((bearing + 14.4) / 2.4).astype(int), 0, 12)
    return level[group] * np.where(np.abs(bearing - 3.1) < 0.15, 3.0, 1.0)


def estimated(first: np.ndarray, second: np.ndarray, kind: str = "floor") -> tuple[float, float]:
    plane = working_plane(kind, FAN, 0.15, 15.0)
    estimator = PanEstimator(plane)
    assert estimator.step(plane.warp(first)) == (0.0, 0.0)
    return estimator.step(plane.warp(second))


@pytest.mark.parametrize("pan_deg", [-8.0, -0.5, 0.07, 1.37])
@pytest.mark.parametrize("kind", ["floor", "fan"])
def test_a_known_pan_is_recovered_to_a_tenth_of_a_degree(pan_deg, kind):
    floor = floor_speckle(1)
    first = seen_from(floor, 3.0, noise=0.2)
    second = seen_from(floor, 3.0 + pan_deg, noise=0.2, seed=1)
    pan, match = estimated(first, second, kind)
    assert pan == pytest.approx(pan_deg, abs=0.1)
    assert match > 0.4


@pytest.mark.parametrize("pan_deg", [-1.5, 0.4, 0.8, 2.0])
def test_a_fixed_gain_pattern_over_the_beams_does_not_pull_it_to_zero(pan_deg):
    floor = floor_speckle(2)
    first = seen_from(floor, -4.0, steps_of_eight_beams, noise=0.3)
    second = seen_from(floor, -4.0 + pan_deg, steps_of_eight_beams, noise=0.3, seed=1)
    pan, _ = estimated(first, second)
    assert pan == pytest.approx(pan_deg, abs=0.1)


def test_frames_that_have_nothing_in_common_match_little():
    for seed in range(2):
        one = seen_from(floor_speckle(10 + seed), 0, steps_of_eight_beams)
        other = seen_from(floor_speckle(20 + seed), 0, steps_of_eight_beams)
        assert estimated(one, other)[1] < 0.15


def test_black_and_even_frames_match_nothing():
    black = np.zeros((FAN.rows, FAN.columns), np.uint8)
    picture = seen_from(floor_speckle(4), 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for first, second in [(black, black), (picture, black), (black, picture)]:
            pan, match = estimated(first, second)
            assert math.isfinite(pan)
            assert match == pytest.approx(0, abs=1e-6)
