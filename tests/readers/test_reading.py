"""How a log is read is decided once: `settle` and `apply` keep nothing between two calls."""

from __future__ import annotations

import numpy as np

from sonarrec.readers.decode.layout import Stated
from sonarrec.readers.decode.reading import apply, settle
from sonarrec.readers.raw import PingGeometry, StoredFrame
from sonarrec.sonar.stated import Sonar
from tests.support.messages import polar_frames

BEARINGS = tuple(np.linspace(-14, 14, polar_frames(1)[0].shape[1]).tolist())


def ping(name: str, image: np.ndarray, near_m: float = 1.0) -> StoredFrame:
    return StoredFrame(name, 0, image, ping=PingGeometry(near_m, near_m + 1, BEARINGS, None))


def test_apply_gives_the_same_for_the_same() -> None:
    """Also after other frames, of another window, of another type, or unlike all others."""
    notes: list[str] = []
    stated = Stated(Sonar(tilt_deg=20.0), "log", "messages", notes.append)
    images = polar_frames(3)
    first = [ping(str(n), image) for n, image in enumerate(images)]
    reading = settle(stated, first)
    assert reading.layout is not None
    assert settle(stated, first).levels == reading.levels
    before = [apply(reading, frame)[1] for frame in first]
    moved, shown = apply(reading, ping("moved", images[0], 1.25))
    assert moved.layout is not None
    assert moved.fan == reading.fan
    assert moved.layout.polar is not reading.layout.polar
    deep = images[0].astype(np.uint16) * 257
    assert set(apply(reading, ping("deep", deep))[0].levels.scales) == {
        np.dtype(np.uint8), np.dtype(np.uint16),
    }  # fmt: skip
    assert set(reading.levels.scales) == {np.dtype(np.uint8)}
    for frame, image in zip(first, before, strict=True):
        same, again = apply(reading, frame)
        assert same == reading
        np.testing.assert_array_equal(again, image)
    np.testing.assert_array_equal(shown, before[0])  # polar pixels are as they came
