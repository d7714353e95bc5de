"""COCO annotations become gt.csv, and truth becomes COCO that other tools read: labels to IDs,
images to frames, centres to fan pixels, discs to boxes."""

from __future__ import annotations

import json
import math
import re
import shutil
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from sonarrec.readers import open_log
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import floor_depth, pixel_from_polar, polar_from_pixel
from sonarrec.sonar.stated import Sonar
from sonarrec.truth.match import share_in_image
from tests.support.command import SAMPLE, sonarrec
from tests.support.drawn import make_fan
from tests.support.estimates import csv_file
from tests.support.logs import frames, image_folder
from tests.support.rows import read_rows, write_rows

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
    """A document; images have the ids 7, 8, ... (annotations are of 7) and labels 1, 2, ..."""
    columns, rows = size
    document = {
        "images": [
            {"id": 7 + n, "file_name": name, "width": columns, "height": rows}
            for n, name in enumerate(names)
        ],
        "annotations": [{"id": n, "image_id": 7} | one for n, one in enumerate(annotations)],
        "categories": [{"id": n, "name": name} for n, name in enumerate(labels, 1)],
    }
    path = folder / "coco.json"
    path.write_text(json.dumps(document))
    return path


def point(x: float, y: float) -> dict[str, Any]:
    """An annotation at a place between pixels, as tools count: the corner is (0, 0)."""
    return BBOX | {"bbox": [x - 1, y - 1, 2, 2]}


def test_centres_and_visibility(tmp_path: Path) -> None:
    """Of a box, of a polygon's area wherever its points crowd, of the only labelled keypoint."""
    square = [10, 10, 12, 10, 13, 10, 14, 10, 20, 10, 20, 20, 10, 20, 99]  # one half of a point
    annotations = [
        BBOX | {"iscrowd": 0},
        {"image_id": 8, "category_id": 1, "bbox": [0, 0, 1, 1], "segmentation": [square]},
        {"image_id": 8, "category_id": 2, "bbox": [0, 0, 9, 9], "keypoints": [5, 6, 1, 0, 0, 0]},
        {"image_id": 8, "category_id": 2, "bbox": [0, 0, 9, 9], "attributes": {"occluded": True}},
        BBOX | {"iscrowd": 1},
        BBOX | {"bbox": [0, 0, 0, 0]},
    ]
    source = coco(tmp_path, annotations, ["a_0.png", "a_5.png"])
    assert converted(source, "--map", "disc north=4", code=3) == [
        (0, 1, 11.5, 22.5, 1.0),
        (5, 1, 14.5, 14.5, 1.0),
        (5, 4, 4.0, 4.0, 0.5),
        (5, 4, 5.0, 6.0, 0.5),
    ]


@pytest.mark.parametrize("label", ["3", "ID.3", " Landmark 3 ", "tyre 1", "ID.1 fake", "ID.7", ""])
def test_labels_show_their_id_or_need_a_map(tmp_path: Path, label: str) -> None:
    source = coco(tmp_path, [BBOX], ["0.png"], labels=(label,))
    if "3" in label:
        assert converted(source)[0][1] == 3
        return
    assert repr(label) in failure(source)
    if label:
        assert converted(source, "--map", f"{label}=none") == []
        assert converted(source, "--map", f"{label}=2")[0][1] == 2


@pytest.mark.parametrize(
    ("given", "named"), [("north=1", "north"), ("disc north=9", "9"), ("disc north", "--map")]
)
def test_maps_that_cannot_be_meant(tmp_path: Path, given: str, named: str) -> None:
    source = coco(tmp_path, [BBOX | {"category_id": 2}], ["0.png"])
    assert named in failure(source, "--map", given, code=2)


def test_frames_by_name_in_the_log(tmp_path: Path) -> None:
    """Whatever the numbers in the names say, and with another suffix and folder."""
    stored = ["b30.png", "b4.png", "a99.png", "c1.png"]
    log = image_folder(tmp_path / "log", frames(4, 80, 100), names=stored)
    names = ["task/c1.jpg", "task/b4.jpg", "task/elsewhere9.jpg"]
    annotations = [point(50, 40) | {"image_id": 7 + n} for n in range(3)]
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
    source = coco(tmp_path, [BBOX], ["0.png"])
    (tmp_path / "gt.csv").write_text("mine")
    sonarrec("truth", "convert", source, "--out", tmp_path / "gt.csv", code=1)
    assert (tmp_path / "gt.csv").read_text() == "mine"


