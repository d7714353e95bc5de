"""Maps: landmarks lie where trigonometry puts them, errors are as large as they are said to be, and
other programs read the files."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection

from sonarrec.arrays import FloatArray
from sonarrec.config import preset
from sonarrec.drawing.pen import landmark_colours
from sonarrec.errors import SonarrecError, UsageError
from sonarrec.landmarks import load_landmarks
from sonarrec.mapping.build import make_map
from sonarrec.mapping.landmarks import (
    CHI2_95,
    COMMON_SHARE,
    LEAST_ORIENTATION_DEG,
    SAME_FRAMES,
    _mean_orientation,
    ellipse,
)
from sonarrec.mapping.path import (
    COMMON_LENGTH,
    COMMON_ROTATION,
    Drift,
    measured_path,
    path_from_poses,
)
from sonarrec.mapping.picture import _drawing, draw_map
from sonarrec.readers.poses import read_poses
from sonarrec.results.run_file import run_table
from sonarrec.results.write import ResultsWriter
from sonarrec.sonar.frame import Estimate, FrameResult
from sonarrec.sonar.geometry import pose_table
from sonarrec.sonar.stated import Sonar
from tests.support.command import sonarrec
from tests.support.drawn import make_fan
from tests.support.logs import mcap_file
from tests.support.messages import definition, serialised
from tests.support.rows import read_rows, write_rows

BASIN = load_landmarks("basin")
HEIGHT = 0.68
FAN = make_fan(rows=512)
RATE = 4.0
SIGMA = (0.006, 0.12, 4.0)
"""Of the made-up estimates: slant range (m), bearing and orientation (deg)."""


@dataclass(frozen=True)
class Disc:
    """A landmark on the floor; turn: counter-clockwise from the x axis, deg."""

    id: int
    x: float
    y: float
    turn: float


# Two of ID.1 half a metre apart; ID.2, which looks the same turned by half.
SITE = (Disc(1, -0.4, 2.3, 40.0), Disc(1, 0.1, 2.4, 300.0), Disc(2, 0.9, 2.6, 110.0))


def there_and_back(frames: int = 120) -> FloatArray:
    """(frames, 3) yaw, x, y: to the right and back, all of the site leaving the view between."""
    share = 1 - np.abs(np.linspace(-1, 1, frames))
    return np.column_stack([-25 + 60 * share, -0.5 + 1.2 * share, 0.3 * share])


def seen_by(pose: FloatArray, disc: Disc) -> tuple[float, float, float]:
    """Slant range, bearing, orientation in the image of a disc for a sonar at (yaw, x, y)."""
    yaw, x, y = pose
    right, ahead = disc.x - x, disc.y - y
    bearing = math.degrees(math.atan2(right, ahead)) - yaw
    return math.hypot(right, ahead, HEIGHT), bearing, (disc.turn + yaw) % 360


def results(
    folder: Path,
    path: FloatArray,
    told: FloatArray | None,
    site: Sequence[Disc] = SITE,
    seed: int = 0,
    odometry: dict[str, str] | None = None,
) -> Path:
    """Results as a run writes them, of a sonar that was carried along a path and told another.

    Discs within 12 deg are declared. A disc that comes back has another track. The error of each
    estimate is half of the pass, half of the frame.
    """
    rng = np.random.default_rng(seed)
    rows: list[tuple[Estimate, ...]] = []
    track: dict[Disc, tuple[int, int, FloatArray]] = {}
    for frame, pose in enumerate(path):
        found = []
        for disc in site:
            exact = np.array(seen_by(pose, disc))
            if abs(exact[1]) > 12 or not 1.3 < exact[0] < 3.7:
                continue
            last, number, common = track.get(disc, (-100, 0, np.zeros(3)))
            if frame - last > 10:
                number = len(track) + 10 * frame
                common = rng.normal(0, SIGMA)
            track[disc] = frame, number, common
            noisy = exact + math.sqrt(0.5) * (common + rng.normal(0, SIGMA))
            place = 0.0, 0.0, *noisy[:2], noisy[2] % 360
            claim = 1.0, np.full(5, 0.2), disc.id, 0.99, True, *SIGMA
            found.append(Estimate("framework", number, *place, *claim))
        rows.append(tuple(found))
    config = preset("default")
    sonar = Sonar(height_m=HEIGHT, tilt_deg=20.0, range_min_m=1.25, range_max_m=3.75)
    table = run_table([config], ["framework"], sonar, FAN, BASIN, (folder.name, 0, ""))
    table["input"]["path"] = str(folder.parent / f"{folder.name}.mcap")
    if told is not None:
        poses = write_poses(folder.parent / f"{folder.name}.poses.csv", told)
        odometry = dict(read_poses(poses).source)
    table |= {"odometry": odometry} if odometry else {}
    with ResultsWriter(folder, BASIN, table) as writer:
        for frame, found in enumerate(rows):
            writer.write(FrameResult(frame, round(frame * 1e9 / RATE), 0, 0, found))
        writer.finish([])
    return folder


def write_poses(path: Path, poses: FloatArray) -> Path:
    head, rows = ("timestamp", "yaw", "x", "y"), enumerate(poses.tolist())
    path.parent.mkdir(parents=True, exist_ok=True)
    write_rows(path, [dict(zip(head, (n / RATE, *pose), strict=True)) for n, pose in rows])
    return path


@pytest.fixture
def dive(tmp_path: Path) -> Path:
    """Results with the exact poses."""
    return results(tmp_path / "dive", there_and_back(), there_and_back())


@pytest.fixture
def mapped(dive: Path) -> Path:
    sonarrec("map", dive, "--origin", "54.3233,10.1394,87")
    return dive / "map"


# Where they lie


def test_estimates_on_frames_that_are_not_listed_are_told(dive: Path) -> None:
    rows = read_rows(dive / "estimates.csv")
    strays = [row | {"frame": str(int(row["frame"]) + 1000)} for row in rows[:5]]
    strays[0]["declared"] = "0"
    strays[1]["method"] = "smi"
    alone = map_rows(dive)
    write_rows(dive / "estimates.csv", [*rows, *strays])
    assert f"{dive}: 3 of {len(rows) + 3} " in sonarrec("map", dive, code=3).stderr
    assert read_rows(dive / "map" / "map.csv") == alone


def test_each_landmark_once_where_it_lies(mapped: Path) -> None:
    rows = read_rows(mapped / "map.csv")
    assert [int(row["landmark"]) for row in rows] == [1, 1, 2]
    for row in rows:
        at = np.array([float(row["x_m"]), float(row["y_m"])])
        disc = min(SITE, key=lambda d: math.dist(at, (d.x, d.y)))
        xx, xy, yy = (float(row[k]) for k in ("xx_m2", "xy_m2", "yy_m2"))
        off = at - (disc.x, disc.y)
        assert disc.id == int(row["landmark"])
        assert off @ np.linalg.inv([[xx, xy], [xy, yy]]) @ off < 13.8  # 99.9 %
        period = 180 if disc.id == 2 else 360
        turn = (float(row["orientation_deg"]) - disc.turn + period / 2) % period - period / 2
        assert abs(turn) < 3.3 * float(row["orientation_sigma_deg"])
        assert row["passes"] == "2"
    assert len({(row["x_m"], row["y_m"]) for row in rows}) == 3


def test_a_symbol_that_looks_the_same_at_every_turn_has_no_orientation(dive: Path) -> None:
    """It is all bright; its mean of arbitrary turns was written, within the width of a sector."""
    discs = {"name": "s", "radius_m": 0.15, "ring": [0.8, 1.0], "symbol": [0.0, 0.6]}
    symbols = [{"id": i, "sectors": s} for i, s in ((1, [1, 0]), (2, [1, 1]))]
    given = dive.parent / "set.toml"
    given.write_text(tomli_w.dumps(discs | {"landmark": symbols}))
    told = sonarrec("map", dive, "--landmarks", given).stdout
    assert told.splitlines()[-1].split()[5:7] == ["-", "-"]
    for name, count in (("map", 3), ("passes", 6)):
        found = read_rows(dive / "map" / f"{name}.csv")
        assert len(found) == count
        for row in found:
            cells = row["orientation_deg"], row["orientation_sigma_deg"]
            assert all(cells) if row["landmark"] == "1" else cells == ("", "")


def test_two_logs_make_one_map(tmp_path: Path) -> None:
    path = there_and_back()
    one = results(tmp_path / "one", path, path)
    other = results(tmp_path / "other", path[::-1], path[::-1], [*SITE, Disc(4, -1.2, 2.0, 0)], 1)
    sonarrec("map", one, other, "-o", tmp_path / "site")
    found = [(row["landmark"], row["logs"]) for row in read_rows(tmp_path / "site" / "map.csv")]
    assert found == [("1", "2"), ("1", "2"), ("2", "2"), ("4", "1")]
    assert "--out" in sonarrec("map", one, other, code=2).stderr


def test_what_lies_on_another_is_the_one_claimed_more(dive: Path) -> None:
    """A few frames of a disc under a wrong ID make no second landmark."""
    rows = read_rows(dive / "estimates.csv")
    for row in [row for row in rows if row["landmark"] == "2"][:5]:
        row["landmark"] = "3"
    write_rows(dive / "estimates.csv", rows)
    assert "(ID.2)" in sonarrec("map", dive, code=3).stderr  # since the table was changed
    assert columns(dive, "landmark", "other_frames") == [("1", "0"), ("1", "0"), ("2", "5")]


@pytest.mark.parametrize(("by_m", "places"), [(0.02, 1), (0.2, 2)])
def test_a_landmark_that_was_moved_has_two_places(by_m: float, places: int, tmp_path: Path) -> None:
    """Within a disc of where it lay: two discs could not lie there."""
    path, (disc, _, other) = there_and_back(60), SITE
    results(tmp_path / "site" / "one", path, path, (disc, other))
    there = replace(disc, x=disc.x + by_m)
    results(tmp_path / "site" / "two", path, path, (there, other), seed=1)
    told = sonarrec("map", tmp_path / "site", code=0).stderr
    assert ("moved" in told) == (places == 2)
    rows = read_rows(tmp_path / "site" / "map" / "map.csv")
    assert [row["landmark"] for row in rows] == ["1"] * places + ["2"]
    if places == 2:
        for lay, row in zip((disc, there), rows, strict=False):
            assert math.hypot(float(row["x_m"]) - lay.x, float(row["y_m"]) - lay.y) < 0.03


def test_tracks_are_needed(dive: Path) -> None:
    """Without them two landmarks of one ID that are seen at once were one, between the two."""
    rows = read_rows(dive / "estimates.csv")
    rows[-1]["object"] = ""
    write_rows(dive / "estimates.csv", rows)
    assert f"{dive / 'estimates.csv'}: a track" in sonarrec("map", dive, code=1).stderr
    rows[-1] |= {"declared": "0"}  # a row that is in no pass needs none
    write_rows(dive / "estimates.csv", rows)
    sonarrec("map", dive, code=3)  # since the table was changed


def test_landmarks_of_few_frames_are_left_out(dive: Path) -> None:
    most = max(int(row["frames"]) for row in map_rows(dive))
    assert map_rows(dive, "--min-frames", most + 1) == []
    told = sonarrec("map", dive, "--min-frames", most).stdout.splitlines()[-1:]
    assert told == ["  2 landmarks left out by --min-frames"]
    nothing = results(dive.parent / "empty", there_and_back(), there_and_back(), site=())
    assert "no landmark declared" in sonarrec("map", nothing).stdout


def map_rows(folder: Path, *options: str | int) -> list[dict[str, str]]:
    sonarrec("map", folder, *map(str, options))
    return read_rows(folder / "map" / "map.csv")


def columns(folder: Path, *names: str) -> list[tuple[str, ...]]:
    """Of the landmarks of a map that was made."""
    return [tuple(row[n] for n in names) for row in read_rows(folder / "map" / "map.csv")]


@pytest.mark.slow
def test_the_truth_lies_in_the_ellipse_as_often_as_is_said(tmp_path: Path) -> None:
    inside = []
    for seed in range(40):
        path = there_and_back()
        site = make_map([results(tmp_path / f"{seed}", path, path, seed=seed)])
        for one in site.landmarks:
            off = min((one.position - (d.x, d.y) for d in SITE), key=lambda o: float(np.hypot(*o)))
            inside.append(off @ np.linalg.inv(one.covariance) @ off < CHI2_95)
    assert len(inside) == 120
    assert 0.90 <= np.mean(inside) <= 1


# What drifts


def test_errors_of_a_drifting_path_are_those_of_many_drawn() -> None:
    """Against paths drawn step by step, with the errors that are stated."""
    rng = np.random.default_rng(1)
    moved = np.column_stack([np.full(60, 3.0), np.full(60, 0.01), np.full(60, 0.08)])
    sigma = np.column_stack([np.full(60, 0.3), np.full(60, 0.004), np.full(60, 0.008)])
    frame = np.arange(60)
    path = measured_path(frame, frame, 0 * frame, moved, sigma)
    seen = np.array([0.5, 2.0])  # m to the right and ahead, in frames 20 and 50

    def placed(pose: FloatArray, row: int) -> FloatArray:
        yaw = math.radians(pose[row, 0])
        right, ahead = seen
        return pose[row, 1:] + (
            right * math.cos(yaw) + ahead * math.sin(yaw),
            ahead * math.cos(yaw) - right * math.sin(yaw),
        )

    drawn = []
    for _ in range(4000):
        yaw, x, y = 0.0, 0.0, 0.0
        pose = [(yaw, x, y)]
        longer = [1, *[1 + COMMON_LENGTH * rng.standard_normal()] * 2]
        steps = moved * longer + sigma * rng.standard_normal(moved.shape)
        for turn, right, ahead in steps[1:].tolist():
            cos, sin = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
            x, y = x + right * cos + ahead * sin, y + ahead * cos - right * sin
            yaw += turn
            pose.append((yaw, x, y))
        some = np.array(pose)
        drawn.append([*placed(some, 20), *placed(some, 50), *some[50]])
    found = np.cov(np.array(drawn).T)
    for row, place in ((20, slice(0, 2)), (50, slice(2, 4))):
        at = placed(path.pose, row)
        stated = path.position_covariance(np.array([row]), at[None])[0]
        scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
        assert np.abs((found[place, place] - stated) / scale).max() < 0.08
    assert path.yaw_variance(np.array([50]))[0] == pytest.approx(found[4, 4], rel=0.08)


@pytest.mark.parametrize(("first", "origin"), [(0, (0.0, 0.0)), (20, (500_000.0, 6_000_000.0))])
def test_told_poses_drift_as_stated_from_the_first_one(
    first: int, origin: tuple[float, float]
) -> None:
    """Frames before it have no pose to drift from, least of all the origin, which in UTM is far."""
    frame = np.arange(241)
    at = np.round(frame * 0.25e9).astype(np.int64)
    yaw, x, y = (np.full(241 - first, v) for v in (0.0, *origin))
    path = path_from_poses(
        frame, at, 0 * frame, pose_table("p", {}, at[first:], yaw, x, y), Drift(0.2, 6.0)
    )
    last, position = np.array([240]), np.array([[origin[0], origin[1] + 2]])
    share = (240 - first) / 240  # of a minute
    turned = share * np.radians(6) ** 2 * 2**2
    covariance = path.position_covariance(last, position)[0]
    expected = np.diag([share * 0.04 + turned, share * 0.04])
    np.testing.assert_allclose(covariance, expected, atol=1e-12)
    assert path.yaw_variance(last)[0] == pytest.approx(36 * share)


def test_a_landmark_that_comes_back_is_one_in_spite_of_drift(tmp_path: Path) -> None:
    """Dead reckoning is 0.3 m off by the time of the second pass: as far as the neighbour lies."""
    path = there_and_back()
    off = np.linspace(0, 1, len(path))[:, None] * (4.0, 0.3, -0.1)
    folder = results(tmp_path / "dive", path, path + off)
    assert len(map_rows(folder)) > 3  # as exact poses these are other landmarks
    map_rows(folder, "--drift", "0.4,5")
    assert columns(folder, "landmark", "passes") == [("1", "2"), ("1", "2"), ("2", "2")]


def measured(
    folder: Path, path: FloatArray, sigma: Sequence[float], lost: int | None = None
) -> None:
    """Replace frames.csv by one with the motion measured between frames."""
    head = ["frame", "timestamp_ns", "dx_m", "dy_m", "dyaw_deg"]
    head += ["dx_sigma_m", "dy_sigma_m", "dyaw_sigma_deg"]
    rows = []
    for n, pose in enumerate(path):
        yaw, x, y = path[max(n - 1, 0)]
        cos, sin = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
        dx, dy = pose[1:] - (x, y)
        moved = dx * cos - dy * sin, dx * sin + dy * cos, pose[0] - yaw
        told = ["nan"] * 3 if n == lost else [f"{v:.9f}" for v in moved]
        rows.append(dict(zip(head, (n, n * 10**8, *told, *sigma), strict=True)))
    write_rows(folder / "frames.csv", rows)


def test_without_poses_the_map_is_relative_to_the_first_frame(tmp_path: Path) -> None:
    path = there_and_back()
    folder = results(tmp_path / "dive", path, None)
    assert "--odometry" in sonarrec("map", folder, code=1).stderr
    sigma = (0.002, 0.002, 0.1)
    measured(folder, path, sigma)
    yaw, x, y = path[0]
    cos, sin = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    site = make_map([folder])
    assert len(site.landmarks) == 3
    for one in site.landmarks:
        right, ahead = one.position
        at = (x + right * cos + ahead * sin, y + ahead * cos - right * sin)
        disc = min(SITE, key=lambda d: math.dist(at, (d.x, d.y)))
        assert math.dist(at, (disc.x, disc.y)) < 0.05
        first = min(one_pass.row[0] for one_pass in one.members)
        # What is first seen later is placed less surely.
        assert np.sqrt(one.covariance[0, 0]) >= sigma[0] * math.sqrt(first)
    assert "2 times" not in sonarrec("map", folder, folder, code=3).stderr  # it is one
    other = results(tmp_path / "other", path, None)
    measured(other, path, sigma)
    # With another log each has a map of its own, where it would be if it were mapped alone.
    told = sonarrec("map", tmp_path, code=3)  # since frames.csv was written again
    assert told.stdout.count("1 log") == 2
    assert len(read_rows(other / "map" / "map.csv")) == 3
    sonarrec("map", folder, other, "-o", tmp_path / "both", code=3)
    assert {path.name for path in (tmp_path / "both").iterdir()} == {folder.name, "other"}
    several = ("map", folder, other, "-o", tmp_path / "c")
    assert "(dive, other)" in sonarrec(*several, "--origin", "54,10,0", code=2).stderr


def test_measured_motion_carries_as_far_as_it_is_known(tmp_path: Path) -> None:
    path = there_and_back()
    folder = results(tmp_path / "dive", path, None)
    measured(folder, path, (0.001, 0.001, 0.1), lost=60)
    assert "frame 60" in sonarrec("map", folder, code=3).stderr
    assert all(int(row["last_frame"]) < 60 for row in read_rows(folder / "map" / "passes.csv"))


# What others read


def earth(longitude: float, latitude: float) -> FloatArray:
    """(3,) Earth-centred coordinates on the ellipsoid of WGS 84, m."""
    lon, lat = math.radians(longitude), math.radians(latitude)
    n = 6378137 / math.sqrt(1 - 0.00669437999014 * math.sin(lat) ** 2)
    flat = n * math.cos(lat)
    up = n * (1 - 0.00669437999014) * math.sin(lat)
    return np.array([flat * math.cos(lon), flat * math.sin(lon), up])


def test_geojson_lies_where_the_map_says(mapped: Path) -> None:
    """By way of Earth-centred coordinates: distances and directions from the origin."""
    features = json.loads((mapped / "map.geojson").read_text())["features"]
    points = [f for f in features if f["geometry"]["type"] == "Point"]
    rows = read_rows(mapped / "map.csv")
    assert [f["properties"]["landmark"] for f in points] == [int(r["landmark"]) for r in rows]
    lat, lon = math.radians(54.3233), math.radians(10.1394)
    east = np.array([-math.sin(lon), math.cos(lon), 0])
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    north = np.cross(up, east)
    for feature, row in zip(points, rows, strict=True):
        away = earth(*feature["geometry"]["coordinates"]) - earth(10.1394, 54.3233)
        heading = math.degrees(math.atan2(away @ east, away @ north))
        x, y = float(row["x_m"]), float(row["y_m"])
        assert np.hypot(away @ east, away @ north) == pytest.approx(math.hypot(x, y), abs=2e-4)
        assert heading == pytest.approx(87 + math.degrees(math.atan2(x, y)), abs=0.01)
        turn = (90 + 87 - float(row["orientation_deg"])) % 360
        assert feature["properties"]["heading_deg"] == pytest.approx(turn, abs=0.02)
    others = [f["geometry"]["type"] for f in features if f not in points]
    assert sorted(others) == ["LineString", *["Polygon"] * len(rows)]


def test_an_ellipse_holds_what_it_says() -> None:
    covariance = np.array([[0.04, 0.01], [0.01, 0.02]])
    line = ellipse(np.array([1.0, 2.0]), covariance)
    off = line - (1, 2)
    squared = np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off)
    np.testing.assert_allclose(squared, CHI2_95)
    for one in (covariance, covariance * [[1, -1], [-1, 1]], np.diag([4, 1]), np.diag([1, 4])):
        x, y = ellipse(np.zeros(2), one).T
        assert (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() > 0  # counter-clockwise, as RFC 7946 asks
    drawn = np.random.default_rng(0).multivariate_normal([0, 0], covariance, 20_000)
    inside = np.einsum("ni,ij,nj->n", drawn, np.linalg.inv(covariance), drawn) < CHI2_95
    assert inside.mean() == pytest.approx(0.95, abs=0.006)


def test_the_picture_has_the_path_in_the_colours_of_the_ids_where_it_was(
    mapped: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: dict[str, np.ndarray] = {}
    plot = Axes.plot

    def kept(axes: Axes, x: Any, y: Any, *rest: Any, **more: Any) -> Any:
        drawn[more.get("label") or "other"] = np.column_stack([x, y])
        return plot(axes, x, y, *rest, **more)

    monkeypatch.setattr(Axes, "plot", kept)
    draw_map(mapped / "map.png", make_map([mapped.parent]))
    path = there_and_back()[:, 1:]
    np.testing.assert_allclose(drawn["path of the sonar"], path, atol=1e-6)
    np.testing.assert_allclose(drawn["first place of the sonar"], path[:1], atol=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("pictures")
def test_the_picture_shows_what_was_found_in_the_colours_of_the_ids(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import cv2

    added: list[PatchCollection] = []
    add = Axes.add_collection
    monkeypatch.setattr(
        Axes, "add_collection", lambda axes, *a, **k: added.append(a[0]) or add(axes, *a, **k)
    )
    folder = results(tmp_path / "dive", there_and_back(20), there_and_back(20))
    sonarrec("map", folder)
    lit = [one for one in added if isinstance(one, PatchCollection)][1::2]
    inks = [tuple(np.round(255 * one.get_facecolor()[0, :3]).astype(int).tolist()) for one in lit]
    assert inks == [landmark_colours(BASIN.ids)[disc.id] for disc in SITE]
    # What is lit of each, halfway out, is what its ID says at its orientation.
    for disc, row, patches in zip(SITE, read_rows(folder / "map" / "map.csv"), lit, strict=True):
        angle = np.radians(np.arange(2.5, 360, 5))
        paths = patches.get_paths()[1:]  # the first is the ring
        code = BASIN.codes(angle - math.radians(float(row["orientation_deg"])))
        place = np.array([float(row["x_m"]), float(row["y_m"])])
        points = place + 0.4 * BASIN.radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
        shown = np.any([path.contains_points(points) for path in paths], axis=0)
        expected = code[BASIN.ids.index(disc.id)] > 0.5
        assert np.mean(shown == expected) > 0.94  # but at the edges of sectors
    picture = cv2.imread(str(folder / "map" / "map.png"))
    assert picture is not None
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


# Poses of a topic


def test_the_frame_of_a_topic_is_as_ros_has_it(tmp_path: Path) -> None:
    """x ahead, y to the left, angles counter-clockwise from the x axis."""
    path = there_and_back()
    log = tmp_path / "dive.mcap"
    odometry_log(log, path)
    ros = results(tmp_path / "dive", path, None, odometry={"topic": "/odom"})
    plain = results(tmp_path / "plain", path, path)
    for one, other in zip(map_rows(ros), map_rows(plain), strict=True):
        assert float(one["x_m"]) == pytest.approx(float(other["y_m"]), abs=2e-4)
        assert float(one["y_m"]) == pytest.approx(-float(other["x_m"]), abs=2e-4)
        assert float(one["xx_m2"]) == pytest.approx(float(other["yy_m2"]), rel=1e-2)
        assert float(one["xy_m2"]) == pytest.approx(-float(other["xy_m2"]), rel=5e-2, abs=1e-8)
        period = 180 if one["landmark"] == "2" else 360
        turn = float(other["orientation_deg"]) - 90 - float(one["orientation_deg"])
        assert math.remainder(turn, period) == pytest.approx(0, abs=0.05)
    bag = tmp_path / "bag"
    bag.mkdir()
    log.rename(bag / "bag_0.mcap")
    assert "dive.mcap" in sonarrec("map", ros, code=2).stderr
    sonarrec("map", ros, "--odometry", write_poses(tmp_path / "poses.csv", path))
    run = ros / "run.toml"
    run.write_text(run.read_text().replace(str(log), str(bag)))
    assert len(map_rows(ros)) == 3


def odometry_log(log: Path, path: FloatArray) -> None:
    """An MCAP of the poses alone, as ROS has them."""
    name = "geometry_msgs/msg/PoseStamped"
    messages = []
    for n, (yaw, x, y) in enumerate(path.tolist()):
        half = -math.radians(yaw) / 2
        turned = {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)}
        pose = {"position": {"x": y, "y": -x, "z": 0.0}, "orientation": turned}
        header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "map"}
        data = serialised(name, {"header": header, "pose": pose})
        messages.append(("/odom", round(n * 1e9 / RATE), data))
    mcap_file(log, messages, schema=name, schema_data=definition(name))


# Faults


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ("--origin 54,10", "3 numbers"),
        ("--origin 90,10,0", "LAT"),
        ("--drift 0.1", "2 numbers"),
        ("--method nobody", "'nobody'"),
    ],
)
def test_faults_are_one_line(options: str, told: str, dive: Path) -> None:
    done = sonarrec("map", dive, *options.split(), code=2)
    assert told in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (dive / "map").exists()


@pytest.mark.parametrize(("here", "named"), [("dive", "."), ("dive/sub", "..")])
def test_poses_are_found_from_wherever_the_results_are_named(here, named, dive, monkeypatch):
    """They lie beside the results; the log is elsewhere."""
    told = (dive / "run.toml").read_text()
    log = str(dive.parent / "dive.mcap")
    assert log in told
    (dive / "run.toml").write_text(told.replace(log, "elsewhere/dive.mcap"))
    (dive / "sub").mkdir()
    monkeypatch.chdir(dive.parent / here)
    sonarrec("map", named)
    assert read_rows(dive / "map" / "map.csv")


def test_what_is_left_out_is_told(dive: Path) -> None:
    """Poses end early; ten estimates are nearer than the floor, one of these without a pose."""
    rows = read_rows(dive / "estimates.csv")
    end = int(rows[-1]["frame"]) - 5
    late = [row for row in rows if int(row["frame"]) >= end]
    for row in [late[0], *rows[:9]]:
        row["range_m"] = "0.6"
    write_rows(dive / "estimates.csv", rows)
    early = write_poses(dive.parent / "early.csv", there_and_back()[:end])
    said = sonarrec("map", dive, "--odometry", early, code=3).stderr
    assert f"{dive}: {len(late) + 9} of {len(rows)} " in said


def test_poses_in_a_folder_of_their_own_are_found(dive: Path) -> None:
    """As given by `--odometry poses/dive.poses.csv`."""
    (dive.parent / "poses").mkdir()
    (dive.parent / "dive.poses.csv").rename(dive.parent / "poses" / "dive.poses.csv")
    sonarrec("map", dive)
    deep = dive.parent / "far" / "deep"
    deep.mkdir(parents=True)
    (dive.parent / "poses" / "dive.poses.csv").rename(deep / "dive.poses.csv")
    assert "--odometry" in sonarrec("map", dive, code=1).stderr


def test_poses_that_changed_are_refused(dive: Path) -> None:
    moved = write_poses(dive.parent / "dive.poses.csv", there_and_back() + 1)
    assert "changed" in sonarrec("map", dive, code=1).stderr
    sonarrec("map", dive, "--odometry", moved.rename(dive.parent / "elsewhere.csv"))


def test_one_log_that_cannot_be_mapped_costs_itself_only(tmp_path: Path) -> None:
    path = there_and_back()
    results(tmp_path / "out" / "good", path, path)
    bad = results(tmp_path / "out" / "bad", path, None)
    assert f"{bad}: " in sonarrec("map", tmp_path / "out", code=3).stderr
    assert len(read_rows(tmp_path / "out" / "map" / "map.csv")) == 3
    with pytest.raises(SonarrecError, match="neither poses"):
        make_map([bad])
    with pytest.raises(UsageError, match="none"):
        make_map([bad], drift=Drift(1, 1))


@pytest.mark.usefixtures("pictures")
def test_the_report_shows_the_map(mapped: Path) -> None:
    page = mapped.parent / "report.html"
    sonarrec("report", mapped.parent, code=3)  # there is no log
    picture = base64.b64encode((mapped / "map.png").read_bytes()).decode()
    assert f'src="data:image/png;base64,{picture}"' in page.read_text()
    for path in mapped.iterdir():
        path.unlink()
    sonarrec("report", mapped.parent, code=3)
    assert "image/png" not in page.read_text()


@pytest.mark.parametrize("same", [1, 3])
def test_the_standard_error_of_an_orientation(same: int) -> None:
    """Errors of a pass are common in part: of the mean, weighted by precision, not its root."""
    sigma = np.repeat([2.0, 5.0, 9.0], same)
    weight = sigma**-2 / (sigma**-2).sum()
    own = (weight**2 * sigma**2).sum() * min(SAME_FRAMES, len(sigma))
    common = (weight * sigma).sum() ** 2
    wanted = (1 - COMMON_SHARE) * own + COMMON_SHARE * common + LEAST_ORIENTATION_DEG**2
    found = _mean_orientation(np.full(len(sigma), 40.0), sigma, 360.0)
    assert found == (pytest.approx(40), pytest.approx(math.sqrt(wanted)))


def test_the_map_draws_symbols_as_they_lie() -> None:
    sectors = np.array(BASIN.sectors[0])
    dark, bright = _drawing(BASIN, 0, np.array([2.0, 3.0]), 30.0)
    ring, *wedges = bright
    assert len(wedges) == sum(sectors)
    assert all(w.theta2 - w.theta1 == pytest.approx(360 / len(sectors)) for w in wedges)
    starts = 30 + np.flatnonzero(sectors) * 360 / len(sectors)
    assert [w.theta1 % 360 for w in wedges] == pytest.approx(starts % 360)
    assert ring.r == pytest.approx(BASIN.radius_m * BASIN.ring[1])
    assert len(_drawing(BASIN, 0, np.array([2.0, 3.0]), math.nan)[1]) == 1
    assert dark[0].r == BASIN.radius_m


def test_a_common_error_of_rotations_turns_what_is_seen_about_the_sonar() -> None:
    """A sonar that stands and pans by 4 x 3 deg, each by a share too much."""
    frames = np.arange(5)
    moved = np.column_stack([np.full(5, 3.0), np.zeros((5, 2))])
    path = measured_path(frames, frames, 0 * frames, moved, np.zeros((5, 3)))
    position = np.array([[0.7, 2.1], [-1.2, 1.5]])
    angle = COMMON_ROTATION * np.radians([12.0, 6.0])
    off = angle[:, None] * position[:, ::-1] * (1, -1)
    found = path.position_covariance(np.array([4, 2]), position)
    assert found == pytest.approx(off[:, :, None] * off[:, None])
    since = path.position_covariance(np.array([4, 4]), position, np.array([4, 0]))
    assert since == pytest.approx(np.stack([np.zeros((2, 2)), 4 * found[1]]))
