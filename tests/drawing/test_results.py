"""What is drawn of results lies where the object is, and is told apart."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.drawing.pen import OKABE_ITO, disc_outline, landmark_colours
from sonarrec.drawing.results import (
    STRIP_FRAMES,
    TRAIL_FRAMES,
    Mark,
    Moment,
    caption,
    draw_frame,
    draw_strip,
    trails,
)
from sonarrec.sonar.frame import Estimate
from tests.support.drawn import make_fan
from tests.support.estimates import BASIN, FAN, at, estimate


def painted(picture: np.ndarray, colour: tuple[int, int, int], within: int = 0) -> np.ndarray:
    """(n, 2) column and row of the pixels of this colour; thin lines never quite reach it."""
    away = np.abs(picture[:, :, ::-1].astype(int) - colour)
    return np.argwhere(away.max(axis=2) <= within)[:, ::-1]


@settings(max_examples=30)
@given(
    height=st.floats(0.2, 1.0),
    range_m=st.floats(1.4, 3.5),
    bearing=st.floats(-14, 14),
    radius=st.floats(0.02, 0.3),
)
def test_outline_is_a_circle_on_the_floor(
    height: float, range_m: float, bearing: float, radius: float
) -> None:
    """Every point, cast back to the floor of a three-dimensional scene, is a radius away."""
    fan = make_fan(height_m=height)
    outline = disc_outline(fan, radius, *at(fan, range_m, bearing))
    across = (outline[:, 0] - fan.apex_column) * fan.metres_per_pixel
    ahead = (fan.apex_row - outline[:, 1]) * fan.metres_per_pixel
    slant = np.hypot(across, ahead)
    ground = np.sqrt(slant**2 - height**2)
    centre = math.sqrt(range_m**2 - height**2) * np.exp(1j * math.radians(bearing))
    points = ground * np.exp(1j * np.arctan2(across, ahead))
    np.testing.assert_allclose(np.abs(points - centre), radius, rtol=1e-6)


def test_declared_objects_are_outlined_in_their_colour() -> None:
    place = at(FAN, 2.4, 4.0)
    picture = draw_frame(
        np.zeros((FAN.rows, FAN.columns), np.uint8), FAN, BASIN, [estimate(*place, 3)]
    )
    assert picture.shape == (FAN.rows, FAN.columns, 3)
    outline = disc_outline(FAN, BASIN.radius_m, *place)
    contour = outline.astype(np.float32)[:, None]
    found = painted(picture, landmark_colours(BASIN.ids)[3])
    found = found[found[:, 1] > outline[:, 1].min() - 2]  # below the caption
    away = [abs(cv2.pointPolygonTest(contour, tuple(map(float, p)), True)) for p in found]
    assert len(found) > 100
    assert max(away) < 2
    assert set(map(tuple, np.round(outline).astype(int))) & set(map(tuple, found.tolist()))


def test_small_frames_are_enlarged_about_pixel_centres() -> None:
    fan = make_fan(rows=128)
    picture = draw_frame(
        np.zeros((fan.rows, fan.columns), np.uint8),
        fan,
        BASIN,
        [estimate(60.0, 70.0)],
        paths={0: np.array([[20.0, 100.0], [30.0, 100.0]])},
    )
    assert picture.shape == (512, 4 * fan.columns, 3)
    trail = painted(picture[380:], OKABE_ITO[0], within=90)
    # Pixel 20 covers 80 to 83, its middle is at 81.5.
    np.testing.assert_allclose(trail.mean(axis=0) + np.array([0, 380]), (101.5, 401.5), atol=1)


def test_truth_is_drawn_around_the_estimate() -> None:
    blank = np.zeros((FAN.rows, FAN.columns), np.uint8)
    place = at(FAN, 2.4, 0.0)
    picture = draw_frame(blank, FAN, BASIN, [], truth=[Mark(2, *place)])
    white = painted(picture, (255, 255, 255), within=90)
    above = white[white[:, 1] < place[1]]
    distance = np.hypot(*(above - place).T)
    assert len(above) > 30
    assert distance.min() > 0.95 * BASIN.radius_m / FAN.metres_per_pixel
    # Dashed: some directions are left out.
    angles = np.degrees(np.arctan2(*(above - place).T[::-1]))
    assert len(np.unique(np.round(angles))) < 160


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (estimate(0, 0, 3, p=0.97), "ID.3  0.97"),
        (estimate(0, 0, 3, p=0.6, declared=False), "ID.3?  0.60"),
        (estimate(0, 0, 3, p=0.1, declared=False), ""),
        (estimate(0, 0, 3, p=0.5, declared=False), ""),  # as likely as none of these
    ],
)
def test_caption(given: Estimate, text: str) -> None:
    assert caption(given, BASIN) == text


@pytest.mark.parametrize("count", [7, 30])
def test_one_colour_per_id(count: int) -> None:
    colours = landmark_colours(range(100, 100 + count))
    assert list(colours.values())[: len(OKABE_ITO)] == list(OKABE_ITO[:count])
    assert len(set(colours.values())) == count
    for colour in colours.values():
        # Contrast to black as WCAG counts it; 3 is asked of graphics.
        linear = [c / 12.92 if c <= 0.04 else ((c + 0.055) / 1.055) ** 2.4
                  for c in np.array(colour) / 255]  # fmt: skip
        assert (np.dot(linear, [0.2126, 0.7152, 0.0722]) + 0.05) / 0.05 > 3


def test_trails_are_cut_and_follow_tracks_only() -> None:
    history = [
        Moment(n, n, (estimate(n, 2 * n, number=7), estimate(n, 0, number=n)))
        for n in range(TRAIL_FRAMES + 10)
    ]
    found = trails(history)
    last = TRAIL_FRAMES + 9
    assert set(found) == {7, last}
    np.testing.assert_array_equal(found[7][:, 0], np.arange(last - TRAIL_FRAMES, last + 1))
    np.testing.assert_array_equal(found[7][:, 1], 2 * found[7][:, 0])
    assert not trails([Moment(0, 0, (estimate(0, 0, method="smi"),))])


def test_strip_has_probability_upwards_and_time_to_the_right() -> None:
    def middle(p: float, frames: int) -> tuple[float, int]:
        history = [Moment(n, n, (estimate(0, 0, 3, p=p),)) for n in range(frames)]
        found = painted(draw_strip(history, BASIN, 512)[22:], landmark_colours(BASIN.ids)[3])
        return float(found[:, 1].mean()), int(np.ptp(found[:, 0]))

    (low, _), (half, wide), (high, _) = (middle(p, 60) for p in (0.02, 0.51, 1.0))
    assert low - half == pytest.approx(half - high, abs=1.5)
    assert low - half > 40
    assert middle(0.5, 30)[1] == pytest.approx(wide * 29 / 59, abs=4)
    # What is older than the strip has left it.
    assert middle(0.5, STRIP_FRAMES)[1] == pytest.approx(middle(0.5, 3 * STRIP_FRAMES)[1], abs=5)


def test_strip_begins_with_the_first_frame_and_leaves_out_what_was_not_read() -> None:
    unread = replace(estimate(0, 0), probabilities=np.full(5, 0.2), declared=False)
    colour = landmark_colours(BASIN.ids)[3]

    def drawn(*estimates: Estimate) -> np.ndarray:
        history = [Moment(n, n, estimates) for n in range(100, 130)]
        return painted(draw_strip(history, BASIN, 512)[22:], colour)

    assert drawn(estimate(0, 0, 3))[:, 0].min() < 40
    assert not len(drawn(unread))


def test_the_marked_object_has_a_thick_outline() -> None:
    image, found = np.zeros((FAN.rows, FAN.columns), np.uint8), estimate(*at(FAN, 2.4, 4.0), 3)
    colour, inked = landmark_colours(BASIN.ids)[3], []
    for marked in (None, found.object, found.object + 1):
        picture = draw_frame(image, FAN, BASIN, [found], marked=marked)
        inked.append(len(painted(picture, colour)))
    assert inked[1] > 1.5 * inked[0]
    assert inked[2] == inked[0]


def test_the_symbol_that_was_read_is_drawn_where_it_lies() -> None:
    """In white, outside the ID's own: nine directions from the line of sight on, and no others."""
    x, y = at(FAN, 2.0, 0.0)
    found = replace(estimate(x, y), orientation_deg=90.0, read="9" * 9 + "0" * 27)
    image = np.zeros((FAN.rows, FAN.columns), np.uint8)
    picture = draw_frame(image, FAN, BASIN, [found])
    scale = picture.shape[0] // FAN.rows
    off = painted(picture, (255, 255, 255)) - np.array([x, y]) * scale
    assert len(off) > 20
    angle = np.degrees(np.arctan2(-off[:, 1], off[:, 0])) % 360
    assert ((angle > 85) & (angle < 185)).all()
    assert not len(
        painted(draw_frame(image, FAN, BASIN, [replace(found, read="")]), (255, 255, 255))
    )
