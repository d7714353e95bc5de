"""What the headers of ARIS files (DDF_05) mean, by the maker's description (aris-file-sdk, MIT).

Samples are 0 to 80 dB over 0 to 255, taken as grey. Ranges are computed from the times of the
samples and the sound speed, because the window in metres of the description assumes 1450 m/s.
"""

from __future__ import annotations

import csv
from functools import cache
from importlib import resources

import numpy as np

from sonarrec.errors import Diagnostics
from sonarrec.readers.containers.ddf.headers import (
    COMPASS,
    attitude_of,
    compass,
    header_dtype,
    measured,
)
from sonarrec.readers.raw import HeaderInfo, UnusableError
from sonarrec.sonar import MIN_WINDOW_M, PingGeometry, Sonar

_HEADER_BYTES = 1024
FULL_SCALE_DB = 80

FILE_HEADER = {
    "FrameCount": (4, "<u4"),
    "NumRawBeams": (16, "<u4"),
    "SamplesPerChannel": (24, "<u4"),
    "Reverse": (40, "<u4"),
}
FRAME_HEADER = {
    "FrameTime": (4, "<u8"),  # of the recording computer, microseconds
    "sonarTimeStamp": (20, "<u8"),
    "ReceiverGain": (68, "<u4"),
    "Depth": (128, "<f4"),
    "Altitude": (132, "<f4"),
    **COMPASS,
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
"""Offset and type of each field, by its name in the description."""

SYSTEMS = {0: "ARIS 1800", 1: "ARIS 3000", 2: "ARIS 1200"}
BEAMS = {
    **dict.fromkeys((1, 2), 48),
    **dict.fromkeys((3, 4, 5), 96),
    **dict.fromkeys((6, 7, 8), 64),
    **dict.fromkeys((9, 10, 11, 12), 128),
}
"""By ping mode."""
PINGS_PER_FRAME = {1: 3, 3: 6, 6: 4, 9: 8}
"""By ping mode. Each ping of a frame records 16 beams: every third, sixth, ... one."""
CHANNELS = (10, 2, 14, 6, 8, 0, 12, 4, 11, 3, 15, 7, 9, 1, 13, 5)
"""The place of each channel among the 16 beams of its ping."""


@cache
def bearings_deg() -> dict[tuple[int, bool], tuple[float, ...]]:
    """Of the beams, positive to the right, by their number and whether the telephoto lens is on."""
    text = resources.files(__package__).joinpath("aris_beams.csv").read_text(encoding="utf-8")
    rows = csv.reader(line for line in text.splitlines() if not line.startswith("#"))
    return {
        (int(beams), lens == "telephoto"): tuple(-float(bearing) for bearing in bearings)
        for beams, lens, *bearings in rows
    }


class Aris:
    """DDF_05.

    file_header, frame_header: structured dtypes, little-endian, as long as the headers. A header
    is one `np.void` of such a dtype.
    """

    name = "ARIS"
    file_header = header_dtype(FILE_HEADER, _HEADER_BYTES)
    frame_header = header_dtype(FRAME_HEADER, _HEADER_BYTES)

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
        length = int(frame["SamplePeriod"]) * samples * m_per_us
        if length < MIN_WINDOW_M or start + length > 1000:
            raise UnusableError(f"a window of {start:g} to {start + length:g} m")
        lens = bool(frame["LargeLens"])
        bearings = bearings_deg().get((beams, lens))
        if bearings is None:
            raise UnusableError(f"there is no table of {beams} beams behind a telephoto lens")
        return PingGeometry(start, start + length, bearings, None, "range-major")

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
        stored = samples.reshape(pings, len(samples), len(CHANNELS))
        ordered = np.empty((len(samples), len(CHANNELS), pings), samples.dtype)
        ordered[:, list(CHANNELS)] = stored.transpose(1, 2, 0)
        return ordered.reshape(len(samples), -1)

    def times(self, frame: np.void) -> tuple[int | None, int | None]:
        """(the computer's time, the sonar's time), ns since 1970; None if unknown."""
        return _nanoseconds(frame["FrameTime"]), _nanoseconds(frame["sonarTimeStamp"])

    def header_info(
        self, file: np.void, frames: list[np.void], diagnostics: Diagnostics
    ) -> HeaderInfo:
        """Tilt and frame rate; everything else for `info`. frames: some from all over the file."""
        frame = frames[0]
        tilt = attitude_of(frames, "SonarTilt", diagnostics)
        if file["Reverse"]:
            diagnostics.note(
                "its header says that the sonar lay upside down (lens up); if left and right are "
                "exchanged, use --flip"
            )
        rate = measured(frame["FrameRate"])
        lens = ", telephoto lens" if frame["LargeLens"] else ""
        system = SYSTEMS.get(int(frame["TheSystemType"]), "ARIS")
        values = {
            "sonar": f"{system}{lens}, serial {frame['SonarSerialNumber']}",
            "ping_mode": int(frame["PingMode"]),
            "frequency": "high" if frame["FrequencyHiLow"] else "low",
            "beam_order": "stored in order" if frame["ReorderedSamples"] else "put in order",
            "frame_rate_hz": rate,
            "sound_speed_m_s": measured(frame["SoundSpeed"]),
            "sample_start_us": int(frame["SampleStartDelay"]),
            "sample_period_us": int(frame["SamplePeriod"]),
            "sample_full_scale_db": FULL_SCALE_DB,
            "receiver_gain_db": int(frame["ReceiverGain"]),
            "water_temperature_c": measured(frame["WaterTemp"]),
            "salinity_ppt": int(frame["Salinity"]),
            "depth_m": measured(frame["Depth"]),
            "altitude_m": measured(frame["Altitude"]),
            **compass(frame),
            "rotator_pan_deg": measured(frame["SonarPan"]),
            "rotator_tilt_deg": measured(frame["SonarTilt"]),
            "rotator_roll_deg": measured(frame["SonarRoll"]),
        }
        rate = rate if rate is not None and 0 < rate < 1000 else None
        sonar = Sonar(tilt_deg=tilt, frame_rate_hz=rate)
        return HeaderInfo(sonar, values, sample_db=FULL_SCALE_DB / 255)


def _nanoseconds(microseconds: int) -> int | None:
    """Nanoseconds from microseconds; None for zero and for impossible times."""
    return int(microseconds) * 1000 if 0 < microseconds < 2**53 else None
