"""Makes the logs that the reader tests read: images with known pixels, and MCAP messages.

The bytes of messages are packed here field by field, or by rosbags, not by the package's writer.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from mcap.writer import CompressionType, IndexType, Writer

from sonarrec.readers import open_log
from sonarrec.sonar.frame import Frame

SONAR_TOML = """\
[sonar]
layout = "fan"
range_min_m = 1.25
range_max_m = 3.75
field_of_view_deg = 28.8
tilt_deg = 20.0
height_m = 0.68
frame_rate_hz = 4.0
"""
PERIOD_NS = 250_000_000
COMPRESSION = {
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}


def frames(count: int = 7, rows: int = 48, columns: int = 38, seed: int = 0) -> list[np.ndarray]:
    """Images that are never alike, with some structure for compressors to work on."""
    rng = np.random.default_rng(seed)
    ramp = np.add.outer(np.arange(rows), np.arange(columns))
    return [
        ((ramp * (k + 1) + rng.integers(0, 20, (rows, columns))) % 256).astype(np.uint8)
        for k in range(count)
    ]


def image_folder(
    path: Path, images: list[np.ndarray], suffix: str = ".png", names: Sequence[str] = ()
) -> Path:
    """A folder of images, or arrays. names: of the files, in place of frame0.png and so on."""
    path.mkdir(parents=True)
    for k, image in enumerate(images):
        file = path / (names[k] if names else f"frame{k}{suffix}")
        if suffix == ".npy":
            np.save(file, image)
        else:
            assert cv2.imwrite(str(file), image)
    (path / "sonar.toml").write_text(SONAR_TOML)
    return path


def video_file(path: Path, images: list[np.ndarray], codec: str, rate_hz: float = 4.0) -> Path:
    rows, columns = images[0].shape
    code = cv2.VideoWriter.fourcc(*codec)
    writer = cv2.VideoWriter(str(path), code, rate_hz, (columns, rows))
    assert writer.isOpened()
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    path.with_suffix(".sonar.toml").write_text(SONAR_TOML)
    return path


class Read(NamedTuple):
    """What a log gives: its frames, what of it could not be used, and what else is told."""

    frames: list[Frame]
    problems: list[str]
    notes: list[str]

    @property
    def numbers(self) -> list[int]:
        return [frame.index for frame in self.frames]

    @property
    def times(self) -> list[int]:
        return [frame.timestamp_ns for frame in self.frames]

    @property
    def images(self) -> list[np.ndarray]:
        return [frame.image for frame in self.frames]


def read(path: str | Path, **options: Any) -> Read:
    """options: of open_log."""
    with open_log(path, **options) as log:
        return Read(list(log), log.diagnostics.problems, log.diagnostics.notes)


def cdr_image(
    image: np.ndarray,
    encoding: str = "mono8",
    *,
    order: str = "<",
    step: int | None = None,
    padding: int = 0,
    stamp: tuple[int, int] = (1, 2),
    frame_id: bytes = b"sonar\0",
    is_bigendian: int = 0,
) -> bytes:
    """A sensor_msgs/msg/Image. padding: bytes after each row; step: as stated, right or wrong."""
    body = struct.pack(order + "iI", *stamp)
    body += struct.pack(order + "I", len(frame_id)) + frame_id
    body += bytes(-len(body) % 4)
    body += struct.pack(order + "II", *image.shape[:2])
    name = encoding.encode() + b"\0"
    body += struct.pack(order + "I", len(name)) + name + bytes([is_bigendian])
    body += bytes(-len(body) % 4)
    rows = image.reshape(image.shape[0], -1)
    data = b"".join(row.tobytes() + b"\xaa" * padding for row in rows)
    body += struct.pack(order + "II", rows.nbytes // len(rows) + padding if step is None else step,
                        len(data))  # fmt: skip
    return bytes([0, order == "<", 0, 0]) + body + data


def cdr_compressed_image(data: bytes, image_format: str, frame_id: bytes = b"\0") -> bytes:
    """A sensor_msgs/msg/CompressedImage, little-endian."""
    body = struct.pack("<iII", 1, 2, len(frame_id)) + frame_id
    body += bytes(-len(body) % 4)
    name = image_format.encode() + b"\0"
    body += struct.pack("<I", len(name)) + name
    body += bytes(-len(body) % 4)
    return b"\x00\x01\x00\x00" + body + struct.pack("<I", len(data)) + data


def mcap_file(
    path: Path,
    messages: Iterable[tuple[str, int, bytes]],
    *,
    schema: str = "sensor_msgs/msg/Image",
    encoding: str = "cdr",
    schema_encoding: str = "ros2msg",
    schema_data: bytes = b"",
    compression: str = "zstd",
    chunk_size: int = 4000,
    chunked: bool = True,
    indexed: bool = True,
) -> Path:
    """messages: (topic, log time, bytes), in the order to be written; small chunks, so several.
    A topic "/a#2" is a channel more of "/a"."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=chunk_size,
            compression=COMPRESSION[compression],
            use_chunking=chunked,
            index_types=IndexType.ALL if indexed else IndexType.NONE,
            repeat_channels=indexed,
            repeat_schemas=indexed,
            use_statistics=indexed,
            use_summary_offsets=indexed,
        )
        writer.start()
        schema_id = writer.register_schema(schema, schema_encoding, schema_data)
        channels: dict[str, int] = {}
        for topic, log_time, data in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(
                    topic.partition("#")[0], encoding, schema_id
                )
            writer.add_message(channels[topic], log_time, data, publish_time=log_time + 1)
        writer.finish()
    (path.parent / "sonar.toml").write_text(SONAR_TOML)
    return path


def image_mcap(
    path: Path, images: Iterable[np.ndarray], pixels: str = "mono8", **options: Any
) -> Path:
    """These images, four a second. pixels: their encoding; options: of mcap_file."""
    timed = [("/a", k * PERIOD_NS, cdr_image(image, pixels)) for k, image in enumerate(images)]
    return mcap_file(path, timed, **options)
