"""What the headers of all DDF files have in common."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

MAX_TILT_CHANGE_DEG = 5.0
COMPASS = {
    "CompassHeading": (160, "<f4"),
    "CompassPitch": (164, "<f4"),
    "CompassRoll": (168, "<f4"),
}
"""Where the compass lies in the header of a frame, of every version."""


def header_dtype(fields: dict[str, tuple[int, str]], size: int) -> np.dtype[Any]:
    """A header of `size` bytes of which only these fields are read: name, offset and type."""
    return np.dtype(
        {
            "names": list(fields),
            "offsets": [offset for offset, _ in fields.values()],
            "formats": [kind for _, kind in fields.values()],
            "itemsize": size,
        }
    )


def measured(value: float) -> float | None:
    """A float of a header as few digits tell it; None where it is none."""
    return float(f"{float(value):.7g}") + 0.0 if math.isfinite(value) else None


def compass(frame: np.void) -> dict[str, float | None]:
    """Heading, pitch and roll for `info`; None, all three, where no compass has written."""
    angles = {name: measured(frame[name]) for name in COMPASS}
    is_set = any(angles.values())
    return {
        f"compass_{name.removeprefix('Compass').lower()}_deg": angle if is_set else None
        for name, angle in angles.items()
    }


def attitude_of(frames: Sequence[np.void], rotator: str | None) -> tuple[float | None, list[str]]:
    """The tilt (deg, downward) by a file's headers, None where they tell none, and notes on it.

    frames: headers of frames all over the file. rotator: the field of the rotator's tilt. The
    median of the compass's pitch is taken, without a compass that of the rotator's tilt; both are
    taken to be positive upward.
    """
    readings = {"compass pitch": [compass(frame)["compass_pitch_deg"] for frame in frames]}
    if rotator is not None:  # zeros where there is none
        readings["rotator tilt"] = [measured(frame[rotator]) or None for frame in frames]
    for name, angles in readings.items():
        tilts = [-angle for angle in angles if angle is not None and abs(angle) < 90]
        if not tilts:
            continue
        tilt = float(f"{np.median(tilts):.4g}") + 0.0  # no negative zero
        if tilt < 0:
            return None, [f"its headers say that the sonar looks {-tilt:g} deg upward ({name})"]
        if max(tilts) - min(tilts) > MAX_TILT_CHANGE_DEG:
            text = f"its tilt is between {min(tilts):.3g} and {max(tilts):.3g} deg ({name})"
            return tilt, [f"{text}; the median, {tilt:g} deg, serves for all frames"]
        return tilt, []
    return None, []