def test_visible_is_limited_by_the_fan(tmp_path: Path) -> None:
    """On the fan's right edge, half of the disc; in the middle, all; well outside it is told."""
    log = image_folder(tmp_path / "log", frames(2, 300, 560))
    of_another_size = failure(coco(tmp_path, [point(9, 9)], ["frame0.png"]), "--log", log)
    assert {"100 x 80", "560 x 300"} <= {*re.findall(r"\d+ x \d+", of_another_size)}
    fan = make_fan()  # the same geometry on 300 rows
    edge = math.radians(fan.bearing_max_deg)
    pixels_away = 2.4 / fan.metres_per_pixel
    x = 279.5 + pixels_away * math.sin(edge)
    y = fan.apex_row - pixels_away * math.cos(edge)
    shapes = [point(a + 0.5, b + 0.5) for a, b in ((279.5, 150.0), (x, y), (x + 60, y))]
    source = coco(tmp_path, shapes, ["frame0.png"], (560, 300))
    rows = sorted(converted(source, "--log", log, code=3), key=lambda row: row[2])
    assert [row[4] for row in rows] == pytest.approx([1.0, 0.5], abs=0.01)
    with (log / "sonar.toml").open("a") as file:
        file.write("flip = true\n")
    mirrored = sorted(converted(source, "--log", log, code=3), reverse=True)
    assert sorted(559 - row[2] for row in mirrored) == pytest.approx([row[2] for row in rows])


@pytest.mark.parametrize("with_log", [False, True])
def test_boxes_given_by_two_corners_are_told_and_left_out(tmp_path: Path, with_log: bool) -> None:
    log = image_folder(tmp_path / "log", frames(2, 300, 560))
    boxes = [[270, 140, 20, 20], [400, 180, 420, 200], [300, 200, 330, 230]]
    source = coco(tmp_path, [BBOX | {"bbox": box} for box in boxes], ["frame0.png"], (560, 300))
    out, given = tmp_path / "new.csv", ["--log", log] if with_log else []
    told = sonarrec("truth", "convert", source, "-o", out, *given, code=3).stderr
    assert "2 of 3" in told
    assert "corners" in told
    assert [float(row["x_px"]) for row in read_rows(out)] == pytest.approx([279.5])
    # Of boxes alone that are outside nothing is written.
    outside = coco(tmp_path, [BBOX | {"bbox": boxes[1]}], ["frame0.png"], (560, 300))
    assert "corners" in failure(outside, *given)


@settings(max_examples=30)
@given(st.floats(1.6, 3.4), st.floats(-16, 16), st.floats(0.05, 0.2))
def test_an_edge_cuts_a_segment(range_m: float, bearing_deg: float, radius_m: float) -> None:
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
    annotations = [BBOX, BBOX | {"image_id": 10}]
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


# Truth as COCO, and back


SAMPLES = SAMPLE.parent
RADIUS_M = 0.15
FAN = {"layout": "fan", "range_min_m": 1.25, "range_max_m": 3.75, "field_of_view_deg": 28.8}
POLAR = FAN | {"layout": "polar"}
LOGS: dict[str, dict[str, Any]] = {
    "fan": FAN,
    "flipped fan": FAN | {"flip": True},
    "fan upside down": FAN | {"range_order": "near_first"},
    "wide": FAN | {"field_of_view_deg": 130.0},
    "polar": POLAR,
    "wide polar": POLAR | {"field_of_view_deg": 130.0},
    "flipped polar": POLAR | {"flip": True, "range_order": "far_first"},
    "beams as rows": POLAR | {"beam_order": "beam-major"},
    "uneven beams": POLAR | {"bearings_deg": UNEVEN[::-1], "ranges_m": RANGES_M},
}


