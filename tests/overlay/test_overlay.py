"""Overlays: what is drawn lies where the object is, is stamped as its image, and plays."""

from __future__ import annotations

import base64
import csv
import itertools
import json
import math
import os
import re
import tomllib
import tracemalloc
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest
import tomli_w
import zstandard
from click.testing import CliRunner, Result
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import McapError
from mcap.reader import make_reader

from sonarrec.cli import main
from sonarrec.drawing.pen import (
    OKABE_ITO,
    disc_outline,
    draw_picture,
    enlargement,
    landmark_colours,
)
from sonarrec.drawing.results import (
    STRIP_FRAMES,
    TRAIL_FRAMES,
    Mark,
    Moment,
    caption,
    draw_frame,
    draw_strip,
    trails,
)
from sonarrec.errors import SonarrecError, UsageError
from sonarrec.geometry import pixel_from_polar
from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.nouns import Estimate, Fan, FrameResult
from sonarrec.overlay.overlay import Targets, write_overlay
from sonarrec.readers import open_log
from sonarrec.results.stream import choose_method, read_estimates
from sonarrec.results.write import ResultsWriter
from sonarrec.sonar import Sonar, load_sonar
from tests.support.drawn import draw_on_floor, make_fan
from tests.support.logs import PERIOD_NS, SONAR_TOML, cdr_image, image_folder, mcap_file

BASIN = load_landmarks("basin")
FAN = make_fan(rows=512)
SAMPLE = Path(__file__).parents[2] / "sample_data" / "pan.mcap"
STAMP_NS = 1_700_000_000_123_456_789


def estimate(
    x_px: float,
    y_px: float,
    landmark: int = 1,
    *,
    p: float = 0.9,
    declared: bool = True,
    number: int = 0,
    method: str = "framework",
) -> Estimate:
    """An estimate with probability p for its ID, the rest for none of these."""
    beliefs = np.array([p * (i == landmark) for i in BASIN.ids] + [1 - p])
    return Estimate(
        method, number, x_px, y_px, 2.0, 0.0, math.nan, 0.9, beliefs, landmark, p, declared
    )


def at(fan: Fan, range_m: float, bearing_deg: float) -> tuple[float, float]:
    column, row = pixel_from_polar(fan, range_m, bearing_deg)
    return float(column), float(row)


def painted(picture: np.ndarray, colour: tuple[int, int, int], within: int = 0) -> np.ndarray:
    """(n, 2) column and row of the pixels of this colour; thin lines never quite reach it."""
    away = np.abs(picture[:, :, ::-1].astype(int) - colour)
    return np.argwhere(away.max(axis=2) <= within)[:, ::-1]


# Where a disc is drawn


@settings(max_examples=60)
@given(
    height=st.floats(0.2, 1.0),
    range_m=st.floats(1.4, 3.5),
    bearing=st.floats(-14, 14),
    radius=st.floats(0.02, 0.3),
)
def test_outline_is_a_circle_on_the_floor(
    height: float, range_m: float, bearing: float, radius: float
) -> None:
    """Every point, cast back to the floor of a three-dimensional scene, is a radius away."""
    fan = make_fan(height_m=height)
    outline = disc_outline(fan, radius, *at(fan, range_m, bearing))
    across = (outline[:, 0] - fan.apex_column) * fan.metres_per_pixel
    ahead = (fan.apex_row - outline[:, 1]) * fan.metres_per_pixel
    slant = np.hypot(across, ahead)
    ground = np.sqrt(slant**2 - height**2)
    centre = math.sqrt(range_m**2 - height**2) * np.exp(1j * math.radians(bearing))
    points = ground * np.exp(1j * np.arctan2(across, ahead))
    np.testing.assert_allclose(np.abs(points - centre), radius, rtol=1e-6)


@pytest.mark.parametrize("range_m", [1.6, 2.2, 3.2])
@pytest.mark.parametrize("bearing", [-8.0, 0.0, 5.0])
def test_outline_fits_a_rendered_disc(range_m: float, bearing: float) -> None:
    disc, _ = draw_on_floor(FAN, range_m, bearing, 0.15, lambda x, y: np.hypot(x, y) <= 1)
    outline = disc_outline(FAN, 0.15, *at(FAN, range_m, bearing))
    filled = np.zeros(disc.shape, np.uint8)
    cv2.fillPoly(filled, [np.round(outline * 16).astype(np.int32)], 1, shift=4)
    both, either = (filled > 0) & (disc > 0.5), (filled > 0) | (disc > 0.5)
    # fillPoly paints the edge pixels too: half a pixel of a radius of 29.
    assert both.sum() / either.sum() > 0.95


def test_outline_nearer_than_the_floor_stays_at_its_place() -> None:
    fan = make_fan(range_min_m=0.3, height_m=0.68)
    place = at(fan, 0.5, 3.0)
    outline = disc_outline(fan, 0.15, *place)
    assert np.isfinite(outline).all()
    np.testing.assert_allclose(outline.mean(axis=0), place, atol=15)


# What is drawn


