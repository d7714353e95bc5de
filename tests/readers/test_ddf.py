"""ARIS and DIDSON files: the real one against its maker's description, and written ones."""

from __future__ import annotations

import itertools
import json
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sonarrec.errors import SonarrecError
from sonarrec.readers.containers.ddf_headers import (
    FILE_HEADER,
    FRAME_HEADER,
    WINDOW_M,
    bearings_deg,
    lens_bearings_deg,
)
from sonarrec.sonar.geometry import pixel_from_polar
from tests.support.command import sonarrec
from tests.support.logs import frames, read
from tests.support.sonar_files import PERIOD_US, START_US, aris_file, as_pings_came, didson_file

SAMPLE = Path(__file__).parent / "aris_sample" / "sample.aris"
SDK = Path(__file__).parents[3] / "shared" / "data" / "vendor" / "aris-sdk"
NUMBER = {"uint32_t": "<u4", "int32_t": "<i4", "uint64_t": "<u8", "float": "<f4", "double": "<f8"}
FRAME_BYTES = 1024 + 48 * 2000  # of the sample: header and samples


def info(path: Path) -> dict[str, Any]:
    log: dict[str, Any] = json.loads(sonarrec("info", "--json", path).stdout)["logs"][0]
    return log


def described() -> dict[str, tuple[int, str]]:
    """Offset and type of every field of a frame's header, by the maker's description."""
    if not SDK.is_dir():
        pytest.skip(f"no description of the format at {SDK}")
    text = (SDK / "FrameHeader.h").read_text()
    offsets = re.findall(r"ArisFrameHeaderOffset_(\w+)\s*=\s*(\d+)", text)
    types = {name: kind for kind, name in re.findall(r"^ +(\w+) (\w+);", text, re.MULTILINE)}
    return {n: (int(o), NUMBER[types[n]]) for n, o in offsets if types.get(n) in NUMBER}


# The real file


def test_every_field_used_is_where_the_description_has_it() -> None:
    fields = described()
    assert {name: fields[name] for name in FRAME_HEADER} == FRAME_HEADER
    at, places = 0, {}
    text = (SDK / "FileHeaderFieldsOnly.h").read_text()
    for kind, name, count in re.findall(r"^ +(\w+) (\w+)(?:\[(\d+)\])?;", text, re.MULTILINE):
        if kind in NUMBER:
            places[name] = (at, NUMBER[kind])
        at += int(count or 1) * (np.dtype(NUMBER[kind]).itemsize if kind in NUMBER else 1)
    assert at == 1024
    assert {name: places[name] for name in FILE_HEADER} == FILE_HEADER


@pytest.mark.parametrize(
    "name", ["1800_1200_48", "1800_96", "3000_64", "3000_128", "_Telephoto_48", "_Telephoto_96"]
)
def test_bearings_are_the_maker_s_tables(name: str) -> None:
    beams = int(name.rpartition("_")[2])
    bearings = bearings_deg()[beams, "Telephoto" in name]
    assert len(bearings) == beams
    assert bearings[0] > 5
    assert all(a > b for a, b in itertools.pairwise(bearings))  # the first is the right-most
    if not SDK.is_dir():
        pytest.skip(f"no tables at {SDK}")
    rows = re.findall(
        r"3\((\d+), *(-?[\d.]+), *(-?[\d.]+), *(-?[\d.]+)",
        (SDK / f"BeamWidths_ARIS{name}.h").read_text(),
    )
    assert [int(row[0]) for row in rows] == list(range(beams))
    assert [-float(row[1]) for row in rows] == list(bearings)


def raw_values(number: int) -> dict[str, float]:
    """The header of a frame of the sample, by the description alone."""
    start = 1024 + number * FRAME_BYTES
    header = SAMPLE.read_bytes()[start : start + 1024]
    return {
        n: np.frombuffer(header, kind, 1, at)[0].item() for n, (at, kind) in described().items()
    }


