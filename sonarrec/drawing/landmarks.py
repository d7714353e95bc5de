"""Whether the IDs of a landmark set can be told apart, and a picture of the set.

Seen through beams that are wide at the disc's distance, symbols differ less than as drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from heapq import nsmallest

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.drawing.plates import NEAR as NEAR_PLATES
from sonarrec.drawing.plates import NEAR_SEEN as NEAR_PLATES_SEEN
from sonarrec.drawing.plates import draw_pairs, draw_plates, plate_distances, plate_doubts
from sonarrec.landmarks import DrawnSet, LandmarkSet

GRID = 30  # cells across a disc
TURN_DEG = 5  # of one disc against the other; of both against the line of sight three times that
MOST_PAIRS = 12  # of the IDs most alike as drawn: views of an ID take some 3 ms
NEAR = 1 / 8  # of the symbol's area, as drawn; nearer, one bad sector makes one ID of the other
# As seen. Of simulated IDs a twelfth apart nearly all were told with .05 left by the beams, and one
# in five with .02.
NEAR_SEEN = 0.04
# Of simulated discs with rings of .03 of the radius, a third of a beam, as many are recognised as
# with .2; with .005 one in eleven is.
THINNEST_BEAMS, THINNEST_SHARE = 0.25, 0.02
DISC_PX, MOST_COLUMNS = 160, 6


@dataclass(frozen=True, slots=True)
class Distance:
    """How far two IDs are apart, at the rotation at which they differ least.

    drawn: share of the symbol's area in which they differ. seen: the same of what beams leave of
    it, the mean square of the difference.
    """

    ids: tuple[int, int]
    drawn: float
    seen: float


@lru_cache(maxsize=4)  # the logs of one run share it
def distances(landmarks: LandmarkSet, beam_m: float) -> list[Distance]:
    """The distances of all pairs of IDs, or of the MOST_PAIRS most alike, the nearest first.

    beam_m: width of a beam at the disc, between half-power points.
    """
    if isinstance(landmarks, DrawnSet):
        alike = plate_distances(landmarks, beam_m, MOST_PAIRS)
        ids = landmarks.ids
        return [Distance((ids[a], ids[b]), *shares.tolist()) for a, b, shares in alike]
    signs = np.where(np.asarray(landmarks.sectors, bool), 1.0, -1.0)
    count, spectra = signs.shape[1], np.fft.rfft(signs, axis=1)
    pairs: list[tuple[float, int, int]] = []
    for a, one in enumerate(spectra):
        # At every rotation at once: what agrees less what differs.
        agreement = np.fft.irfft(spectra[a + 1 :] * one.conj(), count, axis=1).max(axis=1)
        differ = np.round((count - agreement) / 2) / count
        pairs += [(float(share), a, a + 1 + n) for n, share in enumerate(differ)]
    nearest = nsmallest(MOST_PAIRS, pairs)
    smear = beam_m / landmarks.radius_m
    views = {
        k: _views(landmarks, k, smear) for k in sorted({k for _, *pair in nearest for k in pair})
    }
    inner, outer = landmarks.symbol
    cells = math.pi * (outer**2 - inner**2) / (2 / GRID) ** 2
    found = []
    for drawn, a, b in nearest:
        one, other = (
            views[a][: 180 // TURN_DEG : 3],
            views[b],
        )  # half a turn of both changes nothing
        squares = (one**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2 * one @ other.T
        least = max(float(squares.min()), 0.0)
        ids = landmarks.ids[a], landmarks.ids[b]
        found.append(Distance(ids, drawn, min(least / cells, drawn)))
    return sorted(found, key=lambda d: (d.seen, d.drawn))


def _views(landmarks: LandmarkSet, k: int, smear: float) -> FloatArray:
    """(360 / TURN_DEG, cells) a disc at every rotation, as beams show it. smear: width of a beam in
    disc radii, which lies across the line of sight."""
    across = (np.arange(3 * GRID) + 0.5) * 2 / GRID - 3  # wider than the disc, for what is smeared
    inside = across[GRID : 2 * GRID]
    beam = np.exp(-4 * math.log(2) * ((inside[:, None] - across) / max(smear, 1e-3)) ** 2)
    beam /= beam.sum(axis=1, keepdims=True)
    x, y = np.meshgrid(inside, inside)
    degree, radius = np.floor(np.degrees(np.arctan2(y, x))).astype(int), np.hypot(x, y)
    turn = np.arange(0, 360, TURN_DEG)[:, None, None]
    # Two rounds: the indices go from -535 to 179, and negative ones count from the end.
    drawn = landmarks.codes(np.radians(np.arange(720) + 0.5))[k, degree - turn]
    drawn *= (radius >= landmarks.symbol[0]) & (radius <= landmarks.symbol[1])
    drawn += (radius > landmarks.ring[0]) & (radius <= landmarks.ring[1])
    return np.asarray((drawn @ beam).astype(np.float32).reshape(len(turn), -1))


def doubts(landmarks: LandmarkSet, beam_m: float, near: list[Distance]) -> list[str]:
    """What makes a set hard to recognise, a few words each. near: from `distances`."""
    least, of_what, seen = NEAR, "an eighth of their symbol", NEAR_SEEN
    if isinstance(landmarks, DrawnSet):
        found = plate_doubts(landmarks, beam_m)
        least, of_what, seen = NEAR_PLATES, f"{NEAR_PLATES:.0%} of their cells", NEAR_PLATES_SEEN
    else:
        found = _doubts_of_discs(landmarks, beam_m)
    for alike, how in (
        ([d for d in near if d.drawn < least], f"differ in less than {of_what}"),
        (
            [d for d in near if d.seen < seen and d.drawn >= least],
            "look alike through the beams",
        ),
    ):
        pairs = ", ".join(f"{d.ids[0]} and {d.ids[1]}" for d in alike[:3])
        more = f" and {len(alike) - 3} more pairs" if len(alike) > 3 else ""
        found += [f"IDs {pairs}{more} {how}"] if alike else []
    return found


def _doubts_of_discs(landmarks: LandmarkSet, beam_m: float) -> list[str]:
    """What makes discs hard to recognise, whatever else there is in the set."""
    found = []
    width = landmarks.ring[1] - landmarks.ring[0]
    if width < THINNEST_SHARE:
        found.append(f"there is no ring to speak of: it is {width:.2g} of the radius wide")
    elif width * landmarks.radius_m < THINNEST_BEAMS * beam_m:
        found.append(
            f"the ring, {1000 * width * landmarks.radius_m:.0f} mm wide, is too thin for beams "
            f"that are {1000 * beam_m:.0f} mm wide there"
        )
    for number, code in zip(landmarks.ids, landmarks.sectors, strict=True):
        if len(set(code)) == 1:
            kind = "a filled disc" if code[0] else "a blank disc"
            found.append(f"ID {number} is {kind}, which other round things look like as well")
    return found


def draw_landmarks(landmarks: LandmarkSet, beam_m: float) -> ByteImage:
    """(rows, columns, 3) uint8 BGR: every disc as drawn, and below it as beams show it."""
    if isinstance(landmarks, DrawnSet):
        return draw_plates(landmarks, beam_m)
    points = (np.arange(2 * DISC_PX) + 0.5) / DISC_PX - 1
    x, y = np.meshgrid(points, -points)
    sigma = max(beam_m / landmarks.radius_m * DISC_PX / 2.355, 1e-3)
    pairs = []
    for k in range(len(landmarks.ids)):
        disc = (np.where(np.hypot(x, y) > 1, 0.15, 0.05) + 0.9 * landmarks.pattern(k, x, y)) * 255
        shown = np.clip(disc, 0, 255).astype(np.float32)
        seen = cv2.GaussianBlur(shown, (0, 0), sigmaX=sigma, sigmaY=1)
        size = (DISC_PX, DISC_PX)
        pairs.append([cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in (shown, seen)])
    return draw_pairs(landmarks.ids, pairs, MOST_COLUMNS)
