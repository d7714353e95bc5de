"""What the headers of DDF files mean: ARIS (DDF_05) and DIDSON (DDF_03, DDF_04).

ARIS by the maker's description (aris-file-sdk, MIT): samples are 0 to 80 dB over 0 to 255, taken as
grey; ranges are computed from the times of the samples and the sound speed, because the window in
metres of the description assumes 1450 m/s.

For DIDSON the maker has published no description. Offsets, codes and the lens are those on which
free readers agree; they go back to the maker's own Matlab scripts. A note tells the user where
readers disagree.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from sonarrec.errors import Diagnostics
from sonarrec.readers.raw import HeaderInfo, PingGeometry, UnusableError
from sonarrec.sonar.stated import MIN_WINDOW_M, Sonar

MAX_TILT_CHANGE_DEG = 5.0
FULL_SCALE_DB = 80  # of ARIS

# Offset and type of each field, by its name in ARIS's description; the first four are everywhere.
_EVERY_FRAME = {
    "ReceiverGain": (68, "<u4"),
    "Depth": (128, "<f4"),
    "Altitude": (132, "<f4"),
    "CompassHeading": (160, "<f4"),  # of DIDSON's rotator, if there is no compass
    "CompassPitch": (164, "<f4"),
    "CompassRoll": (168, "<f4"),
}
FILE_HEADER = {
    "FrameCount": (4, "<u4"),
    "FrameRate": (8, "<u4"),  # the next two of DIDSON
    "HighResolution": (12, "<u4"),
    "NumRawBeams": (16, "<u4"),
    "SamplesPerChannel": (24, "<u4"),
    "Reverse": (40, "<u4"),
    "SN": (44, "<u4"),  # of DIDSON
}
FRAME_HEADER = _EVERY_FRAME | {
    "FrameTime": (4, "<u8"),  # of the recording computer, microseconds
    "sonarTimeStamp": (20, "<u8"),
    "WaterTemp": (224, "<f4"),
    "SonarPan": (244, "<f4"),
    "SonarTilt": (248, "<f4"),
    "SonarRoll": (252, "<f4"),
    "PingMode": (436, "<u4"),
    "FrequencyHiLow": (440, "<u4"),
    "SamplePeriod": (452, "<u4"),  # microseconds
    "FrameRate": (460, "<f4"),  # Hz, though the description says microseconds
    "SoundSpeed": (464, "<f4"),
    "SamplesPerBeam": (468, "<u4"),
    "SampleStartDelay": (476, "<u4"),  # microseconds
    "LargeLens": (480, "<u4"),
    "TheSystemType": (484, "<u4"),
    "SonarSerialNumber": (488, "<u4"),
    "ReorderedSamples": (516, "<u4"),
    "Salinity": (520, "<u4"),
}
_CLOCK = ("Year", "Month", "Day", "Hour", "Minute", "Second", "Hundredth")
_DIDSON_FRAME = _EVERY_FRAME | {
    **{name: (20 + 4 * n, "<u4") for n, name in enumerate(_CLOCK)},
    "WindowStart": (52, "<u4"),
    "WindowLength": (56, "<u4"),
    "ConfigFlags": (192, "<u4"),
}

SYSTEMS = {0: "ARIS 1800", 1: "ARIS 3000", 2: "ARIS 1200"}
BEAMS = {
    **dict.fromkeys((1, 2), 48),
    **dict.fromkeys((3, 4, 5), 96),
    **dict.fromkeys((6, 7, 8), 64),
    **dict.fromkeys((9, 10, 11, 12), 128),
}
"""Of ARIS, by ping mode."""
PINGS_PER_FRAME = {1: 3, 3: 6, 6: 4, 9: 8}
"""By ping mode. Each ping of a frame records 16 beams: every third, sixth, ... one."""
CHANNELS = (10, 2, 14, 6, 8, 0, 12, 4, 11, 3, 15, 7, 9, 1, 13, 5)
"""The position of each channel among the 16 beams of its ping."""

_SAMPLES = 512  # of a DIDSON's beam, if the header states none
_CLASSIC, _LONG_RANGE, _FLAGS = 1, 2, 3  # bits of ConfigFlags
WINDOW_M = {
    0: (1.25, 2.5, 5, 10, 20, 40),
    _CLASSIC: (1.125, 2.25, 4.5, 9, 18, 36),
    _LONG_RANGE: (2.5, 5, 10, 20, 40, 70),
    _CLASSIC | _LONG_RANGE: (2.25, 4.5, 9, 18, 36, 72),
}
"""Lengths of the window, by the bits of ConfigFlags. Codes 0 to 3 stand for the first four lengths
at high frequency, for the last four at low."""
START_M = {0: 0.419, _CLASSIC: 0.375}
"""Step of the window's start at high frequency; at low frequency it is twice this."""
# By the maker, for the standard sonar: soundmetrics.com/SONAR101/resolution.html.
BEAM_WIDTH_DEG = {"high": 0.3, "low": 0.4}
# Of 96 beams from left to right: beam number = 1 + this polynomial of the bearing in deg.
LENS = (0.0030, -0.0055, 2.6829, 48.04)


