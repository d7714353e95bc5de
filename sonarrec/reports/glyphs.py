"""The drawing of a landmark, for pages."""

from __future__ import annotations

import numpy as np

from sonarrec.landmarks import DrawnSet, LandmarkSet


def glyph(landmarks: LandmarkSet, k: int) -> str:
    """A path that draws the k-th landmark, seen from above at orientation 0, on a 100 x 100 sheet.

    To be filled by the even-odd rule.
    """
    if isinstance(landmarks, DrawnSet):
        drawing = landmarks.drawings()[k]
        side = 98 / len(drawing)
        square = f"h{side:g}v{side:g}h{-side:g}z"
        cells = np.argwhere(drawing).tolist()
        return "".join(f"M{1 + c * side:g} {1 + r * side:g}{square}" for r, c in cells)
    ring = "".join(
        f"M{50 - r:g} 50a{r:g} {r:g} 0 1 0 {2 * r:g} 0a{r:g} {r:g} 0 1 0 {-2 * r:g} 0z"
        for r in (49 * share for share in landmarks.ring)
    )
    inner, outer = (49 * share for share in landmarks.symbol)
    sectors, path = landmarks.sectors[k], ring
    for n in range(2 * len(sectors)):
        if sectors[n // 2]:  # in halves: an arc from a point to itself would be no arc
            angle = np.array([n, n + 1, n + 1, n]) * np.pi / len(sectors)
            radius = np.array([outer, outer, inner, inner])
            x, y = 50 + radius * np.cos(angle), 50 - radius * np.sin(angle)
            a, b, c, d = (f"{px:.1f} {py:.1f}" for px, py in zip(x, y, strict=True))
            path += f"M{a}A{outer:.1f} {outer:.1f} 0 0 0 {b}"
            path += f"L{c}A{inner:.1f} {inner:.1f} 0 0 1 {d}z"
    return path