def test_declared_objects_are_outlined_in_their_colour() -> None:
    place = at(FAN, 2.4, 4.0)
    picture = draw_frame(
        np.zeros((FAN.rows, FAN.columns), np.uint8), FAN, BASIN, [estimate(*place, 3)]
    )
    assert picture.shape == (FAN.rows, FAN.columns, 3)
    outline = disc_outline(FAN, BASIN.radius_m, *place)
    contour = outline.astype(np.float32)[:, None]
    found = painted(picture, landmark_colours(BASIN.ids)[3])
    found = found[found[:, 1] > outline[:, 1].min() - 2]  # below the caption
    away = [abs(cv2.pointPolygonTest(contour, tuple(map(float, p)), True)) for p in found]
    assert len(found) > 100
    assert max(away) < 2
    assert set(map(tuple, np.round(outline).astype(int))) & set(map(tuple, found.tolist()))


def test_small_frames_are_enlarged_about_pixel_centres() -> None:
    fan = make_fan(rows=128)
    assert enlargement(fan) == 4
    picture = draw_frame(
        np.zeros((fan.rows, fan.columns), np.uint8),
        fan,
        BASIN,
        [estimate(60.0, 70.0)],
        paths={0: np.array([[20.0, 100.0], [30.0, 100.0]])},
    )
    assert picture.shape == (512, 4 * fan.columns, 3)
    trail = painted(picture[380:], OKABE_ITO[0], within=90)
    # Pixel 20 covers 80 to 83, its middle is at 81.5.
    np.testing.assert_allclose(trail.mean(axis=0) + np.array([0, 380]), (101.5, 401.5), atol=1)


def test_truth_is_drawn_around_the_estimate() -> None:
    blank = np.zeros((FAN.rows, FAN.columns), np.uint8)
    place = at(FAN, 2.4, 0.0)
    picture = draw_frame(blank, FAN, BASIN, [], truth=[Mark(2, *place)])
    white = painted(picture, (255, 255, 255), within=90)
    above = white[white[:, 1] < place[1]]
    distance = np.hypot(*(above - place).T)
    assert len(above) > 30
    assert distance.min() > 0.95 * BASIN.radius_m / FAN.metres_per_pixel
    # Dashed: some directions are left out.
    angles = np.degrees(np.arctan2(*(above - place).T[::-1]))
    assert len(np.unique(np.round(angles))) < 160


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (estimate(0, 0, 3, p=0.97), "ID.3  0.97"),
        (estimate(0, 0, 3, p=0.6, declared=False), "ID.3?  0.60"),
        (estimate(0, 0, 3, p=0.1, declared=False), ""),
    ],
)
def test_caption(given: Estimate, text: str) -> None:
    assert caption(given, BASIN) == text


@pytest.mark.parametrize("count", [1, 7, 8, 30])
def test_one_colour_per_id(count: int) -> None:
    colours = landmark_colours(range(100, 100 + count))
    assert list(colours.values())[: len(OKABE_ITO)] == list(OKABE_ITO[:count])
    assert len(set(colours.values())) == count
    for colour in colours.values():
        # Contrast to black as WCAG counts it; 3 is asked of graphics.
        linear = [c / 12.92 if c <= 0.04 else ((c + 0.055) / 1.055) ** 2.4
                  for c in np.array(colour) / 255]  # fmt: skip
        assert (np.dot(linear, [0.2126, 0.7152, 0.0722]) + 0.05) / 0.05 > 3


# Dichromats' colours by Machado, Oliveira and Fernandes (2009), severity 1, in linear RGB.
DICHROMATS = {
    "protan": [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]],
    "deutan": [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]],
    "tritan": [[1.2555, -0.0767, -0.1788], [-0.0784, 0.9308, 0.1476], [0.0047, 0.6914, 0.3039]],
}


@pytest.mark.parametrize("kind", DICHROMATS)
def test_colours_are_told_apart_with_any_colour_vision(kind: str) -> None:
    share = np.array(OKABE_ITO) / 255
    linear = np.where(share < 0.04, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array(DICHROMATS[kind]).T, 0, 1)
    seen = np.where(seen < 0.003, seen * 12.92, 1.055 * seen ** (1 / 2.4) - 0.055)
    lab = cv2.cvtColor(seen[None].astype(np.float32), cv2.COLOR_RGB2LAB)[0]
    # Side by side 2.3 is just noticeable; thin lines apart from each other need several times that.
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(lab, 2)) > 12


@settings(max_examples=40)
@given(
    rows=st.integers(2, 700),
    x=st.floats(-1e4, 1e4) | st.floats(-1e15, 1e15),
    y=st.floats(-1e4, 1e4) | st.floats(-1e15, 1e15),
    declared=st.booleans(),
)
def test_any_size_and_place_can_be_drawn(rows: int, x: float, y: float, declared: bool) -> None:
    fan = make_fan(rows=rows)
    one = estimate(x, y, declared=declared)
    frame = draw_frame(np.zeros((fan.rows, fan.columns), np.uint8), fan, BASIN, [one])
    picture = draw_picture(frame, draw_strip([Moment(5, 10**9, (one,))], BASIN, 512))
    assert max(frame.shape) >= 512
    assert picture.shape[0] % 2 == picture.shape[1] % 2 == 0


# Over time