def test_what_info_tells_of_the_real_file_is_in_its_headers() -> None:
    values = raw_values(0)
    log = info(SAMPLE)
    assert (log["kind"], log["faults"]) == ("ARIS", [])
    (images,) = log["images"]
    assert (images["frames"], images["usable"], images["problems"]) == (6, 6, [])
    assert (images["columns"], images["rows"], images["pixels"]) == (48, 2000, "uint8")
    header = images["header"]
    assert "ARIS 1200, telephoto lens" in header["sonar"]
    assert (values["TheSystemType"], values["LargeLens"]) == (2, 1)
    assert values["SonarSerialNumber"] == 1098
    for key, name in {
        "ping_mode": "PingMode", "frame_rate_hz": "FrameRate", "sound_speed_m_s": "SoundSpeed",
        "sample_start_us": "SampleStartDelay", "sample_period_us": "SamplePeriod",
        "receiver_gain_db": "ReceiverGain", "water_temperature_c": "WaterTemp",
        "salinity_ppt": "Salinity", "depth_m": "Depth", "altitude_m": "Altitude",
        "compass_heading_deg": "CompassHeading", "compass_pitch_deg": "CompassPitch",
        "compass_roll_deg": "CompassRoll", "rotator_tilt_deg": "SonarTilt",
    }.items():  # fmt: skip
        assert header[key] == pytest.approx(values[name], rel=1e-6), key
    assert header["rotator_roll_deg"] is None  # NaN: there is no such axis
    assert values["FrequencyHiLow"] == 1
    assert header["frequency"] == "high"
    # The window as "Understanding ARIS data" works it out. That in the header assumes 1450 m/s.
    metres = 1e-6 * values["SoundSpeed"] / 2
    start = values["SampleStartDelay"] * metres
    end = start + values["SamplePeriod"] * values["SamplesPerBeam"] * metres
    geometry = images["geometry"]
    assert (geometry["range_min_m"], geometry["range_max_m"]) == pytest.approx((start, end))
    assert values["WindowStart"] == pytest.approx(start * 1450 / values["SoundSpeed"])
    assert geometry["tilt_deg"] == pytest.approx(
        -np.median([raw_values(k)["CompassPitch"] for k in range(6)]), abs=1e-4
    )
    assert set(images["origins"].values()) == {"header"}


def test_times_of_the_real_file() -> None:
    """FrameRate is in Hz, whatever the description says: the times of the frames tell."""
    found, _, notes = read(SAMPLE)
    assert not notes
    for k, frame in enumerate(found):
        values = raw_values(k)
        assert frame.timestamp_ns == frame.stamps.log == values["FrameTime"] * 1000
        assert frame.stamps.header == values["sonarTimeStamp"] * 1000
    rate = 5e9 / (found[5].timestamp_ns - found[0].timestamp_ns)
    assert rate == pytest.approx(values["FrameRate"], rel=0.01)
    assert f"{datetime.fromtimestamp(found[0].timestamp_ns / 1e9, UTC):%Y-%m-%d}" == "2013-06-14"


def test_the_real_picture_is_what_its_samples_say() -> None:
    """Sample i of beam k lies at its range and bearing: beam 0 the right-most, near range below."""
    frame = read(SAMPLE).frames[2]
    fan = frame.fan
    samples = np.fromfile(SAMPLE, np.uint8, 48 * 2000, offset=2048 + 2 * FRAME_BYTES)
    samples = samples.reshape(2000, 48)
    column, row = pixel_from_polar(
        fan,
        (3.29762 + (np.arange(2000) + 0.5) * 0.01005153)[:, None],
        np.array(bearings_deg()[48, True])[None, :],
    )
    places = column.astype(np.float32), row.astype(np.float32)
    seen = cv2.remap(frame.image, *places, cv2.INTER_LINEAR)
    far = slice(900, 1900)  # where a beam is wider than a pixel
    assert np.corrcoef(seen[far].ravel(), samples[far].ravel())[0, 1] > 0.95
    assert np.corrcoef(seen[far, ::-1].ravel(), samples[far].ravel())[0, 1] < 0.6


