"""Saturated pictures: told from others, and what stood out stands out again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonarrec.readers import open_log
from sonarrec.recogniser.restore.saturation import LIFTS, OF_GAUSSIAN, Levels
from sonarrec.sonar.frame import Frame
from tests.support.command import sonarrec
from tests.support.drawn import make_fan
from tests.support.on_record import SAMPLES, check_nearly_as_on_record
from tests.support.slow import but_first

FAN = make_fan(256, 0.75, 1.9, 40.0, height_m=0.7)
RADIUS_M = 0.15
ROW, COLUMN = np.mgrid[: FAN.rows, : FAN.columns]
AWAY = np.hypot(COLUMN - 150, ROW - 130) * FAN.metres_per_pixel / RADIUS_M  # from a disc's centre
RING, FLOOR = (AWAY > 0.8) & (AWAY < 1), (AWAY > 1.2) & (AWAY < 1.8)
SIGMA = 40.0


def disc(seed: int, mean: float = 110.0, ring_over_floor: float = 1.5) -> np.ndarray:
    """Speckle of 40 levels in grains of some pixels, and a ring so many sigmas brighter."""
    grains = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, ROW.shape), (0, 0), 0.8)
    return mean + SIGMA * (grains / grains.std() + ring_over_floor * RING)


def frame(levels: np.ndarray) -> Frame:
    return Frame(0, 0, np.clip(levels, 1, 255).astype(np.uint8), FAN)


def restored(picture: Frame) -> tuple[Frame, bool]:
    """The frame, and whether it was saturated."""
    levels = Levels(RADIUS_M)
    (after,) = levels.restored([picture])
    assert levels.seen == 1
    return after, bool(levels.saturated)


def contrast(pixels: np.ndarray) -> float:
    """Ring over floor, in standard deviations of the floor."""
    return float((pixels[RING].mean() - pixels[FLOOR].mean()) / pixels[FLOOR].std())


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_lifts_are_means_beyond_a_limit(share: float) -> None:
    levels = np.sort(np.random.default_rng(1).normal(0, 1, 1_000_000))
    beyond = levels[round(len(levels) * (1 - share)) :]
    expected = OF_GAUSSIAN * (beyond.mean() - beyond[0])
    # A share is one of 255: its lift is off by a hundredth where the curve is steep.
    assert LIFTS[round(255 * share)] == pytest.approx(expected, abs=0.01)
    assert (np.diff(LIFTS) >= 0).all()


@pytest.mark.parametrize("cut", [0.05, 0.1, 0.2, 0.3])
def test_a_ring_stands_out_again(cut: float) -> None:
    """Lifting halves what clipping takes of the contrast, and keeps the order of all levels."""
    levels = disc(2)
    shifted = frame(levels + 255 - np.quantile(levels, 1 - cut))
    after, was = restored(shifted)
    assert was
    true, clipped, found = contrast(levels), contrast(shifted.pixels), contrast(after.pixels)
    assert clipped < 0.9 * true
    assert abs(found - true) < 0.6 * abs(clipped - true)
    unsaturated = shifted.pixels < 252
    order = np.argsort(shifted.pixels[unsaturated], kind="stable")
    assert (np.diff(after.pixels[unsaturated][order].astype(int)) >= 0).all()


def test_other_pictures_are_left_as_they_are() -> None:
    speckle = 20 * np.log10(np.random.default_rng(3).rayleigh(30, ROW.shape))
    few = disc(4)
    few[np.random.default_rng(6).uniform(size=ROW.shape) < 0.01] = 400
    bright = np.where(ROW < 64, 235 + 6 * np.random.default_rng(5).normal(size=ROW.shape), disc(5))
    white_around = disc(6)
    white_around[cv2.fillPoly(np.ones(ROW.shape, np.uint8), [outline()], 0) > 0] = 255
    for levels in (disc(3), 3 * speckle, few, bright, white_around, 0 * few, disc(7, mean=4)):
        picture = frame(levels)
        after, was = restored(picture)
        assert after is picture
        assert not was


def outline() -> np.ndarray:
    """Corners of a polygon that holds all of the fan."""
    bearing = np.radians(np.linspace(-21, 21, 50))
    reach = (FAN.range_max_m + 0.06) / FAN.metres_per_pixel, 140.0
    arc = [(r * np.sin(bearing), -r * np.cos(bearing)) for r in reach]
    (far_x, far_y), (near_x, near_y) = arc
    x = np.concatenate([far_x, near_x[::-1]]) + FAN.apex_column
    y = np.concatenate([far_y, near_y[::-1]]) + FAN.apex_row
    return np.rint(np.stack([x, y], axis=1)).astype(np.int32)


def test_the_highest_level_may_be_another_and_smeared_by_jpeg() -> None:
    levels = disc(8) + 255 - np.quantile(disc(8), 0.9)
    dim = frame(np.minimum(levels, 255) * 0.8)
    coded = cv2.imencode(".jpg", frame(levels).pixels, [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
    jpeg = replace(dim, pixels=np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)))
    for picture in (dim, jpeg):
        after, was = restored(picture)
        assert was
        assert contrast(after.pixels) > contrast(picture.pixels) + 0.1


def saturate(pictures: list[np.ndarray]) -> list[np.ndarray]:
    gain = 255 / np.quantile(np.concatenate([p[p > 8] for p in pictures[::10]]), 0.9)
    return [cv2.convertScaleAbs(p, alpha=gain) for p in pictures]


@pytest.mark.parametrize("sample", but_first(["pan", "polar"]))
def test_landmarks_are_recognised_and_a_note_tells(tmp_path: Path, sample: str) -> None:
    """With a tenth of the echoes saturated, in fan images and polar ones."""
    log, source = tmp_path / sample, SAMPLES / sample
    log.mkdir()
    (log / "sonar.toml").write_bytes((source / "sonar.toml").read_bytes())
    with open_log(source) as recording:
        pictures = saturate([f.pixels for f in recording])
    for index, picture in enumerate(pictures):
        cv2.imwrite(str(log / f"{index:06d}.png"), picture)
    assert "saturated" in sonarrec("run", log, "-o", tmp_path / "out").stderr
    check_nearly_as_on_record(tmp_path / "out" / sample, sample)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda levels: levels + 100, "lower gain"),
        (lambda levels: 255 - np.clip(levels - 90, 0, 255), "reversed"),
        (lambda levels: 255.0 * (levels > 110), "masks"),
    ],
)
def test_gain_is_blamed_only_where_it_may_be_the_cause(change, told: str) -> None:
    levels = Levels(RADIUS_M)
    list(levels.restored([frame(np.asarray(change(disc(1)), float))]))
    assert levels.saturated
    assert told in levels.cause
    assert ("lower gain" in levels.cause) == (told in ("lower gain", "reversed"))
