"""Every sonar message type, encoding and compression, as other packages write it, gives the frames
of the image folder; and what drivers do differently."""

from __future__ import annotations

import dataclasses
import json
import math
import struct
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import messages
import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given, settings
from hypothesis import strategies as st
from logs import PERIOD_NS, SONAR_TOML, frames, image_folder, mcap_file
from messages import (
    BIN_M,
    DEFINITIONS,
    FIRST_BIN,
    SOUND_SPEED,
    WRITERS,
    bearings_deg,
    directions,
    polar_toml,
    serialised,
    sidecars,
    stamp_ns,
)

from sonarrec import config
from sonarrec.cli import main
from sonarrec.geometry import PolarToFan, Sonar, polar_from_pixel, sonar_from_table
from sonarrec.mcap_writer import SCHEMAS, is_polar
from sonarrec.pipeline import process
from sonarrec.readers import open_log
from sonarrec.readers.fans import FanImages, looks_beam_major
from sonarrec.readers.messages import MESSAGES, decoder_for, message_type
from sonarrec.readers.raw import Ping, RawFrame, UnusableError
from sonarrec.readers.ros_definitions import (
    DefinitionError,
    Struct,
    definition_text,
    known,
    parse_definition,
)
from sonarrec.records import Frame, SonarrecError, UsageError
from sonarrec.simulation.simulate import load_scene, render

PROJECTED = "marine_acoustic_msgs/msg/ProjectedSonarImage"
RAW = "marine_acoustic_msgs/msg/RawSonarImage"
OCULUS = "oculus_interfaces/msg/Ping"
BINS, BEAMS = 60, 24
BEARINGS_DEG = bearings_deg(BEAMS)
TILT = Sonar(tilt_deg=20.0)


def polar_frames(count: int = 3) -> list[np.ndarray]:
    """Bright blobs on speckle: samples resemble their neighbours, as a sonar's do."""
    rng = np.random.default_rng(7)
    images = []
    for _ in range(count):
        speckle = cv2.GaussianBlur(rng.normal(0, 1, (BINS, BEAMS)), (0, 0), 1.2)
        images.append(np.clip(90 + 90 * speckle, 1, 255).astype(np.uint8))
    return images


def read(path: Path, **options: Any) -> tuple[list[Frame], list[str], list[str]]:
    with open_log(path, **options) as log:
        return list(log), log.problems, log.notes


# The matrix


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("writer", WRITERS)
def test_every_message_gives_the_frames_of_the_folder(
    writer: str, compression: str, tmp_path: Path
) -> None:
    images = polar_frames()
    log = tmp_path / "log.mcap"
    WRITERS[writer](log, images, compression)
    mine, theirs = sidecars(writer, BINS, BEAMS)
    (tmp_path / "sonar.toml").write_text(mine or SONAR_TOML)
    folder = image_folder(tmp_path / "folder", images)
    (folder / "sonar.toml").write_text(theirs or SONAR_TOML)
    found, problems, notes = read(log)
    expected, _, _ = read(folder)
    assert not problems
    assert not notes
    for k, (frame, same) in enumerate(zip(found, expected, strict=True)):
        assert (frame.index, frame.timestamp_ns) == (k, k * PERIOD_NS)
        assert frame.stamps.log == k * PERIOD_NS
        assert frame.stamps.publish in (k * PERIOD_NS, k * PERIOD_NS + 1)  # the SDK keeps one
        assert frame.stamps.header == stamp_ns(k)
        np.testing.assert_array_equal(frame.image, same.image)
        assert dataclasses.astuple(frame.fan) == pytest.approx(dataclasses.astuple(same.fan))


@pytest.fixture(scope="module")
def recording() -> list[np.ndarray]:
    """Simulated pings with landmarks, in the messages' window."""
    scene = load_scene("sample_polar")
    sonar = replace(
        scene.sonar,
        range_min_m=FIRST_BIN * BIN_M,
        range_max_m=(FIRST_BIN + 128) * BIN_M,
        range_bins=128,
        beams=48,
    )
    return [frame.image for frame in render(replace(scene, sonar=sonar, frames=4))]


Estimates = Callable[[str, list[np.ndarray]], bytes]


@pytest.fixture(scope="module")
def estimates_of_folder(tmp_path_factory: pytest.TempPathFactory) -> Estimates:
    """estimates.csv of an image folder, worked out once for each sonar.toml."""
    done: dict[str, bytes] = {}

    def estimates(toml: str, images: list[np.ndarray]) -> bytes:
        if toml not in done:
            path = tmp_path_factory.mktemp("folder")
            folder = image_folder(path / "log", images)
            (folder / "sonar.toml").write_text(toml)
            process(folder, path, config.preset("default"))
            done[toml] = (path / "log" / "estimates.csv").read_bytes()
        return done[toml]

    return estimates


