"""Pictures in false colour: the map is found, and grey comes back."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path
from typing import get_args

import cv2
import matplotlib as mpl
import numpy as np
import pytest

from sonarrec.readers import open_log
from sonarrec.readers.decode.colour import (
    EXCHANGED,
    LUMINANCE,
    MAPS,
    find_map,
    is_coloured,
    map_levels,
)
from sonarrec.sonar.frame import ColourMap
from tests.support.command import sonarrec

SAMPLE = Path(__file__).parents[2] / "sample_data" / "pan"


def picture() -> np.ndarray:
    return np.asarray(cv2.imread(str(SAMPLE / "000010.png"), cv2.IMREAD_GRAYSCALE))


def test_the_maps_that_may_be_stated_are_those_there_are() -> None:
    assert get_args(ColourMap) == (LUMINANCE, *MAPS, *(name + EXCHANGED for name in MAPS))


@pytest.mark.parametrize("name", MAPS)
def test_levels_come_back(name: str) -> None:
    """The table of colours has steps of 4, of which viridis takes one for a level or two."""
    levels = np.tile(np.arange(24, 256, dtype=np.uint8), (2, 1))  # black is black in any map
    back = map_levels(cv2.applyColorMap(levels, MAPS[name]), name).astype(int)
    assert np.abs(back - levels).max() <= 4


@pytest.mark.parametrize("quality", [None, 80])
@pytest.mark.parametrize("name", MAPS)
def test_the_map_is_found(name: str, quality: int | None) -> None:
    """Also in a JPEG, which shares colours between pixels."""
    grey = picture()
    drawn = cv2.applyColorMap(grey, MAPS[name])
    drawn[grey == 0] = 0  # outside of the fan
    if quality is not None:
        data = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        drawn = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert is_coloured(drawn)
    if quality and name == "rainbow":  # it begins as the reverse of hot and of jet
        assert find_map([drawn]) is None
        return
    assert find_map([drawn]) == name
    off = np.abs(map_levels(drawn, name).astype(int) - grey)[grey >= 24]
    assert np.median(off) <= (2 if quality is None else 6)


def as_stored(drawn: np.ndarray, quality: int | None) -> np.ndarray:
    """A coloured picture as PNG (None) or JPEG gives it back."""
    if quality is None:
        return drawn
    data = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return cv2.imdecode(data, cv2.IMREAD_COLOR)


@pytest.mark.parametrize("quality", [None, 80])
@pytest.mark.parametrize("name", MAPS)
def test_a_reversed_map_is_not_taken_for_another(name: str, quality: int | None) -> None:
    """Its levels would come out reversed; their luminance is at least told."""
    grey = picture()
    drawn = cv2.applyColorMap(255 - grey, MAPS[name])
    drawn[grey == 0] = 0  # outside of the fan
    # Jet reversed has the same colours as jet with red and blue exchanged.
    expected = "jet_bgr" if name == "jet" else None
    assert find_map([as_stored(drawn, quality)]) in (None, expected)


@pytest.mark.parametrize("quality", [None, 80])
@pytest.mark.parametrize("name", MAPS)
def test_a_map_with_red_and_blue_exchanged_is_read(name: str, quality: int | None) -> None:
    grey = picture()
    drawn = np.ascontiguousarray(cv2.applyColorMap(grey, MAPS[name])[:, :, ::-1])
    drawn[grey == 0] = 0  # outside of the fan
    drawn = as_stored(drawn, quality)
    found = find_map([drawn])
    if found is None:  # it is told as luminance; rainbow alone, in strong JPEG, is not sure
        assert (name, quality) == ("rainbow", 80)
        return
    assert found == f"{name}_bgr"
    off = np.abs(map_levels(drawn, found).astype(int) - grey)[grey >= 24]
    assert np.median(off) <= (2 if quality is None else 6)


@pytest.mark.parametrize("name", ["jet", "viridis", "inferno", "magma", "plasma", "turbo"])
def test_the_maps_are_those_of_matplotlib(name: str) -> None:
    colours = mpl.colormaps[name](picture())[:, :, 2::-1]
    drawn = np.round(255 * colours).astype(np.uint8)
    assert find_map([drawn]) == name
    assert np.median(np.abs(map_levels(drawn, name).astype(int) - picture())) <= 2


BLUES = [(255, 100, 100), (255, 80, 180), (200, 60, 140)]
"""The brightest colours of viewers' ramps that were taken for turbo, magma and inferno."""


@pytest.mark.parametrize("table", ["afmhot", "Blues_r", "winter", "gist_ncar", *BLUES])
def test_ramps_and_other_maps_are_none_of_ours(table: str | tuple[int, int, int]) -> None:
    """Also in a JPEG."""
    if isinstance(table, str):
        ramp = np.round(255 * mpl.colormaps[table](np.arange(256))[:, 2::-1]).astype(np.uint8)
    else:
        ramp = (np.arange(256)[:, None] * np.array(table) / 255).astype(np.uint8)
    drawn = cv2.applyColorMap(picture(), ramp[:, None])
    data = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
    assert find_map([drawn]) is None
    assert isinstance(table, str) or find_map([cv2.imdecode(data, cv2.IMREAD_COLOR)]) is None


