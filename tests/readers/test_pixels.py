"""Pixels of any depth become 8-bit grey by a scale that the first frame settles."""

from __future__ import annotations

import io
import math
import re
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from sonarrec.errors import SonarrecError
from sonarrec.readers import open_log
from sonarrec.readers.decode.grey import grey_scale, holds_amplitudes, single_channel, to_grey8
from sonarrec.readers.decode.pixels import decode_image
from sonarrec.readers.raw import UnusableError
from sonarrec.simulation.render import render
from sonarrec.sonar.geometry import PolarToFan
from sonarrec.sonar.stated import Sonar, sonar_from_table
from tests.studies.learning.random_scenes import random_scene
from tests.support import messages
from tests.support.logs import frames, image_mcap, read
from tests.support.messages import BEAMS, BEARINGS_DEG, BIN_M, BINS, FIRST_BIN, log_of


def floats_log(path: Path, images: list[np.ndarray], number: int) -> Path:
    pings = []
    for k, image in enumerate(images):
        fields = messages.projected_fields(k, image)
        pings.append(fields | {"image": messages.samples(image, number)})
    return log_of(path, pings)


AMPLITUDES = [
    (np.random.default_rng(k).rayleigh(40.0, (BINS, BEAMS)) + 1).astype(np.float32)
    for k in range(3)
]


def greys(path: Path, **keys: Any) -> list[np.ndarray]:
    found = read(path, sonar=Sonar(tilt_deg=20.0, **keys))
    assert not found.problems
    return found.images


def off(found: list[np.ndarray], expected: list[np.ndarray]) -> int:
    """The largest difference; 1 of a value on the edge of rounding."""
    return int(np.abs(np.array(found, int) - np.array(expected, int)).max())


def in_the_fan(levels: np.ndarray) -> list[np.ndarray]:
    window = (FIRST_BIN * BIN_M, (FIRST_BIN + BINS) * BIN_M)
    sonar = Sonar("polar", *window, tilt_deg=20.0, bearings_deg=tuple(BEARINGS_DEG.tolist()))
    to_fan = PolarToFan(sonar.complete("test"), BINS, BEAMS)
    return [to_fan(np.rint(np.clip(image, 0, 255)).astype(np.uint8)) for image in levels]


@pytest.mark.parametrize("number", [4, 8, 9], ids=["u4", "f4", "f8"])
def test_amplitudes_become_logarithmic(number: int, tmp_path: Path) -> None:
    """By the closed form, from the median of the first ping; the ping ten times as bright that
    follows is 20 dB brighter."""
    dtype = {4: "<u4", 8: "<f4", 9: "<f8"}[number]
    images = [AMPLITUDES[0].astype(dtype), (AMPLITUDES[1] * 10).astype(dtype)]
    full_db = 20 * math.log10(float(np.median(images[0]))) + 50 * 2 / 3
    levels = 255 * (1 + (20 * np.log10(np.array(images, float)) - full_db) / 50)
    found = greys(floats_log(tmp_path / "log.mcap", images, number))
    assert off(found, in_the_fan(levels)) <= 1
    alone = greys(floats_log(tmp_path / "one.mcap", images[:1], number))
    np.testing.assert_array_equal(alone[0], found[0])


def test_the_scale_can_be_stated(tmp_path: Path) -> None:
    path = floats_log(tmp_path / "log.mcap", AMPLITUDES, 8)
    keys = {"pixel_scale": "linear", "full_scale": 200.0}
    assert off(greys(path, **keys), in_the_fan(np.array(AMPLITUDES) * 255 / 200)) <= 1
    decibels = floats_log(tmp_path / "db.mcap", [20 * np.log10(i) - 60 for i in AMPLITUDES], 8)
    keys = {"full_scale": 1000.0, "dynamic_range_db": 60.0}
    by_log = greys(path, **keys)
    by_db = greys(decibels, full_scale=0.0, dynamic_range_db=60.0)  # db: some are negative
    assert off(by_log, by_db) <= 1
    with pytest.raises(SonarrecError, match="pixel_scale"):
        sonar_from_table({"pixel_scale": "sqrt"}, "x")
    with pytest.raises(SonarrecError, match="full_scale = 0"):
        greys(path, full_scale=0.0)
    with pytest.raises(SonarrecError, match="dynamic_range_db = -1"):
        greys(path, dynamic_range_db=-1.0)