@pytest.mark.parametrize("writer", WRITERS)
def test_every_message_gives_the_estimates_of_the_folder(
    writer: str,
    recording: list[np.ndarray],
    estimates_of_folder: Estimates,
    tmp_path: Path,
) -> None:
    """A log with landmarks through the whole program: the same bytes."""
    images = recording
    if "culus" in writer:  # which records from the sonar on
        images = [np.pad(image, ((FIRST_BIN, 0), (0, 0))) for image in images]
    log = tmp_path / "log.mcap"
    WRITERS[writer](log, images, "zstd")
    bins, beams = images[0].shape
    mine, theirs = sidecars(writer, bins, beams)
    if not theirs:
        mine = theirs = polar_toml(bins, FIRST_BIN, bearings_deg(beams))
    (tmp_path / "sonar.toml").write_text(mine)
    summary = process(log, tmp_path / "out", config.preset("default"))
    assert not summary.problems
    assert not summary.notes
    found = (tmp_path / "out" / "log" / "estimates.csv").read_bytes()
    assert found.count(b"\n") > 8
    assert found == estimates_of_folder(theirs, images)


# One message


def ping_of(name: str, fields: dict[str, Any], **options: Any) -> Ping:
    decode = decoder_for(name, "ros2msg", messages.definition(name), "cdr")
    assert decode is not None
    assert decode.polar
    return decode(memoryview(serialised(name, fields, **options)))


@pytest.mark.parametrize("forward", ["x", "y", "z"])
@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("side", [1, -1])
def test_the_forward_axis_is_found(forward: str, backwards: bool, side: int) -> None:
    image = polar_frames(1)[0]
    for across in set("xyz") - {forward}:
        vectors = directions(BEARINGS_DEG + 3.0, across, forward)
        for vector in vectors:
            vector[forward] *= -1 if backwards else 1
            vector[across] *= side  # drivers disagree; beams always run from left to right
        fields = messages.projected_fields(0, image) | {"beam_directions": vectors}
        told = ping_of(PROJECTED, fields).sonar
        assert told is not None
        expected = (BEARINGS_DEG + 3.0) * (1 if side > 0 else -1)
        expected = expected if expected[0] < expected[-1] else -expected
        np.testing.assert_allclose(told.bearings_deg, expected, atol=1e-9)


@pytest.mark.parametrize("number", range(10))
@pytest.mark.parametrize("order", ["<", ">"])
def test_every_sample_type(number: int, order: str) -> None:
    dtype = np.dtype(order + ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"][number])
    values = (polar_frames(1)[0] // 3).astype(dtype)
    fields = messages.projected_fields(0, values)
    fields["image"] = messages.samples(values, number) | {"is_bigendian": order == ">"}
    np.testing.assert_array_equal(ping_of(PROJECTED, fields).pixels, values)


def test_uneven_ranges(tmp_path: Path) -> None:
    """Bins that grow with range: each pixel of the fan shows the bin at its own range."""
    middles = 1 + 0.9 * np.linspace(0, 1, BINS) ** 1.5
    image = np.repeat(np.arange(10, 10 + BINS, dtype=np.uint8)[:, None], BEAMS, axis=1)
    fields = messages.projected_fields(0, image) | {"ranges": middles.astype(np.float32)}
    frame = read(log_of(tmp_path / "log.mcap", [fields]), sonar=TILT)[0][0]
    row, column = np.mgrid[0 : frame.fan.rows, 0 : frame.fan.columns]
    range_m, _ = polar_from_pixel(frame.fan, column, row)
    expected = np.interp(range_m, middles, np.arange(10, 10 + BINS))
    seen = frame.image > 0
    assert seen.mean() > 0.3
    # cv2.remap places to a 32nd of a bin, and pixels are whole numbers.
    assert np.abs(frame.image[seen] - expected[seen]).max() <= 0.5 + 1 / 32 + 0.01


def test_gains_are_taken_out() -> None:
    image = polar_frames(1)[0]
    gains = np.linspace(1, 4000, BINS).astype(np.uint32)
    for size in (1, 2, 4):
        values = image.astype(f"<u{size}")
        rows = [gain.tobytes() + row.tobytes() for gain, row in zip(gains, values, strict=True)]
        step = 4 + BEAMS * size
        for stated in (step, BEAMS):  # the second is wrong, as a driver may be
            fields = messages.oculus_interfaces_fields(0, image) | {
                "has_gains": True, "sample_size": size, "step": stated,
                "ping_data": np.frombuffer(b"".join(rows), np.uint8),
            }  # fmt: skip
            np.testing.assert_allclose(
                ping_of(OCULUS, fields).pixels, image / np.sqrt(gains)[:, None], rtol=1e-6
            )


def test_raw_sonar_image_ranges() -> None:
    """Range is (sample0 + i) c / (2 rate), told about the middle of each sample."""
    fields = messages.raw_fields(0, polar_frames(1)[0]) | {"sample0": 3, "sample_rate": 2000.0}
    told = ping_of(RAW, fields).sonar
    assert told is not None
    metres = SOUND_SPEED / 4000.0
    assert told.range_min_m == pytest.approx(2.5 * metres)
    assert told.range_max_m == pytest.approx((2.5 + BINS) * metres)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        (PROJECTED, {"ranges": np.zeros(BINS, np.float32)}, "ranges do not rise"),
        (PROJECTED, {"ranges": np.full(BINS, np.nan, np.float32)}, "'ranges' is no list"),
        (PROJECTED, {"ranges": np.arange(3, dtype=np.float32)}, "do not fit 1440 bytes"),
        (PROJECTED, {"beam_directions": []}, "fewer than two beams"),
        (PROJECTED, {"beam_directions": directions(np.zeros(BEAMS))}, "do not run one way"),
        (PROJECTED, {"beam_directions": directions(np.zeros(5))}, "24 beams with 5 directions"),
        (PROJECTED, {"beam_directions": directions(np.linspace(-91, 91, BEAMS))}, "90 deg"),
        (RAW, {"sample_rate": 0.0}, "0 samples a second"),
        (RAW, {"rx_angles": np.zeros(0, np.float32)}, "24 beams with 0 directions"),
        (
            RAW,
            {
                "samples_per_beam": 2**32 - 1,
                "rx_angles": np.zeros(0, np.float32),
                "image": messages.samples(np.zeros((0, 0), np.uint8)),
            },
            "0 beams of 4294967295 samples are no image",
        ),
        (OCULUS, {"range_resolution": -1.0}, "range resolution -1 m"),
        (OCULUS, {"range_resolution": 1e308}, "'range_resolution' is no number"),
        (OCULUS, {"sample_size": 3}, "samples of 3 bytes"),
        (OCULUS, {"n_beams": 0}, "do not fit"),
        (OCULUS, {"bearings": np.arange(5, dtype=np.int16)}, "24 beams with 5 bearings"),
        (OCULUS, {"bearings": np.zeros(BEAMS, np.int16)}, "do not run one way"),
    ],
)  # fmt: skip
def test_pings_that_cannot_be_used(name: str, change: dict[str, Any], says: str) -> None:
    fields = messages.FIELDS[name](0, polar_frames(1)[0])
    with pytest.raises(UnusableError, match=says):
        ping_of(name, fields | change)


