"""MCAP files that are cut: anywhere, also inside a compressed chunk."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader

from sonarrec.nouns import Frame
from sonarrec.readers import open_log
from sonarrec.readers.containers.mcap import chunks
from tests.support.logs import PERIOD_NS, cdr_image, frames, mcap_file
from tests.support.slow import but_first

COMPRESSIONS = ("none", "lz4", "zstd")


def read(path: Path) -> tuple[list[Frame], list[str]]:
    with open_log(path) as log:
        return list(log), log.diagnostics.problems


@pytest.mark.parametrize(
    "options",
    but_first(
        [
            {},
            {"content_checksum": True, "block_checksum": True, "store_size": False},
            {"block_linked": False},
            {"block_size": lz4.frame.BLOCKSIZE_MAX4MB},
            {"compression_level": 9, "block_size": lz4.frame.BLOCKSIZE_MAX256KB},
        ],
        2,
    ),
    ids=str,
)
def test_cut_lz4_frames(options: dict[str, int], tmp_path: Path) -> None:
    """Blocks that compress, and blocks stored as they are, of every kind of frame."""
    rng = np.random.default_rng(1)
    smooth = (np.add.outer(np.arange(300), np.arange(300)) // 9).astype(np.uint8)
    parts = [smooth + rng.integers(0, 3, (300, 300), dtype=np.uint8), smooth * 0]
    parts.append(rng.integers(0, 256, (300, 300), dtype=np.uint8))
    plain = b"".join(p.astype(np.uint8).tobytes() for p in parts)
    data = lz4.frame.compress(plain, **options)
    path = tmp_path / "data"
    gained = 0
    for cut in [*random.Random(1).sample(range(len(data)), 40), len(data)]:
        path.write_bytes(data[:cut])
        head = chunks.ChunkHead(0, 0, 0, 0, len(plain), 0, "lz4", 0, len(data), cut)
        with path.open("rb") as file:
            contents = chunks.ChunkStore(file).open(head)
            contents.file.seek(0)
            found = contents.file.read()
        whole_blocks = lz4.frame.LZ4FrameDecompressor().decompress(data[:cut])
        assert plain.startswith(found)
        assert len(found) >= len(whole_blocks)
        gained += len(found) - len(whole_blocks)
    assert found == plain
    assert gained > 100_000


# Cut files


def whole_messages(contents: bytes) -> int:
    """How many message records are whole in the beginning of a chunk's contents."""
    at, count = 0, 0
    while at + 9 <= len(contents):
        opcode, length = struct.unpack_from("<BQ", contents, at)
        at += 9 + length
        count += opcode == 0x05 and at <= len(contents)
    return count


@pytest.mark.slow
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_600_frames_cut_at_50_places(compression: str, tmp_path: Path) -> None:
    """Against what the compressors' own libraries make of the stored bytes before the cut."""
    images = frames(600, 24, 30)
    messages = [("/a", k * PERIOD_NS, cdr_image(i)) for k, i in enumerate(images)]
    path = mcap_file(tmp_path / "log.mcap", messages, compression=compression, chunk_size=150_000)
    whole = path.read_bytes()
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes  # type: ignore[union-attr]
    assert len(chunks) == 4
    inflate = {
        "none": lambda data: data,
        "lz4": lambda data: lz4.frame.LZ4FrameDecompressor().decompress(data),
        "zstd": lambda data: zstandard.ZstdDecompressor().decompressobj().decompress(data),
    }[compression]
    cut = tmp_path / "cut.mcap"
    told = 0
    places = range(chunks[0].chunk_start_offset, len(whole))
    for place in random.Random(compression).sample(places, 50):
        cut.write_bytes(whole[:place])
        expected = in_chunks = 0
        for chunk in chunks:
            start = chunk.chunk_start_offset + chunk.chunk_length - chunk.compressed_size
            end = start + chunk.compressed_size
            if start < place:
                expected += whole_messages(inflate(whole[start : min(place, end)]))
                in_chunks += whole_messages(inflate(whole[start:end]))
        if not expected:
            continue
        found, problems = read(cut)
        if compression == "lz4":  # the library gives up the block that is cut
            assert expected <= len(found) <= expected + 65536 // len(messages[0][2])
        else:
            assert len(found) == expected
        for frame, image in zip(found, images, strict=False):
            np.testing.assert_array_equal(frame.image, image)
        assert "cut short or damaged at byte " in problems[0]
        if "only the summary" in problems[0]:
            assert len(found) == 600
        for line in problems[1:]:
            told += 1
            missing = int(line.split(" held ")[1].split(" more ")[0])
            assert abs(len(found) + missing - in_chunks) <= 3  # by size: chunks hold more records
    assert told > 20 or compression == "zstd"
