"""Bags of ROS: one log through all parts, whatever is missing; bad ones are one line."""

from __future__ import annotations

import sqlite3
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zstandard

from sonarrec.errors import SonarrecError
from sonarrec.readers import open_log
from sonarrec.readers.messages import ros
from tests.support.bags import IMAGE, bag, messages, ros1_messages, split_bag
from tests.support.logs import PERIOD_NS, cdr_image, frames, mcap_file, read
from tests.support.messages import image_fields, serialised

IMAGES = frames(10)


def split(folder: Path, storage: str = ".mcap", images: list[np.ndarray] = IMAGES) -> list[Path]:
    """A bag of these images in five parts, which are returned."""
    timed = messages(images)
    ends = [0, 2, 3, 6, 8, 10] if len(images) == 10 else range(0, len(images) + 1, 10)
    return split_bag(folder, [timed[a:b] for a, b in pairwise(ends)], storage)


def numbers(path: Path, images: list[np.ndarray] = IMAGES) -> tuple[list[int], list[str]]:
    """Which of the images are read, by their times, and the problems."""
    found, problems, _ = read(path)
    places = [frame.timestamp_ns // PERIOD_NS for frame in found]
    for frame, place in zip(found, places, strict=True):
        np.testing.assert_array_equal(frame.image, images[place])
    return places, problems


@pytest.mark.parametrize("storage", [".mcap", ".db3"])
def test_a_part_that_is_cut_is_read_up_to_the_cut(storage: str, tmp_path: Path) -> None:
    images = frames(30, 60, 60)
    part = split(tmp_path / "dive", storage, images)[1]
    data = part.read_bytes()
    part.write_bytes(data[: len(data) * 6 // 10])
    found, problems = numbers(tmp_path / "dive", images)
    kept = len(found) - 10
    assert 10 < kept < 20
    assert found == [*range(kept), *range(20, 30)]
    assert any(f"{part.name}: cut short" in line for line in problems)


@pytest.mark.parametrize("storage", [".mcap", ".db3"])
def test_a_missing_part(storage: str, tmp_path: Path) -> None:
    files = split(tmp_path / "dive", storage)
    files[2].unlink()
    for named in (files[2].name, "part 2"):  # the second time by the parts' numbers alone
        found, (problem,) = numbers(tmp_path / "dive")
        assert found == [0, 1, 2, 6, 7, 8, 9]
        assert "missing" in problem
        assert named in problem
        (tmp_path / "dive" / "metadata.yaml").unlink(missing_ok=True)
    for file in files:
        file.unlink(missing_ok=True)
    with pytest.raises(SonarrecError, match="no image"):
        read(tmp_path / "dive")


def as_recorded(path: Path, seconds: list[float], container: str) -> Path:
    """A log whose messages have these log times, in the order of recording."""
    times = [round(s * 1e9) for s in seconds]
    if container == ".bag":
        pings = [serialised(IMAGE, image_fields(k, i), ros1=True) for k, i in enumerate(IMAGES)]
        return ros1_messages(path / "dive.bag", list(zip(times, pings, strict=True)))
    timed = [(time, data) for time, (_, data) in zip(times, messages(IMAGES), strict=True)]
    if container == ".db3":
        return bag(path / "dive", timed)
    return mcap_file(
        path / "dive.mcap",
        [("/sonar", *message) for message in timed],
        chunk_size=2000 if container == "chunks" else 10**6,
        chunked=container != "no chunks",
    )


@pytest.mark.parametrize("container", ["chunks", "one chunk", "no chunks", ".db3", ".bag"])
def test_a_clock_that_was_set(container: str, tmp_path: Path) -> None:
    """Back by the largest fall from any time to a later recorded one, for threads may swap some; or
    ahead by years."""
    clocks = {
        "back": [10, 11, 12, 13, 14, 12.5, 13.5, 14.5, 15.5, 16.5],
        "far": [5000, 5001, 5002, 5003, 5004, 1400.5, 1401.5, 1402.5, 1403.5, 1404.5],
        "swapped": [10, 11, 12, 13, 14, 13.5, 15, 16, 17, 18],
        "forward": [0, 1, 2, 3, 4, 1.7e9, 1.7e9 + 1, 1.7e9 + 2, 1.7e9 + 3, 1.7e9 + 4],
    }
    for name, seconds in clocks.items():
        (tmp_path / name).mkdir()
        fall = max(a - b for k, a in enumerate(seconds) for b in seconds[k:])
        with open_log(as_recorded(tmp_path / name, seconds, container)) as log:
            for _ in range(2):  # a further pass tells nothing anew
                assert [f.timestamp_ns / 1e9 for f in log] == sorted(seconds)
                assert not log.diagnostics.problems
                notes = [note for note in log.diagnostics.notes if "clock set?" in note]
                assert len(notes) == (fall > 1 or name == "forward"), notes
        told = [f"{fall:.1f} s"]
        if name == "forward":
            told = [f"{(1.7e9 - 4) / 86400 / 365.2425:.1f} years", "frame 5"]
        assert all(fact in note for note in notes for fact in told)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}\n",
        "rosbag2_bagfile_information: [",
        "rosbag2_bagfile_information: !!python/object/apply:os.system ['touch ran']",
        "rosbag2_bagfile_information: {relative_file_paths: 7, files: 3}",
    ],
)
def test_empty_metadata(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    split(tmp_path / "dive")
    (tmp_path / "dive" / "metadata.yaml").write_text(text)
    name = "renamed" if len(text) < 4 else "dive"  # with an empty one it is a bag under any name
    found, problems, _ = read((tmp_path / "dive").rename(tmp_path / name))
    assert len(found) == 10
    assert all("metadata.yaml" in line and "\n" not in line for line in problems)
    assert not (tmp_path / "ran").exists()


def test_metadata_that_cannot_be_true(tmp_path: Path) -> None:
    """Nothing outside of the folder is read, and no end of lost frames is believed."""
    files = split(tmp_path / "dive")
    mcap_file(tmp_path / "secret.mcap", [("/sonar", 10**12, cdr_image(IMAGES[0]))])
    file = tmp_path / "dive" / "metadata.yaml"
    told = file.read_text()
    file.write_text(told.replace(files[4].name, "../secret.mcap"))
    found, problems, _ = read(tmp_path / "dive")
    assert len(found) == 8
    assert any("missing" in line and "secret.mcap" in line for line in problems)
    assert any(files[4].name in line and "not listed" in line for line in problems)
    file.write_text(told.replace("message_count: 10", "message_count: 1000000000000"))
    assert len(read(tmp_path / "dive").frames) == 10


def test_messages_that_inflate_too_far(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros, "MAX_FRAME_BYTES", 2**20)
    bomb = zstandard.ZstdCompressor().compress(bytes(2**24))
    timed = [*messages(IMAGES[:2]), (PERIOD_NS * 2, bomb), (PERIOD_NS * 3, bomb[:4] + b"\xff" * 20)]
    found, (large, damaged), _ = read(bag(tmp_path / "dive", timed))
    assert len(found) == 2
    assert "more than" in large
    assert "does not inflate" in damaged


def test_a_view_in_place_of_a_table_is_refused(tmp_path: Path) -> None:
    """It may have no end."""
    file = bag(tmp_path / "dive", messages(IMAGES)) / "dive.db3"
    with sqlite3.connect(file) as database:
        database.execute("ALTER TABLE messages RENAME TO others")
        endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
        database.execute(
            f"CREATE VIEW messages AS {endless} SELECT i AS rowid, 1 AS topic_id, i AS timestamp, "
            "x'00' AS data FROM n"
        )
    with pytest.raises(SonarrecError, match="view"):
        read(file)


def test_rows_of_a_database_that_are_left_unread_are_told(tmp_path: Path) -> None:
    file = bag(tmp_path / "dive", messages(IMAGES)) / "dive.db3"
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET topic_id = 77 WHERE rowid > 6")
    file.with_name("dive.db3-journal").write_bytes(b"hot")
    found, problems, _ = read(file)
    assert len(found) == 6
    assert any("dive.db3: 4 messages" in p for p in problems)
    assert any("dive.db3-journal" in p for p in problems)