@pytest.mark.parametrize("name", messages.FIELDS)
@pytest.mark.parametrize("wire", ["cdr", "ros1", "json"])
@settings(max_examples=25, deadline=None, derandomize=True)
@given(data=st.data())
def test_damaged_messages_never_escape(name: str, wire: str, data: st.DataObject) -> None:
    """Whatever the bytes, a decoder gives a ping or says that it cannot be used."""
    fields = messages.FIELDS[name](0, polar_frames(1)[0][:8, :8])
    decode = decoder_for(name, "", b"", wire)
    if decode is None:  # no definition of ours
        return
    if wire == "json":
        message = bytearray(json.dumps(messages.plain(fields)).encode())
    else:
        message = bytearray(serialised(name, fields, ros1=wire == "ros1"))
    for _ in range(data.draw(st.integers(0, 5))):
        place = data.draw(st.integers(0, len(message) - 1))
        message[place] = data.draw(st.integers(0, 255))
    message = message[: data.draw(st.integers(0, len(message)) | st.just(len(message)))]
    try:
        ping = decode(memoryview(bytes(message)))
    except UnusableError:
        return
    assert ping.pixels.size


# A log of pings


def log_of(path: Path, pings: list[dict[str, Any]], name: str = PROJECTED) -> Path:
    bytes_of = [("/a", k * PERIOD_NS, serialised(name, f)) for k, f in enumerate(pings)]
    mcap_file(path, bytes_of, schema=name)
    (path.parent / "sonar.toml").unlink()
    return path


def test_the_tilt_is_the_users(tmp_path: Path) -> None:
    path = log_of(tmp_path / "log.mcap", [messages.projected_fields(0, polar_frames(1)[0])])
    with pytest.raises(SonarrecError, match="all but its tilt; give --tilt-deg"):
        read(path)
    (frame,), problems, notes = read(path, sonar=Sonar(tilt_deg=12.0, height_m=0.3))
    assert (frame.fan.tilt_deg, frame.fan.height_m) == (12.0, 0.3)
    assert not problems
    assert not notes


