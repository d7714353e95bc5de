"""Writes the sonars' own files: ARIS, DIDSON, Oculus and Gemini.

Headers are packed field after field in the order of their descriptions, not by offsets, and by
nothing of the package's.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

ARIS_FRAME = """
FrameIndex I, FrameTime Q, Version I, Status I, sonarTimeStamp Q, TS_Day I, TS_Hour I, TS_Minute I,
TS_Second I, TS_Hsecond I, TransmitMode I, WindowStart f, WindowLength f, Threshold I, Intensity i,
ReceiverGain I, DegC1 I, DegC2 I, Humidity I, Focus I, Battery I, UserValue1 f, UserValue2 f,
UserValue3 f, UserValue4 f, UserValue5 f, UserValue6 f, UserValue7 f, UserValue8 f, Velocity f,
Depth f, Altitude f, Pitch f, PitchRate f, Roll f, RollRate f, Heading f, HeadingRate f,
CompassHeading f, CompassPitch f, CompassRoll f, Latitude d, Longitude d, SonarPosition f,
ConfigFlags I, BeamTilt f, TargetRange f, TargetBearing f, TargetPresent I, FirmwareRevision I,
Flags I, SourceFrame I, WaterTemp f, TimerPeriod I, SonarX f, SonarY f, SonarZ f, SonarPan f,
SonarTilt f, SonarRoll f, PanPNNL f, TiltPNNL f, RollPNNL f, VehicleTime d, TimeGGK f, DateGGK I,
QualityGGK I, NumSatsGGK I, DOPGGK f, EHTGGK f, HeaveTSS f, YearGPS I, MonthGPS I, DayGPS I,
HourGPS I, MinuteGPS I, SecondGPS I, HSecondGPS I, SonarPanOffset f, SonarTiltOffset f,
SonarRollOffset f, SonarXOffset f, SonarYOffset f, SonarZOffset f, Tmatrix 64s, SampleRate f,
AccellX f, AccellY f, AccellZ f, PingMode I, FrequencyHiLow I, PulseWidth I, CyclePeriod I,
SamplePeriod I, TransmitEnable I, FrameRate f, SoundSpeed f, SamplesPerBeam I, Enable150V I,
SampleStartDelay I, LargeLens I, TheSystemType I, SonarSerialNumber I, ReservedEK Q,
ArisErrorFlagsUint I, MissedPackets I, ArisAppVersion I, Available2 I, ReorderedSamples I,
Salinity I, Pressure f
"""
DDF_FILE = """
Version I, FrameCount I, FrameRate I, HighResolution I, NumRawBeams I, SampleRate f,
SamplesPerChannel I, ReceiverGain I, WindowStart I, WindowLength I, Reverse I, SN I, strDate 32s,
strHeaderID 256s
"""
DIDSON_FRAME = """
FrameNumber i, FrameTime Q, Version I, Status i, Year i, Month i, Day i, Hour i, Minute i, Second i,
HSecond i, Transmit i, WindowStart i, WindowLength i, Threshold i, Intensity i, ReceiverGain i,
DegC1 i, DegC2 i, Humidity i, Focus i, Battery i, Status1 16s, Status2 8s, PanWCom f, TiltWCom f,
Velocity f, Depth f, Altitude f, Pitch f, PitchRate f, Roll f, RollRate f, Heading f, HeadingRate f,
SonarPan f, SonarTilt f, SonarRoll f, Latitude d, Longitude d, SonarPosition f, ConfigFlags i
"""
SIGNATURE = {3: 0x03464444, 4: 0x04464444, 5: 0x05464444}
START_US = 1_371_198_079_000_000
PERIOD_US = 125_000
# Of the 16 channels of a ping, the beam that each hears, as the maker's integration kit has it.
CHANNEL_BEAM = (10, 2, 14, 6, 8, 0, 12, 4, 11, 3, 15, 7, 9, 1, 13, 5)


def packed(description: str, size: int, values: dict[str, Any]) -> bytes:
    """The fields one after another, zero where no value is given, filled up to `size` bytes."""
    fields = [field.split() for field in description.split(",")]
    assert not set(values) - {name for name, _ in fields}
    zero = {code: b"" if code.endswith("s") else 0 for _, code in fields}
    data = struct.pack(
        "<" + "".join(code for _, code in fields),
        *(values.get(name, zero[code]) for name, code in fields),
    )
    return data + bytes(size - len(data))


def aris_frame(number: int, image: np.ndarray, **values: Any) -> bytes:
    """Header and samples of frame `number`; image: (samples, beams), beam 0 the right-most."""
    mode = {48: 1, 96: 3, 64: 6, 128: 9}[image.shape[1]]
    time_us = START_US + number * PERIOD_US
    header = {
        "FrameIndex": number, "FrameTime": time_us, "Version": SIGNATURE[5],
        "sonarTimeStamp": time_us + 7, "ReceiverGain": 20, "CompassHeading": 50.0,
        "CompassPitch": -20.0, "CompassRoll": 1.0, "WaterTemp": 12.5, "Depth": 3.25,
        "PingMode": mode, "FrequencyHiLow": 1, "SamplePeriod": 8, "FrameRate": 8.0,
        "SoundSpeed": 1450.0, "SamplesPerBeam": image.shape[0], "SampleStartDelay": 2000,
        "TheSystemType": 1, "SonarSerialNumber": 77, "ReorderedSamples": 1, "Salinity": 15,
    }  # fmt: skip
    return packed(ARIS_FRAME, 1024, header | values) + image.tobytes()


def aris_file(path: Path, images: list[np.ndarray], *, reverse: int = 0, **values: Any) -> Path:
    """An ARIS recording; values: fields of every frame's header."""
    samples, beams = images[0].shape
    head = {"Version": SIGNATURE[5], "FrameCount": len(images), "NumRawBeams": beams,
            "SamplesPerChannel": samples, "Reverse": reverse}  # fmt: skip
    frames = [aris_frame(k, image, **values) for k, image in enumerate(images)]
    path.write_bytes(packed(DDF_FILE, 1024, head) + b"".join(frames))
    return path


