"""What the headers of DIDSON files (DDF_03, DDF_04) mean, as far as it is public.

The maker has published no description. Offsets, codes and the lens are those on which free readers
agree; they go back to the maker's own Matlab scripts. A note tells the user where readers disagree.
"""

from __future__ import annotations

from datetime import UTC, datetime

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
from sonarrec.sonar import PingGeometry, Sonar

FILE_HEADER = {
    "FrameCount": (4, "<u4"),
    "FrameRate": (8, "<u4"),
    "HighResolution": (12, "<u4"),
    "NumBeams": (16, "<u4"),
    "SamplesPerBeam": (24, "<u4"),
    "Reverse": (40, "<u4"),
    "SerialNumber": (44, "<u4"),
}
FRAME_HEADER = {
    **{
        name: (20 + 4 * place, "<u4")
        for place, name in enumerate(
            ("Year", "Month", "Day", "Hour", "Minute", "Second", "Hundredth", "Transmit",
             "WindowStart", "WindowLength", "Threshold", "Intensity", "ReceiverGain")
        )
    },
    "Depth": (128, "<f4"),
    "Altitude": (132, "<f4"),
    **COMPASS,  # of the rotator, if there is no compass
    "ConfigFlags": (192, "<u4"),
}  # fmt: skip
HEADER_BYTES = {3: (512, 256), 4: (1024, 1024)}
"""Of the file and of a frame, by version."""

_SAMPLES = 512  # of a beam, if the header states none
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


def lens_bearings_deg(beams: int) -> np.ndarray:
    """(beams,) bearings of the beams' middles, from left to right. beams: 96, or 48 pairs."""
    bearing = np.arange(-30, 30, 0.001)
    width = 96 / beams
    middles = (np.arange(beams) + 0.5) * width + 0.5
    bearings = np.interp(middles, 1 + np.polyval(LENS, bearing), bearing)
    return np.asarray(np.round(bearings, 4))


class Didson:
    """DDF_03 or DDF_04, with the methods of `Aris`."""

    name = "DIDSON"

    def __init__(self, version: int) -> None:
        """version: 3 or 4."""
        file_bytes, frame_bytes = HEADER_BYTES[version]
        self.file_header = header_dtype(FILE_HEADER, file_bytes)
        self.frame_header = header_dtype(FRAME_HEADER, frame_bytes)

    def shape(self, file: np.void, frame: np.void | None) -> tuple[int, int]:  # noqa: ARG002
        """(samples, beams), from the header of the file alone."""
        return int(file["SamplesPerBeam"]) or _SAMPLES, int(file["NumBeams"])

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
        bearings = lens_bearings_deg(beams)
        if not file["Reverse"]:  # the first beam is the right-most, as with ARIS
            bearings = bearings[::-1]
        far = near + WINDOW_M[flags][length + (2 if low else 0)]
        beam_width = None if flags & _LONG_RANGE else BEAM_WIDTH_DEG["low" if low else "high"]
        return PingGeometry(
            near, far, tuple(bearings.tolist()), None, "range-major", beam_width_deg=beam_width
        )

    def pixels(self, frame: np.void, samples: np.ndarray) -> np.ndarray:  # noqa: ARG002
        """The samples as stored."""
        return samples

    def times(self, frame: np.void) -> tuple[int | None, int | None]:
        """(the sonar's date and time, None). The file states no time zone; UTC is assumed."""
        parts = [int(frame[name]) for name in list(FRAME_HEADER)[:6]]
        try:
            whole = datetime(*parts, tzinfo=UTC)  # type: ignore[misc, arg-type]
        except (ValueError, OverflowError):
            return None, None  # the form of the computer's time is not known
        stamp = int(whole.timestamp()) * 10**9 + min(int(frame["Hundredth"]), 99) * 10**7
        # A clock that was never set, or counts years from 2000, is not used.
        return (stamp if 0 <= stamp < 2**63 else None), None

    def header_info(
        self, file: np.void, frames: list[np.void], diagnostics: Diagnostics
    ) -> HeaderInfo:
        """Tilt and frame rate; everything else for `info`."""
        frame = frames[0]
        tilt = attitude_of(frames, None, diagnostics)
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
            "sonar": f"{kind}, {windows} windows, serial {file['SerialNumber']}",
            "frequency": "high" if file["HighResolution"] else "low",
            "frame_rate_hz": rate or None,
            "receiver_gain_db": int(frame["ReceiverGain"]),
            "depth_m": measured(frame["Depth"]),
            "altitude_m": measured(frame["Altitude"]),
            **compass(frame),
        }
        known_rate = float(rate) if 0 < rate < 1000 else None
        return HeaderInfo(Sonar(tilt_deg=tilt, frame_rate_hz=known_rate), values)
