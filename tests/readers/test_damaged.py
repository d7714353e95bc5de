"""One corpus of damaged files, cut anywhere and changed anywhere, through `info` and `run`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sonarrec.errors import SonarrecError
from sonarrec.readers.info import describe
from sonarrec.sonar.frame import Frame
from tests.support import logs
from tests.support.bags import bag, messages, ros1_bag
from tests.support.command import sonarrec
from tests.support.logs import SONAR_TOML, frames, image_mcap, video_file
from tests.support.sonar_files import aris_file, didson_file, gemini_file, oculus_file

IMAGES = frames(10, 64, 48)
IMAGES_OF_96 = frames(10, 64, 96)
Make = Callable[[Path], Path]


def mcap(compression: str, chunked: bool = True) -> Make:
    how = {"compression": compression, "chunked": chunked, "chunk_size": 10_000}
    return lambda path: image_mcap(path / "log.mcap", IMAGES, **how)


CORPUS: dict[str, Make] = {
    "mcap": mcap("none"),
    "mcap, lz4": mcap("lz4"),
    "mcap, zstd": mcap("zstd"),
    "mcap, no chunks": mcap("none", chunked=False),
    "db3": lambda path: bag(path / "log", messages(IMAGES)) / "log.db3",
    "bag": lambda path: ros1_bag(path / "log.bag", IMAGES, "BZ2"),
    "aris": lambda path: aris_file(path / "log.aris", IMAGES),
    "oculus": lambda path: oculus_file(path / "log.raw", IMAGES),
    "gemini": lambda path: gemini_file(path / "log.glf", IMAGES),
    "didson": lambda path: didson_file(path / "log.ddf", IMAGES_OF_96, 4),
    "avi": lambda path: video_file(path / "log.avi", IMAGES, "MJPG"),
    "mkv": lambda path: video_file(path / "log.mkv", IMAGES, "FFV1"),
    "mp4": lambda path: video_file(path / "log.mp4", IMAGES, "mp4v"),
}
POLAR = (".aris", ".ddf", ".glf", ".raw")


def made(make: Make, folder: Path) -> tuple[Path, list[Frame]]:
    """A whole log, with the geometry that it does not state, and its frames."""
    path = make(folder)
    text = "[sonar]\ntilt_deg = 20.0\n" if path.suffix in POLAR else SONAR_TOML
    (path.parent / "sonar.toml").write_text(text)
    whole, problems, _ = logs.read(path)
    assert len(whole) == len(IMAGES)
    assert not problems
    return path, whole


def read(path: Path) -> tuple[list[Frame], list[str]]:
    """The frames, and what is told of the others; of a Matroska, which counts none, in a note."""
    try:
        found, problems, notes = logs.read(path)
    except SonarrecError as error:
        return [], [str(error)]
    return found, [*problems, *(note for note in notes if " read: " in note)]


@pytest.mark.parametrize("make", CORPUS.values(), ids=CORPUS)
def test_a_cut_file_is_read_up_to_the_cut_and_told(make: Make, tmp_path: Path) -> None:
    """The frames are the first of the whole log, as many as lie in the file where that shows; and
    `run` does what reading does, with exit code 3."""
    path, whole = made(make, tmp_path)
    data, counts = path.read_bytes(), []
    # Where each image lies in the file as it is, something may follow its pixels.
    ends = [data.find(image.tobytes()) + image.size for image in IMAGES]
    for k in range(1, 25, 2):
        path.write_bytes(data[: (size := len(data) * k // 25)])
        found, lines = read(path)
        counts.append(len(found))
        assert [frame.index for frame in found] == list(range(len(found)))
        # SQLite and the decoders of videos fill up the frame that is cut.
        sure = found[:-1] if path.suffix in (".db3", ".avi") else found
        for frame, before in zip(sure, whole, strict=False):
            np.testing.assert_array_equal(frame.image, before.image)
        assert lines or len(found) == len(whole) or path.suffix == ".raw"  # cut between pings
        assert not [line for line in lines if "\n" in line or len(line) > 1000]
        if min(ends) >= IMAGES[0].size and path.suffix != ".db3":
            assert len(found) <= sum(end <= size for end in ends) <= len(found) + 1, size
    assert counts == sorted(counts)
    path.write_bytes(data[: len(data) * 4 // 5 - 3])
    found, lines = read(path)
    sonarrec("run", path, "-o", tmp_path / "out", code=3 if found else 1)
    if found:
        rows = (tmp_path / "out" / "log" / "frames.csv").read_text().splitlines()
        assert len(rows) == 1 + len(found)


@pytest.mark.parametrize("make", CORPUS.values(), ids=CORPUS)
def test_a_changed_file_is_told_or_reads_as_before(make: Make, tmp_path: Path) -> None:
    """Never more frames than there were; lost ones are told, in lines; no traceback."""
    path, _ = made(make, tmp_path)
    data, rng, most = path.read_bytes(), np.random.default_rng(0), 0
    for k in range(0, 15, 2):
        changed = bytearray(data)
        for at in rng.integers(0, len(data), 1 + 4 * k):
            changed[at] = rng.integers(0, 256)
        path.write_bytes(changed)
        try:
            found = describe(path)
        except SonarrecError as error:
            lines = [str(error)]
        else:
            lines = [*found.faults, *(p for i in found.images for p in (*i.problems, *i.notes))]
            usable = sum(images.usable or 0 for images in found.images)
            most = max(most, usable)
            assert usable <= len(IMAGES)
            assert lines or usable == len(IMAGES) or not found.images
        assert not [line for line in lines if "\n" in line or len(line) > 1000]
    assert most > len(IMAGES) // 2 or path.suffix == ".bag"  # whose one chunk holds all


@pytest.mark.parametrize("kind", ["aris", "didson", "oculus"])
@pytest.mark.parametrize("lost", [100, 900, -700])
def test_lost_or_strange_bytes_cost_their_frames(kind: str, lost: int, tmp_path: Path) -> None:
    """Reading goes on at the next header; every other frame keeps its image and its time."""
    path, whole = made(CORPUS[kind], tmp_path)
    data, before = path.read_bytes(), {frame.timestamp_ns: frame.image for frame in whole}
    for k in range(2, 9):
        at = len(data) * k // 10
        path.write_bytes(data[:at] + (data[at + lost :] if lost > 0 else bytes(-lost) + data[at:]))
        found, lines = read(path)
        times = [frame.timestamp_ns for frame in found]
        assert times == sorted(set(times))
        for frame in found:
            np.testing.assert_array_equal(frame.image, before[frame.timestamp_ns])
        assert len(whole) - 2 <= len(found)
        assert lines


@pytest.mark.parametrize(("ending", "codec"), [("mov", "mp4v"), ("mkv", "FFV1")])
def test_a_video_damaged_inside_is_told(ending: str, codec: str, tmp_path: Path) -> None:
    """Its decoder yields as many pictures as ever, some of them wrong."""
    path = video_file(tmp_path / f"log.{ending}", frames(12, 192, 152), codec)
    whole, problems, _ = logs.read(path)
    assert (len(whole), problems) == (12, [])
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 300] = bytes(300)
    path.write_bytes(data)
    assert any("damaged inside" in line for line in logs.read(path).problems)


def test_an_mp4_that_was_not_finished_is_told(tmp_path: Path) -> None:
    path = video_file(tmp_path / "log.mp4", frames(12), "mp4v")
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"moov") - 4])
    with pytest.raises(SonarrecError, match="moov"):
        logs.read(path)