@pytest.mark.parametrize("mark", [-9999.0, -32768.0, np.finfo(np.float32).min])
@pytest.mark.parametrize("decibels", [False, True])
def test_pixels_marked_as_without_data_are_black(mark: float, decibels: bool) -> None:
    """As rasters of other programs are filled outside the fan; the scale is that of the rest."""
    values = AMPLITUDES[0].astype(np.float32) + 1
    values = 20 * np.log10(values) - 60 if decibels else values
    outside = np.zeros(values.shape, bool)
    outside[:, :3] = True
    whole = grey8(np.where(outside, np.float32(np.nan), values))
    np.testing.assert_array_equal(grey8(np.where(outside, np.float32(mark), values)), whole)
    assert not whole[outside].any()
    assert whole[~outside].mean() > 30


def test_a_blank_first_ping_is_black_and_settles_nothing(tmp_path: Path) -> None:
    for blank in (0.0, np.nan, -np.inf):
        images = [np.full((BINS, BEAMS), blank, np.float32), *AMPLITUDES]
        log = floats_log(tmp_path / "log.mcap", images, 8)
        first, *rest = greys(log)
        assert not first.any()
        whole = greys(floats_log(tmp_path / "whole.mcap", AMPLITUDES, 8))
        np.testing.assert_array_equal(rest, whole)


def grey8(pixels: np.ndarray, sonar: Sonar = Sonar(), amplitudes: bool = False) -> np.ndarray:  # noqa: B008
    """One frame by the scale that it would settle as the first of a log."""
    channel = single_channel(pixels)
    scale = grey_scale(sonar, channel, amplitudes)
    assert scale is not None
    return to_grey8(channel, scale)


def test_grey8() -> None:
    every = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    expected = np.round(every / 257).astype(np.uint8)
    np.testing.assert_array_equal(grey8(every), expected)
    np.testing.assert_array_equal(grey8(every.astype(">u2")), expected)
    colour = np.random.default_rng(1).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    weighted = colour @ np.array([0.114, 0.587, 0.299])
    assert np.abs(grey8(colour) - weighted).max() <= 0.51
    floats = np.array([[0.0, 0.5, 1.0, np.nan]])
    np.testing.assert_array_equal(grey8(floats), [[0, 128, 255, 0]])
    endless = np.array([[0.0, np.inf, 1.0, -np.inf]])  # what is beyond every bound settles none
    np.testing.assert_array_equal(grey8(endless), [[0, 255, 255, 0]])
    for shape, kind in (((3, 3, 2), "u1"), ((0, 3), "u1"), ((3,), "u1"), ((3, 3), "c8")):
        with pytest.raises(UnusableError):
            grey8(np.zeros(shape, kind), amplitudes=True)


def speckle(seed: int, log: bool) -> np.ndarray:
    """8-bit Rayleigh speckle whose level falls off by 12 dB down the image."""
    level = np.geomspace(60, 15, 256)[:, None]
    amplitude = np.random.default_rng(seed).rayleigh(level / 1.25, (256, 96))
    if log:
        amplitude = 255 * (1 + 20 * np.log10(np.maximum(amplitude, 0.1) / 255) / 50)
    return np.clip(np.rint(amplitude), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("log", [False, True])
def test_8_bit_amplitudes_are_told_from_logarithms_by_their_speckle(log):
    assert holds_amplitudes([speckle(seed, log) for seed in range(3)]) is not log


def test_without_speckle_nothing_is_taken_for_amplitudes():
    flat = np.full((256, 96), 40, np.uint8)
    even = np.random.default_rng(1).integers(0, 255, (256, 96)).astype(np.uint8)
    for image in (flat, 0 * flat, even, flat[:3, :3]):
        assert not holds_amplitudes([image])
    assert not holds_amplitudes([])


def scale_of(folder: Path, images: list[np.ndarray], **keys: Any) -> tuple[Any, list[str]]:
    """(pixel_scale, notes) of the log of these images."""
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"{k}.png"), image)
    with open_log(folder, sonar=Sonar("polar", 1.0, 3.0, 28.8, 20.0, **keys)) as log:
        next(iter(log))
        return log.reading()["pixel_scale"], log.diagnostics.notes