def test_a_window_that_changes(tmp_path: Path) -> None:
    """A ping of another window is put where it belongs in the fan of the first; one that shows
    too little of it is told of."""
    image = polar_frames(1)[0]
    pings = []
    for first, length, bins in ((1.0, 1.0, 60), (0.5, 2.0, 90), (1.25, 1.0, 60), (1.6, 1.0, 60)):
        grey = np.full((bins, BEAMS), 200, np.uint8) if pings else image
        middles = first + (np.arange(bins) + 0.5) * length / bins
        fields = messages.projected_fields(len(pings), grey)
        pings.append(fields | {"ranges": middles.astype(np.float32)})
    found, problems, _ = read(log_of(tmp_path / "log.mcap", pings), sonar=TILT)
    assert [f.index for f in found] == [0, 1, 2]
    assert problems == [
        "message 3 of /a: its window, 1.6 to 2.6 m, shows less than half of the first ping's, "
        "1 to 2 m, skipped"
    ]
    fan = found[0].fan
    assert all(f.fan == fan for f in found)
    assert fan.range_min_m == pytest.approx(1.0)
    row, column = np.mgrid[0 : fan.rows, 0 : fan.columns]
    range_m, bearing = polar_from_pixel(fan, column, row)
    inside = (np.abs(range_m - 1.5) < 0.49) & (np.abs(bearing) < 15)
    assert (found[1].image[inside] == 200).all()
    assert (found[2].image[inside & (range_m > 1.26)] == 200).all()
    assert (found[2].image[range_m < 1.24] == 0).all()


def test_a_topic_of_pings_and_images() -> None:
    """An image that tells nothing has no place in the fan that pings made."""
    image = polar_frames(1)[0]
    told = ping_of(PROJECTED, messages.projected_fields(0, image)).sonar
    make = FanImages(Sonar(layout="polar", tilt_deg=20.0), "log")
    for _ in range(2):
        with pytest.raises(UnusableError, match="does not tell its geometry"):
            make(RawFrame("image", 0, image))
        assert make(RawFrame("ping", 0, image, None, told))[0].any()


def test_a_first_ping_with_a_window_too_far_to_draw(tmp_path: Path) -> None:
    """Sixty bins at a thousand kilometres would be a fan of 10^14 pixels."""
    pings = [messages.projected_fields(k, image) for k, image in enumerate(polar_frames())]
    far = 1e6 + np.arange(BINS) * 0.25
    pings[0]["ranges"] = far.astype(np.float32)
    found, problems, _ = read(log_of(tmp_path / "log.mcap", pings), sonar=TILT)
    assert [f.index for f in found] == [1, 2]
    assert len(problems) == 1
    assert "m in 60 bins, makes a fan of" in problems[0]


def test_what_is_stated_does_not_fit_the_log(tmp_path: Path) -> None:
    pings = [messages.projected_fields(0, polar_frames(1)[0])]
    path = log_of(tmp_path / "log.mcap", pings)
    with pytest.raises(SonarrecError, match="2 bearings but the images have 24 beams"):
        read(path, sonar=TILT.updated(Sonar(bearings_deg=(-1.0, 1.0))))
    with pytest.raises(SonarrecError, match="height_m = 3 must be above 0 and below"):
        read(path, sonar=TILT.updated(Sonar(height_m=3.0)))


def test_the_number_of_beams_and_bins_may_change(tmp_path: Path) -> None:
    few = messages.projected_fields(1, np.full((30, 12), 50, np.uint8))
    few |= {
        "beam_directions": directions(np.linspace(-14, 14, 12)),
        "ranges": ((FIRST_BIN + (np.arange(30) + 0.5) * 2) * BIN_M).astype(np.float32),
    }
    pings = [messages.projected_fields(0, polar_frames(1)[0]), few]
    found, problems, _ = read(log_of(tmp_path / "log.mcap", pings), sonar=TILT)
    assert not problems
    assert found[1].image.shape == found[0].image.shape
    assert found[1].image.max() == 50


@pytest.mark.parametrize(
    ("stated", "says"),
    [
        (Sonar(range_min_m=0.9), "range_min_m = 0.9 (not 1)"),
        (Sonar(range_max_m=2.5), "range_max_m = 2.5 (not 1.938)"),
        (Sonar(field_of_view_deg=60.0), "field_of_view_deg = 60 (not 33.39)"),
        (Sonar(layout="fan"), 'layout = "fan" (they are polar, and read so)'),
        (Sonar(bearings_deg=tuple(range(-12, 12))), "bearings_deg"),
        (Sonar(range_min_m=1.001, field_of_view_deg=33.0), None),
        (Sonar(layout="polar", bearings_deg=None), None),
    ],
)
def test_what_is_stated_wins_and_is_told(stated: Sonar, says: str | None, tmp_path: Path) -> None:
    image = polar_frames(1)[0]
    path = log_of(tmp_path / "log.mcap", [messages.projected_fields(k, image) for k in range(3)])
    found, problems, notes = read(path, sonar=stated.updated(TILT))
    assert not problems
    assert notes == ([] if says is None else [f"{path}: stated against the messages: {says}"])
    fan = found[0].fan
    if stated.range_min_m is not None:
        assert fan.range_min_m == stated.range_min_m
    if stated.range_max_m is not None:
        assert fan.range_max_m == stated.range_max_m
    if stated.field_of_view_deg == 60:
        assert fan.bearing_max_deg == 30
    if stated.bearings_deg is not None:
        assert fan.bearing_min_deg == -12.5


def beam_major(fields: dict[str, Any]) -> dict[str, Any]:
    image = fields["image"]
    data = np.ascontiguousarray(image["data"].reshape(BINS, BEAMS).T).ravel()
    return fields | {"image": image | {"data": data}}


