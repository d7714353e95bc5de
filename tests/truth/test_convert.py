"""Annotations of every format, written out by hand as the formats are described, to gt.csv."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import Result
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.geometry import floor_depth, polar_from_pixel
from sonarrec.landmarks import load_landmarks
from sonarrec.readers import open_log
from sonarrec.sonar import Sonar
from sonarrec.truth.annotations.shapes import centre_of_area
from sonarrec.truth.convert import convert
from sonarrec.truth.match import share_in_image
from sonarrec.truth.table import read_truth
from tests.support.command import sonarrec
from tests.support.drawn import make_fan
from tests.support.logs import frames, image_folder
from tests.support.rows import read_rows

BASIN = load_landmarks("basin")
Row = tuple[int, int, float, float, float]


def run(*arguments: str | Path, code: int = 0) -> Result:
    return sonarrec("truth", "convert", *arguments, code=code)


def rows_of(path: Path) -> list[Row]:
    numbers = ("x_px", "y_px", "visible")
    return [
        (int(r["frame"]), int(r["landmark"]), *(float(r[name]) for name in numbers))
        for r in read_rows(path)
    ]


def converted(tmp_path: Path, source: Path, *more: str | Path, code: int = 0) -> list[Row]:
    (tmp_path / "gt.csv").unlink(missing_ok=True)
    run(source, "--out", tmp_path / "gt.csv", *more, code=code)
    return rows_of(tmp_path / "gt.csv")


def failure(source: Path, *more: str | Path, code: int = 1) -> str:
    """The one line said of a fault; no gt.csv may have been written."""
    out = source.parent / "nothing.csv"
    done = run(source, "--out", out, *more, code=code)
    assert not out.exists()
    (line,) = done.stderr.splitlines()
    return line


# --- CVAT ----------------------------------------------------------------------------------------

CVAT = """<?xml version="1.0" encoding="utf-8"?>
<annotations>
  <version>1.1</version>
  <meta><task><size>9</size><mode>{mode}</mode><labels><label><name>ID.1</name></label></labels>
    <original_size><width>100</width><height>80</height></original_size></task></meta>
{body}
</annotations>
"""
BOX = (
    '<box frame="{0}" keyframe="1" outside="{1}" occluded="{2}" '
    'xtl="{3}" ytl="10" xbr="{4}" ybr="20"/>'
)


def cvat(tmp_path: Path, body: str, mode: str = "interpolation") -> Path:
    path = tmp_path / "annotations.xml"
    path.write_text(CVAT.format(mode=mode, body=body))
    return path


def track(*shapes: str, label: str = "ID.1", more: str = "") -> str:
    return f'<track id="0" label="{label}" source="manual"{more}>{"".join(shapes)}</track>'


def test_cvat_fills_in_between_keyframes_as_cvat_does(tmp_path: Path) -> None:
    """Linearly, towards a keyframe that is outside as well, but never from one.

    Corners are edges between pixels, so a box from 10 to 20 is centred on pixel 14.5.
    """
    body = track(
        BOX.format(4, 0, 0, 18, 28),
        BOX.format(0, 0, 0, 10, 20),
        BOX.format(6, 1, 0, 18, 28),
        BOX.format(8, 0, 0, 40, 50),
    )
    rows = converted(tmp_path, cvat(tmp_path, body))
    assert [row[0] for row in rows] == [0, 1, 2, 3, 4, 5, 8]
    assert [row[2] for row in rows] == [14.5, 16.5, 18.5, 20.5, 22.5, 22.5, 44.5]


def test_a_shape_drawn_twice_is_one_row(tmp_path: Path) -> None:
    """As in overlapping parts of a job, flagged as occluded in one: two rows would be refused."""
    body = track(BOX.format(0, 0, 0, 10, 20), BOX.format(1, 0, 1, 12, 22)) + track(
        BOX.format(0, 0, 1, 10, 20), BOX.format(1, 0, 0, 12, 22)
    )
    rows = converted(tmp_path, cvat(tmp_path, body))
    assert rows == [(0, 1, 14.5, 14.5, 0.5), (1, 1, 16.5, 14.5, 0.5)]
    assert len(read_truth(tmp_path / "gt.csv").at) == 2


def test_cvat_shapes(tmp_path: Path) -> None:
    common = 'frame="{}" outside="0" occluded="0" keyframe="1"'
    shapes = [
        f'<ellipse {common} cx="30.50" cy="20.50" rx="4.00" ry="3.00" rotation="20"/>',
        f'<polygon {common} points="10.00,10.00;20.00,10.00;20.00,20.00;10.00,20.00;10.00,11.00"/>',
        f'<points {common} points="7.50,8.50"/>',
        f'<mask {common} rle="0, 16" left="10" top="20" width="4" height="4"/>',
    ]
    body = "".join(
        track(shape.format(n), label=f"landmark_{n + 1}") for n, shape in enumerate(shapes)
    )
    rows = converted(tmp_path, cvat(tmp_path, body))
    assert [row[:2] for row in rows] == [(0, 1), (1, 2), (2, 3), (3, 4)]
    assert [row[2:4] for row in rows] == [(30, 20), (14.5, 14.5), (7, 8), (11.5, 21.5)]


@pytest.mark.parametrize(
    ("told", "share"), [("true", 1.0), ("False", 0.0), ("0.25", 0.25), ("hardly", None)]
)
def test_visible_by_a_checkbox_of_cvat(tmp_path: Path, told: str, share: float | None) -> None:
    """As COCO's true and false; it outdoes the flag. Another text is no share."""
    box = BOX.format(0, 0, 1, 10, 20)[:-2]
    body = f'{box}><attribute name="visibility">{told}</attribute></box>'
    source = cvat(tmp_path, track(body))
    if share is None:
        assert "line 6: visibility must be a share, 0 to 1, not 'hardly'" in failure(source)
    else:
        assert [row[4] for row in converted(tmp_path, source)] == [share]