def simulated() -> np.ndarray:
    """One polar image of the simulator: logarithmic grey, 0 to 1."""
    frame = next(render(random_scene(2000)))
    return frame.image.astype(float) / 255


@pytest.mark.parametrize("median", [1 / 24, 1 / 10, 1 / 4])
def test_16_bit_amplitudes_are_found_by_their_speckle_and_noted(tmp_path, median):
    grey = simulated()
    amplitude = np.where(grey > 0, 10 ** ((grey - 1) * 50 / 20), 0)
    amplitude *= median / np.median(amplitude[amplitude > 0])
    image = np.clip(amplitude * 65535, 0, 65535).astype(np.uint16)
    scale, notes = scale_of(tmp_path, [image])
    assert scale == "log"
    (note,) = notes
    assert "16-bit pixels" in note
    assert scale_of(tmp_path, [image], pixel_scale="linear") == ("linear", [])


@pytest.mark.parametrize(("levels", "is_told"), [(255, True), (15, False), (1000, False)])
def test_grey_levels_in_deeper_pixels_are_told(tmp_path, levels, is_told):
    _, notes = scale_of(tmp_path, [np.rint(simulated() * levels).astype(np.uint16)])
    assert any("full_scale = 255" in note for note in notes) == is_told


@pytest.mark.parametrize("part", [1, 1 / 8])
def test_16_bit_logarithms_stay_linear_and_dim_ones_are_noted(tmp_path, part):
    image = np.rint(simulated() * 65535 * part).astype(np.uint16)
    scale, notes = scale_of(tmp_path, [image])
    assert scale == "linear"
    assert len(notes) == (part < 1)
    assert all("--pixel-scale log" in note and "full_scale" in note for note in notes)
    assert scale_of(tmp_path, [image], full_scale=65535 * part) == ("linear", [])


@pytest.mark.parametrize("stated", [None, "linear"])
def test_8_bit_amplitudes_are_noted_and_what_is_stated_wins(tmp_path, stated):
    images = [speckle(k, log=False) for k in range(3)]
    scale, notes = scale_of(tmp_path, images, pixel_scale=stated)
    assert scale == (stated or "log")
    assert len(notes) == (stated is None)


def test_the_scales_that_the_manual_lists_are_those_taken() -> None:
    page = resources.files("sonarrec").joinpath("help", "geometry.md").read_text("utf-8")
    rows = re.findall(r"^ {4,6}.*?  +(linear|log|db) +(\S.*)$", page, re.MULTILINE)
    cases = [  # in the order of the page, and whether they hold amplitudes
        *((40, "u1", False), (40, "u1", True), (40000, "u2", False), (40000, "u2", True)),
        *((400, "u2", False), (0.4, "f4", False), (-4, "f4", False), (4, "f4", False)),
    ]
    for (scale, full), (level, kind, amplitudes) in zip(rows, cases, strict=True):
        image = np.full((9, 9), level, kind)
        taken = grey_scale(Sonar(), image, amplitudes)
        assert taken is not None
        assert taken.pixel_scale == scale
        if full == "from the first frame":
            assert round(255 / 3) == to_grey8(image, taken)[0, 0]
        else:
            assert taken.full_scale == float(full)