def test_beam_order(tmp_path: Path) -> None:
    """Found from the first ping, or stated."""
    pings = [messages.projected_fields(k, image) for k, image in enumerate(polar_frames())]
    turned = [beam_major(fields) for fields in pings]
    usual = log_of(tmp_path / "usual.mcap", pings)
    other = log_of(tmp_path / "other.mcap", turned)
    expected, _, _ = read(usual, sonar=TILT)
    wrong, _, _ = read(other, sonar=Sonar(tilt_deg=20.0, beam_order="range-major"))
    stated, _, _ = read(other, sonar=Sonar(tilt_deg=20.0, beam_order="beam-major"))
    with open_log(other, sonar=TILT) as log:
        found = list(log)
        assert log.reading()["beam_order"] == "beam-major"
    for frame, same, also, odd in zip(expected, found, stated, wrong, strict=True):
        np.testing.assert_array_equal(frame.image, same.image)
        np.testing.assert_array_equal(frame.image, also.image)
        assert not np.array_equal(frame.image, odd.image)


def test_beam_order_of_images_that_decide_nothing(tmp_path: Path) -> None:
    blank = [messages.projected_fields(0, np.full((BINS, BEAMS), 9, np.uint8))]
    with open_log(log_of(tmp_path / "log.mcap", blank), sonar=TILT) as log:
        list(log)
        assert log.reading()["beam_order"] == "range-major"


def test_beam_order_of_a_shared_recording() -> None:
    folder = Path(__file__).parents[2] / "shared" / "data" / "basin_b"
    files = sorted(folder.glob("*.png"))[::25]
    if not files:
        pytest.skip(f"no recording {folder}")
    for file in files:
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        bins, beams = image.shape
        assert not looks_beam_major(image)
        assert looks_beam_major(np.ascontiguousarray(image.T).reshape(bins, beams))


def test_polar_images_with_a_row_per_beam(tmp_path: Path) -> None:
    images = frames(3, BINS, BEAMS)
    folder = image_folder(tmp_path / "usual", images)
    turned = image_folder(tmp_path / "turned", [np.ascontiguousarray(i.T) for i in images])
    polar = Sonar(layout="polar")
    expected, _, _ = read(folder, sonar=polar)
    found, _, _ = read(turned, sonar=Sonar(layout="polar", beam_order="beam-major"))
    for frame, same in zip(expected, found, strict=True):
        np.testing.assert_array_equal(frame.image, same.image)


@pytest.mark.parametrize("uneven", [False, True])
def test_flip_mirrors_the_bearings(uneven: bool, tmp_path: Path) -> None:
    """What lay at bearing b lies at -b, also where bearings are neither even nor symmetric."""
    sonar = Sonar(layout="polar", range_min_m=1.0, range_max_m=1.9, field_of_view_deg=28.0)
    if uneven:
        sonar = sonar.updated(Sonar(bearings_deg=tuple((BEARINGS_DEG + 2).tolist())))
    spot = np.zeros((BINS, BEAMS), np.uint8)
    spot[28:33, 17:21] = 255
    centres = []
    for flip in (False, True):
        to_fan = PolarToFan(sonar.updated(Sonar(flip=flip, tilt_deg=20.0)), BINS, BEAMS)
        image = to_fan(spot).astype(float)
        row, column = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
        centre = (image * column).sum() / image.sum(), (image * row).sum() / image.sum()
        centres.append([float(v) for v in polar_from_pixel(to_fan.fan, *centre)])
        assert to_fan.fan.bearing_min_deg < to_fan.fan.bearing_max_deg
    assert abs(centres[0][1]) > 3
    np.testing.assert_allclose(centres[1], [centres[0][0], -centres[0][1]], atol=1e-6)
    images = frames(2)
    folder = image_folder(tmp_path / "fan", images)
    for frame, image in zip(read(folder, sonar=Sonar(flip=True))[0], images, strict=True):
        np.testing.assert_array_equal(frame.image, image[:, ::-1])


# Times


def test_the_time_that_names_a_frame(tmp_path: Path) -> None:
    """Header stamps that go back: they name the frames, log time orders them."""
    path = tmp_path / "log.mcap"
    images = polar_frames(4)
    pings = [
        ("/a", k * PERIOD_NS, serialised("sensor_msgs/msg/Image", messages.image_fields(3 - k, i)))
        for k, i in enumerate(images)
    ]
    mcap_file(path, pings)
    expected = {
        "log": [k * PERIOD_NS for k in range(4)],
        "publish": [k * PERIOD_NS + 1 for k in range(4)],
        "header": [stamp_ns(3 - k) for k in range(4)],
    }
    for clock, times in expected.items():
        found, problems, _ = read(path, time=clock)
        assert not problems
        assert [f.timestamp_ns for f in found] == times
        for frame, image in zip(found, images, strict=True):
            np.testing.assert_array_equal(frame.image, image)
    process(path, tmp_path, config.preset("default"), time="header")
    lines = (tmp_path / "log" / "frames.csv").read_text().splitlines()
    assert lines[0].endswith("log_time_ns,publish_time_ns,header_stamp_ns")
    assert lines[2].split(",")[1] == str(stamp_ns(2))
    assert lines[2].split(",")[4:] == [str(PERIOD_NS), str(PERIOD_NS + 1), str(stamp_ns(2))]
    before = (tmp_path / "log" / "estimates.csv").read_bytes()
    again = tmp_path / "again"
    process(path, again, config.preset("default"), earlier_run=tmp_path / "log" / "run.toml")
    assert (again / "log" / "estimates.csv").read_bytes() == before


