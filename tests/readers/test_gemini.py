"""Gemini: written logs against an independent reader of them, whole and damaged."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytritech.glf import GLF
from pytritech.util.range import calculate_range

from sonarrec.errors import SonarrecError
from sonarrec.readers.open import find_log
from sonarrec.sonar.frame import Frame
from tests.support import logs
from tests.support.logs import frames
from tests.support.sonar_files import (
    GEMINI_START_S,
    GEMINI_STATUS,
    gemini_log,
    gemini_message,
    gemini_record,
)

TILT = {"tilt_deg": 20.0}
IMAGES = frames(6, 64, 40)
RECORDS = [gemini_record(k, image) for k, image in enumerate(IMAGES)]
START_NS = round((GEMINI_START_S + 315_532_800) * 1e9)


def read(path: Path, **sonar: Any) -> tuple[list[Frame], list[str]]:
    return logs.read(path, sonar=TILT | sonar)


def raw(path: Path) -> tuple[list[Frame], list[str]]:
    log = find_log(path).open()
    return list(log), log.diagnostics.faults


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    """The fan images of IMAGES."""
    path = gemini_log(tmp_path_factory.mktemp("whole") / "whole.glf", RECORDS)
    return [frame.image for frame in read(path)[0]]


# Whole logs


@pytest.mark.parametrize(("version", "compression"), [(2, 0), (2, 1), (3, 0), (3, 1)])
def test_as_another_reader_reads_it(version: int, compression: int, tmp_path: Path) -> None:
    """pytritech, which its authors wrote for their own recordings."""
    table = 0.9 * np.sin(np.linspace(-1, 1, 40))
    records = []
    for k, image in enumerate(IMAGES):
        more = {"version": version, "compression": compression, "bearings": table, "speed": 1502.5}
        records += [GEMINI_STATUS, gemini_record(k, image, **more)]  # type: ignore[arg-type]
    path = gemini_log(tmp_path / "a.glf", records)
    found, faults = raw(path)
    assert faults == []
    with GLF(str(path)) as theirs:
        for frame, record in zip(found, theirs.images, strict=True):
            data, (beams, bins) = theirs.extract_image(record)
            np.testing.assert_array_equal(
                frame.pixels, np.frombuffer(data, np.uint8).reshape(bins, beams)
            )
            assert frame.ping is not None
            # Its table is positive to the left.
            np.testing.assert_allclose(
                frame.ping.bearings_deg, -np.degrees(record.bearing_table), rtol=1e-12
            )
            assert frame.ping.range_max_m == pytest.approx(calculate_range(record))
            assert frame.ping.range_min_m == 0
            assert frame.time_ns is not None
            # Theirs is by London's clock, an hour behind in the summer, and whole milliseconds.
            apart_s = frame.time_ns / 1e9 - record.header.time.timestamp()
            assert min(abs(apart_s), abs(apart_s - 3600)) < 1.1e-3


def test_times_window_and_header(tmp_path: Path) -> None:
    records = [gemini_record(k, x, first_bin=100) for k, x in enumerate(IMAGES)]
    log = find_log(gemini_log(tmp_path / "a.glf", records)).open()
    for k, frame in enumerate(log):
        assert frame.time_ns == frame.stamps.log == START_NS + k * 125_000_000
        assert frame.stamps.header == START_NS + k * 125_000_000 - 31_250_000
        assert frame.ping is not None
        bin_m = 1490 / 2 / 46_560
        assert frame.ping.range_min_m == pytest.approx(100 * bin_m)
        assert frame.ping.range_max_m == pytest.approx(164 * bin_m)
    assert log.header_info.values == {
        "sonar": "Gemini 1200ik, device 1194",
        "mounted": "upright",
        "sound_speed_m_s": 1490.0,
        "range_resolution_m": pytest.approx(1490 / 2 / 46_560),
        "gain_percent": 57,
        "chirp": "yes",
    }


def test_upside_down_left_is_right(tmp_path: Path, whole: list[np.ndarray]) -> None:
    records = [gemini_record(k, x[:, ::-1], upside_down=True) for k, x in enumerate(IMAGES)]
    found, problems = read(gemini_log(tmp_path / "a.glf", records))
    assert problems == []
    np.testing.assert_array_equal([frame.image for frame in found], whole)


def test_other_records_and_zoomed_images_are_passed_over(
    tmp_path: Path, whole: list[np.ndarray]
) -> None:
    records = [
        *(GEMINI_STATUS, gemini_message(98, b"$HEHDT,12.5,T*2A"), RECORDS[0]),
        *(gemini_record(1, IMAGES[1], zoomed=True), gemini_message(99, bytes(70)), RECORDS[2]),
    ]
    found, problems = read(gemini_log(tmp_path / "a.glf", records))
    assert problems == []
    np.testing.assert_array_equal([frame.image for frame in found], whole[:3])


def test_of_two_sonars_the_first_is_read(tmp_path: Path, whole: list[np.ndarray]) -> None:
    other = [gemini_record(k, image[::-1], device=7) for k, image in enumerate(IMAGES)]
    records = [record for both in zip(RECORDS, other, strict=True) for record in both]
    found, problems = read(gemini_log(tmp_path / "a.glf", records))
    np.testing.assert_array_equal([frame.image for frame in found], whole)
    assert len(problems) == 1
    assert "a.glf: 6 images" in problems[0]


# Logs that are not whole


def test_lost_bytes_cost_one_image(tmp_path: Path, whole: list[np.ndarray]) -> None:
    records = [*RECORDS[:2], RECORDS[2][:500] + RECORDS[2][560:], *RECORDS[3:]]
    found, problems = read(gemini_log(tmp_path / "a.glf", records))
    assert [frame.index for frame in found] == [0, 1, 3, 4, 5]
    np.testing.assert_array_equal([frame.image for frame in found], [*whole[:2], *whole[3:]])
    (line,) = problems
    assert "end mark" in line


@pytest.mark.parametrize("at", [0, 14, 21, 23])
def test_an_image_without_its_beginning_is_told(
    at: int, tmp_path: Path, whole: list[np.ndarray]
) -> None:
    bad = bytearray(RECORDS[2])
    bad[at] ^= 0x40
    found, problems = read(gemini_log(tmp_path / "a.glf", [*RECORDS[:2], bytes(bad), *RECORDS[3:]]))
    np.testing.assert_array_equal([frame.image for frame in found], [*whole[:2], *whole[3:]])
    (line,) = problems
    assert line.endswith("damaged, skipped")


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"compression": 2}, "compressed as video (H.264), which is not read"),
        ({"compression": 9}, "unknown compression 9"),
        ({"speed": 3.0}, "a speed of sound of 3 m/s"),
        ({"speed": float("nan")}, "a speed of sound of nan m/s"),
        ({"bins_hz": 0}, "no rate of its range bins"),
        ({"bearings": np.zeros(40)}, "bearings do not run one way"),
        ({"bearings": np.linspace(-3, 3, 40)}, "bearings of 90 deg and more"),
    ],
)
def test_what_one_image_cannot_be(more: dict[str, Any], says: str, tmp_path: Path) -> None:
    records = [RECORDS[0], gemini_record(1, IMAGES[1], **more), RECORDS[2]]
    found, problems = read(gemini_log(tmp_path / "a.glf", records))
    assert [frame.index for frame in found] == [0, 2]
    (line,) = problems
    assert says in line


def test_what_cannot_be_opened(tmp_path: Path) -> None:
    path = tmp_path / "a.glf"
    path.write_bytes(b"junk" * 999)
    with pytest.raises(SonarrecError, match=r"not a \.glf of a Gemini, which is a ZIP"):
        read(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "text")
    with pytest.raises(SonarrecError, match=r"a ZIP without a \.dat"):
        read(path)
    gemini_log(path, RECORDS, zipfile.ZIP_LZMA)
    with pytest.raises(SonarrecError, match="read \\(ZIP method 14"):
        read(path)
    path = gemini_log(tmp_path / "b.glf", [GEMINI_STATUS])
    with pytest.raises(SonarrecError, match="no image of a Gemini can be read in it"):
        read(path)
    path = gemini_log(tmp_path / "c.glf", [gemini_record(0, IMAGES[0], compression=2)])
    with pytest.raises(SonarrecError, match=r"image .* in it \(its samples"):
        read(path)
