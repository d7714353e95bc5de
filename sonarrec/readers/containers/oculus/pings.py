"""What each message of an Oculus means.

To add a message, write one function from its bytes to a Ping and its header, and add one row to
MESSAGES.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from sonarrec.readers.containers.oculus.samples import oculus_geometry, oculus_samples
from sonarrec.readers.raw import Ping, UnusableError

Header = dict[str, Any]
"""What a ping says about the sonar, by name and unit; None if the sonar did not measure it."""
Fields = list[tuple[str, str]]

_HEAD: Fields = [
    ("id", "<u2"), ("source", "<u2"), ("target", "<u2"), ("message", "<u2"), ("version", "<u2"),
    ("payload", "<u4"), ("part", "<u2"),
]  # fmt: skip
_FIRE: Fields = [  # what the sonar was asked for
    ("mode", "u1"), ("rate", "u1"), ("network", "u1"), ("gamma", "u1"), ("flags", "u1"),
    ("range", "<f8"), ("gain", "<f8"), ("sound_speed_asked", "<f8"), ("salinity", "<f8"),
]  # fmt: skip
_WATER: Fields = [
    ("ping", "<u4"), ("status", "<u4"), ("frequency", "<f8"), ("temperature", "<f8"),
    ("pressure", "<f8"),
]  # fmt: skip
_IMAGE: Fields = [("data_size", "u1"), ("resolution", "<f8"), ("ranges", "<u2"), ("beams", "<u2")]
_PLACE: Fields = [("offset", "<u4"), ("size", "<u4"), ("total", "<u4")]
# In the first version the start of a ping is a count of unknown unit.
_RESULT = np.dtype(
    [*_HEAD, *_FIRE, *_WATER, ("sound_speed", "<f8"), ("start", "<u4"), *_IMAGE, *_PLACE]
)
_RESULT_2 = np.dtype(
    [
        *_HEAD, *_FIRE, ("more_flags", "<u4"), ("reserved", "<u4", (8,)), *_WATER,
        ("heading", "<f8"), ("pitch", "<f8"), ("roll", "<f8"), ("sound_speed", "<f8"),
        ("start", "<f8"), *_IMAGE, ("spare", "<u4", (4,)), *_PLACE,
    ]
)  # fmt: skip
HEAD_TYPE = np.dtype(_HEAD)
"""How every message begins."""
MESSAGE_MARK = b"SO"
"""The first bytes of every message: its `id`."""
FULL_PING, SIMPLE_PING = 0x22, 0x23
KNOWN_MESSAGES = (0x15, FULL_PING, SIMPLE_PING, 0x55, 0x80, 0xFF)
"""The numbers of all messages; those without a name are fire, settings, logs and dummy."""
_BYTES_OF_SAMPLE = {0: 1, 1: 2, 3: 4}


def read_simple_ping(message: bytes) -> tuple[Ping, Header]:
    """OculusSimplePingResult, the first version: without a time."""
    return _ping(message, _RESULT)


def read_simple_ping_2(message: bytes) -> tuple[Ping, Header]:
    """OculusSimplePingResult2: with heading, pitch, roll, and seconds since switched on."""
    ping, header = _ping(message, _RESULT_2)
    fields = np.frombuffer(message, _RESULT_2, 1)[0]
    for key in ("heading", "pitch", "roll"):
        header[f"{key}_deg"] = _within(fields[key], -360, 360)
    start = _within(fields["start"], 0, 2**33)
    stamp = None if start is None else round(start * 1e9)
    return replace(ping, stamp_ns=stamp), header


MESSAGES: dict[tuple[int, int], Callable[[bytes], tuple[Ping, Header]]] = {
    (SIMPLE_PING, 0): read_simple_ping,  # as the first version's sonars send it
    (SIMPLE_PING, 1): read_simple_ping,
    (SIMPLE_PING, 2): read_simple_ping_2,
}
"""What reads a ping, by message number and version."""


def _ping(message: bytes, layout: np.dtype[Any]) -> tuple[Ping, Header]:
    """A ping and its header, without what only the second version has. Raises UnusableError."""
    if len(message) < layout.itemsize:
        raise UnusableError(f"a ping of {len(message)} bytes")
    fields = np.frombuffer(message, layout, 1)[0]
    bins, beams, offset = int(fields["ranges"]), int(fields["beams"]), int(fields["offset"])
    image = message[offset : offset + int(fields["size"])]
    if len(image) != fields["size"] or offset < layout.itemsize + 2 * beams:
        raise UnusableError(f"its image of {fields['size']} bytes from {offset} on lies outside")
    size = _BYTES_OF_SAMPLE.get(int(fields["data_size"]))
    if size is None:
        raise UnusableError(f"unknown sample type {fields['data_size']}")
    gains = len(image) == bins * (beams * size + 4)  # the flag that announces gains may be wrong
    hundredths = np.frombuffer(message, "<i2", beams, layout.itemsize).astype(float)
    geometry = oculus_geometry(hundredths, float(fields["resolution"]), bins, beams)
    pixels = oculus_samples(image, bins, beams, size, gains=gains)
    header: Header = {
        "sonar": f"Oculus, device {fields['source']}",
        "mode": {1: "low frequency", 2: "high frequency"}.get(int(fields["mode"])),
        "frequency_hz": _within(fields["frequency"], 1e4, 1e8),
        "sound_speed_m_s": _within(fields["sound_speed"], 1000, 2000),
        "range_resolution_m": float(fields["resolution"]),
        "range_asked_m": _within(fields["range"], 0, 1000) if fields["flags"] & 1 else None,
        "gain_percent": _within(fields["gain"], 0, 100),
        "gamma": _within(1.0 if fields["gamma"] in (0, 255) else fields["gamma"] / 254, 0, 1),
        "gains_sent": "yes" if gains else "no",
        "temperature_c": _within(fields["temperature"], -5, 60),
        "pressure_bar": _within(fields["pressure"], 1e-3, 1e4),
    }
    return Ping(pixels, sonar=geometry), header


def _within(value: float, low: float, high: float) -> float | None:
    """The value; None out of bounds, which is what happened to be in the sonar's memory."""
    leftover = 0 < abs(value) < 1e-9
    return float(f"{value:.7g}") if low <= value <= high and not leftover else None


def message_number(message: bytes) -> int | None:
    """The number of a message; None if these bytes are not a message."""
    if len(message) < HEAD_TYPE.itemsize or message[:2] != MESSAGE_MARK:
        return None
    return int(np.frombuffer(message, HEAD_TYPE, 1)[0]["message"])


def decoded(message: bytes) -> tuple[Ping, Header]:
    """The ping of a message, and its header. Raises UnusableError if it cannot be used."""
    head = np.frombuffer(message, HEAD_TYPE, 1)[0]
    parse = MESSAGES.get((int(head["message"]), int(head["version"])))
    if parse is None:
        raise UnusableError(f"a ping of version {head['version']}, which is not known")
    with np.errstate(all="ignore"):  # damaged numbers overflow; results are checked
        return parse(message)
