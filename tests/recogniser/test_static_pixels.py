"""Pixels that never change: found where they were drawn, filled, and nothing else touched."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonarrec.readers import open_log
from sonarrec.recogniser.restore.static_pixels import AHEAD, MOST_BYTES_AHEAD, Unchanging
from sonarrec.sonar.frame import Frame
from sonarrec.sonar.geometry import fan_mask
from tests.support.command import sonarrec
from tests.support.drawn import make_fan
from tests.support.on_record import SAMPLES, check_nearly_as_on_record

FAN = make_fan(200, 1.0, 3.0, 40.0, height_m=0.7)
INSIDE = fan_mask(FAN) > 0


def floor(step: int, count: int = 40) -> Iterator[np.ndarray]:
    """Speckle, in grains of 3 x 3 pixels, that moves by some pixels a frame under a fixed fan."""
    rng = np.random.default_rng(4)
    size = (FAN.rows, FAN.columns + step * count)
    grains = cv2.GaussianBlur(rng.normal(0, 1, size), (0, 0), 1.5)
    grains = np.clip(90 + 28 * grains / grains.std(), 1, 255)
    for at in range(count):
        moved = grains[:, step * at : step * at + FAN.columns]
        yield np.where(INSIDE, moved, 0).astype(np.uint8)


def frames(images: Iterable[np.ndarray]) -> Iterator[Frame]:
    for index, image in enumerate(images):
        yield Frame(index, index * 250_000_000, image, FAN)


def lines() -> np.ndarray:
    """The opacity of a drawn circle, a slanted line and a word, with smooth edges."""
    opacity = np.zeros((FAN.rows, FAN.columns), np.uint8)
    cv2.circle(opacity, (119, 300), 200, 255, 1, cv2.LINE_AA)
    cv2.line(opacity, (119, 300), (150, 0), 255, 1, cv2.LINE_AA)
    cv2.putText(opacity, "ping", (90, 60), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 255, 2, cv2.LINE_AA)
    return opacity


@pytest.mark.parametrize(("level", "most", "off"), [(255, 1.0, 5), (180, 1.0, 5), (255, 0.7, 10)])
def test_what_is_drawn_is_filled_and_the_rest_left_alone(level: int, most: float, off: int) -> None:
    opacity = lines()
    share = most * opacity / 255.0
    drawn = [(i * (1 - share) + level * share).astype(np.uint8) for i in floor(4)]
    unchanging = Unchanging()
    filled = [f.pixels for f in unchanging.filled(frames(drawn))]
    whole = list(floor(4))
    solid = (opacity > 200) & INSIDE
    beside = cv2.dilate(opacity, np.ones((7, 7))) == 0
    for before, after in zip(drawn, filled, strict=True):
        np.testing.assert_array_equal(after[beside], before[beside])
    # What is filled is speckle as about it: it has the floor's mean to a fifth of its spread (28),
    # and that spread to a quarter. Pixels under smooth edges keep a part of the line; where the
    # floor shines through it, more do: twice these bounds.
    after, floor_levels = (np.stack([i[solid] for i in images]) for images in (filled, whole))
    assert abs(after.mean() - floor_levels.mean()) < off
    assert abs(after.std() - floor_levels.std()) < 1.5 * off
    assert abs(np.stack([i[solid] for i in drawn]).mean() - floor_levels.mean()) > 60
    assert 0.5 < unchanging.share / (solid.sum() / INSIDE.sum()) < 4


def test_dead_beams_of_polar_images_are_filled_from_their_neighbours() -> None:
    with open_log(SAMPLES / "polar") as log:
        whole = list(log)
    dead = np.zeros(whole[0].pixels.shape[1], bool)
    dead[[5, 30, 31, 32, 70]] = True
    cut = [replace(f, pixels=np.where(dead, 0, f.pixels).astype(np.uint8)) for f in whole]
    for before, frame in zip(whole, Unchanging().filled(iter(cut)), strict=True):
        np.testing.assert_array_equal(frame.pixels[:, ~dead][:, :3], before.pixels[:, :3])
        # The lit floor: far out all is black.
        assert (frame.pixels[:, 31] > 0).sum() > 0.9 * (before.pixels[:, 31] > 0).sum()


def test_a_standing_sonar_and_a_moving_one_without_lines_are_left_alone() -> None:
    rng = np.random.default_rng(5)
    (image,) = floor(4, 1)
    still = np.where(lines() > 0, 255, image)
    noise = (np.where(INSIDE, rng.normal(0, 5, image.shape), 0) for _ in range(40))
    standing = [np.clip(still + n, 0, 255).astype(np.uint8) for n in noise]
    for images in (standing, list(floor(1, 80)), list(floor(4))):
        found = Unchanging()
        left = list(found.filled(frames(images)))
        assert all(f.pixels is i for f, i in zip(left, images, strict=True))
        assert found.share == 0


@pytest.mark.parametrize(("specks", "rows"), [(2, 60), (64, 120)])
def test_black_with_specks_in_it_is_left_alone(specks: int, rows: int) -> None:
    """Behind a wall, or where the sonar leaves out weak echoes, most pixels are dark by chance."""
    rng = np.random.default_rng(7)
    images = list(floor(4))
    for image in images:
        image[:rows] = 0
        image[rng.integers(0, rows, specks), rng.integers(70, 170, specks)] = 60
    left = list(Unchanging().filled(frames(images)))
    assert all(f.pixels is i for f, i in zip(left, images, strict=True))


def test_what_comes_later_frees_what_was_filled() -> None:
    """Half of the picture stands until the sonar turns on."""
    opacity, images = lines(), list(floor(4, 80))
    kept = images[0].copy()
    drawn = [np.where(opacity > 0, kept, i) if n < 30 else i for n, i in enumerate(images)]
    found = Unchanging()
    last = [*found.filled(frames(drawn))][-1]
    assert found.share == 0
    assert last.pixels is drawn[-1]


@pytest.mark.parametrize(
    ("shape", "ahead"), [((200, 240), AHEAD), ((2048, 2048), 4), ((4096, 4096), 1)]
)
def test_large_images_are_not_hoarded(shape: tuple[int, int], ahead: int) -> None:
    """A standing sonar, of which the most frames are read ahead."""
    assert ahead * shape[0] * shape[1] <= MOST_BYTES_AHEAD
    read = 0

    def counted() -> Iterator[Frame]:
        nonlocal read
        for index in range(AHEAD + 5):
            read += 1
            yield Frame(index, index, image, replace(FAN, rows=shape[0], columns=shape[1]))

    image = np.ones(shape, np.uint8)
    for number, _ in enumerate(Unchanging().filled(counted())):
        assert read <= max(ahead, number + 1)
    assert read == AHEAD + 5


@pytest.mark.slow
def test_landmarks_are_recognised_under_a_grid_and_the_note_tells(tmp_path: Path) -> None:
    """A white grid over the sample log: the same landmarks as on record, in all but few frames."""
    log = tmp_path / "pan"
    log.mkdir()
    (log / "sonar.toml").write_bytes((SAMPLES / "pan" / "sonar.toml").read_bytes())
    with open_log(SAMPLES / "pan") as recording:
        for frame in recording:
            image, fan = frame.image.copy(), frame.fan
            apex = (round(fan.apex_column), round(fan.apex_row))
            for range_m in np.arange(1.5, 3.75, 0.5):
                cv2.circle(image, apex, round(range_m / fan.metres_per_pixel), 255, 1, cv2.LINE_AA)
            for column in range(0, fan.columns, 40):
                cv2.line(image, apex, (column, 0), 255, 1, cv2.LINE_AA)
            cv2.imwrite(str(log / f"{frame.index:06d}.png"), image)
    assert "picture never" in sonarrec("run", log, "-o", tmp_path / "out").stderr
    check_nearly_as_on_record(tmp_path / "out" / "pan", "pan")
