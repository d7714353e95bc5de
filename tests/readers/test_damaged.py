"""One corpus of damaged files, cut anywhere and changed anywhere, through `info`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard

from sonarrec.errors import SonarrecError
from sonarrec.readers.info import describe
from sonarrec.sonar import Sonar
from tests.support.bags import bag, messages, ros1_bag
from tests.support.logs import frames, mcap_file
from tests.support.sonar_files import aris_file, gemini_log, gemini_record, oculus_ping

IMAGES = frames(10, 64, 48)
Make = Callable[[Path], Path]


def mcap(compression: str, chunked: bool = True) -> Make:
    timed = [("/a", *message) for message in messages(IMAGES)]
    return lambda path: mcap_file(
        path / "log.mcap", timed, compression=compression, chunked=chunked, chunk_size=10_000
    )


def packed(ending: str, pack: Callable[[bytes], bytes]) -> Make:
    def make(path: Path) -> Path:
        whole = mcap("none")(path)
        whole.with_name(f"log.mcap{ending}").write_bytes(pack(whole.read_bytes()))
        return whole.with_name(f"log.mcap{ending}")

    return make


def database(path: Path) -> Path:
    return bag(path / "log", messages(IMAGES)) / "log.db3"


def oculus(path: Path) -> Path:
    file = path / "log.raw"
    file.write_bytes(b"".join(oculus_ping(k, image) for k, image in enumerate(IMAGES)))
    return file


def video(path: Path) -> Path:
    file = path / "log.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 10, (48, 64))
    for image in IMAGES:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return file


CORPUS: dict[str, Make] = {
    "mcap": mcap("none"),
    "mcap, lz4": mcap("lz4"),
    "mcap, zstd": mcap("zstd"),
    "mcap, no chunks": mcap("none", chunked=False),
    "mcap.zst": packed(".zst", zstandard.ZstdCompressor().compress),
    "mcap.lz4": packed(".lz4", lz4.frame.compress),
    "db3": database,
    "bag": lambda path: ros1_bag(path / "log.bag", IMAGES, "BZ2"),
    "aris": lambda path: aris_file(path / "log.aris", IMAGES),
    "oculus": oculus,
    "gemini": lambda path: gemini_log(
        path / "log.glf", [gemini_record(k, image) for k, image in enumerate(IMAGES)]
    ),
    "avi": video,
}


@pytest.mark.parametrize("make", CORPUS.values(), ids=CORPUS)
def test_a_damaged_file_is_read_as_far_as_it_goes_and_told(make: Make, tmp_path: Path) -> None:
    """Never more frames than there were; lost ones are told, in lines; no traceback."""
    path = make(tmp_path)
    data, rng, read = path.read_bytes(), np.random.default_rng(0), set[int]()
    for k in range(30):
        changed = bytearray(data)
        if k % 2:
            del changed[int(len(data) * (k + 1) / 31) :]
        else:
            for at in rng.integers(0, len(data), 1 + 2 * k):
                changed[at] = rng.integers(0, 256)
        path.write_bytes(changed)
        try:
            found = describe(path, sonar=Sonar(tilt_deg=20.0))
        except SonarrecError as error:
            lines = [str(error)]
        else:
            lines = [*found.faults, *(p for images in found.images for p in images.problems)]
            usable = sum(images.usable or 0 for images in found.images)
            read.add(usable)
            assert usable <= len(IMAGES)
            assert lines or usable == len(IMAGES) or not found.images
        assert not [line for line in lines if "\n" in line or len(line) > 1000]
    assert max(read) > len(IMAGES) // 2 or path.suffix == ".bag"  # whose one chunk holds all
