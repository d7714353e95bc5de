"""COCO annotations become gt.csv: labels to IDs, images to frames, centres to fan pixels."""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.readers import open_log
from sonarrec.sonar.geometry import floor_depth, polar_from_pixel
from sonarrec.sonar.stated import Sonar
from sonarrec.truth.match import share_in_image
from tests.support.command import sonarrec
from tests.support.drawn import make_fan
from tests.support.logs import frames, image_folder
from tests.support.rows import read_rows

Row = tuple[int, int, float, float, float]
BBOX = {"category_id": 1, "bbox": [10, 20, 4, 6]}


def converted(source: Path, *more: str | Path, code: int = 0) -> list[Row]:
    out = source.with_name("gt.csv")
    out.unlink(missing_ok=True)
    sonarrec("truth", "convert", source, "--out", out, *more, code=code)
    return [
        (
            int(r["frame"]),
            int(r["landmark"]),
            float(r["x_px"]),
            float(r["y_px"]),
            float(r["visible"]),
        )
        for r in read_rows(out)
    ]


def failure(source: Path, *more: str | Path, code: int = 1) -> str:
    """The one line said of a fault; no gt.csv may have been written."""
    out = source.parent / "nothing.csv"
    done = sonarrec("truth", "convert", source, "--out", out, *more, code=code)
    assert not out.exists()
    (line,) = done.stderr.splitlines()
    return line


def coco(
    folder: Path,
    annotations: list[dict[str, Any]],
    names: list[str],
    size: tuple[int, int] = (100, 80),
    labels: tuple[str, ...] = ("ID.1", "disc north"),
) -> Path:
    """A document; images have the ids 7, 8, ... and labels 1, 2, ..."""
    columns, rows = size
    document = {
        "images": [
            {"id": 7 + n, "file_name": name, "width": columns, "height": rows}
            for n, name in enumerate(names)
        ],
        "annotations": [{"id": n} | one for n, one in enumerate(annotations)],
        "categories": [{"id": n, "name": name} for n, name in enumerate(labels, 1)],
    }
    path = folder / "coco.json"
    path.write_text(json.dumps(document))
    return path


def point(x: float, y: float) -> dict[str, Any]:
    """An annotation at a place between pixels, as tools count: the corner is (0, 0)."""
    return {"image_id": 7, "category_id": 1, "bbox": [x - 1, y - 1, 2, 2]}


def test_centres_and_visibility(tmp_path: Path) -> None:
    """Of a box, of a polygon's area wherever its points crowd, of the only labelled keypoint."""
    square = [10, 10, 12, 10, 13, 10, 14, 10, 20, 10, 20, 20, 10, 20]
    annotations = [
        BBOX | {"image_id": 7, "iscrowd": 0},
        {"image_id": 8, "category_id": 1, "bbox": [0, 0, 1, 1], "segmentation": [square]},
        {"image_id": 8, "category_id": 2, "bbox": [0, 0, 9, 9], "keypoints": [5, 6, 1, 0, 0, 0]},
        {"image_id": 8, "category_id": 2, "bbox": [0, 0, 9, 9], "attributes": {"occluded": True}},
        {"image_id": 7, "category_id": 1, "bbox": [0, 0, 9, 9], "iscrowd": 1},
        {"image_id": 7, "category_id": 1, "bbox": [0, 0, 0, 0]},
    ]
    source = coco(tmp_path, annotations, ["a_0.png", "a_5.png"])
    assert converted(source, "--map", "disc north=4", code=3) == [
        (0, 1, 11.5, 22.5, 1.0),
        (5, 1, 14.5, 14.5, 1.0),
        (5, 4, 4.0, 4.0, 0.5),
        (5, 4, 5.0, 6.0, 0.5),
    ]


@pytest.mark.parametrize("label", ["3", "ID.3", " Landmark 3 "])
def test_labels_that_show_their_id(tmp_path: Path, label: str) -> None:
    source = coco(tmp_path, [BBOX | {"image_id": 7}], ["0.png"], labels=(label,))
    assert converted(source)[0][1] == 3


@pytest.mark.parametrize("label", ["tyre 1", "ID.1 fake", "ID.7", ""])
def test_other_labels_need_a_map(tmp_path: Path, label: str) -> None:
    source = coco(tmp_path, [BBOX | {"image_id": 7}], ["0.png"], labels=(label,))
    assert "nothing can be used" in failure(source)
    assert repr(label) in failure(source)
    if label:
        assert converted(source, "--map", f"{label}=none") == []
        assert converted(source, "--map", f"{label}=2")[0][1] == 2


