"""Every reader gives the same frames; input that cannot be used is one clear line."""

from __future__ import annotations

import hashlib
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarrec.errors import MAX_PROBLEM_LINES, Diagnostics, SonarrecError, UsageError
from sonarrec.readers import open_log
from sonarrec.readers.info import describe
from sonarrec.sonar.geometry import PolarToFan
from sonarrec.sonar.stated import Sonar, load_sonar
from sonarrec.tables import natural_order
from tests.support.bags import bag, messages, ros1_bag, split_bag
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
from tests.support.sonar_files import (
    aris_file,
    gemini_file,
    gemini_log,
    gemini_record,
    oculus_file,
    oculus_log,
    oculus_ping,
)

PING = oculus_ping(0, frames(1)[0])
Maker = Callable[[Path, list[np.ndarray]], Path]


def folder(suffix: str, change: Callable[[np.ndarray], np.ndarray] = lambda image: image) -> Maker:
    return lambda path, images: image_folder(path / "log", [change(i) for i in images], suffix)


def mcap(**options: object) -> Maker:
    return lambda path, images: image_mcap(path / "log.mcap", images, **options)


def as_bag(storage: str, compressed: str | None = None) -> Maker:
    return lambda path, images: bag(path / "log", messages(images), storage, compressed)


def as_parts(storage: str, compressed: str | None = None, told: bool = True) -> Maker:

    def make(path: Path, images: list[np.ndarray]) -> Path:
        timed = messages(images)
        split_bag(path / "log", [timed[:2], timed[2:3], timed[3:]], storage, compressed)
        if not told:
            (path / "log" / "metadata.yaml").unlink()
        return path / "log"

    return make


# A new format is one row here.
SAME_FRAMES: dict[str, Maker] = {
    "png": folder(".png"),
    "tiff": folder(".tiff"),
    "bmp": folder(".bmp"),
    "pgm": folder(".PGM"),
    "png, 16 bit": folder(".png", lambda i: i.astype(np.uint16) * 257),
    "tiff, 16 bit": folder(".tif", lambda i: i.astype(np.uint16) * 257),
    "tiff, float": folder(".tif", lambda i: (i / 255).astype(np.float32)),
    "png, colour": folder(".png", lambda i: cv2.cvtColor(i, cv2.COLOR_GRAY2BGR)),
    "png, alpha": folder(".png", lambda i: cv2.cvtColor(i, cv2.COLOR_GRAY2BGRA)),
    "npy": folder(".npy"),
    "npy, 16 bit, big-endian": folder(".npy", lambda i: (i.astype(np.uint16) * 257).astype(">u2")),
    "npy, float": folder(".npy", lambda i: (i / 255).astype(np.float32)),
    "npy, double": folder(".npy", lambda i: i / 255),
    "npy, half": folder(".npy", lambda i: (i / 255).astype(np.float16)),
    "npy, integers": folder(".npy", lambda i: i.astype(np.int64)),
    "npy, 16 bit as integers": folder(".npy", lambda i: i.astype(np.int32) * 257),
    "npy, of one": folder(".npy", lambda i: i[None]),
    "avi": lambda path, images: video_file(path / "log.avi", images, "HFYU"),  # lossless
    "mkv": lambda path, images: video_file(path / "log.mkv", images, "HFYU"),
    "bag, ROS 1, bz2": lambda path, images: ros1_bag(path / "log.bag", images, "BZ2"),
    "bag, db3": as_bag(".db3"),
    "bag, db3, by message": as_bag(".db3", "message"),
    "bag, mcap": as_bag(".mcap"),
    "bag, mcap, by storage": as_bag(".mcap", "storage"),
    "bag, mcap, parts, no metadata": as_parts(".mcap", told=False),
    "bag, db3, parts": as_parts(".db3"),
    "bag, db3, parts, by message, no metadata": as_parts(".db3", "message", told=False),
    "mcap, no chunks, no index": mcap(chunked=False, indexed=False),
    "mcap, no index": mcap(indexed=False),
    "mcap, dotted schema": mcap(schema="sensor_msgs.msg.Image"),
    "mcap, short schema": mcap(schema="sensor_msgs/Image"),
}


