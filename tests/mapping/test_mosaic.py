"""The mosaic shows the floor where it lies, once, and needs no more memory for a longer way."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonarrec.arrays import FloatArray
from sonarrec.geometry import polar_from_pixel
from sonarrec.recogniser.tiles import SIDE, Tiles, parts, warped
from tests.support.command import sonarrec
from tests.support.drawn import make_fan
from tests.support.vehicle import write_poses

FAN = make_fan(rows=192)
BLOBS = ((-0.5, 2.4), (0.35, 2.0), (0.7, 2.9))
"""Bright round things on the floor, x and y in m."""
BLOB_M = 0.07
DETAIL_M = 0.05


def floor(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey level of the floor: frozen detail, and the blobs."""
    detail = np.sin(x / DETAIL_M + 3 * np.sin(y / 0.21)) * np.sin(
        y / DETAIL_M + 2 * np.sin(x / 0.17)
    )
    level = 90 + 25 * detail
    for at_x, at_y in BLOBS:
        level = np.where(np.hypot(x - at_x, y - at_y) < BLOB_M, 230.0, level)
    return np.asarray(level)


def recorded(folder: Path, path: FloatArray) -> Path:
    """A recording of this floor, fading with range. path: (N, 3) as SonarPath.pose."""
    folder.mkdir(parents=True)
    row, column = np.mgrid[0 : FAN.rows, 0 : FAN.columns]
    slant, bearing = polar_from_pixel(FAN, column, row)
    ground = np.sqrt(np.maximum(slant**2 - 0.68**2, 0))
    inside = (slant > 1.25) & (slant < 3.75) & (np.abs(bearing) < 14.4)
    for n, (yaw, at_x, at_y) in enumerate(path.tolist()):
        sight = np.radians(yaw + bearing)
        level = floor(at_x + ground * np.sin(sight), at_y + ground * np.cos(sight))
        level = np.where(inside, level - 22 * (slant - 2.5), 0)
        image = np.clip(level, 1, 255).astype(np.uint8) * inside.astype(np.uint8)
        cv2.imwrite(str(folder / f"{n:06d}.png"), image)
    (folder / "sonar.toml").write_text(
        '[sonar]\nlayout = "fan"\nrange_min_m = 1.25\nrange_max_m = 3.75\n'
        "field_of_view_deg = 28.8\ntilt_deg = 20.0\nheight_m = 0.68\nframe_rate_hz = 4.0\n"
    )
    return folder


def mosaic_of(home: Path, path: FloatArray, told: FloatArray, *more: str) -> np.ndarray:
    """The picture, (rows, columns, 4), of a run along a path with the poses that it is told."""
    log = recorded(home / "dive", path)
    write_poses(home / "poses.csv", told)
    sonarrec("run", log, "-q", "-o", home / "out", "--odometry", home / "poses.csv")
    sonarrec(
        "map",
        home / "out" / "dive",
        "-q",
        "-o",
        home / "map",
        "--mosaic",
        home / "floor.png",
        *more,
    )
    return np.asarray(cv2.imread(str(home / "floor.png"), cv2.IMREAD_UNCHANGED))


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("mosaic")


@pytest.fixture(scope="module")
def panned(home: Path) -> np.ndarray:
    yaw = 12 * np.sin(np.linspace(0, 2 * np.pi, 30))
    path = np.column_stack([yaw, 0.05 * np.sin(yaw), 0 * yaw])
    return mosaic_of(home, path, path)