def make_log(folder: Path, keys: dict[str, Any], count: int = 4) -> Path:
    """Images of noise with this geometry: only their size matters."""
    folder.mkdir(parents=True)
    columns = len(keys.get("bearings_deg", range(96)))
    rows = 200
    if keys["layout"] == "fan":
        half = math.sin(math.radians(keys["field_of_view_deg"] / 2)) * keys["range_max_m"]
        columns = 2 * int(half / (2.5 / rows)) + 1
    for k, image in enumerate(frames(count, rows, columns)):
        stored = image.T if "beam_order" in keys else image
        assert cv2.imwrite(str(folder / f"ping{7 * k + 3}.png"), stored)
    text = "\n".join(f"{k} = {json.dumps(v)}" for k, v in (keys | {"height_m": 0.68}).items())
    (folder / "sonar.toml").write_text(f"[sonar]\n{text}\nframe_rate_hz = 4\ntilt_deg = 20\n")
    return folder


def fan_of(log: Path) -> Fan:
    with open_log(log) as opened:
        return next(iter(opened)).fan


def read_back(log: Path, truth: Path, *more: str, code: int = 0) -> list[dict[str, str]]:
    """The rows of a truth that went to COCO and back."""
    document, again = truth.with_suffix(".json"), truth.with_suffix(".again.csv")
    for path in (document, again):
        path.unlink(missing_ok=True)
    sonarrec("truth", "convert", truth, "--log", log, "--to", "coco", "-o", document)
    sonarrec("truth", "convert", document, "--log", log, "-o", again, *more, code=code)
    return read_rows(again)


def same(row: dict[str, str], other: dict[str, str]) -> bool:
    """Equal cells, of pixels to the two decimals that are written."""
    places = ("x_px", "y_px")
    return all(abs(float(row[c]) - float(other[c])) < 0.0051 for c in places) and all(
        row.get(c, "") == other.get(c, "") for c in {*row, *other} - {*places}
    )


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    place = tmp_path_factory.mktemp("logs")
    return {name: make_log(place / name, keys) for name, keys in LOGS.items()}


row = st.fixed_dictionaries(
    {
        "frame": st.integers(0, 3),
        "landmark": st.sampled_from(["1", "2", "3", "4", "none"]),
        "range_m": st.floats(1.1, 3.9),
        "share": st.floats(-0.53, 0.53),
        "visible": st.floats(0, 1),
        "orientation_deg": st.one_of(st.just(""), st.integers(0, 3599).map(lambda n: str(n / 10))),
        "track": st.sampled_from(["", "7", "12", "left one"]),
        "source": st.sampled_from(["", "tracked"]),
    }
)