def test_cvat_shapes_without_one_centre_are_counted_and_the_others_used(tmp_path: Path) -> None:
    """Every shape that CVAT writes; the last of a track is marked as outside, and is none."""
    corners = " ".join(
        f'{a}{b}{n}="1"' for a in "xy" for b in ("tl", "bl", "tr", "br") for n in "12"
    )
    at = 'frame="{}" outside="{}" occluded="0" keyframe="1"'
    shapes = [
        f'<points {at} points="1,2;3,4"/>',
        f'<polyline {at} points="1,2;3,4"/>',
        f"<cuboid {at} {corners}/>",
        f'<skeleton {at}><points label="1" points="3,4"/></skeleton>',
    ]
    tracks = (track(s.format(0, 0), s.format(1, 0), s.format(2, 1)) for s in shapes)
    source = cvat(tmp_path, track(BOX.format(0, 0, 0, 10, 20)) + "".join(tracks))
    assert [row[:4] for row in converted(tmp_path, source, code=3)] == [(0, 1, 14.5, 14.5)]
    report = convert(source, tmp_path / "again.csv", BASIN)
    assert report.diagnostics.problems == [
        f"{kind}: 2 shapes passed over"
        for kind in ("several points", "polyline", "cuboid", "skeleton")
    ]


BOMB = """<?xml version="1.0"?>
<!DOCTYPE annotations [<!ENTITY a "{}">{}]>
<annotations><track label="&j;"/></annotations>
"""


def test_entity_bombs_are_refused_before_they_go_off(tmp_path: Path) -> None:
    """Ten levels of ten: 10 GB if expanded."""
    levels = "".join(
        f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefghi", "bcdefghij", strict=True)
    )
    path = tmp_path / "annotations.xml"
    path.write_text(BOMB.format("x" * 10, levels))
    assert "document type declaration" in failure(path)
    secret = tmp_path / "secret"
    secret.write_text("7")
    path.write_text(
        f'<!DOCTYPE annotations [<!ENTITY a SYSTEM "{secret.as_uri()}">]>'
        '<annotations><track label="&a;"/></annotations>'
    )
    assert "document type declaration" in failure(path)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (track('<box frame="0" xtl="1" ytl="2" xbr="3"/>'), "lacks the attribute 'ybr'"),
        (track('<box frame="0" xtl="a" ytl="2" xbr="3" ybr="4"/>'), "line 6: 'a' is no coordinate"),
        (
            track('<points frame="0" points="1,2;3,4"/>'),
            "nothing can be used: several points: 1 shape passed over",
        ),
        (track('<polygon frame="0" points="1,2;3,4"/>'), "line 6: 2 points, which is no polygon"),
        (
            track(BOX.format(0, 0, 0, 1, 2), BOX.format(10**9, 0, 0, 1, 2)),
            "shapes to fill in between keyframes",
        ),
        (track(more=' task_id="1"') + track(more=' task_id="2"'), "several tasks in one file"),
        ("<track", "not well-formed XML"),
        (track(BOX.format("9" * 400, 0, 0, 1, 2)), "no number of a frame"),
    ],
)
def test_bad_cvat_is_one_line(tmp_path: Path, body: str, said: str) -> None:
    assert said in failure(cvat(tmp_path, body))


# --- COCO ----------------------------------------------------------------------------------------


def coco(
    tmp_path: Path,
    annotations: list[dict[str, object]],
    names: list[str],
    *sizes: tuple[int | None, int | None],
) -> Path:
    """sizes: of each image, or of all; default 100 x 80."""
    each = sizes if len(sizes) == len(names) else [*sizes, (100, 80)][:1] * len(names)
    images = [
        {"id": 7 + n, "file_name": name, "width": w, "height": h}
        for n, (name, (w, h)) in enumerate(zip(names, each, strict=True))
    ]
    categories: list[dict[str, object]] = [{"id": n, "name": f"ID.{n}"} for n in (1, 2, 3, 4)]
    categories += [{"id": 5, "name": "disc north", "keypoints": ["centre", "rim"]}]
    path = tmp_path / "coco.json"
    document = {"annotations": annotations, "images": images, "categories": categories}
    path.write_text(json.dumps(document))
    return path


def test_coco(tmp_path: Path) -> None:
    square = [10, 10, 20, 10, 20, 20, 10, 20]
    annotations = [
        {"image_id": 7, "category_id": 1, "bbox": [10, 20, 4, 6], "iscrowd": 0},
        {"image_id": 8, "category_id": 1, "bbox": [0, 0, 1, 1], "segmentation": [square]},
        {"image_id": 8, "category_id": 5, "bbox": [0, 0, 9, 9], "keypoints": [5, 6, 1, 0, 0, 0]},
        {"image_id": 8, "category_id": 5, "bbox": [0, 0, 9, 9], "attributes": {"occluded": True}},
        {"image_id": 7, "category_id": 1, "bbox": [0, 0, 9, 9], "iscrowd": 1},
    ]
    source = coco(tmp_path, annotations, ["a_0.png", "a_5.png"])
    assert converted(tmp_path, source, "--map", "disc north=4", code=3) == [
        (0, 1, 11.5, 22.5, 1.0),
        (5, 1, 14.5, 14.5, 1.0),
        (5, 4, 5.0, 6.0, 0.5),
        (5, 4, 4.0, 4.0, 0.5),
    ]


