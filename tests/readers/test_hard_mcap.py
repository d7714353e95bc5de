"""MCAP files that are damaged, unindexed, overlapping, giant or lying."""

from __future__ import annotations

import errno
import struct
import zlib
from dataclasses import replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import cv2
import lz4.block
import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Channel, Schema, Statistics

from sonarrec.errors import SonarrecError
from sonarrec.nouns import Frame
from sonarrec.readers import open_log
from sonarrec.readers.containers.mcap import chunks, in_order
from sonarrec.simulation.mcap_writer import McapImageWriter
from sonarrec.sonar import Sonar
from tests.studies.memory import peak_of_reading, shapes
from tests.support.hard_logs import HardLog, built, record
from tests.support.logs import PERIOD_NS, cdr_image, frames
from tests.support.slow import but_first

IMAGES = frames(12, 20, 20)
TIMED = [(k * PERIOD_NS, cdr_image(image)) for k, image in enumerate(IMAGES)]


def read(path: Path) -> tuple[list[Frame], list[str]]:
    with open_log(path) as log:
        return list(log), log.diagnostics.problems


def assert_frames(found: list[Frame], numbers: list[int]) -> None:
    """The frames of IMAGES with these numbers, which they keep, and no others."""
    assert [f.index for f in found] == numbers
    for frame in found:
        np.testing.assert_array_equal(frame.image, IMAGES[frame.index])
        assert frame.timestamp_ns == frame.index * PERIOD_NS


# Damage


