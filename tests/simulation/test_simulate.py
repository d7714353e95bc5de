"""The simulator against closed forms, brute force and textbook statistics."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sonarrec.simulation.render import render
from sonarrec.simulation.scene import (
    MotionSection,
    PlacedLandmark,
    PlacedObject,
    Scene,
    SonarSection,
)
from sonarrec.sonar.geometry import pixel_from_polar
from sonarrec.truth.match import share_in_image
from tests.support.bare import BARE, BIN_M, POLAR, changed, looking, mean_power, power
from tests.support.command import sonarrec


def test_truth_pixel_is_the_contract_formula() -> None:
    scene = replace(BARE, landmarks=(PlacedLandmark(3, 1.9, 6.0, 30.0),))
    (row,) = next(render(looking(scene, 2))).truth
    slant = math.hypot(1.9, 0.68)
    assert row.range_m == pytest.approx(slant, abs=1e-5)
    assert row.bearing_deg == pytest.approx(4.0, abs=1e-4)
    across, ahead = slant * math.sin(math.radians(4)), slant * math.cos(math.radians(4))
    assert row.x_px == pytest.approx(190 + across / BIN_M, abs=2e-3)
    assert row.y_px == pytest.approx(511.5 + (1.25 - ahead) / BIN_M, abs=2e-3)
    assert row.orientation_deg == pytest.approx(32.0)
    assert row.visible == 1.0


def test_sectors_lie_where_the_truth_says() -> None:
    disc = PlacedLandmark(1, 1.8, 3.0, 75.0, bright_db=15, symbol_db=15, plate_db=-10)
    scene = looking(replace(BARE, landmarks=(disc,)), -5)
    (row,) = next(render(scene)).truth
    seen = mean_power(scene, 12)
    angle = np.arange(0, 360, 5.0)
    # Where that place of the disc lands in the image: through ground range, not through Eq. 1.
    ground = math.sqrt(row.range_m**2 - 0.68**2)
    turn = np.radians(row.orientation_deg + angle)
    bearing = math.radians(row.bearing_deg)
    x = ground * math.sin(bearing) + 0.4 * 0.15 * np.cos(turn)
    y = ground * math.cos(bearing) + 0.4 * 0.15 * np.sin(turn)
    slant = np.sqrt(x**2 + y**2 + 0.68**2)
    column = np.rint(190 + slant * np.sin(np.arctan2(x, y)) / BIN_M).astype(int)
    line = np.rint(767.5 - slant * np.cos(np.arctan2(x, y)) / BIN_M).astype(int)
    bright = cv2.blur(seen, (3, 3))[line, column] > 3
    np.testing.assert_array_equal(bright[(angle > 15) & (angle < 75)], True)
    np.testing.assert_array_equal(bright[(angle > 105) & (angle < 345)], False)


def test_image_follows_the_truth_through_heave_and_sway() -> None:
    pan = {"pan_min_deg": -4, "pan_max_deg": 4, "pan_start_deg": -4, "pan_deg_s": 1.0}
    sway = {"sway_x_m": 0.1, "sway_y_m": 0.1, "sway_period_s": 9.0, "yaw_jitter_deg": 0.5}
    target = PlacedObject("filled", 1.9, 1.0, size_m=0.12, bright_db=25)
    motion = pan | sway | {"heave_m": 0.08}
    scene = changed(BARE, rate_hz=1.0, motion=motion, frames=8, objects=(target,))
    ranges = []
    for frame in render(scene):
        (row,) = frame.distractors
        line, column = np.nonzero(cv2.blur(power(frame.image, scene), (5, 5)) > 60)
        assert column.mean() == pytest.approx(row.x_px, abs=2)
        assert line.mean() == pytest.approx(row.y_px, abs=2)
        ranges.append(row.range_m)
    assert np.ptp(ranges) > 0.05


def test_more_floor_than_memory_holds_is_one_clear_line(tmp_path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text("name = 'much'\n[motion]\nyaw_jitter_deg = 2000")
    told = sonarrec("simulate", "--scene", scene, "-o", tmp_path / "log", code=1).stderr
    assert told.startswith("sonarrec: much")
    assert told.count("\n") == 1
    assert not (tmp_path / "log").exists()


def test_what_the_image_of_a_wide_fan_cuts_off_is_not_visible() -> None:
    """Its rows end at range_min_m straight ahead, far above the fan's near corners."""
    landmarks = tuple(
        PlacedLandmark(i, g, a)
        for i, g, a in [(1, 1.6, 0.0), (2, 1.6, 42.0), (3, 1.5, -46.0), (4, 1.4, 60.0)]
    )
    wide = {"field_of_view_deg": 130.0, "beams": 256, "beam_width_deg": 1.0}
    (frame,) = render(changed(BARE, sonar=wide, landmarks=landmarks))
    shown = np.pad(np.ones(frame.image.shape, bool), 400)
    rng = np.random.default_rng(0)
    radius, angle = 0.15 * np.sqrt(rng.random(200_000)), 2 * np.pi * rng.random(200_000)
    expected = {}
    for item in landmarks:
        place = math.radians(item.azimuth_deg)
        x = item.ground_m * math.sin(place) + radius * np.cos(angle)
        y = item.ground_m * math.cos(place) + radius * np.sin(angle)
        slant, bearing = np.sqrt(x**2 + y**2 + 0.68**2), np.degrees(np.arctan2(x, y))
        column, row = pixel_from_polar(frame.fan, slant, bearing)
        at = np.rint(row).astype(int) + 400, np.rint(column).astype(int) + 400
        seen = shown[at] & (slant > 1.25) & (slant < 3.75) & (np.abs(bearing) < 65)
        expected[item.id] = seen.mean()
    assert expected[1] == 1
    assert 0 < expected[3] < expected[2] < 1
    assert expected.pop(4) == 0
    truth = {row.landmark: row for row in frame.truth}
    assert {i: row.visible for i, row in truth.items()} == pytest.approx(expected, abs=0.01)
    for item in truth.values():
        place = np.array([item.range_m]), np.array([item.bearing_deg])
        share = share_in_image(frame.fan, *place, 0.15)
        assert share[0] == pytest.approx(expected[item.landmark], abs=0.01)