# Written files


def as_fan(images: list[np.ndarray], near: float, far: float, bearings: Any, folder: Path) -> Any:
    """The fan images of the same samples, read as polar pictures of a stated geometry."""
    folder.mkdir()
    for k, image in enumerate(images):
        assert cv2.imwrite(str(folder / f"{k}.png"), image)
    sonar = {"layout": "polar", "range_min_m": near, "range_max_m": far, "tilt_deg": 20.0,
             "bearings_deg": [float(b) for b in bearings]}  # fmt: skip
    return read(folder, sonar=sonar).images


@pytest.mark.parametrize("beams", [48, 64, 96, 128])
@pytest.mark.parametrize("ordered", [True, False])
def test_frames_of_an_aris(beams: int, ordered: bool, tmp_path: Path) -> None:
    images = frames(3, 200, beams)
    stored = images if ordered else [as_pings_came(image) for image in images]
    path = aris_file(tmp_path / "a.aris", stored, ReorderedSamples=int(ordered))
    found = read(path)
    assert not found.problems + found.notes
    near, far = 2000e-6 * 725, 2000e-6 * 725 + 200 * 8e-6 * 725
    expected = as_fan(images, near, far, bearings_deg()[beams, False], tmp_path / "polar")
    np.testing.assert_array_equal(found.images, expected)
    assert found.times == [(START_US + k * PERIOD_US) * 1000 for k in range(3)]
    assert found.frames[0].fan.tilt_deg == 20.0


def test_an_order_that_is_not_public_is_refused(tmp_path: Path) -> None:
    path = aris_file(tmp_path / "a.aris", frames(2, 64, 96), PingMode=4, ReorderedSamples=0)
    with pytest.raises(SonarrecError, match="ping mode 4"):
        read(path)


@pytest.mark.parametrize(
    ("values", "tilt", "note"),
    [
        ({}, 20.0, None),
        ({"CompassHeading": 0, "CompassPitch": 0, "CompassRoll": 0, "SonarTilt": -7.5}, 7.5, None),
        ({"CompassPitch": 0.0}, 0.0, None),
        ({"CompassPitch": 12.0}, None, "12 deg upward"),
        ({"CompassHeading": 0, "CompassPitch": 0, "CompassRoll": 0}, None, None),
        ({"CompassHeading": 9, "CompassPitch": np.nan, "SonarTilt": np.nan}, None, None),
    ],
)
def test_tilt_by_the_headers(
    values: dict[str, float], tilt: float | None, note: str | None, tmp_path: Path
) -> None:
    path = aris_file(tmp_path / "a.aris", frames(3, 64, 48), **values)
    (images,) = info(path)["images"]
    assert images["geometry"].get("tilt_deg") == tilt
    assert images["lacks"] == ([] if tilt is not None else ["tilt_deg"])
    assert any(note in line for line in images["notes"]) if note else not images["notes"]


def test_a_tilt_that_changes_is_told(tmp_path: Path) -> None:
    one = aris_file(tmp_path / "one.aris", frames(2, 64, 48), CompassPitch=-20).read_bytes()
    two = aris_file(tmp_path / "two.aris", frames(2, 64, 48), CompassPitch=-30).read_bytes()
    (tmp_path / "both.aris").write_bytes(one + two[1024:])
    found = read(tmp_path / "both.aris")
    assert "between 20 and 30 deg" in found.notes[0]
    assert {frame.fan.tilt_deg for frame in found.frames} == {25.0}