@pytest.mark.parametrize(
    ("annotation", "said"),
    [
        ({"image_id": 99, "category_id": 1}, "annotations[0]: image_id 99 is not among the images"),
        ({"image_id": 7, "category_id": 1}, "annotations[0]: no 'bbox'"),
        ({"image_id": 7, "category_id": 1, "bbox": [0, 0, 1]}, "4 numbers, not [0, 0, 1]"),
        ({"image_id": 7, "category_id": 1, "bbox": [0, 0, 1, math.inf]}, "no coordinate"),
        ({"image_id": 7, "category_id": 1, "bbox": [0] * 4}, "annotation left empty: 1 shape"),
        ({"image_id": 7, "category_id": 1, "keypoints": [1, 2]}, "a keypoint must be 3 numbers"),
    ],
)
def test_bad_coco_is_one_line(tmp_path: Path, annotation: dict[str, object], said: str) -> None:
    assert said in failure(coco(tmp_path, [annotation], ["a_0.png"]))


@pytest.mark.parametrize(
    "wrong",
    [
        {"bbox": []},
        {"bbox": None},
        {"bbox": [1, 2, 3, 4], "image_id": 99},
        {"bbox": [1, 2, 3, 4], "category_id": None},
    ],
)
def test_one_bad_annotation_of_coco_costs_itself(tmp_path: Path, wrong: dict[str, object]) -> None:
    right = {"image_id": 7, "category_id": 1, "bbox": [10, 20, 4, 6]}
    source = coco(tmp_path, [right | wrong, right], ["a_0.png"])
    assert converted(tmp_path, source, code=3) == [(0, 1, 11.5, 22.5, 1.0)]


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        (
            "images",
            [{"id": 7, "file_name": "a_0.png"}, {"id": 7, "file_name": "a_1.png"}],
            "images[1]: id 7 is that of 'a_0.png' and of 'a_1.png'",
        ),
        (
            "categories",
            [{"id": 1, "name": "1"}, {"id": 1, "name": "2"}],
            "categories[1]: id 1 is that of '1' and of '2'",
        ),
    ],
)
def test_coco_whose_ids_tell_no_names_is_one_line(
    tmp_path: Path, key: str, value: Any, said: str
) -> None:
    """Of two files put together an id stands for two images: the last of them was taken."""
    source = coco(tmp_path, [BBOX | {"image_id": 7}], ["a_0.png"])
    source.write_text(json.dumps(json.loads(source.read_text()) | {key: value}))
    assert said in failure(source)


# --- MOTChallenge --------------------------------------------------------------------------------


def mot(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "gt.txt"
    path.write_text(text)
    return path


def test_mot_counts_from_one(tmp_path: Path) -> None:
    """A box of 5 x 3 pixels whose first pixel is (1, 1) is centred on pixel (2, 1) counted from 0.

    Class 3 is a label; a row not to be considered is ignored by protocol strict: `visible` 0.001.
    """
    text = "1,9,1,1,5,3,1,3,0.86014\n2, 9, 2, 1, 5, 3, 0, 3, 1\n\n"
    assert converted(tmp_path, mot(tmp_path, text)) == [(0, 3, 2, 1, 0.86), (1, 3, 3, 1, 0.001)]


def test_mot15_has_no_class_so_the_track_is_the_label(tmp_path: Path) -> None:
    text = "1, 2, 794.27, 247.59, 71.245, 174.88, 1, -1, -1, -1\n"
    ((frame, landmark, x, y, visible),) = converted(tmp_path, mot(tmp_path, text))
    assert (frame, landmark, visible) == (0, 2, 1.0)
    assert x == pytest.approx(793.27 + (71.245 - 1) / 2, abs=0.01)
    assert y == pytest.approx(246.59 + (174.88 - 1) / 2, abs=0.01)


def test_mot_of_cvat_names_classes_and_counts_boxes_from_zero(tmp_path: Path) -> None:
    (tmp_path / "labels.txt").write_text("tyre\nlandmark 4\n")
    text = "1,1,0,0,5,3,1,2,1.0\n1,2,9,9,5,3,1,1,1.0\n"
    source = mot(tmp_path, text)
    assert converted(tmp_path, source, "--map", "tyre=none") == [(0, 4, 2, 1, 1.0)]


@pytest.mark.parametrize(
    "text",
    [
        "1,4,1,1,5,3\n2,4,2,1,5,3\n",
        "1 4 1 1 5 3 1 -1 -1 -1\n2 4 2 1 5 3 1 -1 -1 -1\n",
        "frame,id,bb_left,bb_top,bb_width,bb_height,conf,x,y,z\n1,4,1,1,5,3,1,-1,-1,-1\n"
        "2,4,2,1,5,3,1,-1,-1,-1\n",
        "Frame\tID\tx\ty\tw\th\n1\t4\t1\t1\t5\t3\n2\t4\t2\t1\t5\t3\n",
    ],
)
def test_dialects_of_mot(tmp_path: Path, text: str) -> None:
    assert converted(tmp_path, mot(tmp_path, text)) == [(0, 4, 2, 1, 1.0), (1, 4, 3, 1, 1.0)]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("1,1,0,0,5", "line 2: 5 cells"),
        ("1.5,1,0,0,5,5,1", "frames are whole numbers"),
        ("1,1,0,0,5,5,1,1,86", "visibility is a share"),
        ("1,1,0,0,5,5,1,1.5", "line 2: 1.5 is no number"),
        ("0,1,0,0,5,5,1", "lies before the log's first frame, which is called 1 here"),
    ],
)
def test_bad_mot_is_one_line(tmp_path: Path, line: str, said: str) -> None:
    assert said in failure(mot(tmp_path, f"1,1,1,1,5,3,1\n{line}\n"))


