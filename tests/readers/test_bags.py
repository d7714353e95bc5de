"""Bags of ROS: one log through all parts, whatever is missing; bad ones are one line."""

from __future__ import annotations

import sqlite3
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
PARTS = [2, 1, 3, 2, 2]


def parts_of(timed: list[tuple[int, bytes]], sizes: list[int]) -> list[list[tuple[int, bytes]]]:
    ends = np.cumsum(sizes)
    return [timed[end - size : end] for size, end in zip(sizes, ends, strict=True)]


@pytest.mark.parametrize("storage", [".mcap", ".db3"])
def test_a_part_that_is_cut_is_read_up_to_the_cut(storage: str, tmp_path: Path) -> None:
    images = frames(30, 60, 60)
    files = split_bag(tmp_path / "dive", parts_of(messages(images), [10] * 3), storage)
    data = files[1].read_bytes()
    files[1].write_bytes(data[: len(data) * 6 // 10])
    found, problems = read(tmp_path / "dive")
    numbers = [f.timestamp_ns // PERIOD_NS for f in found]
    kept = len(numbers) - 10
    assert 10 < kept < 20
    assert numbers == [*range(kept), *range(20, 30)]
    for frame, number in zip(found, numbers, strict=True):
        np.testing.assert_array_equal(frame.image, images[number])
    assert any(f"{files[1].name}: cut short" in line for line in problems)


@pytest.mark.parametrize("storage", [".mcap", ".db3"])
def test_a_missing_part(storage: str, tmp_path: Path) -> None:
    files = split_bag(tmp_path / "dive", parts_of(messages(IMAGES), PARTS), storage)
    files[2].unlink()
    found, problems = read(tmp_path / "dive")
    assert [f.timestamp_ns // PERIOD_NS for f in found] == [0, 1, 2, 6, 7, 8, 9]
    for frame in found:
        np.testing.assert_array_equal(frame.image, IMAGES[frame.timestamp_ns // PERIOD_NS])
    assert len(problems) == 1
    assert "missing" in problems[0]
    assert files[2].name in problems[0]
    (tmp_path / "dive" / "metadata.yaml").unlink()
    found, problems = read(tmp_path / "dive")
    assert len(found) == 7
    assert len(problems) == 1
    assert "part 2" in problems[0]
    assert "missing" in problems[0]
    for file in files:
        file.unlink(missing_ok=True)
    with pytest.raises(SonarrecError, match="no image"):
        read(tmp_path / "dive")


def as_recorded(path: Path, seconds: list[float], container: str) -> Path:
    """A log whose messages have these log times, in the order of recording."""
    timed = [(round(s * 1e9), data) for s, (_, data) in zip(seconds, messages(IMAGES), strict=True)]
    if container == ".bag":
        ping = [
            serialised(IMAGE, image_fields(k, image), ros1=True) for k, image in enumerate(IMAGES)
        ]
        return ros1_messages(path / "dive.bag", list(zip([t for t, _ in timed], ping, strict=True)))
    if container == "split":
        split_bag(path / "dive", [timed[:5], timed[5:]])
        return path / "dive"
    if container == ".db3":
        return bag(path / "dive", timed)
    sizes = {"chunks": 2000, "one chunk": 10**6, "no chunks": 10**6}
    return mcap_file(
        path / "dive.mcap",
        [("/sonar", *message) for message in timed],
        chunk_size=sizes[container],
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
                notes = [note for note in log.diagnostics.notes if "(was the clock set?)" in note]
                assert len(notes) == (fall > 1 or name == "forward"), notes
        told = f"log times go back by {fall:.1f} s"
        if name == "forward":
            told = f"times jump ahead by {(1.7e9 - 4) / 86400 / 365.2425:.1f} years at frame 5"
        assert all(told in note for note in notes)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "rosbag2_bagfile_information: [",
        "rosbag2_bagfile_information: !!python/object/apply:os.system ['touch ran']",
        "rosbag2_bagfile_information: {relative_file_paths: 7, files: 3}",
    ],
)
def test_metadata_that_says_nothing(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    split_bag(tmp_path / "dive", parts_of(messages(IMAGES), PARTS))
    (tmp_path / "dive" / "metadata.yaml").write_text(text)
    name = "dive" if text else "renamed"  # with an empty one it is a bag under any name
    found, problems = read((tmp_path / "dive").rename(tmp_path / name))
    assert len(found) == 10
    assert all("metadata.yaml" in line and "\n" not in line for line in problems)
    assert not (tmp_path / "ran").exists()


def test_metadata_that_cannot_be_true(tmp_path: Path) -> None:
    """Nothing outside of the folder is read, and no end of lost frames is believed."""
    files = split_bag(tmp_path / "dive", parts_of(messages(IMAGES), PARTS))
    mcap_file(tmp_path / "secret.mcap", [("/sonar", 10**12, cdr_image(IMAGES[0]))])
    file = tmp_path / "dive" / "metadata.yaml"
    told = file.read_text()
    file.write_text(told.replace(files[4].name, "../secret.mcap"))
    found, problems = read(tmp_path / "dive")
    assert len(found) == 8
    assert any("missing" in line and "secret.mcap" in line for line in problems)
    assert any(files[4].name in line and "not listed" in line for line in problems)
    file.write_text(told.replace("message_count: 10", "message_count: 1000000000000"))
    assert len(read(tmp_path / "dive")[0]) == 10


def test_messages_that_inflate_to_more_than_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros, "MAX_FRAME_BYTES", 2**20)
    bomb = zstandard.ZstdCompressor().compress(bytes(2**26))
    timed = [*messages(IMAGES[:2]), (PERIOD_NS * 2, bomb), (PERIOD_NS * 3, bomb[:4] + b"\xff" * 20)]
    bag(tmp_path / "dive", timed)
    found, problems = read(tmp_path / "dive")
    assert len(found) == 2
    assert "inflates to more than" in problems[0]
    assert "does not inflate" in problems[1]


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
    bag(tmp_path / "dive", messages(IMAGES))
    file = tmp_path / "dive" / "dive.db3"
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET topic_id = 77 WHERE rowid > 6")
    file.with_name("dive.db3-journal").write_bytes(b"hot")
    found, problems = read(file)
    assert len(found) == 6
    assert any("dive.db3: 4 messages" in p for p in problems)
    assert any("dive.db3-journal" in p for p in problems)
