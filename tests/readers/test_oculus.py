"""Oculus: real pings, written ones of both versions, raw and in logs, whole and damaged."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonarrec.readers.info import describe
from sonarrec.readers.open import find_log
from tests.readers.test_ddf import as_fan
from tests.support import logs
from tests.support.command import sonarrec
from tests.support.logs import frames
from tests.support.sonar_files import oculus_file, oculus_log, oculus_message, oculus_ping

VENDOR = Path(__file__).parents[3] / "shared" / "data" / "vendor"
IMAGES = frames(6, 64, 40)
PINGS = [oculus_ping(k, image) for k, image in enumerate(IMAGES)]


def read(path: Path, data: bytes | None = None, **sonar: Any) -> logs.Read:
    """A log, which has first to be written where there is data."""
    if data is not None:
        path.write_bytes(data)
    return logs.read(path, sonar={"tilt_deg": 20.0} | sonar)


def header_of(path: Path) -> dict[str, Any]:
    log = json.loads(sonarrec("info", "--json", path).stdout)["logs"][0]
    header: dict[str, Any] = log["images"][0]["header"]
    return header


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    return read(tmp_path_factory.mktemp("whole") / "whole.raw", b"".join(PINGS)).images


@pytest.mark.parametrize("name", ["oculus_one_ping_8bit.raw", "oculus_three_pings_8bit.raw"])
def test_real_pings(name: str, tmp_path: Path) -> None:
    if not (VENDOR / name).exists():
        pytest.skip(f"no real pings at {VENDOR / name}")
    data = (VENDOR / name).read_bytes()
    count = len(data) // 182016
    found, problems, _ = read(VENDOR / name)
    assert (len(found), problems) == (count, [])
    # Field by field, as the free drivers' definition has them one after another.
    at = 182016 * (count - 1)
    head = struct.unpack_from("<5HIH", data, at)
    assert (head[0], head[3], head[5]) == (0x4F53, 0x23, 182000)
    mode, _, _, _, flags, range_m, *_ = struct.unpack_from("<5B4d", data, at + 16)
    result = struct.unpack_from("<2I4dIBd2H3I", data, at + 53)
    frequency, speed, kind, resolution, ranges, beams, offset, size, total = (
        result[2], *result[5:6], *result[7:],
    )  # fmt: skip
    assert (kind, size, total) == (0, ranges * beams, 182016)
    bearings = np.frombuffer(data, "<i2", beams, at + 122) / 100
    (images,) = describe(VENDOR / name).images
    assert images.geometry["bearings_deg"] == [*bearings]
    assert images.geometry["range_max_m"] == pytest.approx(ranges * resolution)
    assert range_m - resolution < ranges * resolution <= range_m  # as far as was asked for
    assert flags & 1
    header = header_of(VENDOR / name)
    assert header["mode"] == {1: "low frequency", 2: "high frequency"}[mode]
    assert header["sound_speed_m_s"] == pytest.approx(speed, rel=1e-6)
    assert header["frequency_hz"] == pytest.approx(frequency, rel=1e-6)
    assert (header["temperature_c"], header["pressure_bar"]) == (None, None)  # never written
    image = np.frombuffer(data, np.uint8, size, at + offset).reshape(ranges, beams)
    expected = as_fan([image], 0.0, ranges * resolution, bearings, tmp_path / "polar")
    np.testing.assert_array_equal(found[-1].image, expected[0])


@pytest.mark.parametrize("version", [0, 1, 2])
def test_both_versions(version: int, tmp_path: Path, whole: list[np.ndarray]) -> None:
    path = oculus_file(tmp_path / "a.raw", IMAGES, version=version)
    found = read(path, frame_rate_hz=8.0)
    assert not found.problems
    np.testing.assert_array_equal(found.images, whole)
    start = 100.0 if version == 2 else 0  # the first version's start has no known unit
    assert found.times == [round((start + k / 8) * 1e9) for k in range(6)]
    header = header_of(path)
    assert header["sound_speed_m_s"] == 1490
    assert (header["temperature_c"], header["pressure_bar"]) == (11.5, 1.75)
    assert header.get("pitch_deg") == (-20 if version == 2 else None)


def test_samples_of_16_bit_and_gains(tmp_path: Path) -> None:
    """A ping of 16 bit sent with gains is the one without times the root of its rows' gains."""
    rng = np.random.default_rng(1)
    echoes = rng.rayleigh(200, (64, 40)).round().astype("<u2")
    gains = rng.integers(1, 40, 64) ** 2
    sent = (echoes * np.sqrt(gains)[:, None]).astype("<u2")
    (frame,) = read(tmp_path / "a.raw", oculus_ping(0, sent, gains=gains)).frames
    log = find_log(tmp_path / "a.raw").open()
    (raw,) = log
    assert raw.pixels is not None
    assert raw.pixels.dtype == np.float32
    np.testing.assert_allclose(raw.pixels, echoes, atol=1)
    assert log.header_info.values["gains_sent"] == "yes"
    assert frame.image.any()
    (raw,) = find_log(oculus_file(tmp_path / "b.raw", [echoes])).open()
    np.testing.assert_array_equal(raw.pixels, echoes)


@pytest.mark.parametrize("compressed", [False, True])
def test_a_log_of_viewpoint(compressed: bool, tmp_path: Path, whole: list[np.ndarray]) -> None:
    found = read(tmp_path / "a.oculus", oculus_log(PINGS, compressed=compressed))
    assert not found.problems
    np.testing.assert_array_equal(found.images, whole)
    for k, frame in enumerate(found.frames):
        assert frame.timestamp_ns == frame.stamps.log == round((1.7e9 + k / 8) * 1e9)
        assert frame.stamps.header == round((100 + k / 8) * 1e9)


KINDS = {0xFF: b"", 0x55: b"settings", 0x15: b"x"}
OTHERS = b"".join(oculus_message(kind, body) for kind, body in KINDS.items())
FULL = oculus_message(0x22, bytes(900))
SHORT = {version: oculus_message(0x23, bytes(60), version=version) for version in (1, 2)}
NOISE = np.random.default_rng(3).bytes(5000)


@pytest.mark.parametrize(
    ("before", "between", "told"),
    [
        (OTHERS, OTHERS, None),
        (b"", FULL + FULL, "a.raw: 2 pings"),
        *((b"", short, f"{len(short)} bytes") for short in SHORT.values()),
        (NOISE[:3000], NOISE, "8000 bytes in 2 gaps"),
    ],
    ids=["other messages", "full pings", "short ping, 1", "short ping, 2", "noise"],
)
def test_what_is_no_ping_costs_no_ping(
    before: bytes, between: bytes, told: str | None, tmp_path: Path, whole: list[np.ndarray]
) -> None:
    found = read(tmp_path / "a.raw", before + PINGS[0] + between + PINGS[1] + PINGS[2])
    np.testing.assert_array_equal(found.images, whole[:3])
    assert len(found.problems) == (told is not None)
    assert all(told in problem for problem in found.problems)
