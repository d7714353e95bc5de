"""Metres and pixels: against closed forms, brute force and round trips."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.errors import SonarrecError
from sonarrec.recogniser.plane import working_plane
from sonarrec.simulation.scene import Scene, scene_sonar
from sonarrec.sonar.geometry import (
    MAX_SIDE,
    PolarToFan,
    Resampling,
    fan_for_image,
    fan_for_polar,
    fan_mask,
    floor_depth,
    ground_range,
    in_fan,
    pixel_from_polar,
    polar_from_pixel,
    slant_range,
)
from sonarrec.sonar.stated import Sonar, load_sonar
from tests.support.drawn import make_fan

BASIN = scene_sonar(Scene())

sonars = st.builds(
    lambda low, window, view, tilt: Sonar(
        range_min_m=low, range_max_m=low + window, field_of_view_deg=view, tilt_deg=tilt
    ),
    *(st.floats(*span) for span in ((0, 20), (0.5, 30), (5, 150), (0, 60))),
)


# Pixels


def test_a_fan_image_by_hand() -> None:
    """512 rows over 2.5 m: the near edge of the window is the lower edge of the last row."""
    fan = fan_for_image(BASIN.complete("test"), 512, 381)
    assert fan.metres_per_pixel == 2.5 / 512
    assert fan.apex_column == 190
    column, row = pixel_from_polar(fan, np.array([1.25, 3.75]), 0.0)
    np.testing.assert_allclose(column, 190)
    np.testing.assert_allclose(row, [511.5, -0.5])
    column, row = pixel_from_polar(fan, 2.0, 10.0)
    assert column == pytest.approx(190 + 2.0 * math.sin(math.radians(10)) * 512 / 2.5)
    assert row == pytest.approx(511.5 + (1.25 - 2.0 * math.cos(math.radians(10))) * 512 / 2.5)


def test_stated_scale_and_apex_count() -> None:
    sonar = BASIN.updated(Sonar(metres_per_pixel=0.01, apex_px=(262.0, 569.0)))
    fan = fan_for_image(sonar.complete("test"), 400, 500)
    assert [float(v) for v in pixel_from_polar(fan, 1.0, 0.0)] == [262, 469]


@settings(max_examples=20)
@given(sonars, st.floats(0.01, 50), st.floats(-89, 89))
def test_round_trip(sonar: Sonar, range_m: float, bearing: float) -> None:
    for fan in (
        fan_for_image(sonar.complete("test"), 300, 200),
        fan_for_polar(sonar.complete("test"), 300),
    ):
        back = polar_from_pixel(fan, *pixel_from_polar(fan, range_m, bearing))
        np.testing.assert_allclose(back, (range_m, bearing), atol=1e-8)


@settings(max_examples=30)
@given(sonars, st.integers(20, 120))
def test_the_polar_fan_holds_the_whole_window(sonar: Sonar, bins: int) -> None:
    """Every point of the window falls into the image, and no row or column is there for nothing."""
    fan = fan_for_polar(sonar.complete("test"), bins)
    bearing = np.linspace(fan.bearing_min_deg, fan.bearing_max_deg, 201)
    for range_m in (sonar.range_min_m, sonar.range_max_m):
        column, row = pixel_from_polar(fan, range_m, bearing)
        assert column.min() >= -1
        assert column.max() <= fan.columns
        assert row.min() >= -0.5 - 1e-9
        assert row.max() <= fan.rows - 0.5 + 1e-9
    assert fan.metres_per_pixel == pytest.approx((sonar.range_max_m - sonar.range_min_m) / bins)


def test_fan_mask_against_a_loop() -> None:
    fan = fan_for_image(BASIN.complete("test"), 48, 40)
    expected = np.zeros((48, 40), np.uint8)
    for row in range(48):
        for column in range(40):
            across = (column - fan.apex_column) * fan.metres_per_pixel
            along = (fan.apex_row - row) * fan.metres_per_pixel
            within = 1.25 <= math.hypot(across, along) <= 3.75
            if within and abs(math.degrees(math.atan2(across, along))) <= 14.4:
                expected[row, column] = 255
    np.testing.assert_array_equal(fan_mask(fan), expected)


# Polar to fan


def brute_fan(sonar: Sonar, polar: np.ndarray, bearings: np.ndarray) -> np.ndarray:
    """Bilinear in range bin and beam, one pixel after the other. bearings rise."""
    bins, beams = polar.shape
    fan = fan_for_polar(sonar.complete("test"), bins)
    image = np.zeros((fan.rows, fan.columns))
    for row in range(fan.rows):
        for column in range(fan.columns):
            range_m, bearing = (float(v) for v in polar_from_pixel(fan, column, row))
            if not in_fan(fan, np.array(range_m), np.array(bearing)):
                continue
            at = (range_m - fan.range_min_m) / fan.metres_per_pixel - 0.5
            at = min(max(at, 0), bins - 1)
            right = int(np.searchsorted(bearings, bearing))
            right = min(max(right, 1), beams - 1)
            share = (bearing - bearings[right - 1]) / (bearings[right] - bearings[right - 1])
            share = min(max(share, 0), 1)
            low = min(int(at), bins - 2)
            upper = polar[low : low + 2, right - 1] * (1 - share)
            both = upper + polar[low : low + 2, right] * share
            image[row, column] = both[0] * (1 - (at - low)) + both[1] * (at - low)
    return image


@pytest.mark.parametrize(("uneven", "falling"), [(False, False), (True, False), (True, True)])
def test_polar_to_fan_against_a_loop(uneven: bool, falling: bool) -> None:
    polar = np.random.default_rng(0).integers(0, 256, (40, 24), dtype=np.uint8)
    bearings = -14.4 + 28.8 * (np.arange(24) + 0.5) / 24
    sonar, order = BASIN, slice(None, None, -1 if falling else 1)
    if uneven:
        bearings = bearings * (1 + 0.02 * np.abs(bearings))
        sonar = BASIN.updated(Sonar(bearings_deg=tuple(bearings[order].tolist())))
    expected = brute_fan(sonar, polar.astype(float), bearings)
    to_fan = PolarToFan(sonar.complete("test"), 40, 24)
    found = to_fan(np.ascontiguousarray(polar[:, order]))
    # cv2.remap places to 1/32 pixel: at most 255 / 32 grey levels in either direction.
    assert np.abs(found - expected).max() <= 16
    assert np.abs(found - expected).mean() < 2
    assert ((found == 0) | (expected > 0)).all()


@pytest.mark.parametrize("side", [100, 700])
def test_every_filled_pixel_is_resampled_and_no_other(side: int) -> None:
    """Also in images so large that they are resampled in parts."""
    rng = np.random.default_rng(side)
    image = rng.integers(1, 256, (90, 80), dtype=np.uint8)
    row, column = np.mgrid[:side, :side]
    seen = (row - side / 2) ** 2 + (column - side / 3) ** 2 < (side / 3) ** 2
    resampling = Resampling((side, side))
    steps = [0, side // 3, side // 2 + 5, side]
    for band in map(slice, steps, steps[1:]):
        x, y = rng.integers(0, 80, (side, side)), rng.integers(0, 90, (side, side))
        resampling.fill(band, x[band].astype(float), y[band].astype(float), seen[band])
        expected = np.where(seen, image[y, x], 0)
        np.testing.assert_array_equal(resampling(image)[band], expected[band])


@pytest.mark.parametrize(
    ("change", "bins", "beams", "told"),
    [
        ({"bearings_deg": (-1.0, 0.0, 1.0)}, 10, 4, "4 beams"),
        ({"ranges_m": (1.5, 2.0, 3.0)}, 10, 4, "10 range bins"),
        # A fan of too many pixels is put down to the range bins.
        ({"field_of_view_deg": 130.0, "range_max_m": 5.5}, 4000, 64, r"4000 range bins .* 5\.5 m"),
    ],
)
def test_images_that_cannot_be_as_stated(
    change: dict[str, Any], bins: int, beams: int, told: str
) -> None:
    with pytest.raises(SonarrecError, match=told):
        PolarToFan(BASIN.updated(Sonar(**change)).complete("test"), bins, beams)


def test_images_with_a_side_too_long_to_resample() -> None:
    """OpenCV's remap takes no more, neither of what it reads nor of what it makes."""
    narrow = BASIN.updated(Sonar(field_of_view_deg=0.05, range_min_m=0.5, range_max_m=300.0))
    far = BASIN.updated(Sonar(field_of_view_deg=2.0, range_min_m=1000.0, range_max_m=1000.2))
    for sonar, bins, beams in ((narrow, MAX_SIDE + 1, 3), (BASIN, 20, MAX_SIDE + 1), (far, 190, 2)):
        with pytest.raises(SonarrecError, match="32766 along"):
            PolarToFan(sonar.complete("test"), bins, beams)
    near = BASIN.updated(Sonar(field_of_view_deg=0.01, range_min_m=0.0, range_max_m=300.0))
    for sonar, bins, beams in ((near, MAX_SIDE, 2), (BASIN, 20, MAX_SIDE)):
        to_fan = PolarToFan(sonar.complete("test"), bins, beams)
        assert to_fan(np.full((bins, beams), 9, np.uint8)).max() == 9