def test_trails_are_cut_and_follow_tracks_only() -> None:
    history = [
        Moment(n, n, (estimate(n, 2 * n, number=7), estimate(n, 0, number=n)))
        for n in range(TRAIL_FRAMES + 10)
    ]
    found = trails(history)
    last = TRAIL_FRAMES + 9
    assert set(found) == {7, last}
    np.testing.assert_array_equal(found[7][:, 0], np.arange(last - TRAIL_FRAMES, last + 1))
    np.testing.assert_array_equal(found[7][:, 1], 2 * found[7][:, 0])
    assert not trails([Moment(0, 0, (estimate(0, 0, method="smi"),))])


def test_strip_has_probability_upwards_and_time_to_the_right() -> None:
    def middle(p: float, frames: int) -> tuple[float, int]:
        history = [Moment(n, n, (estimate(0, 0, 3, p=p),)) for n in range(frames)]
        found = painted(draw_strip(history, BASIN, 512)[22:], landmark_colours(BASIN.ids)[3])
        return float(found[:, 1].mean()), int(np.ptp(found[:, 0]))

    (low, _), (half, wide), (high, _) = (middle(p, 60) for p in (0.02, 0.51, 1.0))
    assert low - half == pytest.approx(half - high, abs=1.5)
    assert low - half > 40
    assert middle(0.5, 30)[1] == pytest.approx(wide * 29 / 59, abs=4)
    # What is older than the strip has left it.
    assert middle(0.5, STRIP_FRAMES)[1] == pytest.approx(middle(0.5, 3 * STRIP_FRAMES)[1], abs=5)


def test_strip_of_a_single_frame_method_joins_nothing() -> None:
    colour = landmark_colours(BASIN.ids)[3]

    def area(method: str) -> int:
        history = [
            Moment(n, n, (estimate(0, 0, 3, p=0.05 if n % 2 else 1.0, method=method),))
            for n in range(60)
        ]
        return len(painted(draw_strip(history, BASIN, 512)[22:], colour))

    assert area("smi") == area("smi:paper") < 0.5 * area("framework")


# Reading estimates.csv


def write_results(
    folder: Path,
    per_frame: list[tuple[Estimate, ...]],
    run: dict[str, Any] | None = None,
    landmarks: LandmarkSet = BASIN,
) -> Path:
    with ResultsWriter(folder, landmarks, {"input": {}} | (run or {})) as writer:
        for n, estimates in enumerate(per_frame):
            writer.write(FrameResult(n, n * PERIOD_NS, 0, len(estimates), estimates))
        writer.finish([])
    return folder


def test_estimates_come_back_as_written(tmp_path: Path) -> None:
    rows = [(), (estimate(10.25, 20.5, 3), estimate(30, 40, 4, number=9)), (), (estimate(1, 2),)]
    path = write_results(tmp_path / "r", rows) / "estimates.csv"
    found = dict(read_estimates(path, "framework", BASIN, FAN))
    assert sorted(found) == [1, 3]
    for read, written in zip(
        itertools.chain(found[1], found[3]), itertools.chain(rows[1], rows[3]), strict=True
    ):
        assert (read.object, read.landmark, read.declared, read.x_px, read.y_px) == (
            written.object, written.landmark, written.declared, written.x_px, written.y_px,
        )  # fmt: skip
        np.testing.assert_allclose(read.probabilities, written.probabilities, atol=1e-6)


def csv_file(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def test_estimates_of_another_program(tmp_path: Path) -> None:
    path = csv_file(
        tmp_path / "e.csv",
        "frame,method,range_m,bearing_deg,landmark,score,declared",
        "4,yolo,2.0,5.0,3,0.8,True",
    )
    assert choose_method(path, None) == "yolo"
    [(frame, [found])] = read_estimates(path, "yolo", BASIN, FAN)
    assert frame == 4
    assert (found.x_px, found.y_px) == pytest.approx(at(FAN, 2.0, 5.0))
    np.testing.assert_allclose(found.probabilities, [0, 0, 0.8, 0, 0.2])
    assert found.object < 0  # and so it has no trail


HEAD = "frame,method,x_px,y_px,landmark,score,declared"


def test_a_method_is_chosen_from_the_first_rows_that_have_it(tmp_path: Path) -> None:
    """Of a long table the rest is read once, by who needs it: here it cannot be."""
    rows = [f"{n},framework,1,1,1,0.5,0" for n in range(2000)]
    path = csv_file(tmp_path / "e.csv", HEAD, *rows, "1,2,3,4,5,6,7,8,9")
    assert choose_method(path, None) == "framework"
    assert choose_method(path, "framework") == "framework"
    with pytest.raises(SonarrecError, match="line 2002: 9 cells"):
        choose_method(path, "smi")


def test_choice_of_method(tmp_path: Path) -> None:
    def chosen(*methods: str, wanted: str | None = None) -> str:
        rows = [f"{n},{m},1,1,1,0.5,0" for n, m in enumerate(methods)]
        return choose_method(csv_file(tmp_path / "e.csv", HEAD, *rows), wanted)

    assert chosen("smi", "framework", "yolo") == "framework"
    assert chosen("smi", "framework:paper") == "framework:paper"
    assert chosen("smi", "framework", wanted="smi") == "smi"
    assert chosen("yolo") == "yolo"
    assert chosen() == "framework"
    assert chosen(wanted="smi") == "smi"
    with pytest.raises(UsageError, match="--method: framework:a, framework:b"):
        chosen("smi", "framework:a", "framework:b")
    with pytest.raises(UsageError, match="no method 'x'; there is smi"):
        chosen("smi", wanted="x")


@pytest.mark.parametrize(
    ("row", "fault"),
    [
        ("0,m,1,1,9,0.5,0", "line 3: landmark 9 is not in the set 'basin'"),
        ("0,m,1,1,x,0.5,0", "line 3: landmark must be a whole number, not 'x'"),
        ("1.5,m,1,1,1,0.5,0", "line 3: frame must be a whole number"),
        ("0,m,nan,1,1,0.5,0", "line 3: no position"),
        ("0,m,,1,1,0.5,0", "line 3: no position"),
        ("0,m,1e300,1,1,0.5,0", "line 3: .*_.* must be a finite number from -1e9 to 1e9"),
        ("0,m,1,1,1,high,0", "line 3: score must be a finite number"),
        ("0,m,1,1,1,0.5,yes", "line 3: declared must be 0 or 1"),
        ("0,m", "line 3: landmark must be a whole number, not an empty cell"),
        ("-1,m,1,1,1,0.5,0", "line 3: frame -1 after frame 0"),
    ],
)
def test_bad_rows_are_told_by_line(row: str, fault: str, tmp_path: Path) -> None:
    path = csv_file(tmp_path / "e.csv", HEAD, "0,m,1,1,1,0.5,0", row)
    with pytest.raises(SonarrecError, match=fault):
        list(read_estimates(path, "m", BASIN, FAN))


@pytest.mark.parametrize(
    ("text", "fault"),
    [("", "empty; expected"), ("frame,method\n", "wrong columns"), ("\0\0", "wrong columns")],
)
def test_tables_of_another_kind(text: str, fault: str, tmp_path: Path) -> None:
    (tmp_path / "e.csv").write_text(text)
    with pytest.raises(SonarrecError, match=fault):
        choose_method(tmp_path / "e.csv", None)


# Whole overlays


def noise(count: int, shape: tuple[int, int] = (128, 96)) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.integers(0, 120, shape, dtype=np.uint8) for _ in range(count)]


