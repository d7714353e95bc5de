"""Image files that are not there, too large or oddly named, and names of logs that are no logs."""

from __future__ import annotations

import io
import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from sonarrec.errors import SonarrecError
from sonarrec.readers import open_log
from sonarrec.readers.decode.pixels import decode_image
from sonarrec.readers.raw import UnusableError
from tests.support.command import sonarrec
from tests.support.hard_logs import peak_of_reading
from tests.support.logs import PERIOD_NS, SONAR_TOML, cdr_image, frames, image_folder, mcap_file

IMAGES = frames(6)


@pytest.mark.parametrize("pattern", ["", "*.png"])
def test_links_to_files_that_are_not_there_keep_their_number(pattern: str, tmp_path: Path) -> None:
    """As git-annex leaves what was not fetched."""
    log = image_folder(tmp_path / "log", IMAGES)
    for gone in (0, 3):
        (log / f"frame{gone}.png").unlink()
        (log / f"frame{gone}.png").symlink_to(tmp_path / "nowhere")
    os.mkfifo(log / "frame9.png")
    (log / "frame7.png").mkdir()
    with open_log(log / pattern) as opened:
        found = list(opened)
        assert opened.digest_source()[0] > 0
        assert opened.name == "log"
    assert [f.index for f in found] == [1, 2, 4, 5]
    for frame in found:
        np.testing.assert_array_equal(frame.image, IMAGES[frame.index])
        assert frame.timestamp_ns == frame.index * PERIOD_NS
    says = "a link to a file that is not there, skipped"
    assert opened.diagnostics.problems == [f"frame0.png: {says}", f"frame3.png: {says}"]
    assert "4 of 6" in sonarrec("info", log / pattern, code=3).stdout
    sonarrec("run", log / pattern, "--out", tmp_path / "out", code=3)


