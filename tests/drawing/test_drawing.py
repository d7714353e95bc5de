"""The stated geometry as it is drawn: rings, bearings, floor and discs at places known apart."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonarrec.drawing.geometry import disc_width_px, draw_grid, draw_preview
from sonarrec.drawing.pen import FLOOR, GRID, TRUTH, Pen, pixel_unit
from sonarrec.drawing.results import STRIP_FRAMES, Moment, draw_strip
from sonarrec.landmarks import load_landmarks
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.stated import Sonar
from tests.support.command import sonarrec
from tests.support.drawn import draw_on_floor, make_fan
from tests.support.logs import PERIOD_NS, frames, image_folder

BASIN = load_landmarks("basin")
FAN = make_fan(rows=512)


def blank(fan: Fan) -> np.ndarray:
    return np.zeros((fan.rows, fan.columns), np.uint8)


def like(picture: np.ndarray, colour: tuple[int, int, int], within: int = 30) -> np.ndarray:
    """(n, 2) column and row of the pixels of about this colour (RGB)."""
    away = np.abs(picture[:, :, ::-1].astype(int) - colour)
    return np.argwhere(away.max(axis=2) <= within)[:, ::-1]


def place(fan: Fan, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slant range (m) and bearing (deg) of pixels, by the contract's formula."""
    across, ahead = points[:, 0] - fan.apex_column, fan.apex_row - points[:, 1]
    return np.hypot(across, ahead) * fan.metres_per_pixel, np.degrees(np.arctan2(across, ahead))


# Range rings and bearings


def gridded(fan: Fan) -> np.ndarray:
    canvas = cv2.cvtColor(blank(fan), cv2.COLOR_GRAY2BGR)
    pen = Pen(canvas, pixel_unit(max(fan.rows, fan.columns)))
    draw_grid(pen, fan)
    return pen.canvas


def test_the_grid_is_the_stated_fan_and_round_ranges_and_bearings() -> None:
    points = like(gridded(FAN), GRID)
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


# The preview


def preview(fan: Fan) -> np.ndarray:
    """The frame of a preview of 512 rows, without what is beside and below it."""
    left = (512 - fan.columns) // 2
    return draw_preview(blank(fan), fan, BASIN, Sonar())[: fan.rows, left : left + fan.columns]


def test_the_floor_s_near_edge_lies_at_the_height() -> None:
    fan = make_fan(rows=512, height_m=2.0)
    range_m, bearing = place(fan, like(preview(fan), FLOOR))
    edge = np.abs(bearing) > 4  # beside the label
    assert np.abs(range_m[edge] - 2.0).max() < 2 * fan.metres_per_pixel
    assert bearing.min() < -14
    assert bearing.max() > 14
    # A floor that begins before the window has no edge in it.
    assert not len(like(preview(FAN), FLOOR))


def test_the_discs_are_to_scale() -> None:
    """Three outlines, each over a disc rendered on the floor from first principles."""
    line = np.zeros((FAN.rows, FAN.columns), np.uint8)
    points = like(preview(FAN), TRUTH, within=60)
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
def test_the_legend_of_a_preview_says_what_is_estimated(
    key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(Pen, "text", lambda _, text, *__: told.append(text))
    stated = Sonar(height_m=0.68, tilt_deg=20.0)
    draw_preview(np.zeros((FAN.rows, FAN.columns), np.uint8), FAN, BASIN, stated)
    assert not [line for line in told if "estimated" in line]
    draw_preview(
        np.zeros((FAN.rows, FAN.columns), np.uint8), FAN, BASIN, replace(stated, **{key: None})
    )
    (line,) = [line for line in told if "estimated" in line]
    assert line.startswith("floor" if key == "height_m" else "stated")


# The strip's time axis


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


# The commands


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
