"""What is drawn lies where it is and is told apart: the stated geometry, and results."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.drawing.geometry import disc_width_px, draw_grid, draw_preview
from sonarrec.drawing.pen import (
    FLOOR,
    GRID,
    OKABE_ITO,
    TRUTH,
    Pen,
    disc_outline,
    landmark_colours,
    pixel_unit,
)
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
from sonarrec.sonar.frame import Estimate, Fan
from sonarrec.sonar.stated import Sonar
from tests.support.command import sonarrec
from tests.support.drawn import draw_on_floor, make_fan
from tests.support.estimates import BASIN, FAN, at, estimate
from tests.support.logs import PERIOD_NS, frames, image_folder

COLOURS = landmark_colours(BASIN.ids)


def blank(fan: Fan = FAN) -> np.ndarray:
    return np.zeros((fan.rows, fan.columns), np.uint8)


def painted(picture: np.ndarray, colour: tuple[int, int, int], within: int = 0) -> np.ndarray:
    """(n, 2) column and row of the pixels of about this colour (RGB); thin lines never quite reach
    it."""
    away = np.abs(picture[:, :, ::-1].astype(int) - colour)
    return np.argwhere(away.max(axis=2) <= within)[:, ::-1]


def place(fan: Fan, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slant range (m) and bearing (deg) of pixels, by the contract's formula."""
    across, ahead = points[:, 0] - fan.apex_column, fan.apex_row - points[:, 1]
    return np.hypot(across, ahead) * fan.metres_per_pixel, np.degrees(np.arctan2(across, ahead))


def gridded(fan: Fan) -> np.ndarray:
    canvas = cv2.cvtColor(blank(fan), cv2.COLOR_GRAY2BGR)
    pen = Pen(canvas, pixel_unit(max(fan.rows, fan.columns)))
    draw_grid(pen, fan)
    return pen.canvas


def test_the_grid_is_the_stated_fan_and_round_ranges_and_bearings() -> None:
    points = painted(gridded(FAN), GRID, 30)
    range_m, bearing = place(FAN, points)
    # Between bearings 0.6 and 4.4 deg and away from labels there are rings alone.
    ring = np.unique(np.round(range_m[(bearing > 0.8) & (bearing < 4.2)], 2))
    assert {1.5, 2.0, 2.5, 3.0, 3.5} <= set(np.round(ring, 1))
    inner = ring[(ring > 1.4) & (ring < 3.55)]
    assert np.abs(inner * 2 - np.round(inner * 2)).max() <= 2 * 0.011
    # Between two rings there are rays alone.
    ray = bearing[(range_m > 2.1) & (range_m < 2.4) & (np.abs(bearing) < 13)]
    assert np.abs(ray - 5 * np.round(ray / 5)).max() < 0.35
    assert {-10, -5, 0, 5, 10} == set((5 * np.round(ray / 5)).astype(int))
    # The outline.
    for range_m, degrees in ((2.25, -14.4), (2.25, 14.4), (1.255, 2.5), (3.745, 2.5)):
        b = math.radians(degrees)
        column = FAN.apex_column + range_m * math.sin(b) / FAN.metres_per_pixel
        row = FAN.apex_row - range_m * math.cos(b) / FAN.metres_per_pixel
        assert np.hypot(*(points - (column, row)).T).min() < 3, (range_m, degrees)


def preview(fan: Fan) -> np.ndarray:
    """The frame of a preview of 512 rows, without what is beside and below it."""
    left = (512 - fan.columns) // 2
    return draw_preview(blank(fan), fan, BASIN, Sonar())[: fan.rows, left : left + fan.columns]


def test_the_floor_s_near_edge_lies_at_the_height() -> None:
    fan = make_fan(rows=512, height_m=2.0)
    range_m, bearing = place(fan, painted(preview(fan), FLOOR, 30))
    edge = np.abs(bearing) > 4  # beside the label
    assert np.abs(range_m[edge] - 2.0).max() < 2 * fan.metres_per_pixel
    assert bearing.min() < -14
    assert bearing.max() > 14
    # A floor that begins before the window has no edge in it.
    assert not len(painted(preview(FAN), FLOOR, 30))