# --- LabelMe -------------------------------------------------------------------------------------


POINT: dict[str, object] = {"label": "1", "points": [[9, 9]], "shape_type": "point"}


def labelme(
    path: Path, shapes: list[dict[str, object]], image: str, size: tuple[int, int] = (100, 80)
) -> Path:
    path.parent.mkdir(exist_ok=True)
    document = {"version": "5.5.0", "flags": {}, "shapes": shapes, "imagePath": image}
    document |= {"imageData": None, "imageWidth": size[0], "imageHeight": size[1]}
    path.write_text(json.dumps(document))
    return path


def test_labelme_folder(tmp_path: Path) -> None:
    folder = tmp_path / "labels"
    shapes: list[dict[str, object]] = [
        {"label": "1", "points": [[10, 10], [14, 13]], "shape_type": "circle", "flags": {}},
        {"label": "2", "points": [[30, 20], [20, 10]], "shape_type": "rectangle", "group_id": None},
        {"label": "3", "points": [[5.5, 6.5]], "shape_type": "point", "flags": {"Occluded": True}},
        {"label": "4", "points": [[0, 0], [4, 0], [4, 4], [0, 4]], "shape_type": "polygon"},
        {"label": "4", "points": [[0, 0], [4, 0]], "shape_type": "line"},
    ]
    labelme(folder / "b.json", shapes, "..\\images\\ping12.png")
    labelme(folder / "a.json", [], "../images/ping3.png")
    assert converted(tmp_path, folder, code=3) == [
        (12, 1, 9.5, 9.5, 1.0),
        (12, 2, 24.5, 14.5, 1.0),
        (12, 3, 5.0, 6.0, 0.5),
        (12, 4, 1.5, 1.5, 1.0),
    ]
    assert converted(tmp_path / "labels", folder / "a.json") == []


def test_labelme_masks_and_rotated_rectangles_lie_where_their_pixels_do(tmp_path: Path) -> None:
    """A mask's two points are its first and its last pixel: labelme fills x2 - x1 + 1 columns."""
    drawn = np.zeros((80, 100), bool)
    drawn[12 : 18 + 1, 20 : 31 + 1] = True
    rows, columns = np.nonzero(drawn)
    turned = cv2.boxPoints(((55.0, 40.0), (20.0, 8.0), 30.0)).tolist()
    shapes: list[dict[str, object]] = [
        {"label": "1", "points": [[20, 12], [31, 18]], "shape_type": "mask"},
        {"label": "2", "points": turned, "shape_type": "oriented_rectangle"},
    ]
    labelme(tmp_path / "a.json", shapes, "5.png")
    assert converted(tmp_path, tmp_path / "a.json") == [
        (5, 1, columns.mean(), rows.mean(), 1.0),
        (5, 2, 54.5, 39.5, 1.0),
    ]
    labelme(tmp_path / "b.json", [shapes[1] | {"points": turned[:2]}], "5.png")
    assert "2 points, which is no oriented_rectangle" in failure(tmp_path / "b.json")


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ({"label": "1", "points": [[1, 2]], "shape_type": "circle"}, ""),
        ({"label": "1", "points": [], "shape_type": "point"}, "0 points, which is no point"),
        ({"label": "1", "points": [[1, 2], [3, 4]]}, "2 points, which is no polygon"),
        ({"label": "1", "points": [[1]], "shape_type": "point"}, "a point must be 2 numbers"),
        ({"label": "", "points": [[1, 2]], "shape_type": "point"}, "1 shape without a label"),
    ],
)
def test_bad_labelme_is_one_line(tmp_path: Path, shape: dict[str, object], said: str) -> None:
    labelme(tmp_path / "a.json", [shape], "a0.png")
    if said:
        assert said in failure(tmp_path / "a.json")
    else:
        assert len(converted(tmp_path, tmp_path / "a.json")) == 1


def test_other_json_in_a_folder_of_labelme_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "labels"
    labelme(folder / "a.json", [], "3.png")
    (folder / "._a.json").write_bytes(b"\0\5\26\7\xff")  # as macOS leaves them
    assert converted(tmp_path, folder) == []
    (folder / "classes.json").write_text('{"classes": ["1"]}')
    assert "classes.json: not as LabelMe writes it (no 'shapes'); move other" in failure(folder)
    (tmp_path / "none").mkdir()
    assert "none: a folder without LabelMe JSON files" in failure(tmp_path / "none")