def test_a_file_too_large_to_be_an_image(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", IMAGES)
    with (log / "frame2.png").open("r+b") as file:
        file.truncate(3 * 2**30)  # sparse
    with open_log(log) as opened:
        assert [f.index for f in opened] == [0, 1, 3, 4, 5]
    assert len(opened.diagnostics.problems) == 1
    assert "frame2.png" in opened.diagnostics.problems[0]


def test_a_name_that_is_no_utf8(tmp_path: Path) -> None:
    odd = os.fsdecode(os.fsencode(tmp_path) + b"/dive\xe9")
    for ending in (".avi", ".xyz"):
        Path(odd + ending).write_bytes(b"junk" * 100)
        with pytest.raises(SonarrecError) as caught:
            open_log(odd + ending)
        str(caught.value).encode()


@pytest.mark.parametrize(
    "name", ["x" * 5000, "*" * 5000, "a/" * 2500, "9" * 5000 + "/*.png", "\0.png"], ids=range(5)
)
def test_an_argument_that_is_no_name(name: str) -> None:
    with pytest.raises(SonarrecError) as caught:
        open_log(name)
    assert "\n" not in str(caught.value)
    if "\0" not in name:
        sonarrec("info", name, code=1)


def test_times_beyond_every_clock(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", [])
    for name in ("9999999999999999999", "9" * 200):
        assert cv2.imwrite(str(log / f"{name}.png"), IMAGES[0])
    with open_log(log) as opened:  # no times, hence
        assert [f.timestamp_ns for f in opened] == [0, PERIOD_NS]
    messages = [("/a", t, cdr_image(i)) for t, i in zip((0, 1, 2**63), IMAGES, strict=False)]
    with open_log(mcap_file(tmp_path / "log.mcap", messages)) as opened:
        assert [f.index for f in opened] == [0, 1]
    assert "beyond every clock" in opened.diagnostics.problems[0]


def jpeg(number: int) -> bytes:
    noise = np.random.default_rng(number).integers(0, 256, (120, 160), dtype=np.uint8)
    return cv2.imencode(".jpg", cv2.GaussianBlur(noise, (0, 0), 2))[1].tobytes()


def test_a_jpeg_that_is_damaged_inside(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", [])
    rng = np.random.default_rng(1)
    for number in range(6):
        data = bytearray(jpeg(number))
        middle = len(data) // 2
        if number == 2:
            data[middle : middle + 100] = rng.bytes(100)
        if number == 3:  # padded, as some cameras do
            data[-2:-2] = bytes(7)
        if number == 4:  # a piece is missing
            del data[middle : middle + 300]
        (log / f"{number}.jpg").write_bytes(data)
    with open_log(log) as opened:
        assert [f.index for f in opened] == [0, 1, 3, 5]
    assert opened.diagnostics.problems == [
        f"{n}.jpg: a JPEG that is damaged inside, skipped" for n in (2, 4)
    ]  # fmt: skip


def test_a_tiff_of_several_images() -> None:
    """Of a stack the first page alone would be read."""
    pages = [Image.fromarray(image) for image in frames(3)]
    for others in ([], pages[1:]):
        pages[0].save(file := io.BytesIO(), "TIFF", save_all=True, append_images=others)
        if others:
            with pytest.raises(UnusableError, match="several images"):
                decode_image(file.getvalue())
        else:
            np.testing.assert_array_equal(decode_image(file.getvalue()), np.asarray(pages[0]))


@pytest.mark.parametrize(
    ("shape", "dtype", "tag", "value"),
    [
        *(((20, 30), dtype, 262, 0) for dtype in ("u2", "f4")),  # white is zero
        ((20, 30, 3), "u2", 284, 2),  # colours in planes
        ((20, 30), "i2", 0, 0),
        ((20, 30), "i1", 0, 0),
    ],
)
def test_a_tiff_that_would_be_misread_is_refused(
    shape: tuple[int, ...], dtype: str, tag: int, value: int
) -> None:
    image = np.random.default_rng(0).integers(-99, 99, shape).astype(dtype)
    plain = [cv2.IMWRITE_TIFF_COMPRESSION, 1]
    data = cv2.imencode(".tiff", np.abs(image) if dtype[0] != "i" else image, plain)[1].tobytes()
    if tag:
        right = struct.pack("<HHIH", tag, 3, 1, 1)
        assert right in data
        decode_image(data)
        data = data.replace(right, struct.pack("<HHIH", tag, 3, 1, value))
    with pytest.raises(UnusableError, match="a TIFF of"):
        decode_image(data)


@pytest.mark.parametrize("kind", ["GIF", "PNG"])
def test_an_animation_is_refused(kind: str) -> None:
    pages = [Image.fromarray(image) for image in frames(3)]
    pages[0].save(file := io.BytesIO(), kind, save_all=True, append_images=pages[1:])
    with pytest.raises(UnusableError, match=kind):
        decode_image(file.getvalue())


def test_pictures_and_times_that_repeat_are_counted(tmp_path: Path) -> None:
    twice = [IMAGES[0], IMAGES[1], IMAGES[1], IMAGES[2], IMAGES[2]]
    log = image_folder(tmp_path / "log", twice)
    with open_log(log) as opened:
        list(opened)
    (note,) = opened.diagnostics.notes
    assert "2 images equal" in note
    timed = [("/a", k // 2 * PERIOD_NS, cdr_image(image)) for k, image in enumerate(IMAGES)]
    with open_log(mcap_file(tmp_path / "log.mcap", timed)) as opened:
        list(opened)
    (note,) = opened.diagnostics.notes
    assert "3 frames" in note
    with open_log(tmp_path / "log.mcap", time="header") as opened:  # that never changes
        list(opened)
    assert "5 frames" in opened.diagnostics.notes[-1]


def test_a_table_beside_images_is_told_to_be_unused(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", IMAGES)
    (log / "notes.txt").write_text("calm sea\n")
    (log / "poses.csv").write_text("timestamp,yaw\n" + "1,2\n" * len(IMAGES))
    with open_log(log) as opened:
        assert not opened.diagnostics.notes
    (log / "data.csv").write_text("time\n" + "1\n" * len(IMAGES))
    with open_log(log) as opened:
        (note,) = opened.diagnostics.notes
    assert "data.csv" in note


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
    (tmp_path / "sonar.toml").write_text(SONAR_TOML)
    frames_read, peak = peak_of_reading(tmp_path)
    assert frames_read == 2
    assert peak < 150