def as_pings_came(image: np.ndarray) -> np.ndarray:
    """(samples, beams) as the sonar sends it: ping after ping, of each sample its 16 channels."""
    pings = image.shape[1] // 16
    came = [
        image[sample, CHANNEL_BEAM[channel] * pings + ping]
        for ping in range(pings)
        for sample in range(len(image))
        for channel in range(16)
    ]
    return np.array(came, np.uint8).reshape(image.shape)


def didson_file(
    path: Path,
    images: list[np.ndarray],
    version: int,
    *,
    file: dict[str, Any] | None = None,
    **values: Any,
) -> Path:
    """A DIDSON recording; file: fields of its header, values: of every frame's."""
    samples, beams = images[0].shape
    file_size, frame_size = {3: (512, 256), 4: (1024, 1024)}[version]
    head = {"Version": SIGNATURE[version], "FrameCount": len(images), "FrameRate": 8,
            "HighResolution": 1, "NumRawBeams": beams, "SamplesPerChannel": samples,
            "SN": 100}  # fmt: skip
    data = packed(DDF_FILE, file_size, head | (file or {}))
    for k, image in enumerate(images):
        frame = {"FrameNumber": k, "Version": SIGNATURE[version], "Year": 2013, "Month": 6,
                 "Day": 14, "Hour": 8, "Minute": 21, "Second": k // 8,
                 "HSecond": 100 * (k % 8) // 8, "WindowStart": 3, "WindowLength": 1,
                 "SonarPan": 50.0, "SonarTilt": -20.0, "ConfigFlags": 1}  # fmt: skip
        data += packed(DIDSON_FRAME, frame_size, frame | values) + image.tobytes()
    path.write_bytes(data)
    return path


def oculus_ping(
    number: int,
    image: np.ndarray,
    *,
    version: int = 2,
    gains: np.ndarray | None = None,
    resolution_m: float = 1 / 64,
    bearings: np.ndarray | None = None,
    message: int = 0x23,
) -> bytes:
    """A simple ping result; image: (ranges, beams), beams from left to right.

    gains: (ranges,) uint32, sent before each row. bearings: (beams,) hundredths of a degree.
    """
    ranges, beams = image.shape
    bearings = np.linspace(-3000, 3000, beams).astype("<i2") if bearings is None else bearings
    rows = image.view(np.uint8).reshape(ranges, -1)
    if gains is not None:
        rows = np.hstack([gains.astype("<u4").view(np.uint8).reshape(ranges, 4), rows])
    data = rows.tobytes()
    flags = 1 | 8 | (2 if image.itemsize == 2 else 0) | (4 if gains is not None else 0)
    fire = struct.pack("<5B4d", 2, 0, 25, 127, flags, ranges * resolution_m, 50.0, 0.0, 0.0)
    water = struct.pack("<2I3d", number, 0, 2.1e6, 11.5, 1.75)
    speed, start = 1490.0, 100.0 + number / 8
    kind = {1: 0, 2: 1, 4: 3}[image.itemsize]
    about = struct.pack("<BdHH", kind, resolution_m, ranges, beams)
    if version == 2:
        fire += bytes(36)
        water += struct.pack("<5d", 30.0, -20.0, 1.0, speed, start)
        about += bytes(16)
    else:
        water += struct.pack("<dI", speed, number * 62_500_000)
    head_size = 16 + len(fire) + len(water) + len(about) + 12
    offset = head_size + 2 * beams + 6  # a gap, as real pings have
    about += struct.pack("<3I", offset, len(data), offset + len(data))
    body = fire + water + about + bearings.astype("<i2").tobytes() + b"\x55" * 6 + data
    return oculus_message(message, body, version)