@pytest.mark.parametrize("make", SAME_FRAMES.values(), ids=SAME_FRAMES)
def test_same_frames_from_every_reader(make: Maker, tmp_path: Path) -> None:
    images = frames()
    path = make(tmp_path, images)
    with open_log(path) as log:
        assert (log.frame_count, log.name, log.fan) == (len(images), "log", None)
        assert next(iter(log)).fan == log.fan
    found = read(path)
    assert not found.problems
    assert found.numbers == list(range(len(images)))
    assert found.times == [k * PERIOD_NS for k in range(len(images))]
    assert {image.dtype for image in found.images} == {np.dtype(np.uint8)}
    np.testing.assert_array_equal(found.images, images)


def aris(path: Path, images: list[np.ndarray]) -> Path:
    return aris_file(path / "log.aris", [i.repeat(2, axis=1)[:, :48] for i in images])


OF_EACH_READER = {
    **{name: SAME_FRAMES[name] for name in ("png", "avi", "bag, db3", "bag, ROS 1, bz2")},
    "aris": aris,
    "oculus": lambda path, images: oculus_file(path / "log.raw", images),
    "gemini": lambda path, images: gemini_file(path / "log.glf", images),
}


@pytest.mark.parametrize("make", OF_EACH_READER.values(), ids=OF_EACH_READER)
def test_every_pass_gives_the_same(make: Maker, tmp_path: Path) -> None:
    """Also after a pass that was left early, or over a span, and where the height is estimated."""
    path = make(tmp_path, frames(8))
    of_pings = path.suffix in (".aris", ".raw", ".glf")
    without_height = tmp_path / "without_height.toml"
    tilt = "[sonar]\ntilt_deg = 20.0\n"
    without_height.write_text(tilt if of_pings else SONAR_TOML.replace("height_m = 0.68", ""))
    with open_log(path, sonar_file=without_height) as log:

        def seen(*span: int) -> list[object]:
            frames = log.within(span) if span else log  # type: ignore[arg-type]
            return [(f.index, f.timestamp_ns, f.fan, f.image.tobytes()) for f in frames]

        next(iter(log))
        whole = seen()
        assert len(whole) == 8
        assert seen(5, 7) == whole[5:7]
        assert seen() == whole
        assert log.fan is not None
        assert log.fan.height_m is not None
        assert log.diagnostics.problems == []


def test_a_log_that_begins_with_faults_is_settled_before_a_span(tmp_path: Path) -> None:
    """Its first usable frame may come late; of what else lies before the span nothing is told."""
    log = image_folder(tmp_path / "log", frames(9))
    for k in (0, 1, 2, 4, 7):
        (log / f"frame{k}.png").write_bytes(b"broken")
    with open_log(log) as opened:
        assert [f.index for f in opened.within((6, None))] == [6, 8]
        told = [line.partition(":")[0] for line in opened.diagnostics.problems]
    assert told == ["frame0.png", "frame1.png", "frame2.png", "frame7.png"]


@pytest.mark.parametrize("is_blank", [False, True], ids=["faults", "blank images of another size"])
def test_a_log_that_begins_with_nothing(is_blank: bool, tmp_path: Path) -> None:
    """Size, colour map and height are those that the first images show that show something."""
    images = [cv2.applyColorMap(image, cv2.COLORMAP_JET) for image in frames(4)]
    whole = image_folder(tmp_path / "whole", images)
    late = image_folder(tmp_path / "late", [images[0][:20] * 0] * 5 + images)
    for k in range(0 if is_blank else 5):
        (late / f"frame{k}.png").write_bytes(b"broken")
    tilt = tmp_path / "tilt.toml"
    tilt.write_text(SONAR_TOML.replace("height_m = 0.68", ""))
    found, expected = (read(log, sonar_file=tilt) for log in (late, whole))
    assert len(found.problems) == 5
    assert found.numbers == [5, 6, 7, 8]
    assert [frame.fan for frame in found.frames] == [frame.fan for frame in expected.frames]
    np.testing.assert_array_equal(found.images, expected.images)


@pytest.mark.parametrize(("stated_hz", "noted"), [(4.0, False), (25.0, True), (None, False)])
def test_the_rate_of_a_video_goes_first(
    stated_hz: float | None, noted: bool, tmp_path: Path
) -> None:
    """Its times come from its container, here of 4 frames per second."""
    path = video_file(tmp_path / "log.avi", frames(3), "HFYU")
    sonar = Sonar(frame_rate_hz=stated_hz)
    found = read(path, sonar=sonar)
    assert found.times == [0, 250_000_000, 500_000_000]
    for told in (found.notes, describe(path, sonar=sonar).images[0].notes):
        assert any("frame_rate_hz = 25" in note for note in told) == noted