@cache
def bearings_deg() -> dict[tuple[int, bool], tuple[float, ...]]:
    """Of ARIS's beams, positive to the right, by their number and whether the telephoto lens is
    on."""
    text = resources.files(__package__).joinpath("aris_beams.csv").read_text(encoding="utf-8")
    rows = csv.reader(line for line in text.splitlines() if not line.startswith("#"))
    return {
        (int(beams), lens == "telephoto"): tuple(-float(bearing) for bearing in bearings)
        for beams, lens, *bearings in rows
    }


def lens_bearings_deg(beams: int) -> np.ndarray:
    """(beams,) bearings of a DIDSON's beams' middles, from left to right. beams: 96, or 48
    pairs."""
    bearing = np.arange(-30, 30, 0.001)
    middles = (np.arange(beams) + 0.5) * (96 / beams) + 0.5
    bearings = np.interp(middles, 1 + np.polyval(LENS, bearing), bearing)
    return np.asarray(np.round(bearings, 4))


def _dtype(fields: Mapping[str, tuple[int, str]], size: int) -> np.dtype[Any]:
    """The dtype of a header of `size` bytes. fields: (offset, type) of those that are read."""
    offsets, formats = zip(*fields.values(), strict=True)
    return np.dtype(
        {"names": list(fields), "offsets": offsets, "formats": formats, "itemsize": size}
    )