# --- What is no annotation file ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.xml", b"<svg></svg>", "not an annotation file this program reads"),
        ("a.json", b'{"type": "FeatureCollection"}', "not an annotation file this program reads"),
        ("a.json", b'{"a": ' + b"[" * 200_000, "not valid JSON"),
        ("a.xml", b"<?xml version='1.0' encoding='klingon'?><annotations/>", "unknown encoding"),
        ("a.json", b'{"\xff": 1}', "unpack an archive first"),
        ("a.zip", b"PK\x03\x04\x00\x00", "unpack an archive first"),
        ("gt.csv", b"frame,landmark,x_px,y_px,visible\n0,1,2,3,1\n", "not an annotation file"),
    ],
)
def test_other_files_are_told_in_one_line(
    tmp_path: Path, name: str, content: bytes, said: str
) -> None:
    (tmp_path / name).write_bytes(content)
    assert said in failure(tmp_path / name)


def test_format_can_be_named(tmp_path: Path) -> None:
    source = mot(tmp_path, "1,1,1,1,5,3,1\n")
    assert "not valid JSON" in failure(source, "--format", "coco")
    (tmp_path / "a.json").write_text('{"images": []}')
    assert "not as MOTChallenge writes it" in failure(tmp_path / "a.json", "--format", "mot")
    assert len(converted(tmp_path, source, "--format", "mot")) == 1


def test_an_existing_truth_is_never_written_over(tmp_path: Path) -> None:
    source = mot(tmp_path, "1,1,1,1,5,3,1\n")
    (tmp_path / "gt.csv").write_text("corrected by hand")
    done = run(source, "--out", tmp_path / "gt.csv", code=1)
    assert "exists already and is left as it is" in done.stderr
    assert (tmp_path / "gt.csv").read_text() == "corrected by hand"
    assert (
        "cannot be written" in run(source, "--out", tmp_path / "gt.csv" / "gt.csv", code=1).stderr
    )
    assert (tmp_path / "gt.csv").read_text() == "corrected by hand"


# --- Labels --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("label", "landmark"),
    [("1", 1), ("ID.1", 1), ("id 2", 2), ("landmark_3", 3), ("Landmark-04", 4), (" id3 ", 3)],
)
def test_labels_that_show_their_id(tmp_path: Path, label: str, landmark: int) -> None:
    body = track(BOX.format(0, 0, 0, 10, 20), label=label)
    assert converted(tmp_path, cvat(tmp_path, body))[0][1] == landmark


@pytest.mark.parametrize("label", ["tyre 1", "1b", "ID.1 fake", "ID.7", "disc", "-1"])
def test_other_labels_are_told_of(tmp_path: Path, label: str) -> None:
    """A fake called `tyre 1` must not become ID.1."""
    body = track(BOX.format(0, 0, 0, 10, 20)) + track(BOX.format(0, 0, 0, 40, 50), label=label)
    source = cvat(tmp_path, body)
    done = run(source, "--out", tmp_path / "gt.csv", code=3)
    assert f"label {label!r} (1 time)" in done.stderr
    assert len(rows_of(tmp_path / "gt.csv")) == 1
    assert len(converted(tmp_path, source, "--map", f"{label}=none")) == 1
    assert [row[1] for row in converted(tmp_path, source, "--map", f"{label}=2")] == [1, 2]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("disc", "expected LABEL=ID"),
        ("other=1", "no shape has this label; labels: disc"),
        ("disc=9", "ID 9 is not in 'basin' (1, 2, 3, 4)"),
    ],
)
def test_maps_that_cannot_be_meant(tmp_path: Path, given: str, said: str) -> None:
    source = cvat(tmp_path, track(BOX.format(0, 0, 0, 10, 20), label="disc"))
    assert said in failure(source, "--map", given, code=2)


def test_nothing_usable_is_a_failure_and_nothing_drawn_is_not(tmp_path: Path) -> None:
    source = cvat(tmp_path, track(BOX.format(0, 0, 0, 10, 20), label="disc"))
    assert "nothing can be used: label 'disc'" in failure(source)
    assert converted(tmp_path, cvat(tmp_path, "")) == []


# --- Frames --------------------------------------------------------------------------------------

BBOX = {"category_id": 1, "bbox": [0, 0, 1, 1]}


def frames_of(tmp_path: Path, names: list[str], *more: str | Path) -> list[int]:
    annotations = [BBOX | {"image_id": 7 + n} for n in range(len(names))]
    return [row[0] for row in converted(tmp_path, coco(tmp_path, annotations, names), *more)]


def test_frames_by_the_number_that_ends_the_name(tmp_path: Path) -> None:
    names = ["x1_0012.png", "x1_0003.jpg"]
    assert frames_of(tmp_path, names) == [3, 12]
    assert frames_of(tmp_path, names, "--first-frame", "1") == [2, 11]


HASHES = ("bee0e8fc28627c80a1ab1e7389701a07", "ca782d9ec0835cb56a667163a7be9435")


@pytest.mark.parametrize("form", ["{}_png.rf.{}.jpg", "data/{1:.8}-{0}.png", "{1:.8}-{0}.png"])
def test_the_hashes_of_other_tools_are_no_numbers(tmp_path: Path, form: str) -> None:
    """Roboflow's at the end, Label Studio's at the beginning; with the log and without it."""
    names = [form.format(f"frame{k}", text) for k, text in zip((3, 5), HASHES, strict=True)]
    assert frames_of(tmp_path, names) == [3, 5]
    log = image_folder(tmp_path / "log", frames(6, 80, 100))
    assert frames_of(tmp_path, names, "--log", log) == [3, 5]


def test_the_end_of_a_hash_is_not_taken_for_a_frame(tmp_path: Path) -> None:
    source = coco(tmp_path, [BBOX | {"image_id": 8}], ["a7.png", "ca782d9.png"])
    assert [row[0] for row in converted(tmp_path, source)] == [1]


