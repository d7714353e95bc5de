"""Bags of ROS for tests, written by rosbags; parts of one bag put together as a recorder does."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from ruamel.yaml import YAML

from tests.support.logs import PERIOD_NS, SONAR_TOML, cdr_image
from tests.support.messages import STORES, image_fields, serialised

IMAGE = "sensor_msgs/msg/Image"
MODES = {
    "file": CompressionMode.FILE,
    "message": CompressionMode.MESSAGE,
    "storage": CompressionMode.STORAGE,
}
STORAGES = {".db3": StoragePlugin.SQLITE3, ".mcap": StoragePlugin.MCAP}
Timed = Sequence[tuple[int, bytes]]
"""(log time in ns, message)."""


def messages(images: Sequence[np.ndarray]) -> list[tuple[int, bytes]]:
    return [(k * PERIOD_NS, cdr_image(image)) for k, image in enumerate(images)]


def bag(
    folder: Path,
    timed: Timed,
    storage: str = ".db3",
    compressed: str | None = None,
    topic: str = "/sonar",
    kind: str = IMAGE,
) -> Path:
    """A bag of one part, as rosbags writes it."""
    writer = Writer(folder, version=9, storage_plugin=STORAGES[storage])
    if compressed is not None:
        writer.set_compression(MODES[compressed], CompressionFormat.ZSTD)
    with writer:
        channel = writer.add_connection(topic, kind, typestore=STORES[False])
        for time, data in timed:
            writer.write(channel, time, data)
    (folder / "sonar.toml").write_text(SONAR_TOML)
    return folder


def split_bag(
    folder: Path, parts: Sequence[Timed], storage: str = ".mcap", compressed: str | None = None
) -> list[Path]:
    """A bag of several parts, each of which rosbags wrote; returns the parts."""
    folder.mkdir(parents=True)
    (folder / "sonar.toml").write_text(SONAR_TOML)
    files, told = [], []
    for k, timed in enumerate(parts):
        one = bag(folder / "one", timed, storage, compressed)
        written = next(p for p in one.iterdir() if p.suffix not in (".yaml", ".toml"))
        end = "".join(written.suffixes)
        files.append(written.rename(folder / f"{folder.name}_{k}{end}"))
        told.append(YAML(typ="safe").load(one / "metadata.yaml")["rosbag2_bagfile_information"])
        shutil.rmtree(one)
    head = told[0]
    count = sum(map(len, parts))
    head["message_count"] = head["topics_with_message_count"][0]["message_count"] = count
    head["relative_file_paths"] = [file.name for file in files]
    head["files"] = [
        {
            "path": file.name,
            "starting_time": {"nanoseconds_since_epoch": timed[0][0]},
            "duration": {"nanoseconds": timed[-1][0] - timed[0][0]},
            "message_count": len(timed),
        }
        for file, timed in zip(files, parts, strict=True)
    ]
    with (folder / "metadata.yaml").open("w") as file:
        YAML(typ="safe").dump({"rosbag2_bagfile_information": head}, file)
    return files


def ros1_bag(path: Path, images: Sequence[np.ndarray], compression: str | None = None) -> Path:
    timed = [
        (k * PERIOD_NS, serialised(IMAGE, image_fields(k, image), ros1=True))
        for k, image in enumerate(images)
    ]
    return ros1_messages(path, timed, compression=compression)


def ros1_messages(
    path: Path, timed: Timed, kind: str = IMAGE, compression: str | None = None
) -> Path:
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(Ros1Writer.CompressionFormat[compression])
    with writer:
        channel = writer.add_connection("/sonar", kind, typestore=STORES[True])
        for time, data in timed:
            writer.write(channel, time, data)
    (path.parent / "sonar.toml").write_text(SONAR_TOML)
    return path