class Aris:
    """DDF_05. A header is one `np.void` of the dtype file_header or frame_header."""

    name = "ARIS"
    file_header, frame_header = _dtype(FILE_HEADER, 1024), _dtype(FRAME_HEADER, 1024)

    def shape(self, file: np.void, frame: np.void | None) -> tuple[int, int]:
        """(samples, beams) of every frame. frame: the first one's header, if there is one."""
        if frame is None:
            return int(file["SamplesPerChannel"]), int(file["NumRawBeams"])
        return int(frame["SamplesPerBeam"]), BEAMS.get(int(frame["PingMode"]), 0)

    def geometry(self, file: np.void, frame: np.void, shape: tuple[int, int]) -> PingGeometry:  # noqa: ARG002
        """The window from times and sound speed, the bearings from the table of the lens. Raises
        UnusableError if it is impossible."""
        samples, beams = shape
        speed = float(frame["SoundSpeed"])
        if not 1000 <= speed <= 2000:
            raise UnusableError(f"a sound speed of {speed:g} m/s")
        m_per_us = speed / 2 * 1e-6
        start = int(frame["SampleStartDelay"]) * m_per_us
        end = start + int(frame["SamplePeriod"]) * samples * m_per_us
        if end - start < MIN_WINDOW_M or end > 1000:
            raise UnusableError(f"a window of {start:g} to {end:g} m")
        bearings = bearings_deg().get((beams, bool(frame["LargeLens"])))
        if bearings is None:
            raise UnusableError(f"there is no table of {beams} beams behind a telephoto lens")
        return PingGeometry(start, end, bearings, None, "range-major")

    def pixels(self, frame: np.void, samples: np.ndarray) -> np.ndarray:
        """(samples, beams) uint8 in the order of the beams; the sonar may have sorted them. Raises
        UnusableError if the order is unknown."""
        if frame["ReorderedSamples"]:
            return samples
        mode = int(frame["PingMode"])
        pings = PINGS_PER_FRAME.get(mode)
        if pings is None:
            raise UnusableError(
                f"its beams are not in order, and the order of ping mode {mode} is not public"
            )
        # Stored ping after ping, with 16 channels each.
        came = samples.reshape(pings, len(samples), len(CHANNELS))
        ordered = np.empty((len(samples), len(CHANNELS), pings), samples.dtype)
        ordered[:, list(CHANNELS)] = came.transpose(1, 2, 0)
        return ordered.reshape(len(samples), -1)

    def times(self, frame: np.void) -> tuple[int | None, int | None]:
        """(the computer's time, the sonar's time), ns since 1970; None if zero or impossible."""
        computer, sonar = (
            us * 1000 if 0 < (us := int(frame[key])) < 2**53 else None
            for key in ("FrameTime", "sonarTimeStamp")
        )
        return computer, sonar

    def header_info(
        self, file: np.void, frames: Sequence[np.void], diagnostics: Diagnostics
    ) -> HeaderInfo:
        """Tilt and frame rate; everything else for `info`. frames: some from all over the file."""
        frame = frames[0]
        if file["Reverse"]:
            diagnostics.note(
                "its header says that the sonar lay upside down (lens up); if left and right are "
                "exchanged, use --flip"
            )
        rate = _measured(frame["FrameRate"])
        lens = ", telephoto lens" if frame["LargeLens"] else ""
        system = SYSTEMS.get(int(frame["TheSystemType"]), "ARIS")
        values = {
            "sonar": f"{system}{lens}, serial {frame['SonarSerialNumber']}",
            "ping_mode": int(frame["PingMode"]),
            "frequency": "high" if frame["FrequencyHiLow"] else "low",
            "beam_order": "stored in order" if frame["ReorderedSamples"] else "put in order",
            "frame_rate_hz": rate,
            "sound_speed_m_s": _measured(frame["SoundSpeed"]),
            "sample_start_us": int(frame["SampleStartDelay"]),
            "sample_period_us": int(frame["SamplePeriod"]),
            "sample_full_scale_db": FULL_SCALE_DB,
            "receiver_gain_db": int(frame["ReceiverGain"]),
            "water_temperature_c": _measured(frame["WaterTemp"]),
            "salinity_ppt": int(frame["Salinity"]),
            **_position(frame),
            "rotator_pan_deg": _measured(frame["SonarPan"]),
            "rotator_tilt_deg": _measured(frame["SonarTilt"]),
            "rotator_roll_deg": _measured(frame["SonarRoll"]),
        }
        sonar = _stated(_tilt(frames, "SonarTilt", diagnostics), rate)
        return HeaderInfo(sonar, values, sample_db=FULL_SCALE_DB / 255)


class Didson:
    """DDF_03 or DDF_04, with the methods of `Aris`."""

    name = "DIDSON"

    def __init__(self, file_bytes: int, frame_bytes: int) -> None:
        """The lengths of the headers."""
        self.file_header = _dtype(FILE_HEADER, file_bytes)
        self.frame_header = _dtype(_DIDSON_FRAME, frame_bytes)

    def shape(self, file: np.void, frame: np.void | None) -> tuple[int, int]:  # noqa: ARG002
        """From the header of the file alone."""
        return int(file["SamplesPerChannel"]) or _SAMPLES, int(file["NumRawBeams"])

    def geometry(self, file: np.void, frame: np.void, shape: tuple[int, int]) -> PingGeometry:
        """The window from its codes, the bearings from the standard lens."""
        beams = shape[1]
        if beams not in (48, 96):
            raise UnusableError(f"{beams} beams, not 48 or 96")
        flags, low = int(frame["ConfigFlags"]) & _FLAGS, not file["HighResolution"]
        start, length = int(frame["WindowStart"]), int(frame["WindowLength"])
        if start > 31 or length > 3:
            raise UnusableError(f"a window of codes {start} and {length}")
        near = start * START_M[flags & _CLASSIC] * (2 if low else 1)
        far = near + WINDOW_M[flags][length + (2 if low else 0)]
        bearings = lens_bearings_deg(beams)
        if not file["Reverse"]:  # the first beam is the right-most, as with ARIS
            bearings = bearings[::-1]
        width = None if flags & _LONG_RANGE else BEAM_WIDTH_DEG["low" if low else "high"]
        return PingGeometry(near, far, tuple(bearings.tolist()), None, "range-major", width)

    def pixels(self, frame: np.void, samples: np.ndarray) -> np.ndarray:  # noqa: ARG002
        """The samples as stored."""
        return samples

    def times(self, frame: np.void) -> tuple[int | None, int | None]:
        """(the sonar's date and time, None). The file states no time zone; UTC is assumed. The form
        of the computer's time is not known."""
        year, month, day, hour, minute, second, hundredth = (int(frame[n]) for n in _CLOCK)
        try:
            moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        except (ValueError, OverflowError):
            return None, None
        stamp = int(moment.timestamp()) * 10**9 + min(hundredth, 99) * 10**7
        # A clock that was never set, or counts years from 2000, is not used.
        return (stamp if 0 <= stamp < 2**63 else None), None

    def header_info(
        self, file: np.void, frames: Sequence[np.void], diagnostics: Diagnostics
    ) -> HeaderInfo:
        """As of `Aris`."""
        frame = frames[0]
        tilt = _tilt(frames, None, diagnostics)
        flags, rate = int(frame["ConfigFlags"]) & _FLAGS, int(file["FrameRate"])
        diagnostics.note(
            "no description of DIDSON files is public: window, bearings and times are read as "
            "other free programs read them (sonarrec help formats)"
        )
        if flags & _LONG_RANGE:
            diagnostics.note(
                "readers disagree on the windows of a long-range DIDSON: check the ranges"
            )
        kind = "DIDSON-LR" if flags & _LONG_RANGE else "DIDSON-S"
        windows = "classic" if flags & _CLASSIC else "extended"
        values = {
            "sonar": f"{kind}, {windows} windows, serial {file['SN']}",
            "frequency": "high" if file["HighResolution"] else "low",
            "frame_rate_hz": rate or None,
            "receiver_gain_db": int(frame["ReceiverGain"]),
            **_position(frame),
        }
        return HeaderInfo(_stated(tilt, rate), values)