def test_a_message_without_a_stamp(tmp_path: Path) -> None:
    message = b'{"height": 2, "width": 3, "encoding": "mono8", "data": "AAAAAAAA"}'
    path = mcap_file(tmp_path / "log.mcap", [("/a", 0, message)], schema="foxglove.RawImage",
                     encoding="json")  # fmt: skip
    assert read(path)[0][0].stamps.header is None
    with pytest.raises(SonarrecError, match="without a header time; --time log needs none"):
        read(path, time="header")
    with pytest.raises(UsageError, match="--time chooses a clock of an MCAP"):
        open_log(image_folder(tmp_path / "images", frames(1)), time="header")


# Grey


def floats_log(path: Path, images: list[np.ndarray], number: int) -> Path:
    pings = []
    for k, image in enumerate(images):
        fields = messages.projected_fields(k, image)
        pings.append(fields | {"image": messages.samples(image, number)})
    return log_of(path, pings)


AMPLITUDES = [
    (np.random.default_rng(k).rayleigh(40.0, (BINS, BEAMS)) + 1).astype(np.float32)
    for k in range(3)
]


def greys(path: Path, **keys: Any) -> list[np.ndarray]:
    with open_log(path, sonar=Sonar(tilt_deg=20.0, **keys)) as log:
        found = [frame.image for frame in log]
        assert log.problems == []
    return found


def in_the_fan(images: list[np.ndarray]) -> list[np.ndarray]:
    sonar = Sonar(
        layout="polar",
        range_min_m=FIRST_BIN * BIN_M,
        range_max_m=(FIRST_BIN + BINS) * BIN_M,
        bearings_deg=tuple(BEARINGS_DEG.tolist()),
        tilt_deg=20.0,
    )
    to_fan = PolarToFan(sonar, BINS, BEAMS)
    return [to_fan(image) for image in images]


@pytest.mark.parametrize("number", [4, 8, 9], ids=["u4", "f4", "f8"])
def test_amplitudes_become_logarithmic(number: int, tmp_path: Path) -> None:
    """By the closed form, from the median of the first ping; the ping ten times as bright that
    follows is 20 dB brighter."""
    dtype = {4: "<u4", 8: "<f4", 9: "<f8"}[number]
    images = [AMPLITUDES[0].astype(dtype), (AMPLITUDES[1] * 10).astype(dtype)]
    full_db = 20 * math.log10(float(np.median(images[0]))) + 50 * 2 / 3
    expected = [
        np.clip(255 * (1 + (20 * np.log10(i.astype(float)) - full_db) / 50), 0, 255) for i in images
    ]
    found = greys(floats_log(tmp_path / "log.mcap", images, number))
    for image, exact in zip(found, in_the_fan([np.rint(e).astype(np.uint8) for e in expected]),
                            strict=True):  # fmt: skip
        assert np.abs(image.astype(int) - exact).max() <= 1  # a value on the edge of rounding
    alone = greys(floats_log(tmp_path / "one.mcap", images[:1], number))
    np.testing.assert_array_equal(alone[0], found[0])


def test_16_bits_that_were_never_compressed(tmp_path: Path) -> None:
    """Dim amplitudes become logarithmic as those of 32 bits do; a compressed image stays linear."""
    for values, scale in ((AMPLITUDES[0], "log"), (polar_frames(1)[0] * 257.0, "linear")):
        narrow = floats_log(tmp_path / f"{scale}2.mcap", [values.astype("<u2")], 2)
        with open_log(narrow, sonar=TILT) as log:
            (frame,) = log
            assert log.reading()["pixel_scale"] == scale
        if scale == "log":
            wide = greys(floats_log(tmp_path / "wide.mcap", [values.astype("<u4")], 4))
        else:
            wide = in_the_fan([polar_frames(1)[0]])
        np.testing.assert_array_equal(frame.image, wide[0])
    flat = floats_log(tmp_path / "stated.mcap", [AMPLITUDES[0].astype("<u2")], 2)
    assert greys(flat, pixel_scale="linear")[0].max() <= 1