def test_the_discs_are_to_scale() -> None:
    """Three outlines, each over a disc rendered on the floor from first principles."""
    line = np.zeros((FAN.rows, FAN.columns), np.uint8)
    points = painted(preview(FAN), TRUTH, 60)
    line[points[:, 1], points[:, 0]] = 1
    for share, aside in ((1 / 6, 0.5), (1 / 2, 0.25), (5 / 6, 0.75)):
        range_m, bearing = 1.25 + 2.5 * share, -14.4 + 28.8 * aside
        disc, _ = draw_on_floor(FAN, range_m, bearing, 0.15, lambda x, y: np.hypot(x, y) <= 1)
        solid = (disc > 0.5).astype(np.uint8)
        rim = cv2.morphologyEx(solid, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
        near = cv2.dilate(line, np.ones((3, 3), np.uint8)) > 0
        assert near[rim].mean() > 0.9, share


def test_disc_width_is_that_of_a_rendered_disc() -> None:
    disc, _ = draw_on_floor(FAN, 2.5, 0.0, 0.15, lambda x, y: np.hypot(x, y) <= 1)
    columns = np.nonzero((disc > 0.5).any(axis=0))[0]
    assert disc_width_px(FAN, BASIN) == pytest.approx(np.ptp(columns) + 1, abs=1.5)


@pytest.mark.parametrize("key", ["height_m", "tilt_deg"])
def test_a_preview_says_what_is_estimated(key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(Pen, "text", lambda _, text, *__: told.append(text))
    stated = Sonar(height_m=0.68, tilt_deg=20.0)
    draw_preview(blank(), FAN, BASIN, stated)
    assert not [line for line in told if "estimated" in line]
    draw_preview(blank(), FAN, BASIN, replace(stated, **{key: None}))
    (line,) = [line for line in told if "estimated" in line]
    assert line.startswith("floor" if key == "height_m" else "stated")


# Results


@settings(max_examples=30)
@given(
    height=st.floats(0.2, 1.0),
    range_m=st.floats(1.4, 3.5),
    bearing=st.floats(-14, 14),
    radius=st.floats(0.02, 0.3),
)
def test_outline_is_a_circle(height: float, range_m: float, bearing: float, radius: float) -> None:
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
    centre = at(FAN, 2.4, 4.0)
    picture = draw_frame(blank(), FAN, BASIN, [estimate(*centre, 3)])
    assert picture.shape == (FAN.rows, FAN.columns, 3)
    outline = disc_outline(FAN, BASIN.radius_m, *centre)
    contour = outline.astype(np.float32)[:, None]
    found = painted(picture, COLOURS[3])
    found = found[found[:, 1] > outline[:, 1].min() - 2]  # below the caption
    away = [abs(cv2.pointPolygonTest(contour, tuple(map(float, p)), True)) for p in found]
    assert len(found) > 100
    assert max(away) < 2
    assert set(map(tuple, np.round(outline).astype(int))) & set(map(tuple, found.tolist()))


def test_small_frames_are_enlarged_about_pixel_centres() -> None:
    fan = make_fan(rows=128)
    paths = {0: np.array([[20.0, 100.0], [30.0, 100.0]])}
    picture = draw_frame(blank(fan), fan, BASIN, [estimate(60.0, 70.0)], paths=paths)
    assert picture.shape == (512, 4 * fan.columns, 3)
    trail = painted(picture[380:], OKABE_ITO[0], within=90)
    # Pixel 20 covers 80 to 83, its middle is at 81.5.
    np.testing.assert_allclose(trail.mean(axis=0) + np.array([0, 380]), (101.5, 401.5), atol=1)


def test_truth_is_drawn_around_the_estimate() -> None:
    centre = at(FAN, 2.4, 0.0)
    picture = draw_frame(blank(), FAN, BASIN, [], truth=[Mark(2, *centre)])
    white = painted(picture, (255, 255, 255), within=90)
    above = white[white[:, 1] < centre[1]]
    distance = np.hypot(*(above - centre).T)
    assert len(above) > 30
    assert distance.min() > 0.95 * BASIN.radius_m / FAN.metres_per_pixel
    # Dashed: some directions are left out.
    angles = np.degrees(np.arctan2(*(above - centre).T[::-1]))
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
        share = np.array(colour) / 255
        linear = np.where(share <= 0.04, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
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
        found = painted(draw_strip(history, BASIN, 512)[22:], COLOURS[3])
        return float(found[:, 1].mean()), int(np.ptp(found[:, 0]))

    (low, _), (half, wide), (high, _) = (middle(p, 60) for p in (0.02, 0.51, 1.0))
    assert low - half == pytest.approx(half - high, abs=1.5)
    assert low - half > 40
    assert middle(0.5, 30)[1] == pytest.approx(wide * 29 / 59, abs=4)
    # What is older than the strip has left it.
    assert middle(0.5, STRIP_FRAMES)[1] == pytest.approx(middle(0.5, 3 * STRIP_FRAMES)[1], abs=5)


def test_strip_begins_with_the_first_frame_and_leaves_out_what_was_not_read() -> None:
    unread = replace(estimate(0, 0), probabilities=np.full(5, 0.2), declared=False)

    def drawn(*estimates: Estimate) -> np.ndarray:
        history = [Moment(n, n, estimates) for n in range(100, 130)]
        return painted(draw_strip(history, BASIN, 512)[22:], COLOURS[3])

    assert drawn(estimate(0, 0, 3))[:, 0].min() < 40
    assert not len(drawn(unread))


def test_the_marked_object_has_a_thick_outline() -> None:
    found, inked = estimate(*at(FAN, 2.4, 4.0), 3), []
    for marked in (None, found.object, found.object + 1):
        picture = draw_frame(blank(), FAN, BASIN, [found], marked=marked)
        inked.append(len(painted(picture, COLOURS[3])))
    assert inked[1] > 1.5 * inked[0]
    assert inked[2] == inked[0]


def test_the_symbol_that_was_read_is_drawn_where_it_lies() -> None:
    """In white, outside the ID's own: nine directions from the line of sight on, and no others."""
    x, y = at(FAN, 2.0, 0.0)
    found = replace(estimate(x, y), orientation_deg=90.0, read="9" * 9 + "0" * 27)
    picture = draw_frame(blank(), FAN, BASIN, [found])
    scale = picture.shape[0] // FAN.rows
    off = painted(picture, (255, 255, 255)) - np.array([x, y]) * scale
    assert len(off) > 20
    angle = np.degrees(np.arctan2(-off[:, 1], off[:, 0])) % 360
    assert ((angle > 85) & (angle < 185)).all()
    unread = draw_frame(blank(), FAN, BASIN, [replace(found, read="")])
    assert not len(painted(unread, (255, 255, 255)))


def ticks(history: list[Moment]) -> np.ndarray:
    """Columns of what is lit right below the line of probability 0, beside its label."""
    strip = draw_strip(history, BASIN, 512)
    return 20 + np.nonzero((strip[119:121, 20:] > 60).any(axis=(0, 2)))[0]


def test_ticks_stand_every_twenty_frames() -> None:
    found = ticks([Moment(n, n * PERIOD_NS, ()) for n in range(200)])
    step = (512 - 10 - 34) / (STRIP_FRAMES - 1)
    expected = np.array([512 - 10 - (199 - n) * step for n in range(80, 200, 20)])
    away = np.abs(found[:, None] - expected)
    assert away.min(axis=0).max() <= 1  # each has its tick
    assert away.min(axis=1).max() <= 1  # and nothing else is there


def test_info_writes_the_preview_of_the_first_frame_that_can_be_used(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(3, 48, 38))
    (log / "frame0.png").write_bytes(b"no image")
    out = tmp_path / "preview.png"
    sonarrec("info", log, "--preview", out, code=3)  # for the broken frame
    picture = cv2.imread(str(out))
    assert picture is not None
    expected = cv2.imread(str(log / "frame1.png"), cv2.IMREAD_GRAYSCALE)
    assert expected is not None
    scale = -(-512 // 48)
    left = (picture.shape[1] - 38 * scale) // 2
    shown = picture[: 48 * scale, left : left + 38 * scale, 0]
    middles = shown[scale // 2 :: scale, scale // 2 :: scale]
    assert np.mean(np.abs(middles.astype(int) - expected) < 12) > 0.7  # all but under the lines


def test_a_preview_that_cannot_be_drawn_does_not_cost_the_account(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(2))
    (log / "sonar.toml").unlink()
    out = tmp_path / "preview.png"
    account = sonarrec("info", log)
    told = sonarrec("info", log, "--preview", out, code=1)
    assert told.stdout == account.stdout
    assert "lacks range_min_m" in told.stderr
    told = sonarrec("info", log, "--preview", out, "--json", code=1)
    assert json.loads(told.stdout)["logs"][0]["images"][0]["lacks"]
    assert not out.exists()