def test_polar_becomes_a_fan(tmp_path: Path) -> None:
    images = frames(3, 60, 24)
    log = image_folder(tmp_path / "log", images)
    (log / "sonar.toml").write_text(SONAR_TOML.replace('"fan"', '"polar"'))
    to_fan = PolarToFan(load_sonar(log / "sonar.toml").complete("test"), 60, 24)
    found = read(log)
    assert not found.problems
    assert all(frame.fan == to_fan.fan for frame in found.frames)
    np.testing.assert_array_equal(found.images, [to_fan(image) for image in images])
    with pytest.raises(SonarrecError, match="3 bearings"):
        read(log, sonar=Sonar(bearings_deg=(-1.0, 0.0, 1.0)))


@given(st.lists(st.text("019.aZ-_/ é\u0663", max_size=8), max_size=12))
def test_natural_order_is_that_of_texts_and_numbers_in_turns(names: list[str]) -> None:
    def in_turns(name: str) -> tuple[list[str | int], str]:
        parts = re.split("([0-9]+)", name)
        return [int(p) if i % 2 else p for i, p in enumerate(parts)], name

    assert sorted(names, key=natural_order) == sorted(names, key=in_turns)


@pytest.mark.parametrize(
    ("names", "told"),
    [
        ("a1_7.png a1_8.png a1_9.png a1_10.png", None),
        ("a1_7.png a1_8.png a1_10.png a1_12.png", "a1_10.png is frame 2"),
        ("007s.jpg 008s.jpg 008s.png 009s.png", "008s.png is frame 2"),
        ("000.png 010.png 020.png 030.png", None),  # every tenth frame, or times
        ("1790000000000.png 1790000000002.png 1790000000003.png", None),
    ],
)
def test_numbers_left_out_in_names_are_told(tmp_path: Path, names: str, told: str | None) -> None:
    """After a gap frames have other numbers than their files, by which truth may go."""
    images = frames(len(names.split()), 20, 20)
    notes = read(image_folder(tmp_path / "log", images, names=names.split())).notes
    assert [note.rpartition("counted: ")[2] for note in notes] == [told] * (told is not None)


@pytest.mark.parametrize("other", ["{n}.jpg", "{n}_mask.png", "seg/{n}.png", "z_{n}.png"])
def test_images_of_two_kinds_are_told(other: str, tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(3, 20, 20))
    (log / "seg").mkdir()
    for path in [*log.glob("*.png")]:
        cv2.imwrite(str(log / other.format(n=path.stem)), cv2.imread(str(path)))
    found, _, notes = read(log)
    told = [note for note in notes if "two kinds" in note]
    assert len(found) == (3 if "/" in other else 6)
    assert bool(told) == ("/" not in other)
    for note in told:  # the glob that it names has one kind
        assert len(read(log / note.split("'")[1]).frames) == 3


def test_folders_of_a_glob_are_no_kinds(tmp_path: Path) -> None:
    for name in "ab":
        image_folder(tmp_path / name, frames(3, 20, 20))
    assert not any("two kinds" in note for note in read(f"{tmp_path}/*/*.png").notes)


def test_natural_order_glob_and_digest(tmp_path: Path) -> None:
    images = frames(12, 20, 20)
    log = image_folder(tmp_path / "log", images)
    (log / "notes.txt").write_text("no image")
    (log / "._frame0.png").write_bytes(b"a file some copiers leave behind")
    found = read(log)
    assert not found.problems
    np.testing.assert_array_equal(found.images, images)
    some = read(f"{log}/frame1*.png").images
    np.testing.assert_array_equal(some, [images[k] for k in (1, 10, 11)])
    with open_log(f"{log}/frame1*.png") as by_glob:
        assert by_glob.name == "log"
    contents, total = b"", 0
    for k in range(12):
        data = (log / f"frame{k}.png").read_bytes()
        contents += f"frame{k}.png\0{len(data)}\n".encode() + data
        total += len(data)
    with open_log(log) as opened:
        assert opened.digest_source() == (total, hashlib.sha256(contents).hexdigest())
    one = log / "frame3.png"
    with open_log(one) as opened:
        of_one = hashlib.sha256(one.read_bytes()).hexdigest()
        assert opened.digest_source() == (one.stat().st_size, of_one)
        assert [f.index for f in opened] == [0]