def moving(count: int) -> list[tuple[Estimate, ...]]:
    """A declared landmark that wanders, and something that is none; nothing in frame 2."""
    return [
        () if n == 2 else (
            estimate(40.0 + n, 60.0, 3, p=0.9, number=1),
            estimate(70.0, 90.0, 1, p=0.2, declared=False, number=2),
        )
        for n in range(count)
    ]  # fmt: skip


def messages(path: Path) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """(schema, log time, message), each valid by the schema in the file and as published.

    Detections for ROS 2 have a test file of their own.
    """
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            if channel.topic == "/sonarrec/detections":
                continue
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            found = json.loads(message.data)
            validator(schema.data).validate(found)
            parse_as_published(schema.name, found)
            yield schema.name, message.log_time, found


@cache
def validator(schema: bytes) -> Any:
    """Of the messages of a schema, which is checked itself."""
    told = json.loads(schema)
    kind = jsonschema.validators.validator_for(told)
    kind.check_schema(told)
    return kind(told)


@cache
def published(name: str) -> Any:
    """A message of Foxglove by its own definition."""
    import foxglove.messages
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kind = getattr(foxglove.messages, name.removeprefix("foxglove."))
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(kind.get_schema().data).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def parse_as_published(name: str, message: dict[str, Any]) -> None:
    """Read by Foxglove's own definition, which refuses unknown fields and other types."""
    from google.protobuf import json_format

    def protobuf_times(value: Any) -> Any:
        if isinstance(value, dict) and set(value) == {"sec", "nsec"}:
            day = datetime.fromtimestamp(value["sec"], UTC).strftime("%Y-%m-%dT%H:%M:%S")
            return f"{day}.{value['nsec']:09d}Z"
        if isinstance(value, dict):
            return {key: protobuf_times(item) for key, item in value.items()}
        return [protobuf_times(item) for item in value] if isinstance(value, list) else value

    json_format.ParseDict(protobuf_times(message), published(name)())


def nanoseconds(time: dict[str, int]) -> int:
    return time["sec"] * 10**9 + time["nsec"]


def test_annotations_carry_the_stamp_of_the_image(tmp_path: Path) -> None:
    """Header stamps that differ from the log times, as a recorder's always do."""
    images, stamps, logged = noise(5), [], []
    recorded = []
    for n, image in enumerate(images):
        stamps.append(STAMP_NS + n * 249_999_999)
        logged.append(stamps[-1] + 31_000_000 + n)
        stamp = divmod(stamps[-1], 10**9)
        recorded.append(("/sonar", logged[-1], cdr_image(image, stamp=stamp)))
    log = mcap_file(tmp_path / "log.mcap", recorded)
    results = write_results(tmp_path / "results", moving(5))
    write_overlay(log, Targets(mcap=tmp_path / "o.mcap"), results=results)
    found = list(messages(tmp_path / "o.mcap"))
    # The images are in the recording already.
    assert [name for name, _, _ in found] == 5 * ["foxglove.ImageAnnotations"]
    assert [time for _, time, _ in found] == logged
    for stamp, (_, _, message) in zip(stamps, found, strict=True):
        times = [message["timestamp"]]
        times += [e["timestamp"] for e in message["points"] + message["texts"]]
        assert {nanoseconds(t) for t in times} == {stamp}
        assert message["texts"]  # never empty, or old versions hold the image back


