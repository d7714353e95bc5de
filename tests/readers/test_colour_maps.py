"""Pictures in false colour: the map is found, and grey comes back."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import cv2
import matplotlib as mpl
import numpy as np
import pytest

from sonarrec.readers.decode.colour import (
    EXCHANGED,
    LUMINANCE,
    MAPS,
    find_map,
    is_coloured,
    map_levels,
)
from sonarrec.sonar.frame import ColourMap
from tests.support.command import SAMPLE, sonarrec
from tests.support.logs import read

FRAMES = 24  # of a log
CHANGE = 12  # the frame from which on it is drawn otherwise


def grey_frame(number: int) -> np.ndarray:
    return np.asarray(cv2.imread(str(SAMPLE / f"{number:06d}.png"), cv2.IMREAD_GRAYSCALE))


GREY = grey_frame(10)


def drawn_by(levels: np.ndarray, name: str, quality: int | None = None) -> np.ndarray:
    """In colour, black outside of the fan, as PNG (None) or JPEG gives it back."""
    drawn = cv2.applyColorMap(levels, MAPS[name.removesuffix(EXCHANGED)])
    drawn = np.ascontiguousarray(drawn[:, :, ::-1]) if name.endswith(EXCHANGED) else drawn
    drawn[GREY == 0] = 0
    return drawn if quality is None else as_jpeg(drawn)


def as_jpeg(drawn: np.ndarray) -> np.ndarray:
    data = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))


def test_the_maps_that_may_be_stated_are_those_there_are() -> None:
    assert get_args(ColourMap) == (LUMINANCE, *MAPS, *(name + EXCHANGED for name in MAPS))


@pytest.mark.parametrize("name", MAPS)
def test_levels_come_back(name: str) -> None:
    """The table of colours has steps of 4, of which viridis takes one for a level or two."""
    levels = np.tile(np.arange(24, 256, dtype=np.uint8), (2, 1))  # black is black in any map
    back = map_levels(cv2.applyColorMap(levels, MAPS[name]), name).astype(int)
    assert np.abs(back - levels).max() <= 4


@pytest.mark.parametrize("quality", [None, 80])
@pytest.mark.parametrize("exchanged", ["", EXCHANGED])
@pytest.mark.parametrize("name", MAPS)
def test_the_map_is_found(name: str, exchanged: str, quality: int | None) -> None:
    """Also with red and blue exchanged, and in a JPEG, which shares colours between pixels."""
    drawn = drawn_by(GREY, name + exchanged, quality)
    assert is_coloured(drawn)
    found = find_map([drawn])
    if (name, quality) == ("rainbow", 80):  # it begins as the reverse of hot and of jet
        assert found is None
        return
    assert found == name + exchanged
    off = np.abs(map_levels(drawn, found).astype(int) - GREY)[GREY >= 24]
    assert np.median(off) <= (2 if quality is None else 6)


@pytest.mark.parametrize("quality", [None, 80])
@pytest.mark.parametrize("name", MAPS)
def test_a_reversed_map_is_not_taken_for_another(name: str, quality: int | None) -> None:
    """Its levels would come out reversed; their luminance is at least told."""
    # Jet reversed has the same colours as jet with red and blue exchanged.
    expected = "jet_bgr" if name == "jet" else None
    assert find_map([drawn_by(255 - GREY, name, quality)]) in (None, expected)


@pytest.mark.parametrize("name", ["jet", "viridis", "inferno", "magma", "plasma", "turbo"])
def test_the_maps_are_those_of_matplotlib(name: str) -> None:
    drawn = np.round(255 * mpl.colormaps[name](GREY)[:, :, 2::-1]).astype(np.uint8)
    assert find_map([drawn]) == name
    assert np.median(np.abs(map_levels(drawn, name).astype(int) - GREY)) <= 2


BLUES = [(255, 100, 100), (255, 80, 180), (200, 60, 140)]
"""The brightest colours of viewers' ramps that were taken for turbo, magma and inferno."""


@pytest.mark.parametrize("table", ["afmhot", "Blues_r", "winter", "gist_ncar", *BLUES])
def test_ramps_and_other_maps_are_none_of_ours(table: str | tuple[int, int, int]) -> None:
    if isinstance(table, str):
        ramp = np.round(255 * mpl.colormaps[table](np.arange(256))[:, 2::-1]).astype(np.uint8)
    else:
        ramp = (np.arange(256)[:, None] * np.array(table) / 255).astype(np.uint8)
    drawn = cv2.applyColorMap(GREY, ramp[:, None])
    assert find_map([drawn]) is None
    assert isinstance(table, str) or find_map([as_jpeg(drawn)]) is None