LAYOUTS: dict[int, Didson | Aris] = {3: Didson(512, 256), 4: Didson(1024, 1024), 5: Aris()}
"""By version, which is the fourth byte of the file."""


def _measured(value: float) -> float | None:
    """A float of a header, without digits beyond its precision; None if it is not finite."""
    return float(f"{float(value):.7g}") + 0.0 if math.isfinite(value) else None


def _compass(frame: np.void) -> dict[str, float | None]:
    """Heading, pitch and roll; all None if no compass has written any of them."""
    angles = {n: _measured(frame[f"Compass{n.title()}"]) for n in ("heading", "pitch", "roll")}
    return angles if any(angles.values()) else dict.fromkeys(angles)


def _position(frame: np.void) -> dict[str, float | None]:
    """Depth, altitude and compass, for `info`."""
    values = {f"{key}_m": _measured(frame[key.title()]) for key in ("depth", "altitude")}
    return values | {f"compass_{key}_deg": angle for key, angle in _compass(frame).items()}


def _stated(tilt_deg: float | None, rate_hz: float | None) -> Sonar:
    known = rate_hz is not None and 0 < rate_hz < 1000
    return Sonar(tilt_deg=tilt_deg, frame_rate_hz=float(rate_hz) if known and rate_hz else None)


def _tilt(frames: Sequence[np.void], rotator: str | None, diagnostics: Diagnostics) -> float | None:
    """The tilt by a file's headers in deg, downward; None if not stated. frames: headers of frames
    from all over the file. rotator: name of the field with the rotator's tilt. It is the median of
    the compass's pitch or, without a compass, of the rotator's tilt; both are taken to be positive
    upward."""
    readings = {"compass pitch": [_compass(frame)["pitch"] for frame in frames]}
    if rotator is not None:  # zeros if there is no rotator
        readings["rotator tilt"] = [_measured(frame[rotator]) or None for frame in frames]
    for name, angles in readings.items():
        tilts = [-angle for angle in angles if angle is not None and abs(angle) < 90]
        if not tilts:
            continue
        tilt = float(f"{np.median(tilts):.4g}") + 0.0  # no negative zero
        if tilt < 0:
            diagnostics.note(f"its headers say that the sonar looks {-tilt:g} deg upward ({name})")
            return None
        if max(tilts) - min(tilts) > MAX_TILT_CHANGE_DEG:
            diagnostics.note(
                f"its tilt is between {min(tilts):.3g} and {max(tilts):.3g} deg ({name}); the "
                f"median, {tilt:g} deg, is used for all frames"
            )
        return tilt
    return None
