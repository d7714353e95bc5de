"""The outline of the fan in a picture, against the fan that was drawn."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.readers.guess.outline import FanOutline, find_outline
from tests.support.command import SAMPLE, sonarrec


def wedge(
    shape: tuple[int, int], apex: tuple[float, float], bearings: tuple[float, float], *ends: float
) -> np.ndarray:
    """(rows, columns) whether a pixel's middle lies between the bearings (deg) and ends (px)."""
    row, column = np.mgrid[: shape[0], : shape[1]]
    across, ahead = column - apex[0], apex[1] - row
    bearing, away = np.degrees(np.arctan2(across, ahead)), np.hypot(across, ahead)
    return (bearing > bearings[0]) & (bearing < bearings[1]) & (away > ends[0]) & (away < ends[1])


def floor(inside: np.ndarray, seed: int = 0) -> np.ndarray:
    """Mean of five frames of speckle in decibels, of which a pixel in a few hundred is dark."""
    echo = np.random.default_rng(seed).exponential(size=(5, *inside.shape))
    return np.asarray((inside * np.clip(90 + 20 * np.log10(echo), 0, 255)).mean(axis=0))


def is_close(found: FanOutline | None, apex: tuple[float, float], far: float) -> bool:
    """Whether the apex is within a hundredth of the fan's length of where it is."""
    assert found is not None
    return math.hypot(found.apex_column - apex[0], found.apex_row - apex[1]) < 0.01 * far


@pytest.mark.slow
@settings(max_examples=12)
@given(
    st.floats(-62, -7),
    st.floats(7, 62),
    st.floats(0.05, 0.6),
    st.integers(300, 1400),
    st.integers(0, 80),
    st.integers(0, 80),
)
def test_it_is_that_of_the_wedge_that_was_drawn(
    left: float, right: float, near: float, far: int, above: int, beside: int
) -> None:
    """Views from 14 to 124 deg, symmetric or not, on canvases with margins."""
    apex = (far * math.sin(math.radians(-left)) + beside, far + above + 0.3)
    columns = round(apex[0] + far * math.sin(math.radians(right))) + beside + 1
    rows = round(apex[1] - near * far * math.cos(math.radians(max(-left, right)))) + above
    inside = wedge((rows, columns), apex, (left, right), near * far, far)
    found = find_outline(floor(inside))
    assert is_close(found, apex, far)
    assert found is not None
    assert found.bearing_min_deg == pytest.approx(left, abs=0.5)
    assert found.bearing_max_deg == pytest.approx(right, abs=0.5)
    assert found.far_px == pytest.approx(far, abs=0.01 * far)
    # On a canvas that ends above the near arc's middle the near end is not seen; here it is.
    assert found.near_px == pytest.approx(near * far, abs=0.01 * far)


APEX, FAR = (200.0, 520.0), 500.0
INSIDE = wedge((480, 401), APEX, (-20, 20), 120, FAR)


def test_what_is_dark_or_lit_beside_does_not_shift_it() -> None:
    """A shadow from edge to edge, a caption, a logo, and pixels that a codec smeared out."""
    picture = floor(INSIDE).astype(np.uint8)
    picture[200:240] = 0
    picture[:, 180:200] = 0
    cv2.putText(picture, "12:30:00", (5, 470), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 255, 1)
    picture[:40, 300:] = 200 * (np.random.default_rng(1).random((40, 101)) < 0.02)
    assert is_close(find_outline(picture), APEX, FAR)


@pytest.mark.parametrize("quality", [95, 75, 50])
def test_in_jpegs(quality: int) -> None:
    """Blocks across the edges hold faint echoes on both sides of them."""
    total = np.zeros(INSIDE.shape)
    for seed in range(5):
        picture = floor(INSIDE, seed).astype(np.uint8)
        _, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
        read = cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)
        assert read is not None
        total += read
    assert is_close(find_outline(total / 5), APEX, FAR)


@pytest.mark.parametrize("background", [30, 255])
def test_on_another_background_than_black(background: int) -> None:
    assert is_close(find_outline(np.where(INSIDE, floor(INSIDE), background)), APEX, FAR)


def test_a_far_end_in_the_dark_makes_it_shorter_and_no_more() -> None:
    lit = wedge(INSIDE.shape, APEX, (-20, 20), 120, 350)
    found = find_outline(floor(INSIDE & lit))
    assert is_close(found, APEX, FAR)
    assert found is not None
    assert found.far_px == pytest.approx(350, abs=2)


