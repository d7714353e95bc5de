"""Leaning and silted discs and ripples against solid geometry, areas and spectra."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sonarrec.errors import SonarrecError
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import FloorSection, PlacedLandmark, PlacedObject, Scene
from tests.support.bare import POLAR, even_power

BIN_M = 2.5 / 512
RANGE_M = 1.25 + (np.arange(512) + 0.5) * BIN_M
HEIGHT, GROUND, RADIUS, LEAN = 0.68, 1.9, 0.15, 12.0
SINE, COSINE = math.sin(math.radians(LEAN)), math.cos(math.radians(LEAN))


def disc(lean: float = 0.0, towards: float = 0.0, **more: float) -> Scene:
    item = PlacedObject(
        "filled",
        GROUND,
        0.0,
        size_m=RADIUS,
        bright_db=20,
        lean_deg=lean,
        lean_towards_deg=towards,
        **more,
    )
    return replace(POLAR, objects=(item,))


def extent(seen: np.ndarray, beams: slice) -> tuple[float, float]:
    """Slant range where the disc begins and ends."""
    level = seen[:, beams].mean(axis=1)
    rows = np.flatnonzero(level > level[:430].max() / 8)
    return 1.25 + rows[0] * BIN_M, 1.25 + (rows[-1] + 1) * BIN_M


@pytest.mark.parametrize(("towards", "raised"), [(0.0, 1), (180.0, -1)])
def test_a_leaning_disc_is_as_long_as_its_edges_are_apart(towards: float, raised: int) -> None:
    seen = even_power(disc(LEAN, towards))
    near = math.hypot(GROUND - RADIUS * COSINE, HEIGHT - (raised < 0) * 2 * RADIUS * SINE)
    far = math.hypot(GROUND + RADIUS * COSINE, HEIGHT - (raised > 0) * 2 * RADIUS * SINE)
    assert extent(seen, slice(46, 50)) == pytest.approx((near, far), abs=3 * BIN_M)


@pytest.mark.parametrize(
    ("lean", "towards"), [(0.0, 0.0), (LEAN, 0.0), (LEAN, 180.0), (LEAN, 90.0)]
)
def test_the_area_that_shows_is_the_projected_disc(lean: float, towards: float) -> None:
    scene = disc(lean, towards)
    seen = even_power(replace(scene, sonar=replace(scene.sonar, beam_width_deg=0.1)))
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


def test_truth_is_the_middle_of_the_raised_disc() -> None:
    scene = replace(POLAR, landmarks=(PlacedLandmark(1, 1.9, 3.0, lean_deg=15.0),))
    (row,) = next(render(scene)).truth
    up = 0.15 * math.sin(math.radians(15))
    assert row.range_m == pytest.approx(math.hypot(1.9, 0.68 - up), abs=1e-4)
    assert row.bearing_deg == pytest.approx(3.0, abs=1e-4)
    moving = replace(scene, motion=replace(scene.motion, surge_m_s=0.2))
    with pytest.raises(SonarrecError, match="discs lean before a standing sonar only"):
        next(render(moving))


@pytest.mark.parametrize("share", [0.15, 0.4])
def test_silt_covers_its_share_and_not_the_rim_alone(share: float) -> None:
    floor = replace(POLAR.floor, silt_m=0.06)
    scene = replace(disc(silted=share), floor=floor)
    bare = even_power(disc())
    covered = even_power(scene)
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


def rippled(towards: float, length: float = 0.12, height: float = 0.008) -> Scene:
    floor = FloorSection(
        texture_db=0,
        angle_exponent=0,
        speckle_s=1e9,
        ripple_height_m=height,
        ripple_length_m=length,
        ripple_towards_deg=towards,
        ripple_bends=0,
    )
    return replace(POLAR, floor=floor)


@pytest.mark.parametrize("length", [0.06, 0.12, 0.25])
def test_ripples_are_as_long_as_stated(length: float) -> None:
    seen = even_power(rippled(0.0, length, length / 15))[:, 44:52].mean(axis=1)
    ground = np.sqrt(RANGE_M**2 - HEIGHT**2)
    even = np.linspace(ground[0], ground[-1], 4096)
    log = np.interp(even, ground, 10 * np.log10(seen))
    spectrum = np.abs(np.fft.rfft((log - log.mean()) * np.hanning(4096), 2**16))
    per_m = np.fft.rfftfreq(2**16, even[1] - even[0])
    spectrum[per_m < 2] = 0
    assert 1 / per_m[np.argmax(spectrum)] == pytest.approx(length, rel=0.04)


def test_the_contrast_of_ripples_depends_on_the_way_they_are_looked_at() -> None:
    def contrast(towards: float) -> float:
        seen = even_power(rippled(towards))[100:400, 46:50].mean(axis=1)
        return float(np.std(10 * np.log10(seen)))

    across, aslant, along = (contrast(towards) for towards in (0.0, 60.0, 90.0))
    assert across > 1.3 * aslant > 1.3 * 1.3 * along
    assert along < 0.8