def test_digits_that_are_no_number_of_a_frame(tmp_path: Path) -> None:
    """Of a space and a query as web tools write them, and of a fraction of a second."""
    names = ["img%2012.png", "a/img%203.jpg", "../b%2F7.png?c=%2F5", "/files/?d=a%2F9.png"]
    assert frames_of(tmp_path, names) == [3, 7, 9, 12]
    assert frames_of(tmp_path, ["a_1714564801.125.png", "b_1714564800.375.png"]) == [0, 1]
    log = image_folder(tmp_path / "log", frames(3, 80, 100))
    (log / "frame0.png").rename(log / "b%2034.png")  # that very name
    (log / "frame1.png").rename(log / "b 5.png")
    assert frames_of(tmp_path, ["b%2034.png", "b%205.png"], "--log", log) == [0, 1]


def test_frames_by_natural_order_of_all_images(tmp_path: Path) -> None:
    names = ["ping10left.png", "ping2left.png", "ping1left.png"]
    annotations = [BBOX | {"image_id": 7, "bbox": [4, 0, 1, 1]}]
    assert converted(tmp_path, coco(tmp_path, annotations, names)) == [(2, 1, 4, 0, 1.0)]


SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "pan.mcap"  # 128 frames


def test_frames_beyond_the_log_are_told(tmp_path: Path) -> None:
    """Numbers that no frame has."""
    for names, count in (["x127.png", "y3.png"], 0), (["x998812.jpg", "x127.png"], 1):
        annotations = [BBOX | {"image_id": 7 + n} for n in range(2)]
        images = coco(tmp_path, annotations, names, (191, 256))
        done = run(images, "--log", SAMPLE, "--out", tmp_path / f"{count}.csv", code=3 * count)
        beyond = "1 shape beyond the log's last frame, 127: frame 998812; frames by the number"
        assert done.stderr.count(beyond) == count
    log = image_folder(tmp_path / "log", frames(2, 80, 100))
    drawn = cvat(tmp_path, track(BOX.format(1, 0, 0, 10, 20), BOX.format(2, 0, 0, 10, 20)))
    done = run(drawn, "--log", log, "--out", tmp_path / "folder.csv", code=3)
    assert "1 shape beyond the log's last frame, 1: frame 2; frames as numbered" in done.stderr


def test_an_order_of_fewer_images_than_the_log_has_frames_is_told(tmp_path: Path) -> None:
    for listed, code in (2, 3), (128, 0):
        names = [f"a{n}left.png" for n in range(listed)]
        source = coco(tmp_path, [BBOX | {"image_id": 7}], names, (191, 256))
        done = run(source, "--log", SAMPLE, "--out", tmp_path / f"{listed}.csv", code=code)
        assert ("2 images listed, but the log has 128 frames" in done.stderr) == (code == 3)


@pytest.mark.parametrize(
    "name", ["1700000000123456789", "ping_1700000000.123456789", "20231114-221320.123456789Z"]
)
def test_names_that_are_times_give_times(tmp_path: Path, name: str) -> None:
    source = coco(tmp_path, [BBOX | {"image_id": 7}], [f"{name}.png"])
    run(source, "--out", tmp_path / "gt.csv")
    assert (tmp_path / "gt.csv").read_text().splitlines() == [
        "timestamp_ns,landmark,x_px,y_px,visible",
        "1700000000123456789,1,0.00,0.00,1.000",
    ]


def test_two_images_of_one_number_are_a_fault(tmp_path: Path) -> None:
    annotations = [BBOX | {"image_id": 7}]
    source = coco(tmp_path, annotations, ["left/1.png", "right/1.png"])
    assert "would both be frame 1" in failure(source)


def test_two_images_of_one_name_are_a_fault(tmp_path: Path) -> None:
    """Their shapes went into one frame, unsaid. Two files of labelme may be of one image."""
    source = tmp_path / "labels"
    for log in "ab":
        labelme(source / f"{log}.json", [POINT], f"..\\log{log}\\34.png")
    assert re.search("would (both|all) be frame 34", failure(source))
    labelme(source / "b.json", [POINT], "..\\loga\\34.png")
    assert [row[0] for row in converted(tmp_path, source)] == [34]


def test_images_of_another_log_are_not_taken_by_their_numbers(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(4, 80, 100))
    source = coco(tmp_path, [BBOX | {"image_id": 7}], ["ping2.png"])
    assert "no image of the log is called as one that was annotated: 'ping2.png'" in failure(
        source, "--log", log
    )


def test_frames_by_name_in_the_log(tmp_path: Path) -> None:
    """Whatever the numbers in the names say, and with another suffix and folder."""
    log = image_folder(tmp_path / "log", frames(4, 80, 100))
    for n, name in enumerate(["b30", "b4", "a99", "c1"]):
        (log / f"frame{n}.png").rename(log / f"{name}.png")
    names = ["task/c1.jpg", "task/b4.jpg", "task/elsewhere9.jpg"]
    annotations = [BBOX | {"image_id": 7 + n} for n in range(3)]
    source = coco(tmp_path, annotations, names)
    done = run(source, "--log", log, "--out", tmp_path / "gt.csv", code=3)
    assert "not in the log: task/elsewhere9.jpg" in done.stderr
    assert [row[0] for row in rows_of(tmp_path / "gt.csv")] == [1, 3]
    assert "--first-frame has no meaning" in failure(
        source, "--log", log, "--first-frame", "1", code=2
    )
    run(source, "--log", log / "*.png", "--out", tmp_path / "glob.csv", code=3)
    assert rows_of(tmp_path / "glob.csv") == rows_of(tmp_path / "gt.csv")


