"""Files that are not there, damaged, oddly named or of others: each costs itself, and is named."""

from __future__ import annotations

import io
import os
import shutil
import struct
import unicodedata
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.writer import Writer
from PIL import Image

from sonarrec.errors import SonarrecError
from sonarrec.readers import open_log
from sonarrec.readers.decode.pixels import decode_image
from sonarrec.readers.info import describe
from sonarrec.readers.named_logs import logs_of
from sonarrec.readers.raw import UnusableError
from tests.support.bags import ros1_bag
from tests.support.command import SAMPLE, sample_log, sonarrec
from tests.support.hard_logs import peak_of_reading
from tests.support.logs import (
    PERIOD_NS,
    SONAR_TOML,
    cdr_image,
    frames,
    image_folder,
    image_mcap,
    mcap_file,
    read,
    video_file,
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


@pytest.mark.parametrize(
    "name", ["x" * 5000, "*" * 5000, "a/" * 2500, "9" * 5000 + "/*.png", "\0.png"], ids=range(5)
)
def test_an_argument_that_is_no_name(name: str) -> None:
    with pytest.raises(SonarrecError):
        open_log(name)
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


# What is not read


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


def test_a_folder_of_recordings_of_which_some_are_not_read(tmp_path: Path) -> None:
    for name in ("a.mov", "b.m4v", "c.webm"):
        video_file(tmp_path / "as.mkv", frames(4), "HFYU").rename(tmp_path / name)
    (tmp_path / "as.sonar.toml").rename(tmp_path / "sonar.toml")
    for name in ("d.imb", "e.imb", "f.ecd", "gt.csv", "notes.txt", ".hidden.imb"):
        (tmp_path / name).write_bytes(b"not ours")
    done = sonarrec("run", tmp_path, "-o", tmp_path.with_name("out"))
    assert "2 .imb, 1 .ecd" in done.stderr
    assert "3 done" in done.stdout
    (tmp_path / "other").mkdir()
    (tmp_path / "d.imb").rename(tmp_path / "other" / "d.imb")
    assert "1 .imb" in sonarrec("run", tmp_path / "other", code=2).stderr


def test_folders_of_images_beside_recordings(tmp_path: Path) -> None:
    """`run` reads the recordings and tells of the folders; a queue of reviews has them all."""
    video_file(tmp_path / "a.mkv", frames(4), "HFYU")
    for name in ("b", "c"):
        image_folder(tmp_path / name, frames(4))
    assert "2 folders of images (--recursive" in sonarrec("info", tmp_path).stderr
    assert "of images" not in sonarrec("info", tmp_path, "--recursive").stderr
    assert [Path(log.path).name for log in logs_of(str(tmp_path))] == ["a.mkv", "b", "c"]


POINTERS = ("a.mcap", "a.aris", "a.bag", "a.db3", "a.mp4", "a.glf", "a.raw", "a.png")


@pytest.mark.parametrize(
    ("name", "head", "fact"),
    [
        ("a.mbez", b"x", "Blueye"),
        ("a.bin", b"\0\0", "Ping360"),
        ("a.svlog", b"x", "Cerulean"),
        ("a.raw", b"\x50\0\0\0XML0", "EK80"),
        ("a.dat", b"RIP2", "3D-15"),
        *((name, LFS, "git lfs pull") for name in POINTERS),
    ],
)
def test_files_of_others_are_named(name: str, head: bytes, fact: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(head + b"x" * 50 * (head != LFS))
    (tmp_path / "sonar.toml").write_text(SONAR_TOML)
    (line,) = sonarrec("run", tmp_path / name, "-o", tmp_path / "out", code=1).stderr.splitlines()
    assert fact in line


def two_sonars(path: Path, camera: str = "/camera") -> Path:
    """A camera, a sonar of a type that is not read, and a thermometer."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, kind in (
            (camera, "sensor_msgs/msg/Image"),
            ("/front/scan", "blueprint_msgs/msg/SonarPing"),
            ("/water", "sensor_msgs/msg/Temperature"),
        ):
            schema = writer.register_schema(kind, "ros2msg", b"")
            channel = writer.register_channel(topic, "cdr", schema)
            for k, image in enumerate(frames(3)):
                writer.add_message(channel, k * PERIOD_NS, cdr_image(image), k * PERIOD_NS)
        writer.finish()
    (path.parent / "sonar.toml").write_text(SONAR_TOML)
    return path


def test_a_sonar_of_a_type_that_is_not_read_beside_a_camera(tmp_path: Path) -> None:
    log = two_sonars(tmp_path / "log.mcap")
    told = sonarrec("run", log, "-o", tmp_path / "out").stderr
    assert "/front/scan (blueprint_msgs/msg/SonarPing)" in told
    assert "/water" not in told
    asked = sonarrec("run", log, "--topic", "/front/scan", "-o", tmp_path / "o", code=2).stderr
    assert "blueprint_msgs/msg/SonarPing" in asked
    chosen = ("--topic", "/camera", "-o", tmp_path / "out", "--overwrite")
    assert "/front/scan" not in sonarrec("run", log, *chosen).stderr
    other = two_sonars(tmp_path / "two" / "log.mcap", "/sonar/image")
    assert "/front/scan" not in sonarrec("run", other, "-o", tmp_path / "two_out").stderr


@pytest.mark.parametrize(
    "make",
    [
        lambda folder: ros1_bag(folder / "log.bag", frames(5)),
        lambda folder: ros1_bag(folder / "log.bag", frames(5), "BZ2"),
        lambda folder: image_mcap(folder / "log.mcap", frames(5)),
    ],
    ids=["bag", "bag, bz2", "mcap"],
)
def test_two_recordings_in_one_file(make: Callable[[Path], Path], tmp_path: Path) -> None:
    log = make(tmp_path)
    whole = read(log)
    log.write_bytes(2 * log.read_bytes())
    doubled = read(log)
    assert doubled.numbers == whole.numbers
    assert (len(whole.problems), len(doubled.problems)) == (0, 1)


def test_a_pointer_in_place_of_an_image_and_of_a_geometry(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(3))
    (log / "frame1.png").write_bytes(LFS)
    found, (problem,), _ = read(log)
    assert len(found) == 2
    assert "git lfs pull" in problem
    (log / "sonar.toml").write_bytes(LFS)
    assert "git lfs pull" in sonarrec("info", log, code=2).stderr


@pytest.mark.parametrize(
    ("name", "head", "fact"),
    [
        ("gt.csv", LFS, "git lfs pull"),
        ("gt.xlsx", b"PK\3\4\x14\0\6\0" + bytes(range(256)), "CSV (UTF-8)"),
        ("gt.csv", b"<!DOCTYPE html><html>", "web page"),
        ("gt.csv", b"\x1f\x8b\x08\0", "unpack it"),
        ("gt.csv", b"frame;landmark;x_px;y_px\n0;1;3;4\n", "by commas"),
    ],
)
def test_other_files_as_truth(name: str, head: bytes, fact: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(head)
    told = sonarrec("truth", "check", tmp_path / name, SAMPLE, code=1)
    assert fact in told.output
    assert len(told.stderr.splitlines()) == 1


def test_rows_that_excel_leaves_empty_are_none(tmp_path: Path) -> None:
    rows = (SAMPLE / "gt.csv").read_text().splitlines()[:9]
    plain, padded = tmp_path / "gt.csv", tmp_path / "padded.csv"
    plain.write_text("\n".join(rows) + "\n")
    empty = "," * rows[0].count(",")
    padded.write_text("\n".join([*rows[:4], empty, *rows[4:], empty, empty]) + "\n")
    log = sample_log(tmp_path / "pan", 12)
    sonarrec("run", "-q", log, "-o", tmp_path / "out")
    counts = []
    for truth in (plain, padded):
        sonarrec("evaluate", "-q", tmp_path / "out", "--ground-truth", truth, code=3)
        counts.append((tmp_path / "out" / "evaluation" / "confusion.csv").read_bytes())
    assert counts[0] == counts[1]
    padded.write_text("\n".join([*rows[:4], empty, rows[4].replace(",1,", ",x,", 1)]) + "\n")
    assert "line 6" in sonarrec("truth", "check", padded, SAMPLE, code=1).output


def test_a_folder_of_macos_and_a_table_of_another_system(tmp_path: Path) -> None:
    """One splits é into a letter and an accent, the other does not."""
    name = "plongée"
    log = sample_log(tmp_path / unicodedata.normalize("NFD", name), 8)
    sonarrec("run", "-q", log, "-o", tmp_path / "out")
    rows = (SAMPLE / "gt.csv").read_text().splitlines()[:9]
    rows = [f"{rows[0]},log", *(f"{row},{unicodedata.normalize('NFC', name)}" for row in rows[1:])]
    (tmp_path / "gt.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    sonarrec("evaluate", tmp_path / "out", "--ground-truth", tmp_path / "gt.csv")


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((4, 5, 6), np.uint8),
        np.zeros((4, 5), complex),
        np.array([["a"]]),
        np.zeros((0, 5), np.uint8),
        np.array([[{}]], object),
    ],
    ids=["three axes", "complex", "text", "empty", "objects"],
)
def test_arrays_of_another_kind_are_refused_in_a_line(array: np.ndarray, tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(3), ".npy")
    np.save(log / "frame1.npy", array, allow_pickle=True)
    found = read(log)
    assert found.numbers == [0, 2]
    assert [line.partition(":")[0] for line in found.problems] == ["frame1.npy"]


def test_many_arrays_beside_one_image_are_the_log(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(12), ".npy")
    cv2.imwrite(str(log / "preview.png"), frames(1)[0])
    found, _, notes = read(log)
    assert len(found) == 12
    assert any("preview.png" in note for note in notes)


def test_most_first_arrays_decide_on_decibels(tmp_path: Path) -> None:
    """One frame without echoes, or of another unit, comes first."""
    decibels = [20 * np.log10(np.maximum(image, 1) / 255) - 3 for image in frames(4)]
    plain = image_folder(tmp_path / "plain", decibels, ".npy")
    odd = image_folder(tmp_path / "odd", [np.full(decibels[0].shape, 0.5), *decibels], ".npy")
    np.testing.assert_array_equal(read(plain).images, read(odd).images[1:])


def test_damaged_arrays_cost_themselves(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(12), ".npy")
    whole = (log / "frame0.npy").read_bytes()
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "|u1", "fortran_order": False, "shape": (10**9, 10**9)}
    )
    bad = [whole[:k] for k in (3, 7, 20, 200, 300)] + [header.getvalue(), whole[:8] * 40]
    for k, data in enumerate(bad, 1):
        (log / f"frame{k}.npy").write_bytes(data)
    both = []
    for in_order in (np.ascontiguousarray, np.asfortranarray):
        np.save(log / "frame8.npy", in_order(frames(12)[8]))
        found = read(log)
        assert found.numbers == [0, 8, 9, 10, 11]
        both.append(found.images)
    np.testing.assert_array_equal(*both)


def test_arrays_beside_images_or_logs_are_no_frames(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(3))
    np.save(log / "times.npy", np.arange(3))
    found, problems, _ = read(log)
    assert (len(found), problems) == (3, [])
    day = tmp_path / "day"
    day.mkdir()
    shutil.copytree(log, day / "dive")
    image_folder(day / "simulated", frames(3), ".npy")
    assert "2 done" in sonarrec("run", day, "--recursive", "-o", tmp_path / "out").stdout


def test_a_log_of_very_many_topics_and_one_of_very_many_faults(tmp_path: Path) -> None:
    images = frames(3)
    timed = [
        (f"/t{t}", k * PERIOD_NS, cdr_image(i)) for k, i in enumerate(images) for t in range(40)
    ]
    many = mcap_file(tmp_path / "many.mcap", timed, chunk_size=10**6)
    assert len(describe(many).images) < 10
    assert [one.topic for one in describe(many, topic="/t39").images] == ["/t39"]
    told = sonarrec("info", many).stdout
    assert "40 image topics" in told
    assert len(told.splitlines()) < 150
    plain = {"chunk_size": 500, "compression": "none"}
    bad = image_mcap(tmp_path / "bad.mcap", images[:1] * 60, **plain)
    bad.write_bytes(bad.read_bytes().replace(images[0].tobytes(), (images[0] ^ 1).tobytes()))
    told = sonarrec("info", bad, code=1).stdout
    assert "57 more" in told
    assert told.count("checksum") == 3


@pytest.mark.parametrize(
    "command", ["evaluate --ground-truth", "run --from-file", "run {} --odometry"]
)
def test_a_named_pipe_is_not_waited_for(command: str, tmp_path: Path) -> None:
    log = sample_log(tmp_path / "log", 3)
    os.mkfifo(tmp_path / "pipe")
    told = sonarrec(*command.format(log).split(), tmp_path / "pipe", code=1).output
    assert "pipe" in told
