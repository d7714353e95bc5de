"""Detections for ROS 2, read back by other people's readers and held against estimates.csv."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sonarrec.landmarks import load_landmarks
from sonarrec.nouns import Estimate
from sonarrec.overlays.detections import detections_message
from tests.support.command import SAMPLE, sample_log, sonarrec
from tests.support.drawn import make_fan

TOPIC = "/sonarrec/detections"
NAME = "vision_msgs/msg/Detection3DArray"
HEIGHT = 0.68
FAN = make_fan(rows=512)
BASIN = load_landmarks("basin")


def detections(path: Path) -> Iterator[tuple[int, Any]]:
    """(log time, message) by the definitions in the file."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for found in reader.iter_decoded_messages(topics=[TOPIC]):
            yield found.message.log_time, found.decoded_message


@pytest.fixture(scope="module")
def overlaid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample log run and overlaid: overlay.mcap, layout.json, results in out/pan."""
    folder = tmp_path_factory.mktemp("detections")
    log = SAMPLE.with_suffix(".mcap")
    sonarrec("run", log, "-o", folder / "out", "-q")
    layout = ("--foxglove-layout", folder / "layout.json")
    sonarrec("overlay", log, folder / "out", "--mcap", folder / "overlay.mcap", *layout, "-q")
    return folder


def test_detections_equal_estimates(overlaid: Path) -> None:
    with (overlaid / "out" / "pan" / "estimates.csv").open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["method"] == "framework"]
    declared: dict[int, list[dict[str, str]]] = {}
    for row in rows:
        if row["declared"] == "1":
            declared.setdefault(int(row["timestamp_ns"]), []).append(row)
    found = list(detections(overlaid / "overlay.mcap"))
    assert len(found) == 128
    assert sum(len(message.detections) for _, message in found) > 100
    for time, message in found:
        assert message.header.frame_id == "sonar"
        told = declared.get(time, [])
        assert len(message.detections) == len(told)
        for one, row in zip(message.detections, told, strict=True):
            check(one, row)


def check(one: Any, row: dict[str, str]) -> None:
    """A detection against its row of estimates.csv."""
    [result] = one.results
    assert one.id == row["object"]
    assert result.hypothesis.class_id == row["landmark"]
    assert result.hypothesis.score == pytest.approx(float(row["score"]), abs=1e-9)
    at, turn = result.pose.pose.position, result.pose.pose.orientation
    # x ahead, y to the left, z up.
    range_m, bearing = float(row["range_m"]), math.radians(float(row["bearing_deg"]))
    assert math.hypot(at.x, at.y, at.z) == pytest.approx(range_m, abs=1e-6)
    assert math.atan2(-at.y, at.x) == pytest.approx(bearing, abs=1e-9)
    assert at.z == pytest.approx(-HEIGHT, abs=1e-6)
    assert (turn.x, turn.y) == (0, 0)
    ahead = math.degrees(2 * math.atan2(turn.z, turn.w)) + 90  # from the sonar's right
    assert math.remainder(ahead - float(row["orientation_deg"]), 360) == pytest.approx(0, abs=1e-6)
    covariance = np.asarray(result.pose.covariance).reshape(6, 6)
    ground = math.hypot(at.x, at.y)
    sight = np.array([math.cos(bearing), -math.sin(bearing)])
    side = np.array([math.sin(bearing), math.cos(bearing)])
    place = covariance[:2, :2]
    along, across = (math.sqrt(v @ place @ v) for v in (sight, side))
    assert along == pytest.approx(float(row["range_sigma_m"]) * range_m / ground, rel=1e-6)
    assert across == pytest.approx(ground * math.radians(float(row["bearing_sigma_deg"])), rel=1e-6)
    assert sight @ place @ side == pytest.approx(0, abs=1e-12)
    assert math.degrees(math.sqrt(covariance[5, 5])) == pytest.approx(
        float(row["orientation_sigma_deg"])
    )
    assert np.count_nonzero(covariance) <= 5
    assert (one.bbox.size.x, one.bbox.size.y, one.bbox.size.z) == (0.3, 0.3, 0)
    assert one.bbox.center.position.x == at.x


def test_stamps_are_those_of_the_images(overlaid: Path) -> None:
    """So that a player shows both together."""
    with (SAMPLE.with_suffix(".mcap")).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        images = [m.decoded_message.header.stamp for m in reader.iter_decoded_messages()]
    found = [m.header.stamp for _, m in detections(overlaid / "overlay.mcap")]
    assert [(s.sec, s.nanosec) for s in found] == [(s.sec, s.nanosec) for s in images]


def test_what_is_not_known_is_told_as_such() -> None:
    nan = math.nan
    known = Estimate("x", -1, 0, 0, 2.0, 5.0, nan, 1, np.ones(5) / 5, 3, 0.8, True)
    near = Estimate("x", 7, 0, 0, 0.3, -5.0, 30.0, 1, np.ones(5) / 5, 3, 0.8, True)
    quiet = Estimate("x", 8, 0, 0, 2.0, 0.0, 30.0, 1, np.ones(5) / 5, 3, 0.8, False)
    store = get_typestore(Stores.ROS2_HUMBLE)
    from sonarrec.overlays.detections import definition

    store.register(get_types_from_msg(definition().decode(), NAME))
    data = detections_message(FAN, 5_000_000_007, BASIN, [known, near, quiet])
    message: Any = store.deserialize_cdr(data, NAME)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (5, 7)
    first, second = message.detections  # not the one that is not declared
    assert first.id == ""
    covariance = first.results[0].pose.covariance.reshape(6, 6)
    assert covariance[5, 5] == pytest.approx(math.pi**2)
    assert np.count_nonzero(covariance) == 1
    # Nearer than the floor: below the sonar, no farther than it was measured.
    at = second.results[0].pose.pose.position
    assert (at.x, at.y) == pytest.approx((0, 0))
    assert at.z == pytest.approx(-0.3)


def test_the_layout_shows_what_is_there(overlaid: Path) -> None:
    layout = json.loads((overlaid / "layout.json").read_text())
    panels: list[str] = []

    def collect(node: Any) -> None:
        if isinstance(node, str):
            panels.append(node)
        else:
            assert node["direction"] in ("row", "column")
            collect(node["first"])
            collect(node["second"])

    collect(layout["layout"])
    assert sorted(panels) == sorted(layout["configById"])
    topics = set()
    for path in (SAMPLE.with_suffix(".mcap"), overlaid / "overlay.mcap"):
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
            assert summary is not None
            topics |= {channel.topic for channel in summary.channels.values()}
    configs = {name.partition("!")[0]: c for name, c in layout["configById"].items()}
    image = configs["Image"]["imageMode"]
    assert image["imageTopic"] in topics - {"/sonarrec/annotations"}
    assert set(image["annotations"]) == {"/sonarrec/annotations"} <= topics
    assert configs["Table"]["topicPath"].partition(".")[0] in topics
    [line] = configs["Plot"]["paths"]
    assert line["value"].partition(".")[0] in topics
    assert line["enabled"]


def test_the_layout_of_images_shows_the_fan_of_the_overlay(tmp_path: Path) -> None:
    log = sample_log(tmp_path / "pan", 10)
    sonarrec("run", log, "-o", tmp_path / "out", "-q")
    overlay = ("overlay", log, tmp_path / "out", "--foxglove-layout", tmp_path / "l.json")
    assert "--foxglove-layout needs --mcap" in sonarrec(*overlay, code=2).stderr
    sonarrec(*overlay, "--mcap", tmp_path / "o.mcap")
    panels = json.loads((tmp_path / "l.json").read_text())["configById"]
    assert panels["Image!sonarrec"]["imageMode"]["imageTopic"] == "/sonarrec/fan"