def oculus_file(path: Path, images: list[np.ndarray], **how: Any) -> Path:
    """Pings one after another. how: of oculus_ping."""
    path.write_bytes(b"".join(oculus_ping(k, image, **how) for k, image in enumerate(images)))
    return path


def oculus_message(message: int, body: bytes, version: int = 2) -> bytes:
    """A message of the sonar, or to it."""
    return struct.pack("<5HIH", 0x4F53, 7892, 0, message, version, len(body), 0) + body


def oculus_log(
    messages: list[bytes], *, compressed: bool = False, encryption: int = 0, first_s: float = 1.7e9
) -> bytes:
    """An `.oculus` log of messages, eight a second, and a record of another kind between them."""
    data = struct.pack("<2I16sHH4xqd", 0x11223344, 48, b"Oculus", 1, encryption, 0, first_s)
    for k, message in enumerate(messages):
        payload = message
        if compressed:
            payload = struct.pack(">I", len(message)) + zlib.compress(message)
        data += _item(10, first_s + k / 8, int(compressed), len(message), payload)
        data += _item(500, first_s + k / 8, 0, 9, b"something")
    return data


def _item(kind: int, time_s: float, compression: int, size: int, payload: bytes) -> bytes:
    return struct.pack(
        "<2I2H4xdH2x2I4x", 0xAABBCCDD, 40, kind, 1, time_s, compression, size, len(payload)
    ) + payload  # fmt: skip


GEMINI_START_S = 1_390_000_000.0
"""Of a log, in seconds since 1980."""


def gemini_record(
    number: int,
    image: np.ndarray,
    *,
    version: int = 3,
    compression: int = 0,
    device: int = 1194,
    bearings: np.ndarray | None = None,
    first_bin: int = 0,
    bins_hz: int = 46_560,
    speed: float = 1490.0,
    upside_down: bool = False,
    zoomed: bool = False,
) -> bytes:
    """A record of one image: (ranges, beams), eight a second.

    bearings: (beams,) radians, by default from -.5 to .5. compression: 0 zlib, 1 none, 2 H.264;
    without a field of its own before version 3.
    """
    ranges, beams = image.shape
    table = np.linspace(-0.5, 0.5, beams) if bearings is None else bearings
    samples = image.tobytes() if compression else zlib.compress(image.tobytes())
    body = struct.pack("<2H", 1, 0xEFEF)
    body += struct.pack("<HIIHII", version, first_bin, first_bin + ranges, 0, 0, beams)
    body += struct.pack("<H", compression) if version >= 3 else b""
    body += struct.pack("<I", len(samples)) + samples + table.astype("<f8").tobytes()
    state = 0x2000 if upside_down else 0
    sent_s = GEMINI_START_S + number / 8 - 0.03125
    body += struct.pack("<IIfdHfh", state, bins_hz, 120.0, sent_s, 0x100, speed, 57)
    body += struct.pack("<3B?", 1, 2, 4, zoomed)
    body += struct.pack("<HdH", 7, 2.0, 0xDEDE) if zoomed else struct.pack("<H", 0xDEDE)
    return gemini_message(0, body, number, device)


def gemini_message(kind: int, body: bytes, number: int = 0, device: int = 1194) -> bytes:
    """Any record of a Gemini's log."""
    time_s = GEMINI_START_S + number / 8
    return struct.pack("<cBIdB3H", b"*", 1, 21 + len(body), time_s, kind, device, 0, 0) + body


GEMINI_STATUS = gemini_message(3, bytes(218))


def gemini_log(path: Path, records: list[bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    """A `.glf` of records; not compressed again, as those of the maker."""
    level = 0 if method == zipfile.ZIP_DEFLATED else None
    with zipfile.ZipFile(path, "w", method, compresslevel=level) as archive:
        archive.writestr("log_2024.cfg", "<log><logHeader></logHeader></log>")
        archive.writestr("data_2024.dat", b"".join(records) + b"\xde\xde")
    return path


def gemini_file(path: Path, images: list[np.ndarray], **how: Any) -> Path:
    """A `.glf` of these images. how: of gemini_record."""
    return gemini_log(path, [gemini_record(k, image, **how) for k, image in enumerate(images)])
