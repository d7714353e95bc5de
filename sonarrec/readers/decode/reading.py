"""How the frames of one log are read: `settle` finds it from the first ones, `apply` follows it.

What pixels hold (grey.py) and where they lie (layout.py) is decided once, so that the scale stays
the same over a log. A few things may show later, and make another Reading: the colours after grey
frames, a type of pixels that did not come before, and the window of a ping.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from sonarrec.arrays import ByteImage
from sonarrec.readers.decode.colour import LUMINANCE
from sonarrec.readers.decode.grey import Levels, first_levels, grey_of
from sonarrec.readers.decode.height import height_from_images
from sonarrec.readers.decode.layout import Layout, Stated, agree, arranged
from sonarrec.readers.raw import StoredFrame, UnusableError
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.stated import Sonar


@dataclass(frozen=True, slots=True)
class Reading:
    """What is known of a log."""

    stated: Stated
    levels: Levels
    layout: Layout | None = None
    """None before the first usable frame."""

    @property
    def sonar(self) -> Sonar:
        """The geometry; for polar pings that of the ping that decided the fan."""
        return self.stated.sonar if self.layout is None else self.layout.sonar

    @property
    def fan(self) -> Fan | None:
        """The geometry of the fan images."""
        return None if self.layout is None else self.layout.fan

    def as_table(self) -> dict[str, Any]:
        """What was decided, for run.toml: keys of the geometry."""
        table: dict[str, Any] = {}
        if self.levels.colour_map != LUMINANCE:
            table["colour_map"] = self.levels.colour_map
        for scale in [*self.levels.scales.values()][:1]:
            table |= scale.as_table()
        return table


def settle(stated: Stated, first: Sequence[StoredFrame]) -> Reading:
    """How a log is read, from its first frames. The fan is that of the ping with which most pings
    agree. It need not be the first, since a driver may send one before it has its settings. A
    height that nobody states is estimated. Raises SonarrecError if the geometry does not fit."""
    first = [frame for frame in first if frame.has_content] or first
    reading = Reading(stated, first_levels(stated, first))
    pings = [(f, f.ping) for f in first if f.ping is not None and f.pixels is not None]
    if pings:
        usual, _ = max(pings, key=lambda ping: sum(agree(ping[1], other) for _, other in pings))
        with suppress(UnusableError):
            reading, _ = apply(reading, usual)
    images = []
    for frame in first:
        with suppress(UnusableError):
            reading, image = apply(reading, frame)
            polar = None if reading.layout is None else reading.layout.polar
            if stated.sonar.height_m is None and image.any():
                images.append(image if polar is None else polar(image))
    if (layout := reading.layout) is None or not images:
        return reading
    if layout.polar is not None:
        layout.polar.free()  # a run makes no more fan images
    fan = replace(layout.fan, height_m=height_from_images(images, layout.fan))
    return replace(reading, layout=replace(layout, fan=fan))


def apply(reading: Reading, frame: StoredFrame) -> tuple[Reading, ByteImage]:
    """(the reading, equal unless the frame shows something new; the frame's grey pixels, in the
    reading's fan). Raises UnusableError if the frame cannot be used, SonarrecError
    if the geometry does not fit the log."""
    if frame.pixels is None:
        raise UnusableError(str(frame.problem))
    levels, image = grey_of(reading.levels, frame, frame.pixels, reading.stated)
    layout, image = arranged(reading.layout, image, frame.ping, reading.stated)
    return Reading(reading.stated, levels, layout), image
