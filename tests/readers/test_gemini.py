"""Gemini: written logs against an independent reader of them, whole and damaged."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytritech.glf import GLF
from pytritech.util.range import calculate_range

from sonarrec.errors import SonarrecError
from sonarrec.readers.open import find_log
from tests.support import logs
from tests.support.logs import frames
from tests.support.sonar_files import (
    GEMINI_START_S,
    GEMINI_STATUS,
    gemini_file,
    gemini_log,
    gemini_message,
    gemini_record,
)

IMAGES = frames(6, 64, 40)
RECORDS = [gemini_record(k, image) for k, image in enumerate(IMAGES)]
START_NS = round((GEMINI_START_S + 315_532_800) * 1e9)


def read(folder: Path, records: list[bytes]) -> logs.Read:
    return logs.read(gemini_log(folder / "a.glf", records), sonar={"tilt_deg": 20.0})


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    return read(tmp_path_factory.mktemp("whole"), RECORDS).images


@pytest.mark.parametrize(("version", "compression"), [(2, 0), (2, 1), (3, 0), (3, 1)])
def test_as_another_reader_reads_it(version: int, compression: int, tmp_path: Path) -> None:
    """pytritech, which its authors wrote for their own recordings."""
    table = 0.9 * np.sin(np.linspace(-1, 1, 40))
    records = []
    for k, image in enumerate(IMAGES):
        more = {"version": version, "compression": compression, "bearings": table, "speed": 1502.5}
        records += [GEMINI_STATUS, gemini_record(k, image, **more)]  # type: ignore[arg-type]
    path = gemini_log(tmp_path / "a.glf", records)
    log = find_log(path).open()
    with GLF(str(path)) as theirs:
        for frame, record in zip(log, theirs.images, strict=True):
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
    assert not log.diagnostics.faults


def test_times_window_and_header(tmp_path: Path) -> None:
    log = find_log(gemini_file(tmp_path / "a.glf", IMAGES, first_bin=100)).open()
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
    found = read(tmp_path, records)
    assert not found.problems
    np.testing.assert_array_equal(found.images, whole)


def test_other_records_are_passed_over(tmp_path: Path, whole: list[np.ndarray]) -> None:
    records = [
        *(GEMINI_STATUS, gemini_message(98, b"$HEHDT,12.5,T*2A"), RECORDS[0]),
        *(gemini_record(1, IMAGES[1], zoomed=True), gemini_message(99, bytes(70)), RECORDS[2]),
    ]
    found = read(tmp_path, records)
    assert not found.problems
    np.testing.assert_array_equal(found.images, whole[:3])


def test_of_two_sonars_the_first_is_read(tmp_path: Path, whole: list[np.ndarray]) -> None:
    other = [gemini_record(k, image[::-1], device=7) for k, image in enumerate(IMAGES)]
    records = [record for both in zip(RECORDS, other, strict=True) for record in both]
    found = read(tmp_path, records)
    np.testing.assert_array_equal(found.images, whole)
    (problem,) = found.problems
    assert "a.glf: 6 images" in problem


def with_image(**how: Any) -> bytes:
    return gemini_record(2, IMAGES[2], **how)


def changed(at: int) -> bytes:
    return RECORDS[2][:at] + bytes([RECORDS[2][at] ^ 0x40]) + RECORDS[2][at + 1 :]


@pytest.mark.parametrize(
    ("record", "says"),
    [
        (RECORDS[2][:500] + RECORDS[2][560:], "end mark"),
        *((changed(at), "damaged") for at in (0, 14, 21, 23)),
        (with_image(compression=2), "H.264"),
        (with_image(compression=9), "unknown compression 9"),
        (with_image(speed=3.0), "3 m/s"),
        (with_image(speed=float("nan")), "nan m/s"),
        (with_image(bins_hz=0), "rate"),
        (with_image(bearings=np.zeros(40)), "one way"),
        (with_image(bearings=np.linspace(-3, 3, 40)), "90 deg"),
    ],
    ids=range(12),
)
def test_a_bad_record_costs_itself(
    record: bytes, says: str, tmp_path: Path, whole: list[np.ndarray]
) -> None:
    found = read(tmp_path, [*RECORDS[:2], record, *RECORDS[3:]])
    np.testing.assert_array_equal(found.images, [*whole[:2], *whole[3:]])
    assert found.numbers == [0, 1, 3, 4, 5]
    (line,) = found.problems
    assert says in line


def other_zip(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "text")


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda path: path.write_bytes(b"junk" * 999), "ZIP"),
        (other_zip, r"\.dat"),
        (lambda path: gemini_log(path, RECORDS, zipfile.ZIP_LZMA), "ZIP method 14"),
        (lambda path: gemini_log(path, [GEMINI_STATUS]), "no image"),
        (lambda path: gemini_file(path, IMAGES[:1], compression=2), r"no image .*\(its samples"),
    ],
    ids=["junk", "empty", "lzma", "no image", "video"],
)
def test_what_cannot_be_opened(make: Callable[[Path], object], says: str, tmp_path: Path) -> None:
    make(tmp_path / "a.glf")
    with pytest.raises(SonarrecError, match=says):
        logs.read(tmp_path / "a.glf")