def test_which_geometry_counts(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(1))

    def tilt(path: Path, **options: object) -> float:
        with open_log(path, **options) as opened:  # type: ignore[arg-type]
            assert opened.sonar.layout == "fan"
            assert opened.sonar.tilt_deg is not None
            return opened.sonar.tilt_deg

    assert tilt(log) == 20
    other = tmp_path / "other.toml"
    other.write_text(SONAR_TOML.replace("tilt_deg = 20.0", "tilt_deg = 21.0"))
    assert tilt(log, sonar_file=other) == 21
    assert tilt(log, sonar_file=other, sonar=Sonar(tilt_deg=22.0)) == 22
    (log / "frame0.sonar.toml").write_text(other.read_text())
    assert tilt(log) == 20
    assert tilt(log / "frame0.png") == 21
    (log / "sonar.toml").unlink()
    with pytest.raises(SonarrecError, match="lacks range_min_m"):
        open_log(log)
    flags = Sonar(range_min_m=1.0, range_max_m=2.0, tilt_deg=5.0, field_of_view_deg=30.0)
    assert tilt(log, sonar=flags) == 5
    with pytest.raises(UsageError, match=r"^--range-min-m and --range-max-m: range_min_m = 3 must"):
        open_log(log, sonar=Sonar(range_min_m=3.0, range_max_m=2.0, tilt_deg=5.0,
                                  field_of_view_deg=30.0))  # fmt: skip


