"""MCAP files as the field sends them: odd, cut, damaged, unindexed, overlapping, giant or lying."""

from __future__ import annotations

import base64
import json
import random
import struct
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.readers.containers import mcap as recording
from sonarrec.readers.messages.types import decoder_for
from sonarrec.readers.raw import UnusableError
from sonarrec.sonar.frame import Frame
from tests.support.hard_logs import HardLog, message, noise_log, peak_of_reading, record
from tests.support.logs import PERIOD_NS, cdr_image, frames, image_mcap, mcap_file, read
from tests.support.slow import but_first

IMAGE = frames(1)[0]


def one(tmp_path: Path, message: bytes, **options: str) -> np.ndarray:
    found = read(mcap_file(tmp_path / "log.mcap", [("/a", 0, message)], **options))
    assert not found.problems
    return found.images[0]


BGR = np.random.default_rng(2).integers(0, 256, (*IMAGE.shape, 3), dtype=np.uint8)


def image_messages() -> Iterator[tuple[bytes, np.ndarray]]:
    for encoding, big in product(("mono16", "16UC1", "32FC1", "64FC1"), (0, 1)):
        kind = {"32FC1": "f4", "64FC1": "f8"}.get(encoding, "u2")
        values = IMAGE.astype(float) * (257 if kind == "u2" else 1 / 255)
        stored = values.astype("<>"[big] + kind)
        yield cdr_image(stored, encoding, is_bigendian=big), IMAGE
    for encoding in ("bgr8", "8UC3", "rgb8", "bgra8", "8UC4", "rgba8"):
        colour = BGR[:, :, ::-1] if encoding.startswith("rgb") else BGR
        if encoding in ("bgra8", "rgba8", "8UC4"):
            colour = np.dstack([colour, np.full(IMAGE.shape, 7, np.uint8)])
        message = cdr_image(np.ascontiguousarray(colour), encoding, padding=5)
        yield message, cv2.cvtColor(BGR, cv2.COLOR_BGR2GRAY)
    for padding in (0, 1, 26):
        yield cdr_image(IMAGE, padding=padding), IMAGE
    for step in (0, 37, 39, 2**32 - 1):  # a wrong one
        yield cdr_image(IMAGE, step=step), IMAGE


@pytest.mark.parametrize(("message", "image"), [*image_messages()])
def test_pixels_of_every_encoding(message: bytes, image: np.ndarray, tmp_path: Path) -> None:
    np.testing.assert_array_equal(one(tmp_path, message), image)


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


# Cut, damaged and hostile files


IMAGES = frames(12, 20, 20)
TIMED = [(k * PERIOD_NS, cdr_image(image)) for k, image in enumerate(IMAGES)]
Change = Callable[[bytearray, int], None]
HEAD = 9 + 22  # of a record, of a message
ALL = list(range(12))
WITHOUT_SECOND = [0, 1, 2, *range(6, 12)]
"""The frames of the other chunks, of three each."""


def by_times(found: list[Frame]) -> list[int]:
    """Which frames these are, by their times: their numbers may be too low."""
    places = [frame.timestamp_ns // PERIOD_NS for frame in found]
    for frame, place in zip(found, places, strict=True):
        np.testing.assert_array_equal(frame.image, IMAGES[place])
    return places


def numbers(found: list[Frame]) -> list[int]:
    """The frames' numbers, each of which must show its own image at its own time."""
    places = by_times(found)
    assert places == [frame.index for frame in found]
    return places


def four_chunks(path: Path, compression: str = "", **how: bool) -> list[int]:
    """Twelve frames in four chunks, and where these begin."""
    with HardLog(path) as log:
        for first in range(0, 12, 3):
            log.chunk(TIMED[first : first + 3], compression, **how)
    return log.positions


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.mcap"


# Damage to the second of four chunks


def flip(data: bytearray, at: int) -> None:
    data[at] ^= 0x10


def record_of(number: int, data: bytearray) -> int:
    return data.index(TIMED[number][1]) - HEAD


def a_byte(data: bytearray, chunk: int) -> None:
    flip(data, chunk + 150)


def length_of_record(value: int) -> Change:
    return lambda data, _: struct.pack_into("<Q", data, record_of(4, data) + 1, value)


def length_of_chunk(value: int) -> Change:
    return lambda data, chunk: struct.pack_into("<Q", data, chunk + 1, value)


LOST = "; its 3 frames are lost"
UNCOUNTED = "in all, 3 of 12 frames are lost"
GOES_ON = "; reading continues at byte "
CASES = {
    "checksum": ({}, a_byte, WITHOUT_SECOND, ["fails its checksum" + LOST]),
    "checksum, lz4": ({"compression": "lz4"}, a_byte, WITHOUT_SECOND, [LOST]),
    "zstd, no index": ({"compression": "zstd", "indexed": False}, a_byte, None, [UNCOUNTED]),
    "record of no length": ({"crc": False}, length_of_record(0), WITHOUT_SECOND, [LOST]),
    "record beyond all": (
        *({"crc": False}, length_of_record(2**40), WITHOUT_SECOND),
        ["is damaged at byte ", "(`mcap recover` may save some)" + LOST],
    ),
    "record beyond all, no index": (
        *({"crc": False, "indexed": False}, length_of_record(2**40), None),
        ["is damaged at byte ", "`mcap recover`", UNCOUNTED],
    ),
    "chunk of 1": (
        *({"compression": "zstd"}, length_of_chunk(1), None),
        [GOES_ON, "contradicts its own length", UNCOUNTED],
    ),
    "chunk beyond all": ({"compression": "zstd"}, length_of_chunk(2**64 - 1), ALL, [GOES_ON]),
}


@pytest.mark.parametrize(("how", "change", "kept", "told"), CASES.values(), ids=CASES)
def test_damage_costs_its_own_chunk_and_is_told(
    how: dict[str, bool], change: Change, kept: list[int] | None, told: list[str], path: Path
) -> None:
    """Where there is an index, the frames after it keep their numbers."""
    chunk = four_chunks(path, **how)[1]  # type: ignore[arg-type]
    whole = read(path)
    assert (numbers(whole.frames), whole.problems) == (ALL, [])
    data = bytearray(path.read_bytes())
    change(data, chunk)
    path.write_bytes(data)
    found, problems, _ = read(path)
    if kept is None:
        assert by_times(found) == WITHOUT_SECOND
    else:
        assert numbers(found) == kept
    assert f"byte {chunk} " in problems[0] or GOES_ON in problems[0]
    for text in told:
        assert any(text in line for line in problems), text


def test_a_chunk_that_states_a_later_start_than_it_has(path: Path) -> None:
    with HardLog(path) as log:
        for first in range(0, 12, 3):
            log.chunk(TIMED[first : first + 3], start=10**12 if first == 3 else None)
    found, problems, _ = read(path)
    assert by_times(found) == [*WITHOUT_SECOND, 3, 4, 5]
    assert ["3 frames out" in line for line in problems] == [True]


def test_messages_of_a_channel_that_is_not_defined_are_told(path: Path) -> None:
    with HardLog(path, finished=False) as log:
        log.loose(TIMED[:10])
    path.write_bytes(path.read_bytes() + b"".join(message(*t, channel=7) for t in TIMED[10:]))
    found, problems, _ = read(path)
    assert len(found) == 10
    assert "2 messages" in problems[-1]


def test_without_an_index_what_follows_damage_is_lost_and_said_to_be(path: Path) -> None:
    with HardLog(path, finished=False) as log:
        log.loose(TIMED[:6])
        log.chunk(TIMED[6:])
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, log.positions[0] + 1, 1)  # its length
    path.write_bytes(data)
    found, problems, _ = read(path)
    assert numbers(found) == list(range(6))
    assert "own length" in problems[1] + problems[0]
    assert any("rest cannot" in line for line in problems)