# --- Positions and visibility --------------------------------------------------------------------


def test_annotations_of_resized_images_are_refused(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(2, 40, 50))
    source = cvat(tmp_path, track(BOX.format(0, 0, 0, 10, 20)))
    assert "drawn on images of 100 x 80 pixels, but those of the log have 50 x 40" in failure(
        source, "--log", log
    )


def test_images_that_are_not_in_the_log_may_have_any_size(tmp_path: Path) -> None:
    """Of a data set of several sonars the log's own images count; these must be of its size."""
    log = image_folder(tmp_path / "log", frames(1, 80, 100))
    sizes = {"frame0.png": (100, 80), "other_7.png": (640, 480)}

    def write(sizes: dict[str, tuple[int, int]]) -> Path:
        for n, (name, size) in enumerate(sizes.items()):
            labelme(tmp_path / "set" / f"{n}.json", [POINT], name, size)
        return tmp_path / "set"

    rows = converted(tmp_path, write(sizes), "--log", log, code=3)
    assert [row[:2] for row in rows] == [(0, 1)]
    said = failure(write(sizes | {"frame0.png": (50, 40)}), "--log", log)
    assert "drawn on images of 50 x 40" in said
    assert "640" not in said


def test_visible_is_limited_by_the_fan(tmp_path: Path) -> None:
    """On the fan's right edge, half of the disc; well outside, nothing; in the middle, all."""
    log = image_folder(tmp_path / "log", frames(2, 300, 560))
    fan = make_fan()  # the same geometry on 300 rows
    edge = math.radians(fan.bearing_max_deg)
    pixels_away = 2.4 / fan.metres_per_pixel
    x = 279.5 + pixels_away * math.sin(edge)
    y = fan.apex_row - pixels_away * math.cos(edge)
    shapes = [(279.5, 150.0), (x, y), (x + 60, y)]
    text = "".join(f"1,{n},{a - 1},{b - 1},5,5,1,{n}\n" for n, (a, b) in enumerate(shapes, 1))
    rows = converted(tmp_path, mot(tmp_path, text), "--log", log)
    assert [row[4] for row in rows] == pytest.approx([1.0, 0.5, 0.0], abs=0.01)


@settings(max_examples=60)
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


def polar_log(folder: Path, **keys: Any) -> Path:
    """A folder with the geometry of a polar log, still without images."""
    sonar = Sonar("polar", 1.25, 3.75, 28.8, 20.0, 0.68, **keys)
    text = "\n".join(f"{k} = {json.dumps(v)}" for k, v in sonar.as_table().items())
    folder.mkdir()
    (folder / "sonar.toml").write_text(f"[sonar]\n{text}\n")
    return folder


UNEVEN = (-13.0, -8, -5, -3, -1, 0, 1, 2, 4, 7, 10, 14)