def test_speckle_is_rayleigh_and_of_unit_power() -> None:
    (frame,) = render(POLAR)
    seen = power(frame.image, POLAR)
    assert seen.mean() == pytest.approx(1.0, rel=0.05)
    assert np.mean(seen**2) / seen.mean() ** 2 == pytest.approx(2.0, rel=0.05)
    assert np.sqrt(seen).mean() ** 2 / seen.mean() == pytest.approx(math.pi / 4, rel=0.02)


def test_speckle_is_frozen_under_pan() -> None:
    """Two images seven beams (2.1 deg) and one second apart, once compensated."""
    panning = MotionSection(pan_min_deg=-10, pan_max_deg=10, pan_start_deg=0, pan_deg_s=2.1)
    usual = Scene(sonar=SonarSection(layout="polar"))
    for scene, least in ((POLAR, 0.99), (usual, 0.9)):
        *seen, last = render(replace(scene, frames=2, rate_hz=1.0, motion=panning))
        assert correlation(seen[0].image[:, 7:], last.image[:, :-7]) > least


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.corrcoef(one.ravel(), other.ravel())[0, 1])


def test_speckle_decorrelates_with_time_as_stated() -> None:
    scene = changed(POLAR, frames=5, rate_hz=0.1, floor={"speckle_s": 40.0})
    seen = [power(frame.image, scene) for frame in render(scene)]
    for lag in (1, 2, 4):
        # Power correlates as the square of the amplitude's exp(-time / 40 s); up to a tenth more,
        # since the scatterers of a beam are few and keep their strengths.
        expected = math.exp(-2 * 10 * lag / 40)
        assert expected - 0.02 < correlation(seen[0], seen[lag]) < expected + 0.1


def test_speckle_decorrelates_with_heave() -> None:
    found = []
    for heave_m in (0.0, 0.004, 0.02, 0.06):
        motion = {"heave_m": heave_m, "heave_period_s": 2.0}
        scene = changed(POLAR, frames=2, rate_hz=1.0, floor={"speckle_m": 0.05}, motion=motion)
        found.append(correlation(*(power(f.image, scene)[200:] for f in render(scene))))
    assert found[0] > 0.99
    assert found[1] > found[2] > found[3]
    assert found[3] < 0.2


def test_tall_things_cast_shadows() -> None:
    wall = PlacedObject("wall", 2.5, 0.0)
    seen = mean_power(replace(POLAR, objects=(wall,)), 10)
    edge = round((math.hypot(2.5, 0.68) - 1.25) / 2.5 * 512)
    shadow_db = 10 * math.log10(seen[edge + 40 :].mean() / seen[: edge - 40].mean())
    assert shadow_db == pytest.approx(POLAR.noise.shadow_db, abs=1)
    # A low beam hides ground * height / (sonar height - height) of floor.
    beam = PlacedObject("beam", 2.0, 0.0, width_m=0.06)
    seen = mean_power(replace(POLAR, objects=(beam,)), 10)[:, 40:56].mean(axis=1)
    dark = np.flatnonzero(seen < 0.3)
    hidden_to = math.hypot(2.03 * 0.68 / (0.68 - 0.03), 0.68)
    assert 1.25 + (dark[-1] + 1) * BIN_M == pytest.approx(hidden_to, abs=0.02)


def test_noise_level_is_the_stated_snr() -> None:
    sonar = {"range_min_m": 0.3, "range_max_m": 2.8}
    seen = mean_power(changed(POLAR, sonar=sonar, noise={"snr_db": 12.0}), 4)
    rows = int((0.6 - 0.3) / 2.5 * 512)  # nearer than the height there is only water
    assert 10 * math.log10(seen[:rows].mean()) == pytest.approx(-12.0, abs=0.3)