def test_the_scale_can_be_stated(tmp_path: Path) -> None:
    path = floats_log(tmp_path / "log.mcap", AMPLITUDES, 8)
    keys = {"pixel_scale": "linear", "full_scale": 200.0}
    expected = [np.rint(np.minimum(i * 255 / 200, 255)).astype(np.uint8) for i in AMPLITUDES]
    for image, exact in zip(greys(path, **keys), in_the_fan(expected), strict=True):
        assert np.abs(image.astype(int) - exact).max() <= 1
    decibels = floats_log(tmp_path / "db.mcap", [20 * np.log10(i) - 60 for i in AMPLITUDES], 8)
    keys = {"full_scale": 1000.0, "dynamic_range_db": 60.0}
    by_log = greys(path, **keys)
    by_db = greys(decibels, full_scale=0.0, dynamic_range_db=60.0)  # db: some are negative
    for mine, theirs in zip(by_log, by_db, strict=True):
        assert np.abs(mine.astype(int) - theirs).max() <= 1
    with pytest.raises(SonarrecError, match='pixel_scale must be "linear" or "log" or "db"'):
        sonar_from_table({"pixel_scale": "sqrt"}, "x")


def test_a_blank_first_ping_is_black_and_settles_nothing(tmp_path: Path) -> None:
    for blank in (0.0, np.nan, -np.inf):
        images = [np.full((BINS, BEAMS), blank, np.float32), *AMPLITUDES]
        log = floats_log(tmp_path / "log.mcap", images, 8)
        first, *rest = greys(log)
        assert not first.any()
        whole = greys(floats_log(tmp_path / "whole.mcap", AMPLITUDES, 8))
        for image, same in zip(rest, whole, strict=True):
            np.testing.assert_array_equal(image, same)


def test_a_full_scale_that_cannot_be_meant(tmp_path: Path) -> None:
    path = floats_log(tmp_path / "log.mcap", AMPLITUDES, 8)
    with pytest.raises(SonarrecError, match="full_scale = 0 must be above 0"):
        greys(path, full_scale=0.0)
    with pytest.raises(SonarrecError, match="dynamic_range_db = -1 must be above 0"):
        greys(path, dynamic_range_db=-1.0)


# Definitions


def test_definitions_are_those_of_the_packages() -> None:
    """Ours, where a log brings none, against the ones kept with the tests."""
    for ros1 in (False, True):
        for name in messages.FIELDS:
            if name == "sonar_oculus/msg/OculusPing":
                continue  # the later version is ours, the older is the tests'
            short = message_type(name)
            if known(short):
                ours = parse_definition(definition_text(short, ros1), short)
                theirs = parse_definition(messages.definition(name, ros1).decode(), short)
                assert ours == theirs
    assert set(map(message_type, DEFINITIONS)) - set(MESSAGES) == {
        "marine_acoustic_msgs/PingInfo",
        "marine_acoustic_msgs/SonarImageData",
        "sonar_oculus/OculusFire",
    }