@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"flip": True},
        {"bearings_deg": UNEVEN},
        {"bearings_deg": UNEVEN[::-1]},
        {"ranges_m": tuple(1.25 + 2.5 * ((n + 0.5) / 200) ** 1.3 for n in range(200))},
        {"beam_order": "beam-major"},
        {"range_order": "far_first"},
        {"range_order": "far_first", "beam_order": "beam-major"},
    ],
)
def test_shapes_on_polar_images_are_moved_to_the_fan(tmp_path: Path, keys: dict[str, Any]) -> None:
    """A bright sample of the polar image lies in the fan where its annotation says."""
    beams = len(keys.get("bearings_deg", range(96)))
    log = polar_log(tmp_path / "log", **keys)
    turned = "beam_order" in keys
    size = (200, beams) if turned else (beams, 200)
    for column, row in ((beams // 3, 120), (beams // 2, 50)):
        point = [row + 0.5, column + 0.5] if turned else [column + 0.5, row + 0.5]
        source = labelme(tmp_path / "0.json", [POINT | {"points": [point]}], "0.png", size)
        polar = np.zeros((200, beams), np.uint8)
        polar[row, column] = 255
        cv2.imwrite(str(log / "0.png"), polar.T if turned else polar)
        ((_, _, x, y, _),) = converted(tmp_path, source, "--log", log)
        with open_log(log) as opened:
            fan = next(iter(opened)).image.astype(float)
        # The brightest fan pixels: between uneven beams the spot is not symmetric about its peak.
        rows, columns = np.nonzero(fan > 0.9 * fan.max())
        assert (columns.mean(), rows.mean()) == pytest.approx((x, y), abs=1.0)


@pytest.mark.parametrize("flip", [False, True])
def test_a_disc_cut_by_the_edge_of_a_polar_image_keeps_its_centre(
    tmp_path: Path, flip: bool
) -> None:
    """Beyond its edges a polar image goes on in the same steps of bearing and range."""
    log = polar_log(tmp_path / "log", flip=flip)
    cv2.imwrite(str(log / "0.png"), np.zeros((200, 96), np.uint8))
    # Corners of the image: samples are 0.3 deg and 12.5 mm wide, and these are their outer edges.
    places = [(0, 100), (96, 110), (-3, 120), (100, 130), (48, -4), (48, 203)]
    shapes = [POINT | {"points": [[x, y]]} for x, y in places]
    source = labelme(tmp_path / "a.json", shapes, "0.png", (96, 200))
    rows = converted(tmp_path, source, "--log", log)
    with open_log(log) as opened:
        fan = next(iter(opened)).fan
    found = polar_from_pixel(fan, *np.array([row[2:4] for row in rows]).T)
    sign = -1 if flip else 1
    expected = [(1.25 + y * 0.0125, sign * (x - 48) * 0.3) for x, y in places]
    # Rows stand in another order; the ranges tell them apart.
    np.testing.assert_allclose(sorted(zip(*found, strict=True)), sorted(expected), atol=0.02)


def test_shapes_on_mirrored_fan_images(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(1, 80, 100))
    with (log / "sonar.toml").open("a") as file:
        file.write("flip = true\n")
    source = cvat(tmp_path, track(BOX.format(0, 0, 0, 10, 20)))
    assert converted(tmp_path, source, "--log", log)[0][2] == 99 - 14.5


def test_polar_log_needs_the_size_of_the_images(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(1, 40, 30))
    text = (log / "sonar.toml").read_text().replace('"fan"', '"polar"')
    (log / "sonar.toml").write_text(text)
    source = mot(tmp_path, "1,1,1,1,5,3,1\n")
    assert "do not tell the size" in failure(source, "--log", log)
    drawn = cvat(tmp_path, track(BOX.format(0, 0, 0, 10, 20)))
    assert "those of the log have 100 beams x 40 ranges" in failure(drawn, "--log", log)


@given(st.integers(3, 8), st.floats(2, 50), st.floats(-200, 200), st.integers(0, 7))
def test_centre_of_an_outline_does_not_follow_where_its_points_crowd(
    corners: int, radius: float, shift: float, crowded: int
) -> None:
    turn = 2 * np.pi * np.arange(corners) / corners
    polygon = [(shift + radius * math.cos(t), 2 * shift + radius * math.sin(t)) for t in turn]
    a, b = polygon[crowded % corners], polygon[(crowded + 1) % corners]
    extra = [(a[0] + k / 9 * (b[0] - a[0]), a[1] + k / 9 * (b[1] - a[1])) for k in range(1, 9)]
    at = crowded % corners + 1
    centre = centre_of_area(polygon[:at] + extra + polygon[at:])
    assert centre == pytest.approx((shift, 2 * shift), abs=1e-6)


# --- The same truth in every format --------------------------------------------------------------

places = st.tuples(
    st.integers(0, 30), st.integers(1, 4), st.integers(0, 8000), st.integers(0, 6000)
)


def as_cvat_video(rows: list[Row], folder: Path) -> Path:
    body = ""
    for frame, landmark, x, y, _ in rows:
        box = f'xtl="{x - 4:.2f}" ytl="{y - 3:.2f}" xbr="{x + 5:.2f}" ybr="{y + 4:.2f}"'
        body += track(
            f'<box frame="{frame}" outside="0" occluded="0" keyframe="1" {box}/>'
            f'<box frame="{frame + 1}" outside="1" occluded="0" keyframe="1" {box}/>',
            label=str(landmark),
        )
    return cvat(folder, body)


def as_cvat_images(rows: list[Row], folder: Path) -> Path:
    body = ""
    for frame in range(31):
        body += f'<image id="{frame}" name="{frame:06d}.png" width="100" height="80">'
        for at, landmark, x, y, _ in rows:
            if at == frame:
                body += f'<points label="ID.{landmark}" points="{x + 0.5:.2f},{y + 0.5:.2f}"/>'
        body += "</image>"
    return cvat(folder, body, "annotation")


def as_coco(rows: list[Row], folder: Path) -> Path:
    annotations: list[dict[str, object]] = [
        {"image_id": 7 + frame, "category_id": i, "bbox": [x - 4, y - 3, 9, 7]}
        for frame, i, x, y, _ in rows
    ]
    return coco(folder, annotations, [f"{frame}.png" for frame in range(31)])


def as_mot(rows: list[Row], folder: Path) -> Path:
    lines = [f"{f + 1},1,{x - 3:.2f},{y - 2:.2f},9,7,1,{i},1" for f, i, x, y, _ in rows]
    return mot(folder, "\n".join(lines) + "\n")


def as_labelme(rows: list[Row], folder: Path) -> Path:
    for frame in {row[0] for row in rows}:
        shapes: list[dict[str, object]] = [
            {"label": str(i), "points": [[x + 0.5, y + 0.5], [x + 9, y]], "shape_type": "circle"}
            for f, i, x, y, _ in rows
            if f == frame
        ]
        labelme(folder / "labels" / f"{frame}.json", shapes, f"{frame}.png")
    return folder / "labels"


@pytest.mark.parametrize("write", [as_cvat_video, as_cvat_images, as_coco, as_mot, as_labelme])
@settings(max_examples=25)
@given(drawn=st.sets(places, min_size=1, max_size=12))
def test_the_same_truth_in_every_format(
    tmp_path_factory: pytest.TempPathFactory, write, drawn: set[tuple[int, int, int, int]]
) -> None:
    folder = tmp_path_factory.mktemp("truth")
    rows = sorted((f, i, x / 100, y / 100, 1.0) for f, i, x, y in drawn)
    convert(write(rows, folder), folder / "gt.csv", BASIN)
    found = sorted(rows_of(folder / "gt.csv"))
    assert [row[:2] for row in found] == [row[:2] for row in rows]
    np.testing.assert_allclose([row[2:] for row in found], [row[2:] for row in rows], atol=0.011)