def test_a_far_end_that_fades_or_is_cut_is_not_told() -> None:
    """The apex is, for the edges show it."""
    whole = floor(INSIDE)
    row, column = np.mgrid[: len(whole), : whole.shape[1]]
    away = np.hypot(column - APEX[0], APEX[1] - row)
    with_bar = whole.copy()
    with_bar[:18] = 70
    for picture, apex in (
        (whole * np.clip((480 - away) / 300, 0, 1), APEX),
        (with_bar, APEX),
        (whole[120:], (APEX[0], APEX[1] - 120)),
    ):
        found = find_outline(picture)
        assert is_close(found, apex, FAR)
        assert found is not None
        assert found.far_px is None
        assert found.near_px == pytest.approx(120, abs=2)


def test_a_shadow_that_cuts_it_in_pieces() -> None:
    """They are one fan; two fans side by side are none."""
    picture = floor(INSIDE)
    picture[:, 215:235] = 0
    found = find_outline(picture)
    assert is_close(found, APEX, FAR)
    assert found is not None
    assert found.view_deg == pytest.approx(40, abs=1)
    assert find_outline(np.concatenate([picture, picture], axis=1)) is None
    apart = np.zeros((len(picture), 20))
    assert find_outline(np.concatenate([picture, apart, picture], axis=1)) is None
    panel = np.full((len(picture), 180), 70)
    assert is_close(find_outline(np.concatenate([floor(INSIDE), apart, panel], axis=1)), APEX, FAR)


def test_none_where_its_edges_fade_or_it_is_tiny() -> None:
    """Edges are not where the light ends; and a pixel is a large part of a tiny fan."""
    row, column = np.mgrid[: INSIDE.shape[0], : INSIDE.shape[1]]
    bearing = np.degrees(np.arctan2(column - APEX[0], APEX[1] - row))
    for fading in (np.abs(bearing), bearing):
        assert find_outline(floor(INSIDE) * np.cos(np.radians(90) * fading.clip(0) / 20)) is None
    assert find_outline(floor(wedge((36, 30), (15.0, 40.0), (-20, 20), 9, 38))) is None


@pytest.mark.parametrize(
    "inside",
    [
        np.zeros((300, 300), bool),
        np.ones((300, 300), bool),
        INSIDE[::-1],
        np.hypot(*np.mgrid[-150:150, -150:150]) < 120,
        np.pad(np.ones((200, 150), bool), 50),
        np.tri(300, dtype=bool),
        INSIDE & (np.arange(401) < 245),
    ],
    ids=["black", "full", "upside down", "a disc", "a rectangle", "a triangle", "behind a panel"],
)
def test_none_where_no_two_edges_narrow_downward(inside: np.ndarray) -> None:
    assert find_outline(floor(inside)) is None


# What the commands make of it


def on_a_canvas(folder: Path) -> None:
    """Eight frames of the sample log with a margin of 30 pixels on the right and 20 above."""
    folder.mkdir()
    for path in sorted(SAMPLE.glob("*.png"))[:8]:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert cv2.imwrite(str(folder / path.name), np.pad(image, ((20, 0), (0, 30))))


def test_run_tells_the_flags_that_place_the_fan(tmp_path: Path) -> None:
    log, out = tmp_path / "log", tmp_path / "out"
    on_a_canvas(log)
    shutil.copy(SAMPLE / "sonar.toml", log)
    told = sonarrec("run", log, "--out", out).stderr
    flags = re.search(r"\(if the stated ranges are right, give (.*?)\)", told)
    assert flags is not None, told
    given = flags[1].split()
    assert given[::3] == ["--apex-px", "--metres-per-pixel"]
    assert [float(x) for x in given[1:3]] == pytest.approx([95, 403.5], abs=1)
    assert float(given[4]) == pytest.approx(2.5 / 256, rel=0.01)
    told = sonarrec("run", log, "--out", out, *given, "-q").stderr
    assert "the pictures show" not in told


def test_info_tells_it_where_the_geometry_is_missing(tmp_path: Path) -> None:
    log = tmp_path / "log"
    on_a_canvas(log)
    text = sonarrec("info", log).stdout
    assert "outline   the images show a fan of 28.8 deg with apex_px = [95.0, 403.5]" in text
    assert "and its ends 128 and 384 px from there" in text
    assert "metres_per_pixel is range_max_m / 384." in text
    assert "range_min_m is about 0.333 of range_max_m, or less" in text
    text = sonarrec("info", log, "--range-max-m", "3.75").stdout
    assert "metres_per_pixel is 0.00975" in text
    assert "range_min_m is about 1.25, or less" in text
    (images,) = json.loads(sonarrec("info", "--json", log).stdout)["logs"][0]["images"]
    assert images["outline"]["far_px"] == pytest.approx(384, abs=2)
    assert "outline" not in sonarrec("info", SAMPLE).stdout  # all of it is stated
    polar = sonarrec("info", "--json", SAMPLE.parent / "polar").stdout
    (images,) = json.loads(polar)["logs"][0]["images"]
    assert images["outline"] is None