@pytest.mark.parametrize(("maxval", "sample"), [(1023, ">u2"), (15, "u1")])
def test_what_a_pgm_calls_white_is_white(tmp_path: Path, maxval: int, sample: str) -> None:
    """As with a picture of all its type's values; a full scale that is stated goes before it."""
    grey = simulated()
    rows, columns = grey.shape
    for k in range(2):
        header = b"P5\n# a comment\n%d %d\n%d\n" % (columns, rows, maxval)
        pixels = np.rint(grey * maxval).astype(sample)
        (tmp_path / f"{k}.pgm").write_bytes(header + pixels.tobytes())
    assert scale_of(tmp_path, []) == ("linear", [])
    for full in (None, 2.0 * maxval):
        sonar = Sonar("polar", 1.0, 3.0, 28.8, 20.0, full_scale=full)
        with open_log(tmp_path, sonar=sonar) as log:
            brightest = int(next(iter(log)).pixels.max())
            assert log.reading()["full_scale"] == (full or maxval)
            assert brightest == pytest.approx(grey.max() * (255 / (1 + bool(full))), 1)


@pytest.mark.parametrize(
    ("kind", "mode"),
    [("JPEG", "L"), *((kind, mode) for kind in ("PNG", "TIFF") for mode in ("L", "RGBA", "I;16"))],
)
def test_an_image_is_turned_as_viewers_turn_it(kind: str, mode: str) -> None:
    grey = np.zeros((24, 40), np.uint8)
    grey[:8], grey[8:16, :8] = 120, 250  # looks otherwise in each of the eight
    picture = Image.fromarray(grey.astype(np.uint16) * 257 if mode == "I;16" else grey)
    for orientation in range(1, 9):
        file, exif = io.BytesIO(), Image.Exif()
        exif[274] = orientation
        (picture.convert(mode) if mode == "RGBA" else picture).save(file, kind, exif=exif)
        shown = np.asarray(ImageOps.exif_transpose(Image.open(file)).convert(picture.mode))
        found = single_channel(decode_image(file.getvalue()))
        np.testing.assert_allclose(found, shown, atol=2)


@pytest.mark.parametrize(("share", "as_decibels"), [(0.01, False), (0.2, False), (0.9, True)])
def test_the_share_below_0_decides(share: float, as_decibels: bool, tmp_path: Path) -> None:
    """Noise below 0 makes no decibels of amplitudes; and what was assumed is told."""
    rng = np.random.default_rng(0)
    images = [rng.rayleigh(200.0, (48, 38)).astype(np.float32) for _ in range(3)]
    for image in images:
        image[rng.random(image.shape) < share] *= -1
    with open_log(image_mcap(tmp_path / "log.mcap", images, "32FC1")) as log:
        list(log)
        (note,) = log.diagnostics.notes
        assert log.reading()["pixel_scale"] == ("db" if as_decibels else "log")
    assert ("decibels" if as_decibels else "amplitudes") in note


def test_one_pixel_out_of_bounds_costs_no_frame(tmp_path: Path) -> None:
    images = [(image / 255).astype(np.float32) for image in frames(4)]
    images[1][0, 0] = -1e-6
    images[2][:10] = 7
    found = read(image_mcap(tmp_path / "log.mcap", images, "32FC1"))
    assert found.numbers == [0, 1, 3]
    assert len(found.problems) == 1


@pytest.mark.parametrize(
    ("values", "kept"),
    [([0, 255], "u1"), ([0, 256], "u2"), ([0, 65535], "u2"), ([0, 65536], "i8"), ([-1, 255], "f4")],
)
def test_integers_of_an_array_are_as_narrow_as_they_can_be(values: list[int], kept: str) -> None:
    file = io.BytesIO()
    np.save(file, np.array([values] * 3, np.int64))
    pixels = decode_image(file.getvalue())
    assert pixels.dtype == kept
    assert pixels[0].tolist() == values