@pytest.mark.parametrize(
    ("compression", "declared"), [("", 0), ("lz4", 100), ("zstd", 100), ("zstd", 2**31 + 1)]
)
def test_a_chunk_that_lies_about_its_size(compression: str, declared: int, path: Path) -> None:
    with HardLog(path) as log:
        log.chunk(TIMED[:6], compression, size=declared)
        log.chunk(TIMED[6:], compression)
    found, problems, _ = read(path)
    assert numbers(found) == [*range(6, 12)]
    assert f"byte {log.positions[0]}" in problems[0]
    assert f" {declared} bytes" in problems[0]


def test_bombs_are_given_up_at_the_size_they_declare(path: Path) -> None:
    bombs = {
        "zstd": zstandard.compress(bytes(2**28)),
        "lz4": lz4.frame.compress(bytes(2**28), block_size=lz4.frame.BLOCKSIZE_MAX4MB),
    }
    wide = zstandard.ZstdCompressionParameters(window_log=30, enable_ldm=True)
    compressor = zstandard.ZstdCompressor(compression_params=wide).compressobj()
    window = compressor.compress(bytes(1000)) + compressor.flush()
    with HardLog(path, finished=False) as log:
        log.chunk(TIMED)
    data = path.read_bytes()
    for name, bomb in [*bombs.items(), ("zstd", window)]:
        head = struct.pack("<QQQII", 0, 0, 2**20, 0, len(name)) + name.encode()
        data += record(0x06, head + struct.pack("<Q", len(bomb)) + bomb)
    path.write_bytes(data)
    frames_read, peak = peak_of_reading(path)
    assert frames_read == 12
    assert peak < 150
    problems = read(path).problems
    assert any("does not inflate" in p and "memory" in p for p in problems)  # zstd --long=31
    assert sum("1048576 bytes" in p for p in problems) == 2


def test_a_message_beyond_the_bound(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "MAX_FRAME_BYTES", 500)
    with HardLog(path) as log:
        log.loose([TIMED[0], (PERIOD_NS, bytes(600)), *TIMED[2:]])
    found, problems, _ = read(path)
    assert numbers(found) == [0, *range(2, 12)]
    assert "message of 622 bytes" in problems[0]


def test_what_follows_the_footer_is_told(path: Path) -> None:
    four_chunks(path)
    data = path.read_bytes()
    path.write_bytes(data + data)
    found, problems, _ = read(path)
    assert numbers(found) == ALL
    more = f"{len(data)} bytes follow its end at byte {len(data)} and were not read"
    assert problems == [f"log.mcap: {more}"]


@pytest.fixture(scope="module")
def least(tmp_path_factory: pytest.TempPathFactory) -> float:
    """What the program itself takes to read a log (MB)."""
    path = tmp_path_factory.mktemp("least") / "log.mcap"
    four_chunks(path)
    return peak_of_reading(path)[1]


@pytest.mark.parametrize(
    ("compression", "chunks", "overlap", "held_mb"),
    but_first([("zstd", 12, False, 0), ("", 1, False, 48), ("lz4", 10, True, 48)]),
)
def test_memory_does_not_grow_with_the_log(
    compression: str, chunks: int, overlap: bool, held_mb: int, least: float, tmp_path: Path
) -> None:
    """Held are the chunk that is read and those that overlap it in time, and no other."""
    path, size = tmp_path / "log.mcap", 48 * 2**20
    noise_log(path, size, compression, chunks, overlap)
    frames_read, peak = peak_of_reading(path)
    assert frames_read >= 0.85 * size / (300 * 512)
    assert peak - least < 20 + held_mb