def test_a_sonar_that_lay_upside_down_is_noted(tmp_path: Path) -> None:
    path = aris_file(tmp_path / "a.aris", frames(2, 64, 48), reverse=1)
    assert "--flip" in read(path).notes[0]


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("beams", [48, 96])
def test_frames_of_a_didson(version: int, beams: int, tmp_path: Path) -> None:
    images = frames(10, 512, beams)
    path = didson_file(tmp_path / "d.ddf", images, version)
    found = read(path)
    assert not found.problems
    assert "DIDSON" in found.notes[0]
    right_to_left = lens_bearings_deg(beams)[::-1]
    expected = as_fan(images, 3 * 0.375, 3 * 0.375 + 2.25, right_to_left, tmp_path / "polar")
    start = int(datetime(2013, 6, 14, 8, 21, tzinfo=UTC).timestamp()) * 10**9
    np.testing.assert_array_equal(found.images, expected)
    hundredths = [100 * (k // 8) + 100 * (k % 8) // 8 for k in range(10)]
    assert found.times == [start + n * 10**7 for n in hundredths]
    assert found.frames[0].fan.tilt_deg == 20.0
    assert "DIDSON-S, classic windows" in info(path)["images"][0]["header"]["sonar"]


def test_a_reversed_didson_is_mirrored(tmp_path: Path) -> None:
    images = frames(2, 512, 96)
    upright = read(didson_file(tmp_path / "a.ddf", images, 3)).images
    mirrored = [np.ascontiguousarray(image[:, ::-1]) for image in images]
    lens_down = read(didson_file(tmp_path / "b.ddf", mirrored, 3, file={"Reverse": 1})).images
    difference = cv2.absdiff(upright[0], lens_down[0])
    assert difference.max() <= 1  # of rounding
    assert np.mean(difference) < 1e-3


def test_lens_of_a_didson() -> None:
    """Uneven, 0.22 to 0.38 deg from beam to beam, over 28.8 deg."""
    bearings = lens_bearings_deg(96)
    steps = np.diff(bearings)
    assert 0.21 < steps.min() < 0.24
    assert 0.36 < steps.max() < 0.38
    assert np.ptp(bearings) == pytest.approx(28.8, abs=0.1)
    np.testing.assert_allclose(
        lens_bearings_deg(48), bearings.reshape(48, 2).mean(axis=1), atol=0.01
    )


@pytest.mark.parametrize(
    ("flags", "high", "near", "length"),
    [
        (0, 1, 3 * 0.419, 2.5),
        (1, 1, 3 * 0.375, 2.25),
        (1, 0, 3 * 0.75, 9),
        (2, 0, 3 * 0.838, 20),
        (3, 1, 3 * 0.375, 4.5),
    ],
)
def test_didson_windows(flags: int, high: int, near: float, length: float, tmp_path: Path) -> None:
    head, images = {"HighResolution": high}, frames(1, 64, 96)
    path = didson_file(tmp_path / "d.ddf", images, 4, file=head, ConfigFlags=flags)
    geometry = info(path)["images"][0]["geometry"]
    assert geometry["range_min_m"] == pytest.approx(near)
    assert geometry["range_max_m"] == pytest.approx(near + length)


@pytest.mark.parametrize("year", [0, 13, 1969, 3000])
def test_a_didson_whose_clock_was_never_set(year: int, tmp_path: Path) -> None:
    """Years that are no date, or beyond every clock: the latter cost all frames."""
    path = didson_file(tmp_path / "d.ddf", frames(3, 64, 96), 3, Year=year)
    found = read(path)
    assert found.times == [0, 125_000_000, 250_000_000]
    assert not found.problems


def test_what_follows_the_last_frame_is_told(tmp_path: Path) -> None:
    path = aris_file(tmp_path / "a.aris", frames(3, 64, 48))
    path.write_bytes(path.read_bytes() + bytes(9000))
    found, (problem,), _ = read(path)
    assert len(found) == 3
    assert "9000 bytes" in problem


def test_the_lengths_of_a_window_double_from_code_to_code() -> None:
    lengths = np.array([*WINDOW_M.values()])
    lengths[:, -1][lengths[:, -1] == 70] = 80  # the maker's long range ends before its double
    assert lengths[:, 1:] == pytest.approx(2 * lengths[:, :-1])
    assert lengths[:, 0].tolist() == [1.25, 1.125, 2.5, 2.25]
