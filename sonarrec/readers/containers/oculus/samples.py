"""The geometry and the samples of a ping, in Oculus files and in MCAP messages of its drivers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.readers.raw import UnusableError, ping_geometry
from sonarrec.sonar import PingGeometry


def oculus_geometry(
    hundredths: FloatArray, resolution_m: float, bins: int, beams: int
) -> PingGeometry:
    """The geometry of a ping whose bins are `resolution_m` long and begin at the sonar.

    hundredths: (beams,) bearings in hundredths of a degree. Raises UnusableError if the numbers are
    impossible.
    """
    if len(hundredths) != beams:
        raise UnusableError(f"{beams} beams with {len(hundredths)} bearings")
    if not 0 < resolution_m < math.inf:
        raise UnusableError(f"range resolution {resolution_m:g} m")
    ranges = (np.arange(bins) + 0.5) * resolution_m
    # The pixels come as the rows of an image, so their order is known.
    return replace(ping_geometry(ranges, hundredths / 100), beam_order="range-major")


def oculus_samples(
    data: bytes | memoryview, bins: int, beams: int, size: int, *, gains: bool, step: int = 0
) -> np.ndarray:
    """The (bins, beams) samples of a ping, unsigned integers of `size` bytes.

    step: bytes from row to row; those beyond a row's own are skipped. gains: whether each row
    begins with its gain, 4 bytes; then its samples are divided by the gain's root, as float32.
    Raises UnusableError if the numbers do not fit the data.
    """
    if size not in (1, 2, 4):
        raise UnusableError(f"samples of {size} bytes")
    head = 4 if gains else 0
    row = head + beams * size
    step = max(step, row)
    if not bins or not beams or len(data) != bins * step:
        raise UnusableError(f"{beams} beams of {bins} samples do not fit {len(data)} bytes")
    rows = np.frombuffer(data, np.uint8).reshape(bins, step)
    pixels = np.ascontiguousarray(rows[:, head:row]).view(f"<u{size}")
    if head:
        gain = np.ascontiguousarray(rows[:, :head]).view("<u4")
        pixels = (pixels / np.sqrt(np.maximum(gain, 1))).astype(np.float32)
    return pixels
