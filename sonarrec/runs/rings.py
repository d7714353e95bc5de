"""Whether the rings of the discs that a run follows lie where the landmark set states them.

The mean grey level round a disc, by distance from its middle, is compared with that of a symbol, a
gap, a ring and the floor, of any levels and smeared by any beam.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.drawing.pen import disc_outline
from sonarrec.geometry import polar_from_pixel
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Frame, FrameResult

EVERY = 3  # frames
HELD_BYTES = 2**24  # of frames that wait for their results
MOST, FEWEST = 60, 15  # profiles
SURE = 0.9  # existence
# Towards the sonar and away from it, where no beam smears the ring: sine of the angle round it.
ALONG = 0.7
RADII = np.linspace(0.3, 1.7, 57)  # as shares of the stated radius
FINE = np.linspace(0.0, 2.5, 501)
SMEARS = (0.03, 0.06, 0.1, 0.14)
# In 11 simulated and real recordings with the true set another scale or edge that is LEAST away
# leaves at least .85 of the misfit; with a radius 7 % off or an inner edge 10 % one of the two
# leaves .65 at most.
CLEARLY = 0.66
# Of objects of which none is declared: a stone in a river leaves .41.
VERY_CLEARLY = 0.4
LEAST_SCALE, LEAST_EDGE = 0.035, 0.045


class Rings:
    """Looks at some frames of a run and the objects in them."""

    def __init__(self, landmarks: LandmarkSet, method: str | None) -> None:
        """method: whose objects are looked at; None: no method's."""
        self._landmarks, self._method = landmarks, method
        self._held: dict[int, Frame] = {}
        self._profiles: list[FloatArray] = []
        self._declared = False

    def look(self, frame: Frame) -> None:
        """A frame, as it is read."""
        if self._method is None or frame.index % EVERY or len(self._profiles) >= MOST:
            return
        if (len(self._held) + 1) * frame.pixels.nbytes <= HELD_BYTES or not self._held:
            self._held[frame.index] = frame

    def add(self, result: FrameResult) -> None:
        """A result, in the frames' order."""
        frame = self._held.pop(result.index, None)
        self._declared |= any(e.declared and e.method == self._method for e in result.estimates)
        sure = [e for e in result.estimates if e.method == self._method and e.existence > SURE]
        if frame is None or not sure:
            return
        fan, polar = frame.fan, frame.polar
        for one in sure:
            # A disc's picture grows in proportion, but for a hundredth of its radius.
            outline = disc_outline(fan, self._landmarks.radius_m, one.x_px, one.y_px)
            angle = np.linspace(0, 2 * np.pi, len(outline), endpoint=False)
            middle = np.array([one.x_px, one.y_px])
            arms = outline[np.abs(np.sin(angle)) > ALONG] - middle
            points = np.moveaxis(middle + RADII[:, None, None] * arms, 2, 0)
            if polar is not None:
                points = np.stack(polar.pixel(*polar_from_pixel(fan, *points))[:2])
            column, row = np.rint(points).astype(int)
            rows, columns = frame.pixels.shape
            inside = row.clip(0, rows - 1), column.clip(0, columns - 1)
            profile = frame.pixels[inside].mean(axis=1)
            self._profiles.append((profile - profile.mean()) / max(profile.std(), 1e-6))

    def doubt(self) -> str | None:
        """What the rings say against the set; None if nothing, or too few were seen."""
        if len(self._profiles) < FEWEST:
            return None
        profile, stated = np.mean(self._profiles, axis=0), self._landmarks
        symbol, *ring = edges = (stated.symbol[1], *stated.ring)
        scales = np.arange(0.8, 1.25, 0.01)
        inner = np.arange(max(ring[0] - 0.25, 0.3), ring[1] - 0.04, 0.01)
        moved = [(min(symbol, a - 0.05), a, ring[1]) for a in inner]
        tried = np.concatenate([[edges], scales[:, None] * edges, moved])
        as_stated, *left = _misfits(profile, tried).tolist()
        misfit, scale = min(zip(left[: len(scales)], scales, strict=True))
        of_edges, edge = min(zip(left[len(scales) :], inner, strict=True))
        limit = as_stated * (CLEARLY if self._declared else VERY_CLEARLY)
        by_scale = abs(scale - 1) >= LEAST_SCALE and misfit < limit
        if not by_scale and not (abs(edge - ring[0]) >= LEAST_EDGE and of_edges < limit):
            return None
        return (
            f"the rings of its discs are not where {stated.name} states them: radius_m may be "
            f"about {scale * stated.radius_m:.3g}, not {stated.radius_m:g}, or the ring begin at "
            f"about {edge:.2f} of it, not {ring[0]:g}"
        )


@cache
def _nearer() -> FloatArray:
    """(smears, radii, 1 + FINE) how much of a profile's point comes from nearer than each edge."""
    kernels = np.exp(-0.5 * ((RADII[:, None] - FINE) / np.array(SMEARS)[:, None, None]) ** 2)
    nearer = np.cumsum(kernels / kernels.sum(axis=2, keepdims=True), axis=2)
    return np.pad(nearer, ((0, 0), (0, 0), (1, 0)))


def _misfits(profile: FloatArray, edges: FloatArray) -> FloatArray:
    """(n,) sums of squares that are left at the best levels and smear; infinite if no ring is
    bright. edges: (n, 3) where the symbol ends and the ring begins and ends."""
    ends = np.pad(np.searchsorted(FINE, edges), ((0, 0), (1, 1)), constant_values=(0, len(FINE)))
    bands = np.diff(np.moveaxis(_nearer()[:, :, ends], 2, 0), axis=3)  # (n, smears, radii, 4)
    across = bands.swapaxes(2, 3)
    # A band of no width has level 0.
    levels = np.linalg.solve(across @ bands + 1e-9 * np.eye(4), (across @ profile)[..., None])
    left = (((bands @ levels)[..., 0] - profile) ** 2).sum(axis=2)
    _, gap, ring, floor = np.moveaxis(levels[..., 0], 2, 0)
    return np.asarray(np.where(ring > np.maximum(gap, floor), left, np.inf).min(axis=1))
