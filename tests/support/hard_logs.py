"""Writes MCAP files record by record, in shapes that the `mcap` package's writer never makes, and
measures the peak memory of reading one."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Schema,
    Statistics,
)

from tests.support.logs import SONAR_TOML, cdr_image

MAGIC = b"\x89MCAP0\r\n"
Timed = Iterable[tuple[int, bytes]]
"""(log time in ns, message), in the order of the file."""


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def message(time: int, data: bytes, channel: int = 1) -> bytes:
    return record(0x05, struct.pack("<HIQQ", channel, 0, time, time) + data)


def built(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for each in records:
        each.write(builder)
    return builder.end()


PACK: dict[str, Callable[[bytes], bytes]] = {
    "": bytes,
    "lz4": lz4.frame.compress,
    "zstd": zstandard.ZstdCompressor(level=1).compress,
}


class HardLog:
    """An MCAP file with one image channel, in the making; a context manager that ends it.

    finished: with DataEnd, summary and footer; without, the file ends after its last record.
    positions: where the chunks begin.
    """

    def __init__(self, path: Path, *, finished: bool = True) -> None:
        self._file = path.open("w+b")
        self._finished = finished
        self._definitions = [
            Schema(id=1, name="sensor_msgs/msg/Image", encoding="ros2msg", data=b""),
            Channel(id=1, topic="/a", message_encoding="cdr", metadata={}, schema_id=1),
        ]
        self._indexes: list[ChunkIndex] = []
        self._count = 0
        self._file.write(MAGIC + built(Header("", "hard"), *self._definitions))
        (path.parent / "sonar.toml").write_text(SONAR_TOML)

    @property
    def positions(self) -> list[int]:
        return [index.chunk_start_offset for index in self._indexes]

    def loose(self, messages: Timed) -> None:
        """Messages outside of any chunk."""
        for time, data in messages:
            self._file.write(message(time, data))
            self._count += 1

    def chunk(
        self,
        messages: Timed,
        compression: str = "",
        *,
        crc: bool = True,
        indexed: bool = True,
        start: int | None = None,
        size: int | None = None,
    ) -> None:
        """One chunk. start, size: in place of the true first time and inflated size."""
        position, name = self._file.tell(), compression.encode()
        times: list[tuple[int, int]] = []
        parts, written = [], 0
        for time, data in messages:
            times.append((time, written))
            parts.append(message(time, data))
            written += len(parts[-1])
        plain = b"".join(parts)
        stored = PACK[compression](plain)
        low = min((t for t, _ in times), default=0)
        high = max((t for t, _ in times), default=0)
        head = struct.pack("<QQ", low if start is None else start, high)
        head += struct.pack("<QI", written if size is None else size, zlib.crc32(plain) * crc)
        head += struct.pack("<I", len(name)) + name + struct.pack("<Q", len(stored))
        self._file.write(record(0x06, head + stored))
        end = self._file.tell()
        index = built(MessageIndex(channel_id=1, records=times)) if indexed else b""
        self._file.write(index)
        self._count += len(times)
        self._indexes.append(
            ChunkIndex(
                chunk_length=end - position,
                chunk_start_offset=position,
                compression=compression,
                compressed_size=len(stored),
                message_end_time=high,
                message_index_length=len(index),
                message_index_offsets={1: end} if indexed else {},
                message_start_time=low,
                uncompressed_size=written,
            )
        )

    def __enter__(self) -> HardLog:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None and self._finished:
            self._finish()
        self._file.close()

    def _finish(self) -> None:
        self._file.write(built(DataEnd(0)))
        summary_start = self._file.tell()
        counts = {"attachment_count": 0, "metadata_count": 0, "channel_count": 1, "schema_count": 1}
        statistics = Statistics(
            channel_message_counts={1: self._count},
            chunk_count=len(self._indexes),
            message_count=self._count,
            message_end_time=max((i.message_end_time for i in self._indexes), default=0),
            message_start_time=min((i.message_start_time for i in self._indexes), default=0),
            **counts,
        )
        summary = built(*self._definitions, statistics, *self._indexes)
        footer = struct.pack("<BQQQ", 0x02, 20, summary_start, 0)
        self._file.write(summary + built(Footer(summary_start, 0, zlib.crc32(summary + footer))))
        self._file.write(MAGIC)


# Reads every frame; prints how many, and its own peak in KiB (bytes on macOS).
_READ = """
import resource, sys
from sonarrec.readers import open_log
from sonarrec.errors import SonarrecError
frames = 0
try:
    with open_log(sys.argv[1]) as log:
        for frame in log:
            frames += 1
except SonarrecError:
    pass
print(frames, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
# On Linux a new process is charged with the peak of the one it was forked from, until it runs
# its own program: so it is forked from a small one.
_LAUNCH = "import subprocess, sys; sys.exit(subprocess.run(sys.argv[1:]).returncode)"


def peak_of_reading(path: Path) -> tuple[int, float]:
    """(frames read, peak resident memory in MB) of a process that reads a log."""
    command = [sys.executable, "-c", _LAUNCH, sys.executable, "-c", _READ, str(path)]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return int(told[0]), int(told[1]) / (1024**2 if sys.platform == "darwin" else 1024)


def noise_log(path: Path, size: int, compression: str, chunks: int, overlap: bool) -> None:
    """A log of about `size` bytes of images that compress next to not at all, too many for a window
    to find again. overlap: every chunk reaches over the whole log; else they follow each other."""
    rng = np.random.default_rng(0)
    images = [cdr_image(rng.integers(0, 256, (300, 512), dtype=np.uint8)) for _ in range(32)]
    timed = [(n, images[n % 32]) for n in range(size // len(images[0]))]
    each = -(-len(timed) // chunks)
    with HardLog(path) as log:
        for k in range(chunks):
            part = timed[k::chunks] if overlap else timed[k * each : (k + 1) * each]
            log.chunk(part, compression)
