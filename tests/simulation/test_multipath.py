"""Multipath against the autocorrelation of what is rendered, and stated levels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sonarrec.simulation.render import render
from sonarrec.simulation.scene import MultipathSection, Scene
from tests.support.bare import POLAR, mean_power, power

BIN_M = 2.5 / 512


def with_late(**late: float) -> Scene:
    """A patchy floor, so that a copy can be told from what it copies."""
    floor = replace(POLAR.floor, texture_db=4.0, texture_m=0.06)
    return replace(POLAR, floor=floor, multipath=MultipathSection(**late))


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


def test_the_copy_is_as_weak_as_stated_and_behind_the_delay() -> None:
    scene = replace(POLAR, multipath=MultipathSection(copy_db=-6.0, delay_m=0.5))
    late = mean_power(scene, 20).mean(axis=1) - mean_power(POLAR, 20).mean(axis=1)
    begins = round(0.5 / BIN_M)
    assert late[begins + 15 :].mean() == pytest.approx(10**-0.6, rel=0.08)
    assert abs(late[: begins - 15].mean()) < 0.03


def test_delays_drift() -> None:
    scene = with_late(copy_db=-1.0, delay_m=0.45, blur_m=0.01, drift_m=0.1, drift_s=4.0)
    scene = replace(scene, frames=8, rate_hz=2.0)
    # Half a period apart the drift has its sign turned.
    delays = [delay_of(power(f.image, scene)) for f in render(scene)]
    assert np.ptp(delays) == pytest.approx(0.2, abs=0.06)
    assert np.mean(delays) == pytest.approx(0.45, abs=0.03)
    for n in range(4):
        assert delays[n] + delays[n + 4] == pytest.approx(0.9, abs=0.08)


def test_bands_lie_across_at_their_ranges() -> None:
    late = MultipathSection(band_db=6.0, band_m=1.9, band_step_m=0.8, band_width_m=0.04)
    seen = mean_power(replace(POLAR, multipath=late), 30)
    for range_m, level in ((1.9, 1 + 10**0.6), (2.7, 1 + 10**0.3), (2.3, 1.0), (3.5, 2.0)):
        row = round((range_m - 1.25) / BIN_M - 0.5)
        across = seen[row - 2 : row + 3]
        assert across.mean() == pytest.approx(level, rel=0.12)
        assert across[:, :48].mean() == pytest.approx(across[:, 48:].mean(), rel=0.2)


def test_its_speckle_is_new_in_every_frame() -> None:
    still = replace(POLAR, frames=2, multipath=MultipathSection(band_db=20.0, band_width_m=5.0))
    first, second = (power(f.image, still) for f in render(still))
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.05
    assert np.mean(first**2) / first.mean() ** 2 == pytest.approx(2.0, rel=0.05)