# The floor


FLAT = Sonar(range_min_m=1.0, range_max_m=2.0, field_of_view_deg=30, tilt_deg=20)


def test_floor_by_hand() -> None:
    fan = fan_for_image(BASIN.complete("test"), 512, 381)
    assert float(ground_range(fan, 2.0)) == pytest.approx(math.sqrt(4 - 0.68**2))
    assert np.isnan(ground_range(fan, 0.5))
    flat = fan_for_image(FLAT.complete("test"), 100, 80)
    # Without a height the beam's axis meets the floor mid-window, and Eq. 1 is exact there.
    slope = float(slant_range(flat, ground_range(flat, 1.5) + 1e-6)) - 1.5
    assert slope / 1e-6 == pytest.approx(math.cos(math.radians(20)), abs=1e-3)


@settings(max_examples=20)
@given(st.floats(0.7, 100), st.sampled_from([BASIN, FLAT]))
def test_ground_range_round_trip(range_m: float, sonar: Sonar) -> None:
    fan = fan_for_image(sonar.complete("test"), 100, 80)
    assert float(slant_range(fan, ground_range(fan, range_m))) == pytest.approx(range_m)


# sonar.toml


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", r"one table \[sonar\]"),
        ("[sonar]\n[other]", r"one table \[sonar\]"),
        ("sonar = 3", r"\[sonar\] must .* not 3"),
        ("[sonar]\nrange_mim_m = 1", r"sonar.range_mim_m \(did you mean range_min_m\?\)"),
        ('[sonar]\nlayout = "round"', 'layout must be "fan" or "polar"'),
        ("[sonar]\napex_px = [1]", r"sonar.apex_px must be a list of 2"),
        ('[sonar]\nbearings_deg = ["a"]', "bearings_deg must be a list"),
    ],
)  # numbers, and files that cannot be read: tests/tables/test_toml.py
def test_a_sonar_toml_that_cannot_be_meant(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "sonar.toml"
    path.write_text(text)
    with pytest.raises(SonarrecError, match=says) as caught:
        load_sonar(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"range_min_m": 3.75}, "range_min_m = 3.75 must be"),
        ({"field_of_view_deg": 180.0}, "field_of_view_deg = 180"),
        ({"tilt_deg": 90.0}, "tilt_deg = 90"),
        ({"height_m": 4.0}, "height_m = 4"),
        ({"frame_rate_hz": 0.0}, "frame_rate_hz = 0"),
        ({"beam_width_deg": 0.0}, "beam_width_deg = 0"),
        ({"beam_width_deg": 5.1}, "beam_width_deg = 5.1"),
        ({"metres_per_pixel": -1.0}, "metres_per_pixel = -1"),
        ({"bearings_deg": ()}, "rise or fall"),
        ({"bearings_deg": (0.0, 2.0, 1.0)}, "rise or fall"),
        ({"bearings_deg": (0.0, 90.0)}, "between -90 and 90"),
    ],
)
def test_contradictions(change: dict[str, Any], says: str) -> None:
    BASIN.complete("here")
    with pytest.raises(SonarrecError, match=says) as caught:
        BASIN.updated(Sonar(**change)).complete("here")
    assert "here: " in str(caught.value)