def flip(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("compression", "indexed"), [("", True), ("", False), ("lz4", True), ("zstd", False)]
)
def test_a_chunk_that_fails_its_checksum(compression: str, indexed: bool, tmp_path: Path) -> None:
    """It is skipped and counted; where the index tells, the frames after it keep their numbers."""
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        for first in range(0, 12, 3):
            log.chunk(TIMED[first : first + 3], compression, indexed=indexed)
    flip(path, log.positions[1] + 150)
    found, problems = read(path)
    assert f"the chunk at byte {log.positions[1]} " in problems[0]
    if indexed:
        assert_frames(found, [0, 1, 2, *range(6, 12)])
        assert len(problems) == 1
        assert problems[0].endswith("; its 3 frames are lost")
    else:
        assert [f.timestamp_ns // PERIOD_NS for f in found] == [0, 1, 2, *range(6, 12)]
        assert problems[1:] == ["log.mcap: in all, 3 of 12 frames are lost"]


def test_a_chunk_without_a_checksum_is_read(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        log.chunk(TIMED, crc=False)
    assert_frames(read(path)[0], list(range(12)))
    assert not read(path)[1]


def test_the_checksum_of_the_data_is_asked_where_chunks_have_none(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with HardLog(path, data_crc=True) as log:
        log.loose(TIMED)
    assert_frames(read(path)[0], list(range(12)))
    assert not read(path)[1]
    flip(path, path.read_bytes().index(TIMED[5][1]) + len(TIMED[5][1]) - 1)
    found, problems = read(path)
    assert len(found) == 12
    assert problems == [
        "log.mcap: its data fail their checksum; which frames are wrong cannot be known"
    ]


def test_a_summary_that_fails_its_checksum_is_not_used(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        log.chunk(TIMED)
    data = path.read_bytes()
    place = data.rindex(struct.pack("<HQ", 1, 12))  # messages counted on channel 1
    flip(path, place + 2)
    found, problems = read(path)
    assert_frames(found, list(range(12)))
    assert problems == ["log.mcap: the summary fails its checksum and was not used"]


@pytest.mark.parametrize(("value", "compression"), [(1, "zstd"), (200, ""), (2**64 - 1, "zstd")])
def test_a_lying_length_is_passed_over_by_the_index(
    value: int, compression: str, tmp_path: Path
) -> None:
    """The length of the second chunk's record: what the index knows behind it is still read, and
    the chunk itself where its record states more than it needs."""
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        for first in range(0, 12, 3):
            log.chunk(TIMED[first : first + 3], compression)
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, log.positions[1] + 1, value)
    path.write_bytes(data)
    found, problems = read(path)
    text = "\n".join(problems)
    assert f"read on from byte {log.positions[2]}, where the index knows what follows" in text
    if value > len(data):
        assert_frames(found, list(range(12)))
        return
    assert [f.timestamp_ns // PERIOD_NS for f in found] == [0, 1, 2, *range(6, 12)]
    assert f"the chunk at byte {log.positions[1]} contradicts its own length" in text
    assert "in all, 3 of 12 frames are lost" in text


def test_a_chunk_record_may_end_with_fields_of_a_later_version(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with HardLog(path, finished=False) as log:
        log.chunk(TIMED, indexed=False)
    data = bytearray(path.read_bytes())
    (length,) = struct.unpack_from("<Q", data, log.positions[0] + 1)
    struct.pack_into("<Q", data, log.positions[0] + 1, length + 7)
    end = log.positions[0] + 9 + length
    path.write_bytes(data[:end] + b"written" + data[end:])
    assert_frames(read(path)[0], list(range(12)))


def test_without_an_index_what_follows_damage_is_lost_and_said_to_be(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with HardLog(path, finished=False) as log:
        log.loose(TIMED[:6])
        log.chunk(TIMED[6:])
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, log.positions[0] + 1, 1)  # its length
    path.write_bytes(data)
    found, problems = read(path)
    assert_frames(found, list(range(6)))
    assert "contradicts its own length" in problems[1] + problems[0]
    assert any("the rest cannot be counted" in line for line in problems)


def test_a_time_that_lies(tmp_path: Path) -> None:
    """Too early costs nothing; too late puts frames out of order, which is told."""
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        for first in range(0, 12, 3):
            log.chunk(TIMED[first : first + 3], start=0)
    assert_frames(read(path)[0], list(range(12)))
    with HardLog(path) as log:
        log.chunk(TIMED[:3], start=2**63)
        log.chunk(TIMED[3:])
    found, problems = read(path)
    assert [f.timestamp_ns // PERIOD_NS for f in found] == [*range(3, 12), 0, 1, 2]
    assert problems == [
        "log.mcap: a chunk states a later time than it holds; frames are out of order there"
    ]


# Bombs


@pytest.mark.parametrize(
    ("compression", "declared"), [("", 0), ("lz4", 100), ("zstd", 100), ("zstd", 2**31 + 1)]
)
def test_a_chunk_that_lies_about_its_size(compression: str, declared: int, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        log.chunk(TIMED[:6], compression, size=declared)
        log.chunk(TIMED[6:], compression)
    found, problems = read(path)
    assert_frames(found, list(range(6, 12)))
    assert f"the chunk at byte {log.positions[0]} " in problems[0]
    assert f" {declared} bytes" in problems[0]


def test_bombs_are_given_up_at_the_size_they_declare(tmp_path: Path) -> None:
    bombs = {
        "zstd": zstandard.compress(bytes(2**28)),
        "lz4": lz4.frame.compress(bytes(2**28), block_size=lz4.frame.BLOCKSIZE_MAX4MB),
    }
    path = tmp_path / "log.mcap"
    with HardLog(path, finished=False) as log:
        log.chunk(TIMED)
    data = path.read_bytes()
    for name, bomb in bombs.items():
        head = struct.pack("<QQQII", 0, 0, 2**20, 0, len(name)) + name.encode()
        data += record(0x06, head + struct.pack("<Q", len(bomb)) + bomb)
    path.write_bytes(data)
    frames_read, peak = peak_of_reading(path)
    assert frames_read == 12
    assert peak < 150
    problems = read(path)[1]
    assert sum("inflates to more than the 1048576 bytes it declares" in p for p in problems) == 2


def test_a_window_beyond_the_bound_is_refused(tmp_path: Path) -> None:
    """zstd --long=31: the decoder would have to keep 2 GB."""
    parameters = zstandard.ZstdCompressionParameters(window_log=30, enable_ldm=True)
    compressor = zstandard.ZstdCompressor(compression_params=parameters).compressobj()
    data = compressor.compress(bytes(1000)) + compressor.flush()
    path = tmp_path / "log.mcap"
    with HardLog(path, finished=False) as log:
        log.chunk(TIMED)
    head = struct.pack("<QQQII", 0, 0, 1000, 0, 4) + b"zstd" + struct.pack("<Q", len(data))
    with path.open("ab") as file:
        file.write(record(0x06, head + data))
    found, problems = read(path)
    assert_frames(found, list(range(12)))
    assert any("does not inflate" in p and "memory" in p for p in problems)


def test_a_message_beyond_the_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(in_order, "MAX_FRAME_BYTES", 500)
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        log.loose([TIMED[0], (PERIOD_NS, bytes(600)), *TIMED[2:]])
    found, problems = read(path)
    assert_frames(found, [0, *range(2, 12)])
    assert "message of 622 bytes, more than is read" in problems[0]


# Images that are not what their headers say


def png_of_size(rows: int, columns: int) -> bytes:
    data = bytearray(cv2.imencode(".png", IMAGES[0])[1].tobytes())
    data[16:24] = struct.pack(">II", columns, rows)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


def jpeg_of_size(rows: int, columns: int) -> bytes:
    data = bytearray(cv2.imencode(".jpg", IMAGES[0])[1].tobytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", rows, columns)
    return bytes(data)


def png_of_chunk(length: int) -> bytes:
    data = bytearray(cv2.imencode(".png", IMAGES[0])[1].tobytes())
    data[33:37] = struct.pack(">I", length)  # of the first chunk after the header
    return bytes(data)


@pytest.mark.parametrize(
    "image",
    [png_of_size(30000, 30000), jpeg_of_size(60000, 60000), png_of_chunk(2**32 - 1)],
    ids=["png", "jpeg", "png chunk"],
)
def test_no_room_is_made_for_what_an_image_claims(image: bytes, tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(cv2.imencode(".png", IMAGES[0])[1].tobytes())
    (tmp_path / "aa.png").write_bytes(image)
    with HardLog(tmp_path / "unused.mcap"):
        pass  # its sonar.toml serves
    frames_read, peak = peak_of_reading(tmp_path)
    assert frames_read == 2
    assert peak < 150


def test_images_cut_short(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    image = rng.integers(0, 256, (60, 80), dtype=np.uint8)
    (tmp_path / "whole.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    suffixes = (".png", ".jpg", ".tiff", ".bmp", ".pgm")
    for suffix in suffixes:
        data = cv2.imencode(suffix, image)[1].tobytes()
        (tmp_path / f"cut{suffix}").write_bytes(data[: len(data) // 2])
    with HardLog(tmp_path / "unused.mcap"):
        pass
    found, problems = read(tmp_path)
    assert len(found) == 1
    assert len(problems) == len(suffixes)


def test_a_fan_too_large_to_make(tmp_path: Path) -> None:
    """A window of 1 m at 1 km: bins of 1 cm ask for a fan of 100,000 pixels a side."""
    bearings = tuple(np.linspace(-65, 65, 20).tolist())
    sonar = Sonar(range_min_m=1000, range_max_m=1001, tilt_deg=20, bearings_deg=bearings)
    path = tmp_path / "log.mcap"
    with HardLog(path):
        pass
    (tmp_path / "sonar.toml").write_text("[sonar]\ntilt_deg = 20.0\n")
    with McapImageWriter(
        path, schema="sonar_oculus/msg/OculusPing", sonar=sonar.complete("test")
    ) as writer:
        writer.write(0, np.zeros((100, 20), np.uint8))
    with pytest.raises(SonarrecError, match="186167 x 100100 pixels"):
        read(path)


def test_a_window_too_short_to_be_meant(tmp_path: Path) -> None:
    bearings = tuple(np.linspace(-30, 30, 20).tolist())
    sonar = Sonar(range_min_m=1, range_max_m=2, tilt_deg=20, bearings_deg=bearings).complete("test")
    sonar = replace(sonar, range_max_m=1.001)
    path = tmp_path / "log.mcap"
    (tmp_path / "sonar.toml").write_text("[sonar]\ntilt_deg = 20.0\n")
    schema = "marine_acoustic_msgs/msg/ProjectedSonarImage"
    with McapImageWriter(path, schema=schema, sonar=sonar) as writer:
        writer.write(0, np.zeros((100, 20), np.uint8))
    with pytest.raises(SonarrecError, match=r"a window of 0\.00099.* m"):
        read(path)


def test_an_odd_first_frame_does_not_cost_the_others(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        log.loose([(0, cdr_image(IMAGES[0][:-2])), *TIMED[1:]])
    found, problems = read(path)
    assert_frames(found, list(range(1, 12)))
    assert problems == ["message 0 of /a: 20 x 18 pixels in a log of 20 x 20, skipped"]


# Definitions that lie


def test_definitions_that_lie_about_their_sizes(tmp_path: Path) -> None:
    """Each is left out; the sound ones behind them count."""
    path = tmp_path / "log.mcap"
    with HardLog(path, finished=False) as log:
        log.loose(TIMED)
    data = path.read_bytes()
    schema = built(Schema(id=1, name="n" * 50, encoding="e", data=b"d"))[9:]
    channel = built(Channel(id=1, topic="t", message_encoding="m", metadata={}, schema_id=1))[9:]
    counts = built(
        Statistics(
            attachment_count=0, channel_count=1, channel_message_counts={1: 2**62}, chunk_count=0,
            message_count=12, message_end_time=0, message_start_time=0, metadata_count=0,
            schema_count=1,
        )
    )[9:]  # fmt: skip
    lies = [
        record(0x03, schema[:2] + struct.pack("<I", 2**32 - 1) + schema[6:]),
        record(0x04, channel[:4] + struct.pack("<I", 2**31) + channel[8:]),
        record(0x04, channel[:-4] + struct.pack("<I", 2**31)),
        record(0x0B, counts[:-14] + struct.pack("<I", 2**32 - 1) + counts[-10:]),
        record(0x03, b""),
        record(0x04, b"\1"),
        record(0x05, b"short"),
    ]
    path.write_bytes(data[:8] + b"".join(lies) + data[8:])
    found, problems = read(path)
    assert_frames(found, list(range(12)))
    assert "cut short" in problems[0]
    assert problems[1:] == [
        "log.mcap: not read: 6 damaged definitions",
        "log.mcap: not read: 1 messages too short for a head",
    ]


def test_counts_that_lie_are_only_counts(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        log.loose(TIMED)
        log._count = 40
    with open_log(path) as opened:
        assert opened.frame_count == 40
        assert_frames(list(opened), list(range(12)))
    assert opened.diagnostics.problems == ["log.mcap: in all, 28 of 40 frames are lost"]


# Overlap, order, memory


@pytest.mark.slow
@settings(max_examples=60)
@given(data=st.data())
def test_any_spread_over_chunks_gives_log_time_order(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Chunks in any order, overlapping, unsorted inside, of any compression, and loose messages
    between them; with memory for next to none of it."""
    path = tmp_path_factory.mktemp("spread", numbered=True) / "log.mcap"
    numbers = data.draw(st.permutations(range(12)))
    cuts = sorted(data.draw(st.sets(st.integers(1, 11), max_size=5)))
    held = chunks.HELD_BYTES
    chunks.HELD_BYTES = data.draw(st.sampled_from([0, 1200, held]))
    try:
        with HardLog(path, finished=data.draw(st.booleans())) as log:
            for start, end in pairwise([0, *cuts, 12]):
                part = [TIMED[n] for n in numbers[start:end]]
                if data.draw(st.booleans()):
                    log.chunk(part, data.draw(st.sampled_from(["", "lz4", "zstd"])))
                else:
                    log.loose(part)
        assert_frames(read(path)[0], list(range(12)))
    finally:
        chunks.HELD_BYTES = held


def test_room_in_the_temporary_file_is_used_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunks, "HELD_BYTES", 0)
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        for first in range(11):  # each overlaps the next by one message
            log.chunk(TIMED[first : first + 2], "zstd")
    most = 0
    original = chunks.ChunkStore._room

    def watched(store: chunks.ChunkStore, size: int) -> chunks.Contents:
        nonlocal most
        contents = original(store, size)
        most = max(most, contents.end)
        return contents

    monkeypatch.setattr(chunks.ChunkStore, "_room", watched)
    assert len(read(path)[0]) == 22
    assert most <= 4 * (len(TIMED[0][1]) + 31)


def test_no_room_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(BytesIO):
        def write(self, _data: object) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(chunks, "HELD_BYTES", 0)
    monkeypatch.setattr(chunks.tempfile, "TemporaryFile", lambda **_: Full())
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        log.chunk(TIMED, "zstd")
    with pytest.raises(SonarrecError, match=r"no room to inflate a chunk .* TMPDIR"):
        read(path)


def test_a_channel_without_a_message(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with HardLog(path):
        pass
    with pytest.raises(SonarrecError, match="not one frame could be used"):
        read(path)


MB = 2**20
SMALL = 48 * MB


@pytest.fixture(scope="module")
def least(tmp_path_factory: pytest.TempPathFactory) -> float:
    """What the program itself takes to read a log (MB)."""
    path = tmp_path_factory.mktemp("least") / "log.mcap"
    with HardLog(path) as log:
        log.chunk(TIMED)
    return peak_of_reading(path)[1]


@pytest.mark.parametrize(
    "shape",
    but_first(
        [
            "one chunk, uncompressed",
            "no index, no footer, lz4",
            "one chunk, zstd, backwards",
            "10 overlapping chunks, lz4",
            "1000 overlapping chunks, zstd",
            "one chunk, lz4, cut",
        ]
    ),
)
def test_memory_does_not_grow_with_the_log(shape: str, least: float, tmp_path: Path) -> None:
    """The shapes of tests/studies/memory.py, small, with a still smaller bound on held chunks.

    Without a bound 48 MB come on top of what the program itself takes.
    """
    path = tmp_path / "log.mcap"
    write = shapes(path, SMALL)[shape]
    write()
    frames_read, peak = peak_of_reading(path, held_bytes=4 * MB)
    assert frames_read >= 0.85 * SMALL / (300 * 512)
    assert peak - least < 20