def test_a_definition_with_all_there_is() -> None:
    text = """\
# a comment
uint8 A=1
string B = "# no comment"   # a constant
int32 x 5                   # a default
string<=10 bounded
float64[<=3] few
uint8[4] four
Inner[] inner
builtin_interfaces/msg/Time when
===
MSG: pkg/Inner
float32 a
===
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
    layout = parse_definition(text, "pkg/Outer")
    counts = {f.name: f.count for f in layout.fields}
    assert counts == {"x": None, "bounded": None, "few": 0, "four": 4, "inner": 0, "when": None}
    assert isinstance(layout.fields[4].kind, Struct)


@pytest.mark.parametrize(
    "text",
    [
        "Self inner",
        "Missing x",
        "int32",
        "int32 x-y",
        "wstring x",
        "uint8[0] x",
        "uint8[99999999999] x",
        "int32[-1] x",
        "A a\n===\nMSG: pkg/A\nB b\n===\nMSG: pkg/B\nA a",
        "\x00",
    ],
)
def test_definitions_that_cannot_be_understood(text: str) -> None:
    with pytest.raises(DefinitionError):
        parse_definition(text, "pkg/Self")


def test_a_definition_that_lies_about_sizes() -> None:
    """Sequences that say they are long cost neither time nor memory."""
    head = b"\x00\x01\x00\x00"
    cases = {
        "Empty[] data\n===\nMSG: sensor_msgs/Empty\n": struct.pack("<I", 2**32 - 1),
        "string[] data": struct.pack("<I", 2**32 - 1) + bytes(100),
        "uint8[999999999] data": bytes(100),
        "Pair[] data\n===\nMSG: sensor_msgs/Pair\nuint8 a\nstring b": struct.pack("<I", 10**6)
        + bytes(6 * 10**6),
        "float64[] data": struct.pack("<I", 2**29) + bytes(100),
    }
    for text, body in cases.items():
        for wire, message in (("cdr", head + body), ("ros1", body)):
            decode = decoder_for("sensor_msgs/Image", "ros2msg", text.encode(), wire)
            assert decode is not None
            with pytest.raises(UnusableError):
                decode(memoryview(message))


def test_nothing_in_a_definition_is_run(tmp_path: Path) -> None:
    """A constant's name or value, a field's name, a bound: all are only text."""
    trap = f"__import__('pathlib').Path({str(tmp_path / 'ran')!r}).touch()"
    for text in (f"int32 X={trap}", f"int32 {trap}=1", f"uint8[{trap}] x", f"int32 x {trap}"):
        try:
            parse_definition(text + "\nuint8 y", "pkg/Name")
        except DefinitionError:
            continue
    assert not (tmp_path / "ran").exists()


def test_a_log_without_definitions_is_read_by_ours(tmp_path: Path) -> None:
    image = polar_frames(1)[0]
    for name in (PROJECTED, RAW, OCULUS, "sensor_msgs/msg/Image"):
        message = serialised(name, messages.FIELDS[name](0, image))
        path = mcap_file(tmp_path / "log.mcap", [("/a", 0, message)], schema=name,
                         schema_encoding="ros2idl", schema_data=b"module x {}")  # fmt: skip
        assert read(path)[0][0].image.any()


# What a user types


def sonarrec(*arguments: str | Path, code: int = 0) -> Result:
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    assert result.exit_code == code, result.output
    return result


@pytest.mark.parametrize("schema", [s for s in SCHEMAS if is_polar(s)])
def test_simulated_pings_are_read_again(schema: str, tmp_path: Path) -> None:
    """Nothing but tilt and height is written beside them; each window is the scene's to a bin."""
    log = tmp_path / "pings.mcap"
    scene = ("--scene", "sample_polar", "--frames", "2", "--format", "mcap")
    sonarrec("simulate", *scene, "--out", log, "--schema", schema, "--compression", "lz4")
    stated = tomllib.loads((tmp_path / "pings.sonar.toml").read_text())["sonar"]
    assert set(stated) == {"tilt_deg", "height_m", "frame_rate_hz"}
    found, problems, notes = read(log)
    assert len(found) == 2
    assert not problems
    assert not notes
    fan = found[0].fan
    bin_m = fan.metres_per_pixel
    assert fan.range_max_m == pytest.approx(2.65, abs=bin_m)
    begins = 0.0 if "culus" in schema else 1.4  # an Oculus records from the sonar on
    assert fan.range_min_m == pytest.approx(begins, abs=bin_m)
    assert fan.bearing_max_deg == pytest.approx(14.4, abs=0.02)


def test_simulate_refuses(tmp_path: Path) -> None:
    polar = ("--schema", "oculus_interfaces/msg/Ping")
    to = ("--out", tmp_path / "x.mcap")
    assert (
        "needs a polar scene"
        in sonarrec("simulate", "--format", "mcap", *polar, *to, code=1).stderr
    )
    assert (
        "one of sensor_msgs/msg/Image, "
        in sonarrec("simulate", "--format", "mcap", "--schema", "x", *to, code=1).stderr
    )
    assert "--format mcap" in sonarrec("simulate", *polar, "--out", tmp_path / "y", code=2).stderr
    assert not list(tmp_path.iterdir())


def test_run_with_the_flags(tmp_path: Path) -> None:
    """A contradiction is one line and no fault; a ping that cannot be used is exit code 3."""
    pings = [messages.projected_fields(k, image) for k, image in enumerate(polar_frames())]
    pings.append(pings[0] | {"ranges": (pings[0]["ranges"] + 5).astype(np.float32)})
    log = log_of(tmp_path / "log.mcap", pings)
    out = ("--out", tmp_path / "out")
    fault = sonarrec("run", log, *out, code=1).stderr
    assert fault.startswith(f"sonarrec: {log}: the messages tell")
    assert fault.count("\n") == 1
    told = sonarrec("run", log, *out, "--tilt-deg", "20", "--time", "header", code=3).stderr
    assert told.splitlines() == [
        "sonarrec: message 3 of /a: its window, 6 to 6.94 m, shows less than half of the first "
        "ping's, 1 to 1.94 m, skipped"
    ]
    flags = ("--flip", "--beam-order", "range-major", "--pixel-scale", "log", "--full-scale", "255")
    stated = ("--tilt-deg", "20", "--range-min-m", "0.9", "--range-max-m", "1.9375")
    told = sonarrec("run", log, *out, *flags, "--dynamic-range-db", "40", *stated).stderr
    assert told.splitlines() == [
        f"sonarrec: note: {log}: stated against the messages: range_min_m = 0.9 (not 1)"
    ]
    run = tomllib.loads((tmp_path / "out" / "log" / "run.toml").read_text())
    assert run["sonar"] == {
        "layout": "polar", "range_min_m": 0.9, "range_max_m": 1.9375, "tilt_deg": 20.0,
        "beam_order": "range-major", "flip": True, "pixel_scale": "log", "full_scale": 255.0,
        "dynamic_range_db": 40.0,
    }  # fmt: skip
    assert run["input"]["topic"] == "/a"
    assert run["fan"]["range_min_m"] == 0.9