@settings(max_examples=4, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("name", LOGS)
@given(st.lists(row, min_size=1, max_size=8, unique_by=lambda r: r["range_m"]))
def test_the_same_rows_come_back(
    logs: dict[str, Path], tmp_path: Path, name: str, rows: list[dict[str, Any]]
) -> None:
    fan = fan_of(logs[name])
    width = fan.bearing_max_deg - fan.bearing_min_deg
    bearings = np.array([fan.bearing_min_deg + (r["share"] + 0.5) * width for r in rows])
    ranges = np.array([r["range_m"] for r in rows])
    assume((share_in_image(fan, ranges, bearings, RADIUS_M) > 0).all())
    x, y = pixel_from_polar(fan, ranges, bearings)
    columns = ["frame", "landmark", "x_px", "y_px", "visible", "orientation_deg", "track", "source"]
    stated = []
    for n, r in enumerate(rows):
        cells = {"x_px": f"{x[n]:.2f}", "y_px": f"{y[n]:.2f}", "visible": f"{r['visible']:.3f}"}
        stated.append({c: str((r | cells)[c]) for c in columns})
    write_rows(tmp_path / "gt.csv", stated)
    found = read_back(logs[name], tmp_path / "gt.csv")
    assert len(found) == len(stated)
    for one in stated:
        assert any(same(one, other) for other in found), (one, found)


@pytest.mark.parametrize("log", ["pan", "pan.mcap", "polar"])
def test_the_truth_of_the_samples_comes_back(tmp_path: Path, log: str) -> None:
    own = SAMPLES / ("polar/gt.csv" if log == "polar" else "pan.gt.csv")
    truth = Path(shutil.copy(own, tmp_path / "gt.csv"))
    found = read_back(SAMPLES / log, truth)
    stated = read_rows(truth)
    assert len(found) == len(stated) > 100
    for one, other in zip(stated, found, strict=True):
        cells = {c: v for c, v in one.items() if c not in ("range_m", "bearing_deg")}
        assert same(cells | {"visible": f"{float(one['visible']):.3f}"}, other)


def test_positions_may_be_stated_in_metres_and_frames_by_time(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log", FAN)
    lines = ["timestamp_ns,landmark,range_m,bearing_deg", "500000000,ID.3,2.5,-4", "0,1,2,3"]
    found = read_back(log, csv_file(tmp_path / "gt.csv", *lines))
    cells = [(one["frame"], one["landmark"], one["visible"]) for one in found]
    assert cells == [("0", "1", "1.000"), ("2", "3", "1.000")]
    fan = fan_of(log)
    for one, place in zip(found, ((2.0, 3.0), (2.5, -4.0)), strict=True):
        back = polar_from_pixel(fan, float(one["x_px"]), float(one["y_px"]))
        assert np.ravel(back) == pytest.approx(place, abs=0.02)


# What other programs find in the file


def document_of(log: Path, truth: Path, *, code: int = 0) -> dict[str, Any]:
    out = truth.with_suffix(".json")
    sonarrec("truth", "convert", truth, "--log", log, "--to", "coco", "-o", out, code=code)
    return json.loads(out.read_text())


@pytest.mark.parametrize("name", ["fan", "wide", "polar"])
def test_a_box_holds_the_whole_disc_and_no_more(tmp_path: Path, name: str) -> None:
    """By points of its edge on the floor, in the images as they are stored."""
    log = make_log(tmp_path / "log", LOGS[name])
    truth = csv_file(tmp_path / "gt.csv", "frame,landmark,range_m,bearing_deg", "2,1,2.2,6")
    document = document_of(log, truth)
    (image,) = (one for one in document["images"] if one["file_name"] == "ping17.png")
    (box,) = document["annotations"]
    stored = cv2.imread(str(log / "ping17.png"), cv2.IMREAD_GRAYSCALE)
    assert stored is not None
    assert (image["height"], image["width"]) == stored.shape
    assert box["image_id"] == image["id"]
    ground = math.sqrt(2.2**2 - 0.68**2)
    angle = np.linspace(0, 2 * np.pi, 2000)
    across = ground * math.sin(math.radians(6)) + RADIUS_M * np.cos(angle)
    along = ground * math.cos(math.radians(6)) + RADIUS_M * np.sin(angle)
    slant, bearing = np.sqrt(across**2 + along**2 + 0.68**2), np.arctan2(across, along)
    rows, columns = stored.shape
    if name == "polar":
        x = (np.degrees(bearing) + 14.4) / 28.8 * columns
        y = (slant - 1.25) / 2.5 * rows
    else:
        x = columns / 2 + slant * np.sin(bearing) / (2.5 / rows)
        y = (3.75 - slant * np.cos(bearing)) / (2.5 / rows)
    left, top, width, height = box["bbox"]
    for near, far, place in ((left, left + width, x), (top, top + height, y)):
        assert min(place.min() - near, far - place.max()) == pytest.approx(0, abs=0.3)
    assert box["area"] == pytest.approx(width * height, abs=0.1)


def test_the_fields_that_tools_import(tmp_path: Path) -> None:
    """CVAT: rectangles without segmentation, tracks of one label by keyframes. Label Studio: a
    score for each. FiftyOne: no attribute with the name of a field."""
    log = make_log(tmp_path / "log", FAN)
    lines = [f"{n},{n % 2 + 1},{70 + n},100,1,7" for n in range(4)] + ["1,none,90,60,1,"]
    truth = csv_file(tmp_path / "gt.csv", "frame,landmark,x_px,y_px,visible,track", *lines)
    document = document_of(log, truth)
    names = {one["id"]: one["name"] for one in document["categories"]}
    assert [*names.values()] == ["ID.1", "ID.2", "ID.3", "ID.4", "none"]
    assert [one["file_name"] for one in document["images"]] == [
        f"ping{k}.png" for k in (3, 10, 17, 24)
    ]
    assert all(isinstance(n, int) and n > 0 for n in names)
    annotations = document["annotations"]
    assert len({one["id"] for one in annotations}) == len(annotations) == 5
    labels: dict[int, set[str]] = {}
    for one in annotations:
        assert one["image_id"] in {image["id"] for image in document["images"]}
        assert not one["segmentation"]
        assert one["iscrowd"] == 0
        assert 0 <= one["score"] <= 1
        assert not {*one["attributes"]} & {*one, "label", "bounding_box", "confidence", "rotation"}
        if "track_id" in one["attributes"]:
            assert one["attributes"]["keyframe"] is True
            labels.setdefault(one["attributes"]["track_id"], set()).add(names[one["category_id"]])
    assert sorted(labels.values(), key=str) == [{"ID.1"}, {"ID.2"}]


def test_occluded_is_what_something_else_than_the_fan_hides(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log", FAN)
    fan = fan_of(log)
    edge = share_in_image(fan, np.array([2.4]), np.array([14.4]), RADIUS_M)[0]
    lines = ["frame,landmark,range_m,bearing_deg,visible", f"0,1,2.4,14.4,{edge:.3f}"]
    lines += ["0,2,2.4,0,1", "0,3,2.9,0,0.4"]
    boxes = document_of(log, csv_file(tmp_path / "gt.csv", *lines))["annotations"]
    assert [one["attributes"]["occluded"] for one in boxes] == [False, False, True]


def test_a_track_that_another_tool_numbered_and_a_label_none(tmp_path: Path) -> None:
    """As CVAT exports them: attributes that the label lacks are gone, the box was moved."""
    log = make_log(tmp_path / "log", FAN)
    lines = ["frame,landmark,x_px,y_px,visible,track", "1,2,70,100,0.2,C", "1,none,90,90,1,"]
    truth = csv_file(tmp_path / "gt.csv", *lines)
    document = document_of(log, truth)
    (box,) = (one for one in document["annotations"] if one["category_id"] == 2)
    assert box["attributes"]["track"] == "C"
    box["attributes"] = {"occluded": True, "track_id": 5, "visible": "partly"}
    box["bbox"][0] += 3
    (tmp_path / "edited.json").write_text(json.dumps(document))
    out = tmp_path / "back.csv"
    sonarrec("truth", "convert", tmp_path / "edited.json", "--log", log, "-o", out)
    found = {one["landmark"]: one for one in read_rows(out)}
    assert [*found["2"].values()] == ["1", "2", "73.00", "100.00", "0.500", "5"]
    assert found["none"]["x_px"] == "90.00"


def test_faults_of_truth_are_told_and_nothing_is_overwritten(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log", FAN)
    header = "frame,landmark,x_px,y_px"
    convert = ("truth", "convert")
    good = csv_file(tmp_path / "good.csv", header, "0,1,70,100", "99,1,70,100")
    out = tmp_path / "coco.json"
    words = ("--to", "coco", "-o", out)
    sonarrec(*convert, good, *words, code=2)  # no --log
    sonarrec(*convert, good, "--log", log, "--first-frame", "3", *words, code=2)
    bare = csv_file(tmp_path / "bare.csv", "frame,landmark", "0,1")
    assert "no positions" in sonarrec(*convert, bare, "--log", log, *words, code=1).stderr
    other = csv_file(tmp_path / "other.csv", header, "99,1,70,100")
    assert "another log" in sonarrec(*convert, other, "--log", log, *words, code=1).stderr
    assert not out.exists()
    told = sonarrec(*convert, good, "--log", log, *words, code=3)
    assert "1 row" in told.stderr
    before = out.read_bytes()
    sonarrec(*convert, good, "--log", log, *words, code=1)
    assert out.read_bytes() == before