def test_frames_beyond_the_times_of_ros_2_are_told_once(tmp_path: Path) -> None:
    """Of Foxglove's own image messages, whose seconds go on: the last of three lies beyond."""
    recorded = []
    for n, image in enumerate(noise(3)):
        time = {"sec": 2**31 - 2 + n, "nsec": 7}
        message = {"timestamp": time, "width": image.shape[1], "height": image.shape[0],
                   "encoding": "mono8", "step": image.shape[1],
                   "data": base64.b64encode(image).decode()}  # fmt: skip
        recorded.append(("/sonar", nanoseconds(time), json.dumps(message).encode()))
    kind = {"schema": "foxglove.RawImage", "encoding": "json", "schema_encoding": "jsonschema"}
    log = mcap_file(tmp_path / "log.mcap", recorded, **kind)
    results, o = write_results(tmp_path / "results", moving(3)), tmp_path / "o.mcap"
    [told] = write_overlay(log, Targets(mcap=o), results=results).diagnostics.problems
    assert f"{o}: 1 frame without /sonarrec/detections" in told
    assert len(list(messages(o))) == 3
    with o.open("rb") as file:
        assert len(list(make_reader(file).iter_messages(topics=["/sonarrec/detections"]))) == 2


def test_annotations_lie_on_the_object(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", noise(4))
    results = write_results(tmp_path / "results", moving(4))
    truth = csv_file(tmp_path / "gt.csv", "frame,landmark,x_px,y_px", "3,3,43,60")
    write_overlay(log, Targets(mcap=tmp_path / "o.mcap"), results=results, ground_truth=truth)
    found = [m for name, _, m in messages(tmp_path / "o.mcap") if name.endswith("Annotations")]
    named, trail, other, dashes = (
        np.array([(p["x"], p["y"]) for p in part["points"]])
        for part in (found[3]["points"][k] for k in (0, 1, 2, 4))
    )
    # Foxglove's origin is the corner of the first pixel: half a pixel from its centre.
    with open_log(log) as opened:
        fan = next(iter(opened)).fan
    np.testing.assert_allclose(named, disc_outline(fan, 0.15, 43.0, 60.0) + 0.5, atol=0.006)
    np.testing.assert_allclose(other.mean(axis=0), (70.5, 90.5), atol=1)
    np.testing.assert_allclose(trail, [[40.5, 60.5], [41.5, 60.5], [43.5, 60.5]])
    np.testing.assert_allclose(dashes.mean(axis=0), named.mean(axis=0), atol=0.2)
    kinds = [part["type"] for part in found[3]["points"]]
    assert kinds == [2, 3, 2, 3, 4]
    colour = [round(255 * named_colour) for named_colour in
              (found[3]["points"][0]["outline_color"][c] for c in "rgb")]  # fmt: skip
    assert tuple(colour) == landmark_colours(BASIN.ids)[3]
    assert [t["text"] for t in found[3]["texts"]] == ["frame 3", "ID.3  0.90", "ID.3"]
    assert [t["text"] for t in found[2]["texts"]] == ["frame 2"]


def test_polar_logs_bring_their_fan(tmp_path: Path) -> None:
    """As one MCAP for Foxglove that is itself a log of equal frames."""
    polar = noise(4, (100, 32))
    toml = SONAR_TOML.replace('"fan"', '"polar"')
    log = mcap_file(
        tmp_path / "log.mcap",
        [("/a", n * PERIOD_NS, cdr_image(i, stamp=(n, 5))) for n, i in enumerate(polar)],
    )
    (tmp_path / "sonar.toml").write_text(toml)
    results = write_results(tmp_path / "results", moving(4))
    write_overlay(log, Targets(mcap=tmp_path / "o.mcap"), results=results)
    with open_log(log) as opened:
        frames = list(opened)
    found = [
        (log_time, m) for name, log_time, m in messages(tmp_path / "o.mcap") if name.endswith("e")
    ]
    for n, (frame, (log_time, image)) in enumerate(zip(frames, found, strict=True)):
        assert (nanoseconds(image["timestamp"]), log_time) == (n * 10**9 + 5, n * PERIOD_NS)
        png = np.frombuffer(base64.b64decode(image["data"]), np.uint8)
        np.testing.assert_array_equal(cv2.imdecode(png, cv2.IMREAD_UNCHANGED), frame.image)
    fan = frames[0].fan
    stated = Sonar(
        layout="fan",
        metres_per_pixel=fan.metres_per_pixel,
        apex_px=(fan.apex_column, fan.apex_row),
    )
    stated = load_sonar(tmp_path / "sonar.toml").updated(stated)
    with open_log(tmp_path / "o.mcap", sonar=stated) as opened:
        for again, frame in zip(opened, frames, strict=True):
            assert again.fan == fan
            np.testing.assert_array_equal(again.image, frame.image)


def test_the_log_is_read_as_the_run_read_it(tmp_path: Path) -> None:
    """Topic, clock and geometry of run.toml; a flipped log is shown by the overlay's own images."""
    stored = [
        (topic, n * PERIOD_NS, cdr_image(image + shade, stamp=(n, 0)))
        for n, image in enumerate(noise(3))
        for topic, shade in (("/a", 0), ("/b", 100))
    ]
    log = mcap_file(tmp_path / "log.mcap", stored)
    sonar = load_sonar(tmp_path / "sonar.toml").updated(Sonar(flip=True))
    run = {"input": {"topic": "/b", "time": "header"}, "sonar": sonar.as_table()}
    (tmp_path / "sonar.toml").unlink()
    results = write_results(tmp_path / "results", moving(3), run)
    o = tmp_path / "o.mcap"
    assert not write_overlay(log, Targets(mcap=o), results=results).diagnostics.notes
    found = [m for name, _, m in messages(tmp_path / "o.mcap") if name.endswith("e")]
    for message, image in zip(found, noise(3), strict=True):
        png = np.frombuffer(base64.b64decode(message["data"]), np.uint8)
        shown = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(shown, image[:, ::-1] + 100)
    other = write_overlay(log, Targets(mcap=tmp_path / "a.mcap"), results=results, topic="/a")
    assert other.diagnostics.notes == [f"{results}: results of topic /b, drawn onto /a"]


def test_video_and_images(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", noise(6, (131, 97)))
    results = write_results(tmp_path / "results", moving(6))
    video, images = tmp_path / "o.mp4", tmp_path / "shots"
    done = write_overlay(log, Targets(video=video, images=images), results=results, span=(1, 5))
    assert (done.method, done.frames) == ("framework", 4)
    assert done.diagnostics.problems == []
    assert sorted(p.name for p in images.iterdir()) == [f"{n:06d}.png" for n in range(1, 5)]
    player = cv2.VideoCapture(str(video))
    assert player.get(cv2.CAP_PROP_FPS) == 4
    for n in range(1, 5):
        ok, played = player.read()
        assert ok
        picture = cv2.imread(str(images / f"{n:06d}.png"))
        assert picture is not None
        assert picture.shape == played.shape == (664, 512, 3)
        # The codec loses some of the speckle, not the drawing.
        assert np.abs(played.astype(int) - picture).mean() < 6
    assert not player.read()[0]


@pytest.mark.usefixtures("work")
def test_a_video_may_be_called_by_its_time() -> None:
    """What stands before a colon is no protocol; OpenCV dies of a name that is not UTF-8."""
    sonarrec("overlay", "log", "--video", "12:30:00.mp4", "-q")
    sonar = Sonar("fan", 1.0, 3.0, 30.0, 20.0)
    with open_log("12:30:00.mp4", sonar=sonar) as video:
        assert len(list(video)) == 4
    told = sonarrec("overlay", "log", "--video", os.fsdecode(b"d\xe9.mp4"), code=1)
    assert told.stderr.startswith(r"sonarrec: d\xe9.mp4: the name of a video must be UTF-8")


@pytest.mark.slow
def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    """The index of the file grows by a hundred bytes a frame. Were the images of 200 more kept,
    these would be 600 kB."""

    def peak(count: int) -> int:
        folder = tmp_path / str(count)
        log = image_folder(folder / "log", noise(count, (64, 48)))
        results = write_results(folder / "results", moving(count))
        done = 0

        def observe(_: int | None) -> None:
            nonlocal done
            done += 1
            if done == 1:  # what is read before the frames takes more than all of them
                tracemalloc.reset_peak()

        tracemalloc.start()
        write_overlay(log, Targets(mcap=folder / "o.mcap"), results=results, observe=observe)
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert done == count
        return found

    peak(5)  # imports
    # With fewer frames the first chunk is not full yet.
    assert peak(440) - peak(240) < 200_000


# The command


def sonarrec(*arguments: str | Path, code: int = 0) -> Result:
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    assert (code == 0) == (result.stderr == "")
    assert "Traceback" not in result.output
    return result


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a log, `log`, and what `sonarrec run` would leave of it."""
    monkeypatch.chdir(tmp_path)
    image_folder(tmp_path / "log", noise(4))
    with open_log("log") as log:
        size, digest = log.digest_source()
        sonar = log.sonar.as_table()
    run = {
        "input": {"name": "log", "bytes": size, "sha256": digest},
        "sonar": sonar,
        "landmarks": BASIN.as_table(),
    }
    write_results(tmp_path / "sonarrec_out" / "log", moving(4), run)
    return tmp_path


def test_the_command(work: Path) -> None:
    (work / "log" / "sonar.toml").unlink()  # run.toml tells the geometry
    told = sonarrec("overlay", "log", "--mcap", "o.mcap", "--video", "o.mp4", "--images", "shots")
    assert told.stdout.splitlines() == [
        "o.mcap: 4 frames, framework", "o.mp4: 4 frames, framework", "shots: 4 frames, framework",
    ]  # fmt: skip
    assert len(list(messages(work / "o.mcap"))) == 8
    assert len(list((work / "shots").iterdir())) == 4
    sonarrec("overlay", "log", "sonarrec_out/log", "--images", "one", "--frames", "2:3", "-q")
    assert [p.name for p in (work / "one").iterdir()] == ["000002.png"]
    two = [(work / d / "000002.png").read_bytes() for d in ("one", "shots")]
    assert two[0] == two[1]  # what came before is in its strip all the same


@pytest.mark.slow
def test_from_run_to_overlay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is named on the sample log lies on the landmark of that name."""
    monkeypatch.chdir(tmp_path)
    sonarrec("run", SAMPLE, "-q")
    sonarrec("overlay", SAMPLE, "--mcap", "o.mcap", "--video", "o.mp4", "-q")
    with SAMPLE.with_suffix(".gt.csv").open(newline="") as file:
        truth = {(int(r["frame"]), int(r["landmark"])): r for r in csv.DictReader(file)}
    shown = right = 0
    for frame, (_, _, message) in enumerate(messages(tmp_path / "o.mcap")):
        loops = [np.array([(q["x"], q["y"]) for q in p["points"]])
                 for p in message["points"] if p["type"] == 2 and p["thickness"] == 2]  # fmt: skip
        names = [t["text"] for t in message["texts"] if re.fullmatch(r"ID\.\d  .*", t["text"])]
        for loop, name in zip(loops, names, strict=True):
            middle = (loop.min(axis=0) + loop.max(axis=0)) / 2
            row = truth.get((frame, int(name[3])), {"x_px": "nan", "y_px": "nan"})
            place = np.array([float(row["x_px"]), float(row["y_px"])]) + 0.5
            # Within a disc's radius, 15 px, as the strict protocol counts a claim as right.
            right += bool(np.hypot(*(middle - place)) < 15)
            shown += 1
    assert right > 0.95 * shown
    assert shown > 100
    assert cv2.VideoCapture("o.mp4").get(cv2.CAP_PROP_FRAME_COUNT) == 128


def test_results_of_a_packed_log_of_any_name_are_found(tmp_path: Path) -> None:
    log = mcap_file(tmp_path / "l.mcap", [("/s", n, cdr_image(i)) for n, i in enumerate(noise(2))])
    packed = tmp_path / os.fsdecode(b"d\xe9ve.mcap.zst")
    packed.write_bytes(zstandard.compress(log.read_bytes()))
    write_results(tmp_path / "out" / r"d\xe9ve", moving(2))
    targets = Targets(images=tmp_path / "shots")
    assert write_overlay(packed, targets, results=tmp_path / "out").frames == 2


@pytest.mark.usefixtures("work")
def test_results_named_with_the_folder_of_the_log_are_found() -> None:
    """A run of several logs of one name names them so."""
    for name in ("log", "log.part"):
        Path("sonarrec_out", "log").rename(Path("sonarrec_out", f"{Path.cwd().name}-{name}"))
        assert "4 frames" in sonarrec("overlay", "log", "--images", "shots").stdout
        Path("sonarrec_out", f"{Path.cwd().name}-{name}").rename(Path("sonarrec_out", "log"))


def test_the_frames_drawn_are_those_that_were_run(work: Path) -> None:
    """Nobody looked at the others: an empty picture of them would say that nothing is there."""
    run = work / "sonarrec_out" / "log" / "run.toml"
    text = run.read_text().replace("[input]", '[input]\nframes = "1:3"')
    assert "frames" in text
    run.write_text(text)
    sonarrec("overlay", "log", "--mcap", "o.mcap", "--images", "shots", "-q")
    assert sorted(p.name for p in (work / "shots").iterdir()) == ["000001.png", "000002.png"]
    assert len(list(messages(work / "o.mcap"))) == 4
    sonarrec("overlay", "log", "--images", "all", "--frames", "0:", "-q")
    assert len(list((work / "all").iterdir())) == 4


def test_a_run_that_was_cut_short(work: Path) -> None:
    run = work / "sonarrec_out" / "log" / "run.toml"
    run.write_text(run.read_text().replace("finished = true", "finished = false"))
    told = sonarrec("overlay", "log", "--mcap", "o.mcap", code=3)
    assert "the run was cut short; frames after 3 have no results" in told.stderr
    # As a run leaves it that was stopped.
    run.parent.rename(run.parent.with_name("log.part"))
    for results in ([], ["sonarrec_out/log"]):
        told = sonarrec("overlay", "log", *results, "--mcap", "o.mcap", code=3)
        assert "log.part: the run was cut short; frames after 3 have no results" in told.stderr
    assert (
        "no results of log here"
        in sonarrec("overlay", "log", "none", "--mcap", "o.mcap", code=2).stderr
    )


@pytest.mark.parametrize(
    ("arguments", "code", "fault"),
    [
        ("", 2, "nothing to write: give --mcap OUT"),
        ("--video o.gif", 2, "o.gif: a video is written as NAME.mp4"),
        ("--video paper.csv/o.mp4", 2, "paper.csv/o.mp4: paper.csv is not a folder"),
        ("--mcap paper.csv/o.mcap", 2, "paper.csv/o.mcap: paper.csv is not a folder"),
        ("--images log", 2, "log/000000.png: it would become part of the recording"),
        ("--images log/sonar.toml", 2, "log/sonar.toml: it would become part of the recording"),
        ("--mcap o.mcap --frames 3", 2, "--frames: expected A:B"),
        ("--mcap o.mcap --frames 3:3", 2, "no frame from 3 up to, not including, 3"),
        ("--mcap o.mcap --frames 9:", 2, "no frame lies in --frames 9:"),
        ("--mcap o.mp4 --video ../{0}/o.mp4", 2, "o.mp4: each output needs a name of its own"),
        ("--mcap o.mcap --method x", 2, "no method 'x'; there is framework"),
        ("elsewhere --mcap o.mcap", 2, "elsewhere: no results of log here"),
        ("--mcap o.mcap --ground-truth paper.csv", 1, "paper.csv: no positions"),
    ],
)
def test_faults_are_one_line(arguments: str, code: int, fault: str, work: Path) -> None:
    csv_file(work / "paper.csv", "frame,landmark", "0,3")
    told = sonarrec("overlay", "log", *arguments.format(work.name).split(), code=code)
    assert fault in told.stderr
    assert len(told.stderr.splitlines()) == 1
    assert not told.stdout


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        (("frame,landmark,x_px,y_px", "1003,3,43,60"), "truth of another log?"),
        (("log,frame,landmark,x_px,y_px", "dive,3,3,43,60"), "its log column names none of log"),
        (("frame,landmark,x_px,y_px",), "it has no row"),
    ],
)
def test_truth_of_another_log_is_told(lines: tuple[str, ...], told: str, work: Path) -> None:
    csv_file(work / "gt.csv", *lines)
    done = sonarrec("overlay", "log", "--images", "o", "--ground-truth", "gt.csv", code=3)
    (line,) = done.stderr.splitlines()
    assert line.startswith("sonarrec: gt.csv: ")
    assert told in line
    assert "no truth is drawn" in line