@pytest.mark.parametrize(
    ("given", "named"), [("north=1", "north"), ("disc north=9", "9"), ("disc north", "--map")]
)
def test_maps_that_cannot_be_meant(tmp_path: Path, given: str, named: str) -> None:
    source = coco(tmp_path, [BBOX | {"image_id": 7, "category_id": 2}], ["0.png"])
    assert named in failure(source, "--map", given, code=2)


def test_frames_by_name_in_the_log(tmp_path: Path) -> None:
    """Whatever the numbers in the names say, and with another suffix and folder."""
    stored = ["b30.png", "b4.png", "a99.png", "c1.png"]
    log = image_folder(tmp_path / "log", frames(4, 80, 100), names=stored)
    names = ["task/c1.jpg", "task/b4.jpg", "task/elsewhere9.jpg"]
    annotations = [BBOX | {"image_id": 7 + n} for n in range(3)]
    source = coco(tmp_path, annotations, names)
    found = converted(source, "--log", log, code=3)
    assert [row[0] for row in found] == [1, 3]
    other = coco(tmp_path, annotations[:1], ["ping2.png"])
    assert "ping2.png" in failure(other, "--log", log)


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["ping_10.png", "ping_9.png", "x/y7.png"], [10, 9, 7]),
        (["b_first.png", "c.png", "a.png"], [1, 2, 0]),
        ([f"p{n}_png.rf.0aB12cd{n}9.jpg" for n in (4, 2, 3)], [4, 2, 3]),
        ([f"up/0a{n}b3c4d-ping_{n}.png" for n in (4, 2, 3)], [4, 2, 3]),
    ],
)
def test_frames_without_a_log(tmp_path: Path, names: list[str], numbers: list[int]) -> None:
    """By the number at the end of every name, else by their order; hashes of tools do not count."""
    boxes = [{"image_id": 7 + n, "category_id": 1, "bbox": [n, 0, 2, 2]} for n in range(3)]
    source = coco(tmp_path, boxes, names)
    found = {round(row[2] - 0.5): row[0] for row in converted(source)}
    assert [found[n] for n in range(3)] == numbers
    if names[0] == "ping_10.png":
        assert {row[0] for row in converted(source, "--first-frame", "7")} == {0, 2, 3}
        failure(source, "--first-frame", "8")
    failure(coco(tmp_path, boxes, ["a_1.png", "b_1.png", "c_2.png"]))


@pytest.mark.parametrize(
    "text",
    [
        "<annotations/>",
        "[]",
        "{}",
        json.dumps({"images": [{"id": 1}], "annotations": [], "categories": []}),
        json.dumps({"images": [], "annotations": [BBOX | {"image_id": 1}], "categories": []}),
        '{"images": ' + "[" * 100_000,
    ],
)
def test_what_is_not_coco_is_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    assert str(path) in failure(path)


def test_an_existing_truth_is_never_written_over(tmp_path: Path) -> None:
    source = coco(tmp_path, [BBOX | {"image_id": 7}], ["0.png"])
    (tmp_path / "gt.csv").write_text("mine")
    sonarrec("truth", "convert", source, "--out", tmp_path / "gt.csv", code=1)
    assert (tmp_path / "gt.csv").read_text() == "mine"


# --- Positions and visibility --------------------------------------------------------------------


def test_visible_is_limited_by_the_fan(tmp_path: Path) -> None:
    """On the fan's right edge, half of the disc; well outside, nothing; in the middle, all."""
    log = image_folder(tmp_path / "log", frames(2, 300, 560))
    small = coco(tmp_path, [point(9, 9)], ["frame0.png"])
    assert "another size" in failure(small, "--log", log)
    fan = make_fan()  # the same geometry on 300 rows
    edge = math.radians(fan.bearing_max_deg)
    pixels_away = 2.4 / fan.metres_per_pixel
    x = 279.5 + pixels_away * math.sin(edge)
    y = fan.apex_row - pixels_away * math.cos(edge)
    shapes = [point(a + 0.5, b + 0.5) for a, b in ((279.5, 150.0), (x, y), (x + 60, y))]
    source = coco(tmp_path, shapes, ["frame0.png"], (560, 300))
    rows = sorted(converted(source, "--log", log), key=lambda row: row[2])
    assert [row[4] for row in rows] == pytest.approx([1.0, 0.5, 0.0], abs=0.01)
    with (log / "sonar.toml").open("a") as file:
        file.write("flip = true\n")
    mirrored = sorted(converted(source, "--log", log), reverse=True)
    assert sorted(559 - row[2] for row in mirrored) == pytest.approx([row[2] for row in rows])


