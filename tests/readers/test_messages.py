"""Every sonar message type, encoding and compression, as other packages write it, gives the frames
and estimates of the image folder; damaged messages never escape."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.readers.messages.fields import Fields
from sonarrec.readers.messages.types import decoder_for, read_projected_sonar_image
from sonarrec.readers.raw import UnusableError
from sonarrec.sonar.geometry import bin_ranges
from sonarrec.sonar.stated import Sonar
from tests.support import messages
from tests.support.logs import PERIOD_NS, SONAR_TOML, cdr_image, image_folder, mcap_file, read
from tests.support.messages import BEAMS, BINS, OCULUS, PROJECTED, RAW, directions, ping_of

IMAGE = messages.polar_frames(1)[0]


@pytest.mark.parametrize(("i", "writer"), [*enumerate(messages.WRITERS)])
def test_every_message_gives_the_frames_of_the_folder(i: int, writer: str, tmp_path: Path) -> None:
    """By each compression in turn: chunks are inflated before anybody asks what is in them."""
    compression = ("none", "lz4", "zstd")[i % 3]
    images = messages.polar_frames()
    log = tmp_path / "log.mcap"
    messages.WRITERS[writer](log, images, compression)
    mine, theirs = messages.sidecars(writer, BINS, BEAMS)
    (tmp_path / "sonar.toml").write_text(mine or SONAR_TOML)
    folder = image_folder(tmp_path / "folder", images)
    (folder / "sonar.toml").write_text(theirs or SONAR_TOML)
    found, problems, notes = read(log)
    assert not problems + notes
    for k, (frame, same) in enumerate(zip(found, read(folder).frames, strict=True)):
        assert (frame.index, frame.timestamp_ns, frame.stamps.log) == (k, *[k * PERIOD_NS] * 2)
        assert frame.stamps.publish in (k * PERIOD_NS, k * PERIOD_NS + 1)  # the SDK keeps one
        assert frame.stamps.header == messages.stamp_ns(k)
        np.testing.assert_array_equal(frame.image, same.image)
        assert dataclasses.astuple(frame.fan) == pytest.approx(dataclasses.astuple(same.fan))


def test_two_sonars_on_one_topic_are_named(tmp_path: Path) -> None:
    timed = [
        ("/a", k * PERIOD_NS, cdr_image(image, frame_id=(b"port\0", b"starboard\0")[k % 2]))
        for k, image in enumerate(messages.polar_frames(6))
    ]
    found, _, (note,) = read(mcap_file(tmp_path / "log.mcap", timed))
    assert len(found) == 6
    assert "port" in note
    assert "starboard" in note


@pytest.mark.parametrize(("first", "in_turn"), [((0, 2, 4, 6, 8, 10), True), (range(6), False)])
def test_channels_that_take_turns_are_told(
    first: Sequence[int], in_turn: bool, tmp_path: Path
) -> None:
    """One after the other they are parts of one recording."""
    timed = [
        ("/a" if k in first else "/a#2", k * PERIOD_NS, cdr_image(image))
        for k, image in enumerate(messages.polar_frames(12))
    ]
    found, _, notes = read(mcap_file(tmp_path / "log.mcap", timed))
    assert len(found) == 12
    assert any("2 channels" in note for note in notes) == in_turn


@pytest.mark.parametrize("forward", ["x", "y", "z"])
@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("side", [1, -1])
def test_the_forward_axis_is_found(forward: str, backwards: bool, side: int) -> None:
    for across in set("xyz") - {forward}:
        vectors = directions(messages.BEARINGS_DEG + 3.0, across, forward)
        for vector in vectors:
            vector[forward] *= -1 if backwards else 1
            vector[across] *= side  # drivers disagree; beams always run from left to right
        fields = messages.projected_fields(0, IMAGE) | {"beam_directions": vectors}
        told = ping_of(PROJECTED, fields).ping
        assert told is not None
        expected = (messages.BEARINGS_DEG + 3.0) * (1 if side > 0 else -1)
        expected = expected if expected[0] < expected[-1] else -expected
        np.testing.assert_allclose(told.bearings_deg, expected, atol=1e-9)


@pytest.mark.parametrize("value", [b"sonar", [115, 111, 110, 97, 114], "c29uYXI="])
def test_bytes_are_bytes_a_list_or_base64(value: Any) -> None:
    assert bytes(Fields({"data": value}).octets("data")) == b"sonar"


@pytest.mark.parametrize("number", range(10))
@pytest.mark.parametrize("order", ["<", ">"])
def test_every_sample_type(number: int, order: str) -> None:
    dtype = np.dtype(order + ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"][number])
    values = (IMAGE // 3).astype(dtype)
    fields = messages.projected_fields(0, values)
    fields["image"] = messages.samples(values, number) | {"is_bigendian": order == ">"}
    np.testing.assert_array_equal(ping_of(PROJECTED, fields).pixels, values)


def test_gains_are_taken_out() -> None:
    gains = np.linspace(1, 4000, BINS).astype(np.uint32)
    for size in (1, 2, 4):
        values = IMAGE.astype(f"<u{size}")
        rows = [gain.tobytes() + row.tobytes() for gain, row in zip(gains, values, strict=True)]
        step = 4 + BEAMS * size
        for stated in (step, BEAMS):  # the second is wrong, as a driver may be
            fields = messages.oculus_interfaces_fields(0, IMAGE) | {
                "has_gains": True, "sample_size": size, "step": stated,
                "ping_data": np.frombuffer(b"".join(rows), np.uint8),
            }  # fmt: skip
            np.testing.assert_allclose(
                ping_of(OCULUS, fields).pixels, IMAGE / np.sqrt(gains)[:, None], rtol=1e-6
            )


def test_raw_sonar_image_ranges() -> None:
    """Range is (sample0 + i) c / (2 rate), told about the middle of each sample."""
    fields = messages.raw_fields(0, IMAGE) | {"sample0": 3, "sample_rate": 2000.0}
    told = ping_of(RAW, fields).ping
    assert told is not None
    metres = messages.SOUND_SPEED / 4000.0
    assert told.range_min_m == pytest.approx(2.5 * metres)
    assert told.range_max_m == pytest.approx((2.5 + BINS) * metres)


@pytest.mark.parametrize("name", [PROJECTED, RAW])
def test_bins_from_the_sonar_on_lie_at_their_own_ranges(name: str) -> None:
    """A first bin at 0 would begin before the sonar: all near it lay up to half a bin too far."""
    ranges = np.arange(BINS) * messages.BIN_M
    if name == PROJECTED:
        fields = messages.projected_fields(0, IMAGE) | {"ranges": ranges.astype(np.float32)}
    else:
        fields = messages.raw_fields(0, IMAGE) | {"sample0": 0}
    told = ping_of(name, fields).ping
    assert told is not None
    assert told.range_min_m == 0
    assert told.range_max_m == pytest.approx(ranges[-1] + messages.BIN_M / 2)
    own = {key: value for key, value in asdict(told).items() if key != "pitch_deg"}
    sonar = Sonar(**own, layout="polar", tilt_deg=20.0).complete("ping")
    np.testing.assert_allclose(bin_ranges(sonar, BINS), ranges, atol=1e-6)


EMPTY = {
    "samples_per_beam": 2**32 - 1, "rx_angles": np.zeros(0, np.float32),
    "image": messages.samples(np.zeros((0, 0), np.uint8)),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        (PROJECTED, {"ranges": np.zeros(BINS, np.float32)}, "not rise"),
        (PROJECTED, {"ranges": np.linspace(1, 1.001, BINS, dtype=np.float32)}, "a window of"),
        (PROJECTED, {"ranges": np.full(BINS, np.nan, np.float32)}, "'ranges'"),
        (PROJECTED, {"ranges": np.arange(3, dtype=np.float32)}, "1440 bytes"),
        (PROJECTED, {"beam_directions": []}, "two beams"),
        (PROJECTED, {"beam_directions": directions(np.zeros(BEAMS))}, "one way"),
        (PROJECTED, {"beam_directions": directions(np.zeros(5))}, "24 .* 5 directions"),
        (PROJECTED, {"beam_directions": directions(np.linspace(-91, 91, BEAMS))}, "90 deg"),
        (RAW, {"sample_rate": 0.0}, "0 samples"),
        (RAW, {"rx_angles": np.zeros(0, np.float32)}, "24 .* 0 directions"),
        (RAW, EMPTY, "0 beams of 4294967295 samples"),
        (OCULUS, {"range_resolution": -1.0}, "resolution -1 m"),
        (OCULUS, {"range_resolution": 1e308}, "'range_resolution'"),
        (OCULUS, {"sample_size": 3}, "3 bytes"),
        (OCULUS, {"n_beams": 0}, "do not fit"),
        (OCULUS, {"bearings": np.arange(5, dtype=np.int16)}, "24 .* 5 bearings"),
        (OCULUS, {"bearings": np.zeros(BEAMS, np.int16)}, "one way"),
    ],
)  # fmt: skip
def test_pings_that_cannot_be_used(name: str, change: dict[str, Any], says: str) -> None:
    fields = messages.FIELDS[name](0, IMAGE)
    with pytest.raises(UnusableError, match=says):
        ping_of(name, fields | change)


@pytest.mark.parametrize("name", messages.FIELDS)
@pytest.mark.parametrize("wire", ["cdr", "ros1", "json"])
@settings(max_examples=8)
@given(data=st.data())
def test_damaged_messages_never_escape(name: str, wire: str, data: st.DataObject) -> None:
    """Whatever the bytes, a decoder gives a ping or says that it cannot be used."""
    fields = messages.FIELDS[name](0, IMAGE[:8, :8])
    decode = decoder_for(name, "", b"", wire)
    if decode is None:  # no definition of ours
        return
    if wire == "json":
        message = bytearray(json.dumps(messages.plain(fields)).encode())
    else:
        message = bytearray(messages.serialised(name, fields, ros1=wire == "ros1"))
    for _ in range(data.draw(st.integers(0, 5))):
        place = data.draw(st.integers(0, len(message) - 1))
        message[place] = data.draw(st.integers(0, 255))
    message = message[: data.draw(st.integers(0, len(message)) | st.just(len(message)))]
    try:
        ping = decode(memoryview(bytes(message)))
    except UnusableError:
        return
    assert ping.pixels.size


@pytest.mark.parametrize(
    ("widths", "expected"),
    [
        (np.radians([0.6, 0.7, 0.8]), 0.7),
        (np.radians([0.0, 0.5, 0.5]), 0.5),  # of a beam that is not driven
        ([20.0, 20.0], None),  # degrees, of the vertical
        ([], None),
        ([np.nan], None),
        ("wide", None),
        (None, None),  # no such field
    ],
)
def test_a_message_tells_how_wide_its_receiving_beams_are(widths: Any, expected: Any) -> None:
    fields = messages.projected_fields(0, IMAGE)
    about = {k: v for k, v in fields["ping_info"].items() if k != "rx_beamwidths"}
    fields["ping_info"] = about if widths is None else about | {"rx_beamwidths": widths}
    ping = read_projected_sonar_image(Fields(fields)).ping
    assert ping is not None
    assert ping.beam_width_deg == expected


@pytest.mark.parametrize("value", [-1, 2.0, "3", None])
def test_a_count_is_a_whole_number_from_0_on(value: object) -> None:
    with pytest.raises(UnusableError, match="height"):
        Fields({"height": value}).integer("height")
    assert Fields({"height": 0}).integer("height") == 0
    assert Fields({}).integer("height", 7) == 7