def test_what_was_written_before_a_fault_is_kept(work: Path) -> None:
    with (work / "sonarrec_out" / "log" / "estimates.csv").open("a") as file:
        file.write("3,0,framework,x\n")
    told = sonarrec("overlay", "log", "--mcap", "o.mcap", code=1)
    assert "estimates.csv line 8: landmark must be a whole number" in told.stderr
    with pytest.raises(McapError):
        list(messages(work / "o.mcap"))  # no footer: it is not whole
    with open_log("o.mcap", sonar_file=work / "log" / "sonar.toml") as kept:
        assert len(list(kept)) == 2  # frame 2 has no row: the next was read to know


def test_an_older_overlay_stays_where_there_is_nothing_to_write(work: Path) -> None:
    targets = ("--mcap", "o.mcap", "--foxglove-layout", "o.json")
    sonarrec("overlay", "log", *targets, "-q")
    (work / "o.json").write_bytes((work / "o.json").read_bytes().replace(b"65", b"50"))
    before = [(work / name).read_bytes() for name in ("o.mcap", "o.json")]
    sonarrec("overlay", "log", *targets, "--frames", "9:", code=2)
    assert [(work / name).read_bytes() for name in ("o.mcap", "o.json")] == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full not found")
@pytest.mark.parametrize("target", ["--mcap", "--video"])
@pytest.mark.parametrize("count", [3, 200])
def test_full_disk(target: str, count: int, work: Path) -> None:
    """Told in one line, at the close or in the middle of it."""
    name = "full.mcap" if target == "--mcap" else "full.mp4"
    (work / name).symlink_to("/dev/full")
    image_folder(work / "many", noise(count))
    write_results(work / "res", moving(3))
    told = sonarrec("overlay", "many", "res", target, name, code=1)
    assert len(told.stderr.splitlines()) == 1
    assert told.stderr.startswith(f"sonarrec: {name}: ")