def test_grey_pictures_and_strange_colours_have_no_map() -> None:
    assert not is_coloured(cv2.cvtColor(GREY, cv2.COLOR_GRAY2BGR))
    palette = np.random.default_rng(1).integers(0, 256, (256, 1, 3), dtype=np.uint8)
    strange = cv2.applyColorMap(GREY, palette)
    assert is_coloured(strange)
    assert find_map([strange]) is None


def make_log(folder: Path, draw: Callable[[int, np.ndarray], np.ndarray]) -> Path:
    """The first frames of the sample, each drawn by its number and its grey image."""
    log = folder / "drawn" / "pan"
    log.mkdir(parents=True)
    shutil.copy(SAMPLE / "sonar.toml", log)
    for k in range(FRAMES):
        cv2.imwrite(str(log / f"{k:06d}.png"), draw(k, grey_frame(k)))
    return log


@pytest.mark.parametrize("in_grey", [0, 4])
def test_a_log_in_jet_is_told_and_read_as_its_grey_one(in_grey: int, tmp_path: Path) -> None:

    def draw(k: int, grey: np.ndarray) -> np.ndarray:
        whole = cv2.applyColorMap(grey, cv2.COLORMAP_JET)
        return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR) if k < in_grey else whole

    found = read(make_log(tmp_path, draw))
    for k, image in enumerate(found.images):
        grey = grey_frame(k)
        assert np.abs(image.astype(int) - grey)[grey >= 24].max() <= 4
    (note,) = found.notes
    assert "jet" in note


@pytest.mark.parametrize(
    "maps", ["jet inferno", "jet rainbow", "rainbow jet", "viridis magma", "magma inferno"]
)
def test_a_map_that_changes_midway_is_told(maps: str, tmp_path: Path) -> None:
    """The colours of rainbow are among those of jet, in reverse."""
    first, then = maps.split()

    def draw(k: int, grey: np.ndarray) -> np.ndarray:
        return cv2.applyColorMap(grey, MAPS[first if k < CHANGE else then])

    _, changed = read(make_log(tmp_path, draw)).notes
    assert f"{CHANGE:06d}.png" in changed


@pytest.mark.parametrize("table", [None, "jet", "viridis"])
def test_pictures_reversed_midway_are_told(table: str | None, tmp_path: Path) -> None:
    def draw(k: int, grey: np.ndarray) -> np.ndarray:
        level = 255 - grey if k >= CHANGE else grey
        return level if table is None else cv2.applyColorMap(level, MAPS[table])

    (told,) = (note for note in read(make_log(tmp_path, draw)).notes if "mean level" in note)
    assert f"{CHANGE:06d}.png" in told


@pytest.mark.parametrize("channels", [1, 3])
def test_a_grey_frame_among_frames_in_colour(channels: int, tmp_path: Path) -> None:
    def draw(k: int, grey: np.ndarray) -> np.ndarray:
        if k != 6:
            return cv2.applyColorMap(grey, cv2.COLORMAP_JET)
        return grey if channels == 1 else cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)

    found = read(make_log(tmp_path, draw))
    assert found.numbers == [*range(FRAMES)]
    np.testing.assert_array_equal(found.images[6], grey_frame(6))


def test_what_is_stated_wins(tmp_path: Path) -> None:
    log = make_log(tmp_path, lambda _, grey: cv2.applyColorMap(grey, cv2.COLORMAP_JET))
    with (log / "sonar.toml").open("a") as file:
        file.write('\ncolour_map = "viridis"\n')
    sonarrec("run", log, "--frames", "0:2", "-o", tmp_path / "again")
    run = tomllib.loads((tmp_path / "again" / "pan" / "run.toml").read_text())
    assert run["input"]["colour_map"] == run["sonar"]["colour_map"] == "viridis"


@pytest.mark.parametrize("name", MAPS)
def test_black_round_a_fan_is_no_echo_whatever_the_map_begins_with(name: str) -> None:
    black = np.zeros((2, 3, 3), np.uint8)
    assert (map_levels(black, name) == 0).all()