def test_a_log_that_begins_in_grey(tmp_path: Path) -> None:
    log = in_colour(tmp_path, cv2.COLORMAP_JET)
    paths = sorted(log.glob("*.png"))
    for k in range(4):
        grey = cv2.imread(str(SAMPLE / paths[k].name), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(paths[k]), cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    with open_log(log) as drawn, open_log(SAMPLE) as plain:
        for one, other in zip(drawn, plain, strict=False):
            assert np.abs(one.image.astype(int) - other.image)[other.image >= 24].max() <= 4
        notes = drawn.diagnostics.notes
    assert len(notes) == 1
    assert "jet; colour_map in sonar.toml states" in notes[0]


def test_a_map_that_changes_midway_is_told(tmp_path: Path) -> None:
    log = in_colour(tmp_path, cv2.COLORMAP_JET)
    paths = sorted(log.glob("*.png"))
    for path in paths[12:]:
        grey = cv2.imread(str(SAMPLE / path.name), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(path), cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO))
    with open_log(log) as drawn:
        list(drawn)
    assert paths[12].name in drawn.diagnostics.notes[-1]
    assert len(drawn.diagnostics.notes) == 2


MAPS_IN_TURN = [("jet", "rainbow"), ("rainbow", "jet"), ("viridis", "magma"), ("magma", "inferno")]


@pytest.mark.parametrize(("first", "then"), MAPS_IN_TURN)
def test_a_map_like_the_one_before_it_is_told(first: str, then: str, tmp_path: Path) -> None:
    """The colours of rainbow are among those of jet, in reverse."""
    log = in_colour(tmp_path, MAPS[first])
    with open_log(log) as drawn:
        list(drawn)
        assert len(drawn.diagnostics.notes) == 1
    paths = sorted(log.glob("*.png"))
    for path in paths[12:]:
        grey = cv2.imread(str(SAMPLE / path.name), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(path), cv2.applyColorMap(grey, MAPS[then]))
    with open_log(log) as drawn:
        list(drawn)
        (_, changed) = drawn.diagnostics.notes
    assert paths[12].name in changed


@pytest.mark.parametrize("table", [None, "jet", "viridis"])
def test_pictures_reversed_midway_are_told(table: str | None, tmp_path: Path) -> None:
    log = in_colour(tmp_path, MAPS[table or "jet"])
    paths = sorted(log.glob("*.png"))
    for n, path in enumerate(paths):
        grey = cv2.imread(str(SAMPLE / path.name), cv2.IMREAD_GRAYSCALE)
        level = 255 - grey if n >= 12 else grey
        cv2.imwrite(str(path), level if table is None else cv2.applyColorMap(level, MAPS[table]))
    with open_log(log) as drawn:
        list(drawn)
        told = [note for note in drawn.diagnostics.notes if "mean level" in note]
    assert len(told) == 1
    assert paths[12].name in told[0]


@pytest.mark.parametrize("channels", [1, 3])
def test_a_grey_frame_among_frames_in_colour(channels: int, tmp_path: Path) -> None:
    log = in_colour(tmp_path, cv2.COLORMAP_JET)
    path = sorted(log.glob("*.png"))[6]
    grey = cv2.imread(str(SAMPLE / path.name), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(path), grey if channels == 1 else cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    with open_log(log) as drawn:
        found = list(drawn)
    assert len(found) == 24
    np.testing.assert_array_equal(found[6].image, grey)


def test_grey_pictures_and_strange_colours_have_no_map() -> None:
    grey = cv2.cvtColor(picture(), cv2.COLOR_GRAY2BGR)
    assert not is_coloured(grey)
    palette = np.random.default_rng(1).integers(0, 256, (256, 1, 3), dtype=np.uint8)
    strange = cv2.applyColorMap(picture(), palette)
    assert is_coloured(strange)
    assert find_map([strange]) is None


def in_colour(folder: Path, table: int | np.ndarray) -> Path:
    log = folder / "drawn" / "pan"
    log.mkdir(parents=True)
    shutil.copy(SAMPLE / "sonar.toml", log)
    for path in sorted(SAMPLE.glob("*.png"))[:24]:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(log / path.name), cv2.applyColorMap(grey, table))
    return log


def test_a_log_in_jet_is_told_and_read_as_its_grey_one(tmp_path: Path) -> None:
    log = in_colour(tmp_path, cv2.COLORMAP_JET)
    with open_log(log) as drawn, open_log(SAMPLE) as grey:
        for one, other in zip(drawn, grey, strict=False):
            assert np.abs(one.image.astype(int) - other.image)[other.image >= 24].max() <= 4
        (note,) = drawn.diagnostics.notes
        assert "colour map jet" in note


def test_what_is_stated_wins(tmp_path: Path) -> None:
    log = in_colour(tmp_path, cv2.COLORMAP_JET)
    with (log / "sonar.toml").open("a") as file:
        file.write('\ncolour_map = "viridis"\n')
    sonarrec("run", log, "--frames", "0:4", "-o", tmp_path / "again")
    run = tomllib.loads((tmp_path / "again" / "pan" / "run.toml").read_text())
    assert run["input"]["colour_map"] == run["sonar"]["colour_map"] == "viridis"