def test_the_height_serves_in_place_of_the_tilt() -> None:
    """The axis then meets the floor mid-window, as it is assumed if only the tilt is stated."""
    window = Sonar(range_min_m=1.25, range_max_m=3.75, field_of_view_deg=28.8)
    by_tilt = fan_for_image(window.updated(Sonar(tilt_deg=20.0)).complete("here"), 256, 191)
    height = floor_depth(by_tilt)
    by_height = fan_for_image(window.updated(Sonar(height_m=height)).complete("here"), 256, 191)
    assert by_height.tilt_deg == pytest.approx(20.0, abs=0.005)
    assert floor_depth(by_height) == height
    steep = window.updated(Sonar(height_m=3.0)).complete("here")
    assert 0 < steep.tilt_deg < 90
    with pytest.raises(SonarrecError, match="height_m = -1 must"):
        window.updated(Sonar(height_m=-1.0)).complete("here")
    with pytest.raises(SonarrecError, match="lacks tilt_deg"):
        window.complete("here")


def test_what_is_missing_is_named() -> None:
    with pytest.raises(SonarrecError, match="lacks range_max_m, tilt_deg, field_of_view_deg"):
        Sonar(range_min_m=1.0).complete("here")
    bearings = Sonar(range_min_m=1.0, range_max_m=2.0, tilt_deg=3.0, bearings_deg=(-1.0, 1.0))
    bearings.complete("here")  # the bearings tell the field of view
    fan = fan_for_polar(bearings.complete("test"), 10)
    assert (fan.bearing_min_deg, fan.bearing_max_deg) == (-2, 2)


@pytest.mark.parametrize("kind", ["fan", "floor"])
def test_the_scale_of_a_plane_is_that_of_its_discs(kind: str) -> None:
    fan = make_fan(512, height_m=0.68)
    for disc_px in (4.0, 10.0, 400.0):
        plane = working_plane(kind, fan, 0.15, disc_px)
        assert plane.axes[0] == pytest.approx(plane.scale * 0.15 / fan.metres_per_pixel)
