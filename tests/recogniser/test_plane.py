"""The working plane against flat-floor trigonometry written out."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from sonarrec.recogniser.plane import FanPlane, FloorPlane, working_plane
from sonarrec.simulation.scene import Scene, SonarSection, scene_sonar
from sonarrec.sonar.frame import Motion
from sonarrec.sonar.geometry import PolarToFan, beam_bearings, bin_ranges, floor_depth
from sonarrec.sonar.stated import Sonar
from tests.support.drawn import draw_on_floor, make_fan

# range_min_m, range_max_m, height_m
WINDOWS = [(1.25, 3.75, 0.68), (1.40, 2.65, 0.55), (0.80, 5.80, 0.60), (2.00, 12.0, 1.60)]


def still_circle(range_m, bearing_deg, height_m, radius_m=0.15):
    """Slant ranges and bearings of a circle on the floor, counter-clockwise from the right."""
    ground, bearing = math.sqrt(range_m**2 - height_m**2), math.radians(bearing_deg)
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    x = ground * math.sin(bearing) + radius_m * np.cos(angle)
    y = ground * math.cos(bearing) + radius_m * np.sin(angle)
    return np.sqrt(x**2 + y**2 + height_m**2), np.degrees(np.arctan2(x, y)), angle


def seen_at(plane):
    """Slant range and bearing of every pixel."""
    row, column = np.mgrid[0 : plane.shape[0], 0 : plane.shape[1]]
    return plane.to_polar(column, row)


@settings(max_examples=30)
@given(
    kind=st.sampled_from(["fan", "floor"]),
    window=st.sampled_from(WINDOWS),
    height_known=st.booleans(),
    share=st.floats(0.05, 1),
    bearing_deg=st.floats(-14, 14),
)
def test_round_trips(kind, window, height_known, share, bearing_deg):
    near, far, height = window
    fan = make_fan(120, near, far, height_m=height if height_known else None)
    plane = working_plane(kind, fan, 0.15, 10.0)
    near = max(near, floor_depth(fan)) if kind == "floor" else near  # nearer there is no floor
    range_m = near + share * (far - near)
    column, row = plane.from_polar(np.array([range_m]), np.array([bearing_deg]))
    back = plane.to_polar(column, row)
    assert back[0][0] == pytest.approx(range_m, rel=1e-9)
    assert back[1][0] == pytest.approx(bearing_deg, abs=1e-7)
    # The contract: column = apex_col + R sin b / mpp, row = apex_row - R cos b / mpp.
    fan_column, fan_row = plane.to_fan(column, row)
    b = math.radians(bearing_deg)
    distance = range_m / fan.metres_per_pixel
    assert fan_column[0] == pytest.approx(fan.apex_column + distance * math.sin(b), abs=1e-6)
    assert fan_row[0] == pytest.approx(fan.apex_row - distance * math.cos(b), abs=1e-6)


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize(("bearing_deg", "share"), [(-12.0, 0.3), (0.0, 0.6), (7.5, 0.95)])
@pytest.mark.parametrize("disc_radius_px", [6.0, 15.0])
def test_a_floor_circle_is_a_circle_of_one_size(window, bearing_deg, share, disc_radius_px):
    near, far, height = window
    fan = make_fan(512, near, far, height_m=height)
    plane = FloorPlane(fan, 0.15, disc_radius_px)
    assert plane.axes[0] == plane.axes[1] <= disc_radius_px + 1e-9  # never finer than the fan
    assert plane.scale <= 1
    range_m = near + share * (far - near)
    ranges, bearings, angle = still_circle(range_m, bearing_deg, height)
    column, row = plane.from_polar(ranges, bearings)
    centre = plane.from_polar(np.array([range_m]), np.array([bearing_deg]))
    np.testing.assert_allclose(column - centre[0], plane.axes[0] * np.cos(angle), atol=1e-6)
    np.testing.assert_allclose(row - centre[1], -plane.axes[0] * np.sin(angle), atol=1e-6)


@pytest.mark.parametrize(("far", "radius_px"), [(5.0, 12.0), (10.0, 9.0)])
def test_a_large_floor_has_larger_pixels(far, radius_px):
    fan = make_fan(1024, 1.0, far, height_m=0.8, field_of_view_deg=130.0)
    plane = FloorPlane(fan, 0.15, 12.0)
    assert plane.axes == pytest.approx((radius_px, radius_px))
    pixel_m2 = (0.15 / radius_px) ** 2
    area_m2 = math.radians(130) * (far**2 - 1) / 2  # less two corners below the image
    assert np.count_nonzero(plane.inside) * pixel_m2 == pytest.approx(area_m2, rel=0.06)


@pytest.mark.parametrize("rows", [200, 331, 512])
@pytest.mark.parametrize(("range_m", "bearing_deg"), [(1.9, -6.0), (2.6, 8.0), (3.3, 1.5)])
def test_a_drawn_disc_comes_out_round_and_where_it_is(rows, range_m, bearing_deg):
    fan = make_fan(rows)
    disc, _ = draw_on_floor(fan, range_m, bearing_deg, 0.15, lambda x, y: np.hypot(x, y) <= 1)
    plane = FloorPlane(fan, 0.15, 12.0)
    image = plane.warp((disc * 255).astype(np.uint8)).astype(float) / 255
    assert image.shape == plane.shape == plane.inside.shape
    row, column = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    area = image.sum()
    centre = np.array([(column * image).sum(), (row * image).sum()]) / area
    expected = plane.from_polar(np.array([range_m]), np.array([bearing_deg]))
    np.testing.assert_allclose(centre, np.ravel(expected), atol=0.15)
    assert area == pytest.approx(math.pi * plane.axes[0] ** 2, rel=0.03)
    across = ((column - centre[0]) ** 2 * image).sum() / area
    along = ((row - centre[1]) ** 2 * image).sum() / area
    assert across == pytest.approx(along, rel=0.05)


@settings(max_examples=30)
@given(
    kind=st.sampled_from(["fan", "floor"]),
    range_m=st.floats(1.3, 3.7),
    bearing_deg=st.floats(-14, 14),
    pan_deg=st.floats(-20, 20),
)
def test_a_turn_to_the_right_lowers_every_bearing(kind, range_m, bearing_deg, pan_deg):
    plane = working_plane(kind, make_fan(100), 0.15, 10.0)
    before = np.stack(plane.from_polar(np.array([range_m]), np.array([bearing_deg])), axis=-1)
    after = np.stack(plane.from_polar(np.array([range_m]), np.array([bearing_deg - pan_deg])), -1)
    np.testing.assert_allclose(plane.moved(before, Motion(pan_deg)), after, atol=1e-7)
    many = np.broadcast_to(before, (3, 4, 1, 2))
    assert plane.moved(many, Motion(pan_deg)).shape == (3, 4, 1, 2)


@pytest.mark.parametrize("window_m", [1.25, 2.5, 5.0, 10.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, 35.0])
def test_the_fan_plane_s_axes_are_equations_1_and_2(window_m, tilt_deg):
    fan = make_fan(512, 1.25, 1.25 + window_m, tilt_deg=tilt_deg)
    across, along = FanPlane(fan, 0.15).axes
    assert across == pytest.approx(0.15 / (window_m / 512))
    assert along == pytest.approx(0.15 * math.cos(math.radians(tilt_deg)) / (window_m / 512))


@pytest.mark.parametrize("kind", ["fan", "floor"])
def test_inside_is_where_the_sonar_looks(kind):
    fan = make_fan(200)
    plane = working_plane(kind, fan, 0.15, 15.0)
    row, column = np.mgrid[0 : plane.shape[0], 0 : plane.shape[1]]
    range_m, bearing_deg = seen_at(plane)
    assert set(np.unique(plane.inside)) == {0, 1}
    inside = plane.inside == 1
    assert range_m[inside].min() >= fan.range_min_m
    assert range_m[inside].max() <= fan.range_max_m
    assert np.abs(bearing_deg[inside]).max() <= fan.bearing_max_deg
    pixel = 3 * fan.metres_per_pixel / plane.scale
    well = (range_m > fan.range_min_m + pixel) & (range_m < fan.range_max_m - pixel)
    well &= np.abs(bearing_deg) < fan.bearing_max_deg - math.degrees(pixel / fan.range_min_m)
    fan_row = plane.to_fan(column, row)[1]
    well &= (fan_row > 2) & (fan_row < fan.rows - 3)  # the window's near corners are cut off
    assert inside[well].all()
    # A white frame stays white wherever the plane says there is data.
    assert plane.warp(np.full((fan.rows, fan.columns), 255, np.uint8))[inside].min() == 255


POLAR = scene_sonar(Scene(sonar=SonarSection(layout="polar")))


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize(("bins", "shrink"), [(140, 1), (400, 3), (401, 3), (512, 4)])
def test_polar_images_go_straight_to_the_floor(bins, shrink, flip):
    """Against means over beams and whole blocks of range bins, then a plain bilinear look-up."""
    beams = 48
    sonar = POLAR.updated(Sonar(flip=flip)).complete("test")
    polar = PolarToFan(sonar, bins, beams)
    plane = FloorPlane(polar.fan, 0.15, 8.0)
    assert max(1, round(1 / plane.scale)) == shrink
    image = np.random.default_rng(0).integers(0, 256, (bins, beams), np.uint8)
    found = plane.warp(image, polar).astype(float)

    # In a pixel there are so many beams; a third of the weight goes to each of the two beside.
    ground = np.sqrt(bin_ranges(sonar, bins) ** 2 - 0.68**2)
    in_pixel = 0.15 / 8 / (math.radians(28.8 / beams) * ground)
    share = np.minimum(in_pixel**2 / 8, 1 / 3)[:, None]
    beside = np.pad(image, [(0, 0), (1, 1)], mode="edge").astype(float)
    blurred = (1 - 2 * share) * image + share * (beside[:, :-2] + beside[:, 2:])
    whole = np.pad(blurred, [(0, -bins % shrink), (0, 0)], mode="edge")
    small = whole.reshape(-1, shrink, beams).mean(axis=1)
    range_m, bearing_deg = seen_at(plane)
    beam = np.interp(
        -bearing_deg if flip else bearing_deg, beam_bearings(sonar, beams), np.arange(beams)
    )
    range_bin = np.interp(range_m, bin_ranges(sonar, bins), np.arange(bins))
    at = [(range_bin + 0.5) / shrink - 0.5, beam]
    expected = map_coordinates(small, at, order=1, mode="nearest")
    inside = plane.inside == 1
    # cv2.remap places to the nearest 1/32 pixel: off by 255 / 64 grey levels in either direction.
    assert np.abs(found - expected)[inside].max() <= 9
    assert np.abs(found - expected)[inside].mean() < 2


def test_a_ping_of_another_window_lies_where_the_fan_of_the_log_has_it():
    fan = PolarToFan(POLAR.complete("test"), 400, 48).fan
    near = POLAR.updated(Sonar(range_max_m=2.75)).complete("test")
    polar = PolarToFan(near, 300, 48, fan)
    plane = FloorPlane(fan, 0.15, 12.0)
    of_log = PolarToFan(POLAR.complete("test"), 400, 48)
    whole = plane.warp(np.full((400, 48), 200, np.uint8), of_log)
    found = plane.warp(np.full((300, 48), 200, np.uint8), polar)
    range_m, _ = seen_at(plane)
    inside = plane.inside == 1
    assert (whole[inside] == 200).all()
    # Along the end of its window a ping is mixed with the black beyond.
    assert (found[inside & (range_m <= 2.75 - 0.02)] == 200).all()
    assert not found[range_m > 2.75].any()


@settings(max_examples=30)
@given(
    kind=st.sampled_from(["fan", "floor"]),
    ahead_m=st.floats(1.0, 3.0),
    right_m=st.floats(-0.6, 0.6),
    carried=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
    pan_deg=st.floats(-20, 20),
)
def test_the_line_of_sight_turns_over_the_floor_as_the_sonar_is_carried(
    kind, ahead_m, right_m, carried, pan_deg
):
    """Directions on a map that lies still: from where the sonar was, and from where it is."""
    plane = working_plane(kind, make_fan(120, 1.25, 3.75, height_m=0.68), 0.15, 10.0)
    slant = math.sqrt(ahead_m**2 + right_m**2 + 0.68**2)
    bearing = math.degrees(math.atan2(right_m, ahead_m))
    place = np.column_stack(plane.from_polar(np.array([slant]), np.array([bearing])))
    before = math.degrees(math.atan2(ahead_m, right_m))
    after = math.degrees(math.atan2(ahead_m - carried[1], right_m - carried[0]))
    for motion, expected in ((Motion(pan_deg, *carried), after - before), (Motion(pan_deg), 0.0)):
        turned = plane.sight_rotation(place, plane.moved(place, motion), motion)
        assert turned[0] == pytest.approx(expected, abs=1e-6)
