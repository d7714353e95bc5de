"""What may be wrong with a landmark set: IDs hard to distinguish, beams too wide for it."""

from __future__ import annotations

from collections.abc import Iterator

from sonarrec.drawing.landmarks import HALF_POWER, Distance
from sonarrec.errors import Advice
from sonarrec.landmarks import WIDEST_SIGMA, DrawnSet, LandmarkSet

# Shares of a symbol's area. As drawn: if two IDs differ in less, one bad sector makes one ID of the
# other. As seen: of simulated IDs that differ in a twelfth, nearly all were distinguished with .05
# left by the beams, and one in five with .02.
NEAR, NEAR_SEEN = 1 / 8, 0.04
# The same of plates. AcTag24h10 has .20, AcTag24h4 .08, as drawn.
PLATES_NEAR, PLATES_NEAR_SEEN = 0.06, 0.03


LEAST_RING = 0.6  # outer radius of a ring, in disc radii; without one round it a disc has no edge


def of_ring(landmarks: LandmarkSet) -> Iterator[str]:
    """Whether the ring of a set is so small that its radii may be in metres."""
    outer = landmarks.ring[1]
    if not isinstance(landmarks, DrawnSet) and outer < LEAST_RING:
        yield (
            f"the ring of {landmarks.name} ends at {outer:g} of radius_m; ring and symbol are "
            f"shares of the radius: if they are in metres, divide them by {landmarks.radius_m:g}"
        )


def of_landmarks(landmarks: LandmarkSet, beam_m: float, near: list[Distance]) -> Iterator[Advice]:
    """On what makes a set hard to recognise. beam_m, near: of and from `distances`."""
    yield from map(Advice, of_ring(landmarks))
    of_what, least, least_seen = "an eighth of their symbol", NEAR, NEAR_SEEN
    if isinstance(landmarks, DrawnSet):
        of_what, least, least_seen = "6% of their cells", PLATES_NEAR, PLATES_NEAR_SEEN
        share = HALF_POWER * WIDEST_SIGMA * landmarks.radius_m / max(beam_m, 1e-9)
        if share < 1:
            yield Advice(
                f"beams are {1000 * beam_m:.0f} mm wide there, too wide for the plates: no ID is "
                f"read beyond {share:.2f} of this range"
            )
    close = [d for d in near if d.drawn < least]
    blurred = [d for d in near if d.seen < least_seen and d.drawn >= least]
    for similar, how in (
        (close, f"differ in less than {of_what}"),
        (blurred, "look alike through the beams"),
    ):
        pairs = ", ".join(f"{d.ids[0]} and {d.ids[1]}" for d in similar[:3])
        more = f" and {len(similar) - 3} more pairs" if len(similar) > 3 else ""
        if similar:
            yield Advice(f"IDs {pairs}{more} {how}")
