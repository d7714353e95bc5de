"""MCAP files as the field sends them: odd, cut, damaged, hostile."""

from __future__ import annotations

import base64
import json
import random
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.readers.messages.types import decoder_for
from sonarrec.readers.raw import UnusableError
from tests.support.logs import PERIOD_NS, cdr_image, frames, image_mcap, mcap_file, read

IMAGE = frames(1)[0]


def one(tmp_path: Path, message: bytes, **options: str) -> np.ndarray:
    found = read(mcap_file(tmp_path / "log.mcap", [("/a", 0, message)], **options))
    assert not found.problems
    return found.images[0]


# Messages


BGR = np.random.default_rng(2).integers(0, 256, (*IMAGE.shape, 3), dtype=np.uint8)


@pytest.mark.parametrize("encoding", ["mono16", "16UC1", "32FC1", "64FC1"])
@pytest.mark.parametrize("big", [0, 1])
def test_deeper_pixels(encoding: str, big: int, tmp_path: Path) -> None:
    kind = {"32FC1": "f4", "64FC1": "f8"}.get(encoding, "u2")
    values = (IMAGE.astype(float) * (257 if kind == "u2" else 1 / 255)).astype(">" + kind)
    message = cdr_image(values if big else values.astype("<" + kind), encoding, is_bigendian=big)
    np.testing.assert_array_equal(one(tmp_path, message), IMAGE)


@pytest.mark.parametrize("encoding", ["bgr8", "8UC3", "rgb8", "bgra8", "8UC4", "rgba8"])
def test_colour(encoding: str, tmp_path: Path) -> None:
    colour = BGR[:, :, ::-1] if encoding.startswith("rgb") else BGR
    if encoding in ("bgra8", "rgba8", "8UC4"):
        colour = np.dstack([colour, np.full(IMAGE.shape, 7, np.uint8)])
    message = cdr_image(np.ascontiguousarray(colour), encoding, padding=5)
    expected = cv2.cvtColor(BGR, cv2.COLOR_BGR2GRAY)
    np.testing.assert_array_equal(one(tmp_path, message), expected)


@pytest.mark.parametrize(
    "rows", [*({"padding": n} for n in (0, 1, 26)), *({"step": n} for n in (0, 37, 39, 2**32 - 1))]
)
def test_rows_with_padding_and_with_a_wrong_step(rows: dict[str, int], tmp_path: Path) -> None:
    np.testing.assert_array_equal(one(tmp_path, cdr_image(IMAGE, **rows)), IMAGE)  # type: ignore[arg-type]


def test_unusable_messages_are_skipped(tmp_path: Path) -> None:
    good = cdr_image(IMAGE)
    bad = {
        "unknown encoding": cdr_image(IMAGE, "yuv422"),
        "too short": good[:-1],
        "no header": good[:3],
        "wrong header": b"\x07" + good[1:],
        "nothing": b"",
        "other size": cdr_image(IMAGE[:-2]),
        "too few data": cdr_image(IMAGE, "bgr8"),
        "no rows": good.replace(struct.pack("<I", 48), bytes(4), 1),
        "huge": good[:24] + b"\xff" * 8 + good[32:],
    }
    messages = [("/a", k * PERIOD_NS, m) for k, m in enumerate([good, *bad.values(), good])]
    found = read(mcap_file(tmp_path / "log.mcap", messages))
    assert found.numbers == [0, len(messages) - 1]
    assert len(found.problems) == len(bad)
    for k, line in enumerate(found.problems):
        assert line.startswith(f"message {k + 1} of /a: ")
        assert "\n" not in line


def test_json_with_fields_missing(tmp_path: Path) -> None:
    table = {"height": IMAGE.shape[0], "width": IMAGE.shape[1], "encoding": "mono8"}
    good = json.dumps(table | {"data": base64.b64encode(IMAGE.tobytes()).decode()}).encode()
    image = one(tmp_path, good, schema="foxglove.RawImage", encoding="json")
    np.testing.assert_array_equal(image, IMAGE)


@pytest.mark.parametrize(
    "message",
    [b"", b"[]", b"{}", b"null", b"[" * 100_000, b'{"data": 5}', b'{"data": "?"}', b"\xff",
     b'{"data": "AAAA", "width": -1, "height": 2, "encoding": "mono8"}',
     b'{"data": "AAAA", "width": 1e99, "height": 2, "encoding": "mono8"}',
     b'{"data": "AAAA", "width": 2, "height": 2, "encoding": ["mono8"]}'],
)  # fmt: skip
def test_json_that_is_no_image(message: bytes) -> None:
    decode = decoder_for("foxglove.RawImage", "", b"", "json")
    assert decode is not None
    with pytest.raises(UnusableError):
        decode(memoryview(message))


# Channels


def test_topics(tmp_path: Path) -> None:
    first, second = frames(2)
    messages = [("/a", 0, cdr_image(first)), ("/b", 1, cdr_image(second)), ("/a", 2, b"x")]
    path = mcap_file(tmp_path / "log.mcap", messages)
    with pytest.raises(UsageError, match="--topic: /a, /b"):
        read(path)
    with pytest.raises(UsageError, match="/a, /b"):
        read(path, topic="/c")
    found = read(path, topic="/b")
    assert not found.problems
    np.testing.assert_array_equal(found.images, [second])


def test_no_image_channel_lists_what_there_is(tmp_path: Path) -> None:
    path = mcap_file(tmp_path / "log.mcap", [("/imu", 0, b"x")], schema="sensor_msgs/msg/Imu")
    with pytest.raises(SonarrecError, match=r"/imu \(sensor_msgs/msg/Imu"):
        read(path)
    with pytest.raises(SonarrecError, match="no channel"):
        read(image_mcap(tmp_path / "empty.mcap", []))


# Order


@pytest.mark.parametrize("options", [{}, {"chunked": False}, {"indexed": False}], ids=str)
def test_log_time_order(options: dict[str, bool], tmp_path: Path) -> None:
    images = frames(40, 12, 12)
    order = list(range(40))
    random.Random(3).shuffle(order)
    times = [k // 2 * PERIOD_NS for k in range(40)]  # pairs at one time keep the file's order
    messages = [("/a", times[k], cdr_image(images[k])) for k in order]
    path = mcap_file(tmp_path / "log.mcap", messages, chunk_size=600, **options)  # type: ignore[arg-type]
    found = read(path)
    assert not found.problems
    expected = sorted(order, key=lambda k: (times[k], order.index(k)))
    assert found.times == [times[k] for k in expected]
    np.testing.assert_array_equal(found.images, [images[k] for k in expected])