@settings(max_examples=30)
@given(st.floats(1.6, 3.4), st.floats(-16, 16), st.floats(0.05, 0.2))
def test_share_inside_a_bearing_edge_is_a_circular_segment(
    range_m: float, bearing_deg: float, radius_m: float
) -> None:
    """Seen from above the fan's sides are straight lines through the sonar."""
    fan = make_fan(range_min_m=0.8, range_max_m=4.5)
    ground = math.sqrt(range_m**2 - floor_depth(fan) ** 2)
    expected = -1.0
    for edge in (fan.bearing_max_deg - bearing_deg, bearing_deg - fan.bearing_min_deg):
        d = np.clip(ground * math.sin(math.radians(edge)) / radius_m, -1, 1)
        expected += 1 - (math.acos(d) - d * math.sqrt(1 - d * d)) / math.pi
    share = share_in_image(fan, np.array([range_m]), np.array([bearing_deg]), radius_m)
    assert share[0] == pytest.approx(max(expected, 0), abs=0.01)  # 500 points


UNEVEN = (-13.0, -8, -5, -3, -1, 0, 1, 2, 4, 7, 10, 14)
RANGES_M = tuple(1.25 + 2.5 * ((n + 0.5) / 200) ** 1.3 for n in range(200))


@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"flip": True},
        {"bearings_deg": UNEVEN[::-1], "ranges_m": RANGES_M},
        {"range_order": "far_first", "beam_order": "beam-major"},
    ],
)
def test_shapes_on_polar_images_are_moved_to_the_fan(tmp_path: Path, keys: dict[str, Any]) -> None:
    """A bright sample of the polar image lies in the fan where its annotation says, and beyond the
    image's edges its steps of bearing and range go on."""
    beams = len(keys.get("bearings_deg", range(96)))
    sonar = Sonar("polar", 1.25, 3.75, 28.8, 20.0, 0.68, **keys)
    text = "\n".join(f"{k} = {json.dumps(v)}" for k, v in sonar.as_table().items())
    log = image_folder(tmp_path / "log", [])
    (log / "sonar.toml").write_text(f"[sonar]\n{text}\n")
    turned = "beam_order" in keys
    for column, row in ((beams // 3, 120), (beams // 2, 50)):
        x, y = (row + 0.5, column + 0.5) if turned else (column + 0.5, row + 0.5)
        size = (200, beams) if turned else (beams, 200)
        source = coco(tmp_path, [point(x, y)], ["0.png"], size)
        polar = np.zeros((200, beams), np.uint8)
        polar[row, column] = 255
        cv2.imwrite(str(log / "0.png"), polar.T if turned else polar)
        ((_, _, x, y, _),) = converted(source, "--log", log)
        with open_log(log) as opened:
            frame = next(iter(opened))
        # The brightest fan pixels: between uneven beams the spot is not symmetric about its peak.
        fan = frame.image.astype(float)
        rows, columns = np.nonzero(fan > 0.9 * fan.max())
        assert (columns.mean(), rows.mean()) == pytest.approx((x, y), abs=1.0)
    if set(keys) <= {"flip"}:
        source = coco(tmp_path, [point(-3, 120)], ["0.png"], (96, 200))
        ((_, _, x, y, _),) = converted(source, "--log", log)
        found = polar_from_pixel(frame.fan, np.array([x]), np.array([y]))
        bearing = (1 if keys else -1) * 51 * 0.3
        assert np.ravel(found) == pytest.approx((1.25 + 120 * 0.0125, bearing), abs=0.02)


@pytest.mark.parametrize("with_log", [False, True])
def test_videos_that_share_the_names_of_their_images(with_log: bool, tmp_path: Path) -> None:
    """The annotations of both would come to lie on the same frames."""
    names = [f"frame{k}.png" for k in range(3)]
    annotations = [BBOX | {"image_id": 7}, BBOX | {"image_id": 10}]
    source = coco(tmp_path, annotations, [*names, *names])
    more = ("--log", image_folder(tmp_path / "log", frames(3))) if with_log else ()
    assert "frame0.png" in failure(source, *more)


def test_a_sheet_or_a_table_is_told_what_it_needs(tmp_path: Path) -> None:
    sheet, table = tmp_path / "labels.xlsx", tmp_path / "labels.csv"
    with zipfile.ZipFile(sheet, "w") as file:
        file.writestr("[Content_Types].xml", "<Types/>")
    table.write_text("frame,landmark,x_px,y_px\n0,1,5,6\n")
    assert "save it as CSV" in failure(sheet)
    for path in (sheet, table):
        assert "needs no conversion" in failure(path)
