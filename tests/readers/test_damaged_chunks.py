"""Chunks without a checksum whose records are damaged, and what stands outside of a recording."""

from __future__ import annotations

import struct
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer

from sonarrec.errors import SonarrecError
from sonarrec.nouns import Frame
from sonarrec.readers import open_log
from sonarrec.readers.containers.mcap.recording import McapRecording
from sonarrec.readers.messages.images import ChannelImages
from tests.support.hard_logs import HardLog, message, record
from tests.support.logs import PERIOD_NS, SONAR_TOML, cdr_image, frames

IMAGES = frames(12, 20, 20)
TIMED = [(k * PERIOD_NS, cdr_image(image)) for k, image in enumerate(IMAGES)]
HEAD = 9 + 22  # of a record, of a message


def read(path: Path) -> tuple[list[Frame], list[str]]:
    with open_log(path) as log:
        return list(log), log.diagnostics.problems


def numbers(found: list[Frame]) -> list[int]:
    """The frames' numbers, each of which must show its own image at its own time."""
    for frame in found:
        np.testing.assert_array_equal(frame.image, IMAGES[frame.index])
        assert frame.timestamp_ns == frame.index * PERIOD_NS
    return [frame.index for frame in found]


def unchecked(
    path: Path,
    *,
    crc: bool = False,
    indexed: bool = True,
    statistics: bool = False,
    repeat_schemas: bool = True,
    repeat_channels: bool = True,
    compression: CompressionType = CompressionType.NONE,
) -> bytearray:
    """Twelve frames in three chunks, and the bytes of the file."""
    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=2000,
            compression=compression,
            index_types=IndexType.ALL if indexed else IndexType.NONE,
            use_statistics=statistics,
            repeat_schemas=repeat_schemas,
            repeat_channels=repeat_channels,
            enable_crcs=crc,
        )
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
        channel = writer.register_channel("/a", "cdr", schema)
        for moment, data in TIMED:
            writer.add_message(channel, moment, data, moment)
        writer.finish()
    (path.parent / "sonar.toml").write_text(SONAR_TOML)
    return bytearray(path.read_bytes())


def head_of(data: bytes, number: int) -> int:
    """Where the record of a message begins."""
    return data.index(TIMED[number][1]) - HEAD


@pytest.mark.parametrize("value", [0, 200, 2**40])
@pytest.mark.parametrize("indexed", [True, False])
def test_a_damaged_record_length_costs_what_follows_in_its_chunk(
    value: int, indexed: bool, tmp_path: Path
) -> None:
    """Where there is an index, the frames of later chunks keep their numbers."""
    path = tmp_path / "log.mcap"
    data = unchecked(path, indexed=indexed)
    per_chunk = 2000 // len(TIMED[0][1])
    struct.pack_into("<Q", data, head_of(data, 1) + 1, value)
    path.write_bytes(data)
    found, problems = read(path)
    if indexed:
        assert numbers(found) == [0, *range(per_chunk, 12)]
    else:
        times = [frame.timestamp_ns // PERIOD_NS for frame in found]
        assert [t for t in times if t > 1] == [*range(per_chunk, 12)]
    assert any("is damaged at byte" in p and "`mcap recover`" in p for p in problems)


@pytest.mark.slow
def test_every_flip_of_a_bit_in_the_head_of_a_message(tmp_path: Path) -> None:
    """It costs nothing, or it is told; and no frame of another chunk is lost or changes its
    number."""
    path = tmp_path / "log.mcap"
    data = unchecked(path)
    at = head_of(data, 5)
    for bit in range(8 * HEAD):
        damaged = data.copy()
        damaged[at + bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        found, problems = read(path)
        lost = set(range(12)) - set(numbers(found))
        assert lost <= {5, 6, 7, 8}, bit  # 9 begins the next chunk
        assert bool(lost) == bool(problems), bit


def test_messages_of_no_channel_and_too_short_ones_are_told(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    data = unchecked(path, indexed=False)
    damaged = data.copy()
    struct.pack_into("<H", damaged, head_of(data, 3) + 9, 77)
    path.write_bytes(damaged)
    found, problems = read(path)
    assert len(found) == 11
    assert any("1 messages of channels that nothing defines" in p for p in problems)
    with HardLog(path, finished=False) as log:
        log.loose(TIMED)
    stray = message(5, b"data", channel=9) + record(0x05, b"short") + record(0x33, b"")
    path.write_bytes(path.read_bytes() + stray)
    found, problems = read(path)
    assert numbers(found) == list(range(12))
    assert problems[1:] == [
        "log.mcap: not read: 1 messages too short for a head",
        "log.mcap: not read: 1 records of no known kind",
        "log.mcap: not read: 1 messages of channels that nothing defines",
    ]


@pytest.mark.parametrize("crc", [False, True])
def test_what_follows_the_footer_is_told(crc: bool, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    data = unchecked(path, crc=crc, statistics=True)
    for more, says in ((bytes(data), ": another recording begins there"), (b"garbage" * 9, "read")):
        path.write_bytes(data + more)
        found, problems = read(path)
        assert numbers(found) == list(range(12))
        (problem,) = problems
        assert f"{len(more)} bytes follow its end at byte {len(data)} and were not read" in problem
        assert says in problem


@pytest.mark.parametrize(
    ("schemas", "channels", "statistics"),
    [(False, False, False), (False, True, True), (True, False, True), (True, True, False)],
)
def test_what_only_a_chunk_defines(
    schemas: bool, channels: bool, statistics: bool, tmp_path: Path
) -> None:
    """As the mcap package reads them too."""
    path = tmp_path / "log.mcap"
    unchecked(
        path,
        crc=True,
        statistics=statistics,
        repeat_schemas=schemas,
        repeat_channels=channels,
        compression=CompressionType.ZSTD,
    )
    with path.open("rb") as file:
        assert len(list(NonSeekingReader(file).iter_messages())) == 12
    with open_log(path) as log:
        assert log.frame_count == 12
        assert numbers(list(log)) == list(range(12))
    assert not log.diagnostics.problems


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
@pytest.mark.parametrize("how", ["cut", "zeroed", "noise"])
def test_a_recording_that_changes_while_it_is_read(
    how: str, compression: CompressionType, tmp_path: Path
) -> None:
    path = tmp_path / "log.mcap"
    data = unchecked(path, compression=compression)
    reader = ChannelImages(McapRecording(path))
    try:
        passed = iter(reader)
        next(passed)
        if how == "cut":
            with path.open("r+b") as file:
                file.truncate(len(data) // 3)
        else:
            noise = np.random.default_rng(0).bytes(len(data))
            path.write_bytes(noise if how == "noise" else bytes(len(data)))
        rest = list(passed)
    except SonarrecError:
        return
    finally:
        reader.close()
    assert len([f for f in rest if f.pixels is not None]) < 11
    assert reader.diagnostics.faults


@pytest.mark.slow
def test_times_that_fall_by_the_hundred_thousand(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    count = 20_000
    with HardLog(path) as log:
        log.chunk(((count - n, b"") for n in range(count)), indexed=False)
    reader = ChannelImages(McapRecording(path))
    tracemalloc.start()
    start = time.process_time()
    stamps = [frame.timestamp_ns for frame in reader]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    reader.close()
    assert stamps == list(range(1, count + 1))
    assert peak < 5e6  # 1 kB each would be 20 MB
    assert time.process_time() - start < 30