def on_floor(world: Path, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y of all pixels by the world file."""
    a, d, b, e, c, f = map(float, world.read_text().split())
    row, column = np.mgrid[0 : picture.shape[0], 0 : picture.shape[1]]
    return a * column + b * row + c, d * column + e * row + f


def test_the_floor_is_drawn_where_it_lies(home: Path, panned: np.ndarray) -> None:
    """And level over the range, although the frames fade with it."""
    x, y = on_floor(home / "floor.pgw", panned)
    # Landmarks' marks are coloured; the floor is grey.
    seen = (panned[..., 3] == 255) & (np.ptp(panned[..., :3].astype(int), axis=2) == 0)
    grey = panned[..., 0].astype(float)
    truth = floor(x, y)
    assert seen.mean() > 0.4
    assert np.corrcoef(grey[seen], truth[seen])[0, 1] > 0.8
    assert not panned[~seen][:, 3].all()
    far = seen & (np.hypot(x, y) > 2.8) & (truth < 200)
    near = seen & (np.hypot(x, y) < 1.9) & (truth < 200)
    assert abs(grey[far].mean() - grey[near].mean()) < 0.35 * grey[seen].std()


@pytest.mark.usefixtures("panned", "pictures")
def test_map_png_shows_it_behind_the_landmarks(home: Path) -> None:
    sonarrec("map", home / "out" / "dive", "-q", "-o", home / "map", "--mosaic", home / "again.png")
    picture = cv2.imread(str(home / "map" / "map.png")).astype(int)
    grey = picture[np.ptp(picture, axis=2) == 0][:, 0]
    assert len(np.unique(grey)) > 200


def test_the_world_file_is_in_degrees_with_an_origin(home: Path, panned: np.ndarray) -> None:
    words = ("-q", "-o", home / "map", "--mosaic", home / "floor.png")
    x, y = on_floor(home / "floor.pgw", panned)
    sonarrec("map", home / "out" / "dive", *words, "--origin", "60,10,90")
    longitude, latitude = on_floor(home / "floor.pgw", panned)
    # Ahead is east, so the right is south.
    assert np.abs((longitude - 10) * 111_412 * math.cos(math.radians(60)) - y).max() < 0.02
    assert np.abs((60 - latitude) * 111_412 - x).max() < 0.02


@pytest.mark.parametrize("stated", [True, False])
def test_what_uncertain_poses_bring_back_elsewhere_is_seen_once(
    tmp_path: Path, stated: bool
) -> None:
    """A return after which the poses are off by two blobs, with --drift that says so or without."""
    there = np.linspace(0, 34, 36)
    yaw = np.concatenate([there, there[::-1]])
    path = np.column_stack([yaw, 0 * yaw, 0 * yaw])
    told = path.copy()
    told[36:, 1] += 2 * BLOB_M
    more = ("--drift", "0.8,0") if stated else ()
    picture = mosaic_of(tmp_path, path, told, *more)
    x, y = on_floor(tmp_path / "floor.pgw", picture)
    grey = picture[..., 0].astype(float)

    def brightness(at: tuple[float, float], right: float) -> float:
        return float(grey[np.hypot(x - at[0] - right, y - at[1]) < 0.6 * BLOB_M].mean())

    first, second = (brightness(BLOBS[0], right) for right in (0, 2 * BLOB_M))
    usual = float(np.median(grey[picture[..., 3] == 255]))
    assert second > usual + 40
    assert (first < usual + 25) == stated


@pytest.mark.usefixtures("panned")
def test_what_cannot_be_drawn_is_told_in_a_line(home: Path, tmp_path: Path) -> None:
    def told(name: Path, code: int) -> str:
        words = ("map", home / "out" / "dive", "-q", "--mosaic", name)
        (line,) = sonarrec(*words, code=code).output.splitlines()
        return line

    assert "ends in .png" in told(home / "floor.jpg", 2)
    (tmp_path / "foreign.pgw").write_text("1\n")
    assert "not overwritten" in told(tmp_path / "foreign.png", 2)
    assert "part of the recording" in told(home / "dive" / "floor.png", 2)
    away = (home / "dive").rename(home / "moved")
    try:
        assert "it is not at" in told(tmp_path / "floor.png", 1)
    finally:
        away.rename(home / "dive")
    assert not (home / "out" / "dive" / "map").exists()


@pytest.mark.parametrize("most", [1, 3, 100])
def test_tiles_on_the_disk_are_those_in_memory(most: int) -> None:
    rng = np.random.default_rng(0)
    whole = np.zeros((4 * SIDE, 5 * SIDE), np.float64)
    with Tiles(2, most) as tiles:
        for _ in range(40):
            picture = rng.normal(size=(90, 130, 2)).astype(np.float32)
            row, column = rng.integers(-SIDE, 2 * SIDE, 2)
            placed, first = warped(picture, np.array([[1.0, 0, column], [0, 1.0, row]]))
            assert first == (column, row)
            for tile, inside, part in parts(placed.shape, first):
                tiles.tile(tile)[inside] += placed[part]
            whole[row + SIDE : row + SIDE + 90, column + SIDE : column + SIDE + 130] += picture[
                ..., 0
            ]
        found = [tiles.rows(row, -1, 5 * SIDE)[..., 0].copy() for row in range(-1, 3)]
        folder = tiles._folder
        assert (folder is None) == (most == 100)
    assert np.abs(np.concatenate(found) - whole).max() < 1e-4
    assert folder is None or not Path(folder.name).exists()