def test_unusable_frames_keep_their_number(tmp_path: Path) -> None:
    images = frames(8)
    log = image_folder(tmp_path / "log", images)
    (log / "frame2.png").write_bytes((log / "frame2.png").read_bytes()[:-300])
    (log / "frame4.png").write_bytes(b"")
    cv2.imwrite(str(log / "frame5.png"), images[5][:-1])
    cv2.imwrite(str(log / "frame6.png"), np.dstack([images[6]] * 3)[:, :20])
    (log / "frame8.pgm").write_bytes(b"P5 4097 4096 255\n")
    found = read(log)
    assert found.numbers == [time // PERIOD_NS for time in found.times] == [0, 1, 3, 7]
    facts = ["2.png: unreadable", "4.png: empty", "5.png: 38 x 47", "6.png: 20 x 48"]
    for line, fact in zip(found.problems, [*facts, "8.pgm: .*4096"], strict=True):
        assert re.match(f"frame{fact}", line)


def test_frames_of_other_depth(tmp_path: Path) -> None:
    """Each type of pixel has its own scale: one log may hold 8 bits, 16 and floating point."""
    images = frames(4)
    log = image_folder(tmp_path / "log", images)
    cv2.imwrite(str(log / "frame1.png"), images[1].astype(np.uint16) * 257)
    (log / "frame2.png").unlink()
    cv2.imwrite(str(log / "frame2.tiff"), (images[2] / 255).astype(np.float32))
    found = read(log)
    assert not found.problems
    np.testing.assert_array_equal(found.images, images)


def test_problem_lines_are_few(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(1))
    for k in range(100):
        (log / f"frame{k + 1}.png").write_bytes(b"x")
    found, problems, _ = read(log)
    assert len(found) == 1
    assert len(problems) == 1
    assert "99 more frames" in problems[0]
    diagnostics = Diagnostics()
    for k in range(100):
        diagnostics.skip(f"frame {k}", f"another fault, {k}")
    assert len(diagnostics.skipped) == MAX_PROBLEM_LINES + 1
    assert "80 more frames" in diagnostics.skipped[-1]


def test_decoders_are_silent(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """libpng, libtiff and FFmpeg write their complaints straight to file descriptor 2."""
    images = frames(4, 64, 64)
    for suffix in (".png", ".tiff", ".bmp"):
        log = image_folder(tmp_path / suffix[1:], images, suffix)
        data = (log / f"frame2{suffix}").read_bytes()
        (log / f"frame2{suffix}").write_bytes(data[: len(data) // 2])
        found = read(log)
        assert (len(found.frames), len(found.problems)) == (3, 1)
    video = SAME_FRAMES["avi"](tmp_path, images)
    video.write_bytes(video.read_bytes()[:-9000])
    found = read(video)
    assert 1 <= len(found.frames) <= 3
    assert len(found.problems) == 1
    (tmp_path / "junk.avi").write_bytes(b"junk" * 1000)
    with pytest.raises(SonarrecError):
        read(tmp_path / "junk.avi", sonar_file=log / "sonar.toml")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("name", "contents", "says"),
    [
        ("nowhere", None, "no such file or folder"),
        ("nothing*.png", None, "no file matches"),
        ("*.txt", {"a.txt": b"x"}, "no image"),
        ("empty", {}, "the folder is empty"),
        ("words", {"words/a.txt": b"x"}, "no image"),
        ("bad", {"bad/a.png": b"x", "bad/b.png": b"y"}, "not one frame"),
        ("log.xyz", b"x", "not a kind of log"),
        ("log.mcap", b"", "zero bytes"),
        ("log.avi", b"", "zero bytes"),
        ("log.mp4", b"junk" * 99, "video"),
        ("log.mcap", b"junk" * 99, "not an MCAP"),
        ("log.png", b"", "empty image"),
        ("x.png", b"nothing", "unreadable image"),
        ("log.aris", b"junk" * 999, "not a DDF"),
        ("log.aris", b"DDF\x01" + bytes(5000), "DDF_01"),
        ("log.aris", b"DDF", "not a DDF"),
        ("log.aris", b"DDF\x05" + bytes(99), "cut short"),
        ("log.aris", b"DDF\x05" + bytes(1500), "0 samples in 0 beams"),
        ("log.aris", b"DDF\x05" + b"\xff" * 1500, "4294967295 samples in 4294967295 beams"),
        ("log.raw", b"junk" * 9999, "no ping"),
        ("log.raw", b"SO" * 9999, "no ping"),
        ("log.raw", PING[:900], r"no ping .*\(only 900 bytes"),
        ("log.oculus", b"SQLite format 3\0" + bytes(99), "ViewPoint"),
        ("log.oculus", oculus_log([PING], encryption=1), "encrypted"),
        ("log.oculus", oculus_log([]), "no ping"),
    ],
    ids=range(25),
)
def test_what_cannot_be_opened(name: str, contents: Any, says: str, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for file, data in ({name: contents} if isinstance(contents, bytes) else contents or {}).items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_bytes(data)
    flags = Sonar(range_min_m=1.0, range_max_m=2.0, tilt_deg=5.0, field_of_view_deg=30.0)
    with pytest.raises(SonarrecError, match=f"^{re.escape(str(tmp_path / name))}.*{says}"):
        read(tmp_path / name, sonar=flags)


def test_a_topic_is_for_mcap(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--topic"):
        open_log(image_folder(tmp_path / "log", frames(1)), topic="/a")


# Two recordings in one file


IMAGES = frames(12, 64, 48)


@pytest.mark.parametrize(
    ("name", "count"),
    # Of the last one times fall by less than a second.
    [(name, 12) for name in ("log.raw", "log.aris", "stored.glf", "packed.glf", "one.glf")]
    + [("log.aris", 7)],
)
def test_times_that_go_back_are_told(tmp_path: Path, name: str, count: int) -> None:
    path, images = tmp_path / name, IMAGES[:count]
    if name == "log.raw":
        oculus_file(path, images)
    elif name == "log.aris":
        aris_file(path, images)
    else:
        records = [gemini_record(k, image) for k, image in enumerate(images)]
        method = zipfile.ZIP_STORED if name == "stored.glf" else zipfile.ZIP_DEFLATED
        gemini_log(path, records * (2 if name == "one.glf" else 1), method)
    if name != "one.glf":
        path.write_bytes(2 * path.read_bytes())
    found, problems, notes = read(path, sonar={"tilt_deg": 20.0})
    assert len(found) == 2 * count
    assert not problems
    (note,) = (note for note in notes if "times go back" in note)
    assert f"frame {count} (were" in note


@pytest.mark.parametrize("unset", [1, 3])
def test_a_clock_that_was_set_after_the_first_frames_is_told(unset: int, tmp_path: Path) -> None:
    set_ns = 1_717_000_000 * 10**9
    times = [k * PERIOD_NS + (k >= unset) * set_ns for k in range(8)]
    stored = [("/s", time, cdr_image(i)) for time, i in zip(times, frames(8), strict=True)]
    found = read(mcap_file(tmp_path / "log.mcap", stored))
    assert found.times == times
    assert any(f"at frame {unset}" in note for note in found.notes)


@pytest.mark.parametrize(("divisor", "unit"), [(1, ""), (1_000, "us"), (10**6, "ms")])
def test_times_in_another_unit_are_told(divisor: int, unit: str, tmp_path: Path) -> None:
    stored = [("/s", k * PERIOD_NS // divisor, cdr_image(i)) for k, i in enumerate(frames(8))]
    notes = read(mcap_file(tmp_path / "log.mcap", stored)).notes
    told = [note for note in notes if "a second" in note]
    assert [f"in {unit} it has 4" in note for note in told] == [True] * bool(unit)