def test_no_such_log(work: Path) -> None:
    told = sonarrec("overlay", "nowhere.mcap", "--mcap", "o.mcap", code=2)
    assert told.stderr == "sonarrec: nowhere.mcap: no such file or folder\n"
    assert not (work / "o.mcap").exists()


def test_results_of_another_log(work: Path) -> None:
    cv2.imwrite("log/frame0.png", noise(1)[0] + 1)
    told = sonarrec("overlay", "log", "--mcap", "o.mcap", code=1)
    assert "results of another log, log with" in told.stderr
    assert len(told.stderr.splitlines()) == 1
    # Tables of another program tell of no input: their frame numbers do.
    (work / "sonarrec_out" / "log" / "run.toml").unlink()
    sonarrec("overlay", "log", "--mcap", "o.mcap")
    (work / "log" / "frame3.png").unlink()
    told = sonarrec("overlay", "log", "--mcap", "o.mcap", code=1)
    assert "frame 3 is listed, but log has only 3 frames" in told.stderr


def test_a_topic_of_another_log_is_nothing_that_was_given(work: Path) -> None:
    folder = work / "sonarrec_out" / "log"
    run = tomllib.loads((folder / "run.toml").read_text())
    run["input"].update(name="dive.mcap", sha256="0" * 64, topic="/sonar", time="header")
    (folder / "run.toml").write_text(tomli_w.dumps(run))
    told = sonarrec("overlay", "log", "--mcap", "o.mcap", code=1)
    assert "results of another log, dive.mcap with" in told.stderr
    told = sonarrec("overlay", "log", "--mcap", "o.mcap", "--topic", "/sonar", code=2)
    assert "--topic chooses a channel of an MCAP or a ROS bag; this log is neither" in told.stderr


def test_the_recording_is_never_overwritten(work: Path) -> None:
    log = mcap_file(work / "rec" / "r.mcap", [("/a", 0, cdr_image(noise(1)[0]))])
    before = log.read_bytes()
    write_results(work / "res", moving(1))
    sonarrec("overlay", log, "res", "--mcap", "rec/../rec/r.mcap", code=2)
    sonarrec("overlay", "log/*.png", "--images", "log", code=2)
    assert log.read_bytes() == before
