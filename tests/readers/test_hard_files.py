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
from tests.support.logs import (
    PERIOD_NS,
    SONAR_TOML,
    cdr_image,
    frames,
    image_folder,
    mcap_file,
    read,
)

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
    found = read(log / pattern)
    assert found.numbers == [1, 2, 4, 5]
    np.testing.assert_array_equal(found.images, [IMAGES[k] for k in found.numbers])
    assert found.times == [k * PERIOD_NS for k in found.numbers]
    for number, line in zip((0, 3), found.problems, strict=True):
        assert line.startswith(f"frame{number}.png: a link")
    with open_log(log / pattern) as opened:
        assert opened.digest_source()[0] > 0
        assert opened.name == "log"
    assert "4 of 6" in sonarrec("info", log / pattern, code=3).stdout


def test_a_file_too_large_to_be_an_image(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", IMAGES)
    with (log / "frame2.png").open("r+b") as file:
        file.truncate(3 * 2**30)  # sparse
    found = read(log)
    assert found.numbers == [0, 1, 3, 4, 5]
    (problem,) = found.problems
    assert "frame2.png" in problem


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
    names = ["9999999999999999999.png", "9" * 200 + ".png"]
    log = image_folder(tmp_path / "log", IMAGES[:2], names=names)
    assert read(log).times == [0, PERIOD_NS]  # no times, hence
    messages = [("/a", t, cdr_image(i)) for t, i in zip((0, 1, 2**63), IMAGES, strict=False)]
    found = read(mcap_file(tmp_path / "log.mcap", messages))
    assert found.numbers == [0, 1]
    assert "clock" in found.problems[0]


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
    found = read(log)
    assert found.numbers == [0, 1, 3, 5]
    for number, line in zip((2, 4), found.problems, strict=True):
        assert line.startswith(f"{number}.jpg")
        assert "damaged" in line


@pytest.mark.parametrize(
    ("shape", "dtype", "tag", "kind", "value"),
    [
        # White is zero, as a SHORT and as a LONG.
        *(((20, 30), dtype, 262, kind, 0) for dtype in ("u2", "f4") for kind in (3, 4)),
        ((20, 30, 3), "u2", 284, 3, 2),  # colours in planes
        ((20, 30), "i2", 0, 0, 0),
        ((20, 30), "i1", 0, 0, 0),
    ],
)
def test_a_tiff_that_would_be_misread_is_refused(
    shape: tuple[int, ...], dtype: str, tag: int, kind: int, value: int
) -> None:
    image = np.random.default_rng(0).integers(-99, 99, shape).astype(dtype)
    plain = [cv2.IMWRITE_TIFF_COMPRESSION, 1]
    data = cv2.imencode(".tiff", np.abs(image) if dtype[0] != "i" else image, plain)[1].tobytes()
    if tag:
        right = struct.pack("<HHII", tag, 3, 1, 1)
        assert right in data
        decode_image(data)
        data = data.replace(right, struct.pack("<HHII", tag, kind, 1, value))
    with pytest.raises(UnusableError, match="TIFF"):
        decode_image(data)


@pytest.mark.parametrize("kind", ["GIF", "PNG", "WebP", "TIFF"])
def test_several_images_in_one_file_are_refused(kind: str) -> None:
    """Of them the first alone would be read."""
    pages = [Image.fromarray(image).convert("RGB") for image in frames(3)]
    pages[0].save(file := io.BytesIO(), kind, save_all=True, append_images=pages[1:])
    with pytest.raises(UnusableError, match=kind if kind != "TIFF" else "several"):
        decode_image(file.getvalue())
    if kind == "TIFF":
        pages[0].save(file := io.BytesIO(), kind, save_all=True)
        np.testing.assert_array_equal(decode_image(file.getvalue())[..., ::-1], pages[0])


def test_pictures_and_times_that_repeat_are_counted(tmp_path: Path) -> None:
    twice = [IMAGES[0], IMAGES[1], IMAGES[1], IMAGES[2], IMAGES[2]]
    (note,) = read(image_folder(tmp_path / "log", twice)).notes
    assert "2 images equal" in note
    timed = [("/a", k // 2 * PERIOD_NS, cdr_image(image)) for k, image in enumerate(IMAGES)]
    log = mcap_file(tmp_path / "log.mcap", timed)
    (note,) = read(log).notes
    assert "3 frames" in note
    assert "5 frames" in read(log, time="header").notes[-1]  # that never changes


def test_a_table_beside_images_is_told_to_be_unused(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", IMAGES)
    (log / "notes.txt").write_text("calm sea\n")
    (log / "poses.csv").write_text("timestamp,yaw\n" + "1,2\n" * len(IMAGES))
    assert not read(log).notes
    (log / "data.csv").write_text("time\n" + "1\n" * len(IMAGES))
    (note,) = read(log).notes
    assert "data.csv" in note


def changed(ending: str, *changes: tuple[int, bytes]) -> bytes:
    """An image of this kind, with other bytes at some places."""
    data = bytearray(cv2.imencode(ending, IMAGES[0])[1].tobytes())
    for at, new in changes:
        data[at : at + len(new)] = new
    return bytes(data)


def png_of_size(rows: int, columns: int) -> bytes:
    size = (16, struct.pack(">II", columns, rows))
    crc = zlib.crc32(changed(".png", size)[12:29])
    return changed(".png", size, (29, struct.pack(">I", crc)))


JPEG_SIZE = changed(".jpg").index(b"\xff\xc0") + 5
FIRST_PNG_CHUNK = 33  # after the header


@pytest.mark.parametrize(
    "image",
    [
        png_of_size(30000, 30000),
        changed(".jpg", (JPEG_SIZE, struct.pack(">HH", 60000, 60000))),
        changed(".png", (FIRST_PNG_CHUNK, b"\xff" * 4)),
    ],
    ids=["png", "jpeg", "png chunk"],
)
def test_no_room_is_made_for_what_an_image_claims(image: bytes, tmp_path: Path) -> None:
    for name, data in {"a": changed(".png"), "aa": image, "b": changed(".png")}.items():
        (tmp_path / f"{name}.png").write_bytes(data)
    (tmp_path / "sonar.toml").write_text(SONAR_TOML)
    frames_read, peak = peak_of_reading(tmp_path)
    assert frames_read == 2
    assert peak < 150
