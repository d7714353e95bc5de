"""Truth and claims as COCO: `truth convert` reads the same rows back, and other tools the boxes."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from sonarrec.readers import open_log
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import pixel_from_polar, polar_from_pixel
from sonarrec.truth.match import share_in_image
from tests.support.command import SAMPLE, sonarrec
from tests.support.estimates import csv_file
from tests.support.logs import frames
from tests.support.rows import read_rows, write_rows

SAMPLES = SAMPLE.parent
RADIUS_M = 0.15
UNEVEN = [-13.0, -8, -5, -3, -1, 0, 1, 2, 4, 7, 10, 14]
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
    "uneven beams": POLAR
    | {
        "bearings_deg": UNEVEN[::-1],
        "ranges_m": [1.25 + 2.5 * ((n + 0.5) / 200) ** 1.3 for n in range(200)],
    },
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
    """Also of discs that the edge of the fan cuts, objects that are no landmark, blank cells."""
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


# --- What other programs find in the file --------------------------------------------------------


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


# --- Faults --------------------------------------------------------------------------------------


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
