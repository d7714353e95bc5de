"""The share of a landmark in view, by the geometry alone: the `visible` of ground truth."""

from __future__ import annotations

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.geometry import floor_depth, ground_range, in_image, points_on_disc
from sonarrec.nouns import Fan

_POINTS = 500  # of a disc: shares are good to a hundredth
_BATCH = 2_000  # discs at a time, which bounds the memory


def share_in_image(
    fan: Fan, range_m: FloatArray, bearing_deg: FloatArray, radius_m: float
) -> FloatArray:
    """(N,) share, 0 to 1, of floor discs that the fan image shows.

    range_m: (N,) slant range of the centres; nearer than the floor counts as straight below the
    sonar, 0 or less as not shown. bearing_deg: (N,) positive to the right. radius_m: of every disc.
    """
    right, ahead = points_on_disc(radius_m, _POINTS)
    share = np.empty(len(range_m))
    for start in range(0, len(range_m), _BATCH):
        batch = slice(start, start + _BATCH)
        ground = np.nan_to_num(ground_range(fan, range_m[batch]))[:, None]
        bearing = np.radians(bearing_deg[batch])[:, None]
        across = ground * np.sin(bearing) + right
        along = ground * np.cos(bearing) + ahead
        slant = np.sqrt(across**2 + along**2 + floor_depth(fan) ** 2)
        share[batch] = in_image(fan, slant, np.degrees(np.arctan2(across, along))).mean(axis=1)
    share[range_m <= 0] = 0  # ranges are squared above, so negative ones would count
    return share
