"""Sloping floors, rolling sonars, leaning and silted discs and ripples against solid geometry."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sonarrec.errors import SonarrecError
from sonarrec.simulation.motion import Plane, Pose
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import PlacedLandmark, PlacedObject, Scene, scene_sonar
from tests.support.bare import BIN_M, POLAR, RANGE_M, changed, even_power

HEIGHT, GROUND, RADIUS, LEAN = 0.68, 1.9, 0.15, 12.0
SINE, COSINE = math.sin(math.radians(LEAN)), math.cos(math.radians(LEAN))


def in_space(x: float, y: float, slope_deg: float, towards_deg: float) -> np.ndarray:
    """A place of the floor, turned about the horizontal line across the way it rises."""
    towards, angle, flat = math.radians(towards_deg), -math.radians(slope_deg), np.array([x, y, 0])
    axis, cos = np.array([-math.cos(towards), math.sin(towards), 0]), math.cos(angle)
    # Rodrigues' formula.
    return flat * cos + np.cross(axis, flat) * math.sin(angle) + axis * (axis @ flat) * (1 - cos)


def sloping(slope: float, towards: float) -> Scene:
    return changed(POLAR, floor={"slope_deg": slope, "slope_towards_deg": towards})


@pytest.mark.parametrize("towards", [0.0, 180.0, 90.0, -140.0])
def test_truth_and_echo_lie_where_the_slope_puts_them(towards: float) -> None:
    target = PlacedObject("filled", 2.1, 7.0, size_m=0.03, bright_db=30)
    landmark = PlacedLandmark(1, 1.7, -6.0)
    scene = replace(sloping(8.0, towards), objects=(target,), landmarks=(landmark,))
    frame = next(render(scene))
    for row, ground, azimuth in (
        (frame.distractors[0], 2.1, math.radians(7)),
        (frame.truth[0], 1.7, math.radians(-6)),
    ):
        place = in_space(ground * math.sin(azimuth), ground * math.cos(azimuth), 8.0, towards)
        seen = place - [0, 0, 0.68]
        assert row.range_m == pytest.approx(np.linalg.norm(seen), abs=1e-4)
        bearing_deg = math.degrees(math.atan2(seen[0], seen[1]))
        assert row.bearing_deg == pytest.approx(bearing_deg, abs=1e-3)
    bright = even_power(scene) > 100
    bin_, beam = (v.mean() for v in np.nonzero(bright))
    seen = frame.distractors[0]
    assert 1.25 + (bin_ + 0.5) * BIN_M == pytest.approx(seen.range_m, abs=0.008)
    assert (beam - 47.5) * 0.3 == pytest.approx(seen.bearing_deg, abs=0.15)
    # What is stated is the height and the tilt, over a floor that nobody says slopes.
    assert scene_sonar(scene) == scene_sonar(POLAR)


@pytest.mark.parametrize(("towards", "slope"), [(0.0, 6.0), (180.0, 4.0)])
def test_the_axis_meets_the_slope_where_a_triangle_says(towards: float, slope: float) -> None:
    scene = changed(sloping(slope, towards), sonar={"vertical_beam_deg": 8.0})
    # The beam's axis is 20 deg down, and the floor rises or falls to meet it.
    sine = math.sin(math.radians(20 + (slope if towards == 0 else -slope)))
    expected = 0.68 * math.cos(math.radians(slope)) / sine
    seen = even_power(scene)[:, 40:56].mean(axis=1)
    log = 10 * np.log10(np.maximum(seen, 1e-6))
    near = np.abs(RANGE_M - expected) < 0.25
    # Decibels of a Gaussian beam are a parabola of the depression.
    depression = np.degrees(np.arcsin(expected * sine / RANGE_M[near]))
    curve = np.polyfit(depression, log[near], 2)
    top = -curve[1] / (2 * curve[0])
    assert expected * sine / math.sin(math.radians(top)) == pytest.approx(expected, abs=0.06)


def test_what_is_looked_at_is_what_is_seen_there() -> None:
    rng = np.random.default_rng(3)
    range_m, bearing = np.linspace(1.3, 3.7, 9), np.linspace(-14, 14, 7)
    for _ in range(20):
        pan, height, x, y, pitch, roll = rng.uniform(
            [-180, 0.6, -3, -3, -3, -5], [180, 0.8, 3, 3, 3, 5]
        )
        plane = Plane(rng.uniform(0, 10), rng.uniform(-180, 180))
        pose = Pose(pan, height, x, y, pitch, roll)
        x_m, y_m, _, sine = plane.view(pose, range_m, bearing + pan)
        slant, seen = plane.seen(pose, x_m.astype(float), y_m.astype(float))
        there = sine > 0
        np.testing.assert_allclose(slant[there], np.tile(range_m[:, None], 7)[there], atol=2e-5)
        np.testing.assert_allclose(seen[there], np.tile(bearing, (9, 1))[there], atol=1e-3)


def disc(lean: float = 0.0, towards: float = 0.0, **more: float) -> Scene:
    leaning = {"lean_deg": lean, "lean_towards_deg": towards} | more
    item = PlacedObject("filled", GROUND, 0.0, size_m=RADIUS, bright_db=20, **leaning)
    return replace(POLAR, objects=(item,))


@pytest.mark.parametrize(("lean", "towards"), [(0, 0), (LEAN, 0), (LEAN, 180), (LEAN, 90)])
def test_the_area_that_shows_is_the_projected_disc(lean: float, towards: float) -> None:
    seen = even_power(changed(disc(lean, towards), sonar={"beam_width_deg": 0.1}))
    cell = RANGE_M[:, None] * math.radians(0.3) * BIN_M * np.ones(96)
    window = slice(*np.searchsorted(RANGE_M, [1.8, 2.22]))
    floor = even_power(POLAR)
    area = cell[window][(seen > 2 * floor)[window]].sum()
    # The rim in space, turned, and as it shows: an outline in slant range and bearing.
    way = np.radians(np.arange(0, 360, 0.5))
    tilt, to = math.radians(lean), math.radians(towards)
    along, aside = RADIUS * np.cos(way), RADIUS * np.sin(way)
    x = along * math.cos(tilt) * math.sin(to) + aside * math.cos(to)
    y = GROUND + along * math.cos(tilt) * math.cos(to) - aside * math.sin(to)
    slant = np.sqrt(x**2 + y**2 + (HEIGHT - (along + RADIUS) * math.sin(tilt)) ** 2)
    bearing = np.arctan2(x, y)
    outline = np.column_stack([slant * np.sin(bearing), slant * np.cos(bearing)])
    projected = cv2.contourArea(outline.astype(np.float32))
    # All cells that hold some of it: half a cell more on every side.
    half = math.sqrt(projected / math.pi)
    assert area == pytest.approx(projected * (1 + 0.007 / half) ** 2, rel=0.06)


def test_a_disc_that_faces_the_sonar_is_brighter_by_lamberts_law() -> None:
    floor, middle = (math.atan2(HEIGHT - up, GROUND) for up in (0.0, RADIUS * SINE))
    rows = slice(*np.searchsorted(RANGE_M, [1.96, 2.06]))
    flat = even_power(disc())[rows, 45:51].mean()
    for towards, sign in ((0.0, 1), (180.0, -1)):
        seen = even_power(disc(LEAN, towards))[rows, 45:51].mean()
        law = (math.sin(middle + sign * math.radians(LEAN)) / math.sin(floor)) ** 2
        assert seen / flat == pytest.approx(law, rel=0.06)


def test_a_raised_far_edge_casts_a_shadow_as_long_as_the_ray_over_it() -> None:
    seen = even_power(disc(LEAN, 0.0))[:, 46:50].mean(axis=1)
    top = 2 * RADIUS * SINE
    end = (GROUND + RADIUS * COSINE) * HEIGHT / (HEIGHT - top)
    dark = RANGE_M[(seen < 0.3) & (RANGE_M > 2.1)]
    assert dark.min() == pytest.approx(math.hypot(GROUND + 0.15, HEIGHT - top), abs=0.03)
    assert dark.max() == pytest.approx(math.hypot(end, HEIGHT), abs=0.02)
    # A disc whose near edge is raised hides nothing behind it.
    assert (even_power(disc(LEAN, 180.0))[360:, 46:50].mean(axis=1) > 0.5).all()


@pytest.mark.parametrize(("towards", "raised"), [(180.0, "near"), (0.0, "far")])
def test_the_raised_edge_of_a_leaning_disc_is_bright_on_the_near_side(
    towards: float, raised: str
) -> None:
    scene = disc(LEAN, towards)
    with_edge = even_power(changed(scene, fading={"specular_db": 6.0}))
    change_db = 10 * np.log10(with_edge / even_power(scene))[:, 46:50].mean(axis=1)
    near, far = change_db[RANGE_M < 2.0], change_db[RANGE_M > 2.04]
    edge_db, others = (near.max(), far) if raised == "near" else (-far.min(), near)
    assert edge_db == pytest.approx(6, abs=0.9)
    assert np.abs(others).max() < 0.5


def test_truth_is_the_middle_of_the_raised_disc() -> None:
    scene = replace(POLAR, landmarks=(PlacedLandmark(1, 1.9, 3.0, lean_deg=15.0),))
    (row,) = next(render(scene)).truth
    up = 0.15 * math.sin(math.radians(15))
    assert row.range_m == pytest.approx(math.hypot(1.9, 0.68 - up), abs=1e-4)
    assert row.bearing_deg == pytest.approx(3.0, abs=1e-4)
    with pytest.raises(SonarrecError, match="standing"):
        next(render(changed(scene, motion={"surge_m_s": 0.2})))


@pytest.mark.parametrize("share", [0.15, 0.4])
def test_silt_covers_its_share_and_not_the_rim_alone(share: float) -> None:
    bare, covered = (
        even_power(disc()),
        even_power(changed(disc(silted=share), floor={"silt_m": 0.06})),
    )
    inside = bare > 60
    # Halfway in decibels between the disc's 20 dB and the floor's 0.
    under = inside & (covered < bare / 10)
    assert under.sum() / inside.sum() == pytest.approx(share, abs=0.08)
    assert np.median(covered[inside & (covered < 3)]) == pytest.approx(1.3, abs=0.7)
    range_m = np.broadcast_to(RANGE_M[:, None], under.shape)
    middle = math.hypot(GROUND, HEIGHT)
    across = RANGE_M[:, None] * np.radians((np.arange(96) - 47.5) * 0.3)
    rho = np.hypot((range_m - middle) * middle / GROUND, across) / RADIUS
    core = inside & (rho < 0.6)
    assert (under & core).sum() > 0.2 * share * core.sum()


@pytest.mark.parametrize("length", [0.06, 0.12, 0.25])
def test_ripples_are_as_long_as_stated(length: float) -> None:
    ripples = {"ripple_height_m": length / 15, "ripple_length_m": length, "ripple_bends": 0}
    scene = changed(POLAR, floor=ripples | {"ripple_towards_deg": 0.0})
    seen = even_power(scene)[:, 44:52].mean(axis=1)
    ground = np.sqrt(RANGE_M**2 - HEIGHT**2)
    even = np.linspace(ground[0], ground[-1], 4096)
    log = np.interp(even, ground, 10 * np.log10(seen))
    spectrum = np.abs(np.fft.rfft((log - log.mean()) * np.hanning(4096), 2**16))
    per_m = np.fft.rfftfreq(2**16, even[1] - even[0])
    spectrum[per_m < 2] = 0
    assert 1 / per_m[np.argmax(spectrum)] == pytest.approx(length, rel=0.04)


def test_single_stones_glitter_on_bright_parts_alone() -> None:
    """Two discs side by side, one of gravel all over, one a bare plate with a blank's ring."""
    filled = PlacedObject("filled", 2.0, -6.0, size_m=RADIUS, bright_db=10)
    blank = PlacedObject("blank", 2.0, 6.0, size_m=RADIUS, bright_db=10, plate_db=-6)
    scene = replace(POLAR, objects=(filled, blank))
    glitter = {"glitter_db": 6.0, "glitter_m": 0.02, "glitter_share": 0.1}
    gain_db = 10 * np.log10(even_power(changed(scene, floor=glitter)) / even_power(scene))
    beam = np.degrees(np.arctan(0.6 * RADIUS / 2.0)) / 0.3  # half of what is looked at
    rows = np.abs(RANGE_M - math.hypot(2.0, HEIGHT)) < 0.5 * RADIUS
    gravel, plate = (
        gain_db[rows][:, round(47.5 + at / 0.3 - beam) : round(47.5 + at / 0.3 + beam)]
        for at in (-6.0, 6.0)
    )
    # Most of the gravel is as it was, but where the beam mixes it with a stone.
    assert 0.04 < np.mean(gravel > 3) < 0.25
    assert np.median(gravel) < 1
    assert gravel.max() > 6
    assert np.abs(plate).max() < 1
    assert np.abs(gain_db[RANGE_M < 1.7]).max() < 0.1  # the floor
