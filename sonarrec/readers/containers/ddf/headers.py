"""What the headers of all DDF files have in common."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sonarrec.errors import Diagnostics

MAX_TILT_CHANGE_DEG = 5.0
COMPASS = {
    "CompassHeading": (160, "<f4"),
    "CompassPitch": (164, "<f4"),
    "CompassRoll": (168, "<f4"),
}
"""Where the compass is in the header of a frame, in every version."""


def header_dtype(fields: dict[str, tuple[int, str]], size: int) -> np.dtype[Any]:
    """The dtype of a header of `size` bytes. fields: (offset, type) of those that are read."""
    return np.dtype(
        {
            "names": list(fields),
            "offsets": [offset for offset, _ in fields.values()],
            "formats": [kind for _, kind in fields.values()],
            "itemsize": size,
        }
    )


def measured(value: float) -> float | None:
    """A float of a header, without digits beyond its precision; None if it is not finite."""
    return float(f"{float(value):.7g}") + 0.0 if math.isfinite(value) else None


def compass(frame: np.void) -> dict[str, float | None]:
    """Heading, pitch and roll for `info`; all None if no compass has written any of them."""
    angles = {name: measured(frame[name]) for name in COMPASS}
    is_set = any(angles.values())
    return {
        f"compass_{name.removeprefix('Compass').lower()}_deg": angle if is_set else None
        for name, angle in angles.items()
    }


def attitude_of(
    frames: Sequence[np.void], rotator: str | None, diagnostics: Diagnostics
) -> float | None:
    """The tilt by a file's headers in deg, downward; None if not stated.

    frames: headers of frames from all over the file. rotator: name of the field with the rotator's
    tilt. It is the median of the compass's pitch or, without a compass, of the rotator's tilt; both
    are taken to be positive upward.
    """
    readings = {"compass pitch": [compass(frame)["compass_pitch_deg"] for frame in frames]}
    if rotator is not None:  # zeros if there is no rotator
        readings["rotator tilt"] = [measured(frame[rotator]) or None for frame in frames]
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
