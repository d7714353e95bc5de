"""Finds the colour map in which a viewer or driver drew pictures, and converts them to grey.

Their luminance will not do: in these maps it does not rise with the level, or not in proportion. In
`jet` the strongest echoes are as dark as the weakest.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray

# OpenCV's; matplotlib has most of them too. Ramps of one hue are left out: their luminance is good
# enough.
MAPS = {
    "hot": cv2.COLORMAP_HOT,
    "inferno": cv2.COLORMAP_INFERNO,
    "jet": cv2.COLORMAP_JET,
    "magma": cv2.COLORMAP_MAGMA,
    "ocean": cv2.COLORMAP_OCEAN,
    "parula": cv2.COLORMAP_PARULA,
    "plasma": cv2.COLORMAP_PLASMA,
    "rainbow": cv2.COLORMAP_RAINBOW,
    "turbo": cv2.COLORMAP_TURBO,
    "viridis": cv2.COLORMAP_VIRIDIS,
}
EXCHANGED = "_bgr"
"""Behind the name of a map whose red and blue were exchanged as the picture was written."""
LUMINANCE = "luminance"
"""In place of a colour map: grey by OpenCV's weights of red, green and blue."""

# In levels, 0 to 255 in each channel:
_COLOURED = 16  # a pixel is not grey if its channels differ by more
_BLACK = 24  # a pixel is black, as outside of a fan in any map, if all channels are below
# Mean distance from a map's nearest colour: of pictures with no more colours than a map has, and of
# those whose neighbours JPEG, video or another size mixed. True maps: 1.5, and 21 in strong JPEG.
_MOST_COLOURS, _NEAR, _NEAR_IF_MIXED = 300, 4.0, 22.0
_CLEARLY = 0.85  # of the next map's distance
# Mean level; sonar pictures have 60 to 120, those in a map's reverse the rest to 255.
_BRIGHT = 150.0
_LEAST_COLOURED = 0.1  # share of the pixels of a picture that is not grey
_SAMPLED = 2000  # pixels of each picture
_BITS = 6  # of each channel, in the table of colours


def is_coloured(pixels: np.ndarray) -> bool:
    """Whether (rows, columns, 3 or more) uint8 BGR pixels are not those of a grey picture."""
    some = _sample(pixels)
    return bool(len(some) and np.mean(np.ptp(some, axis=1) > _COLOURED) > _LEAST_COLOURED)


def distance(pixels: np.ndarray, name: str) -> float:
    """Mean distance, in levels, of a picture's colours from a map."""
    nearest = np.sqrt(_squared(_colours(name), _sample(pixels)[::10]).min(axis=1), dtype=float)
    return float(nearest.mean()) if len(nearest) else 0.0


def strays(pixels: np.ndarray, name: str, usual: float) -> bool:
    """Whether colours are not of the map by which they are read. usual: their distance from it in
    pictures that are. Far from the map they are of none, and nearer perhaps of another: the colours
    of rainbow are those of jet, but for a few, in reverse."""
    off = distance(pixels, name)
    if off <= 1.5 * usual + 1:
        return False
    return off > 1.5 * _NEAR_IF_MIXED or find_map([pixels]) not in (None, name)


def find_map(images: Sequence[np.ndarray]) -> str | None:
    """The colour map of a log's first images; None if it is not one of MAPS. images: (rows,
    columns, 3 or more) uint8, BGR. Their colours must be nearer to the map than to any straight
    line, such as a ramp of one hue, or to any other map, also with red and blue exchanged. In a
    reversed map they would be bright as those of no sonar are."""
    colours = np.concatenate([_sample(image) for image in images])
    if not len(colours):
        return None
    is_mixed = len(np.unique(colours, axis=0)) > _MOST_COLOURS
    tables = {name: _colours(name) for name in MAPS}
    # Jet exchanged is jet reversed.
    exchanged = {name + EXCHANGED: tables[name][:, ::-1] for name in MAPS if name != "jet"}
    squared = {name: _squared(table, colours) for name, table in (tables | exchanged).items()}
    off = {name: np.sqrt(s.min(axis=1), dtype=float).mean() for name, s in squared.items()}
    nearest, second = sorted(off, key=lambda name: off[name])[:2]
    centred = colours - colours.mean(axis=0)
    along = np.linalg.svd(centred[:_SAMPLED].astype(float), full_matrices=False)[2][0]
    off_line = np.linalg.norm(centred - np.outer(centred @ along, along), axis=1).mean()
    most = min(_NEAR_IF_MIXED if is_mixed else _NEAR, off_line, _CLEARLY * off[second])
    if off[nearest] > most:
        return None
    if squared[nearest].argmin(axis=1).mean() <= _BRIGHT:
        return nearest
    return nearest + EXCHANGED if nearest == "jet" else None


def map_levels(pixels: np.ndarray, name: str) -> ByteImage:
    """(rows, columns) uint8: the level of each BGR pixel's nearest colour in a map; 0 if black."""
    down = 8 - _BITS
    blue, green, red = (pixels[:, :, k].astype(np.int32) >> down for k in range(3))
    return np.asarray(_levels(name)[(blue << 2 * _BITS) | (green << _BITS) | red])


def _sample(image: np.ndarray) -> np.ndarray:
    """(n, 3) about _SAMPLED pixels of an image, evenly spread, without the black ones."""
    colours = image[:, :, :3].reshape(-1, 3)
    colours = colours[:: max(1, len(colours) // _SAMPLED)].astype(np.int16)
    return np.asarray(colours[colours.max(axis=1) >= _BLACK])


def _colours(name: str) -> FloatArray:
    """(256, 3) BGR of a map's levels."""
    levels = np.arange(256, dtype=np.uint8)[:, None]
    colours = cv2.applyColorMap(levels, MAPS[name.removesuffix(EXCHANGED)])[:, 0]
    return np.asarray(colours[:, ::-1] if name.endswith(EXCHANGED) else colours, float)


def _squared(table: FloatArray, colours: np.ndarray) -> np.ndarray:
    """(n, 256) float32: squared distances of (n, 3) colours from the (256, 3) colours of a map.
    Colours are multiples of a half, so these are multiples of a quarter, below 2**18: float32 holds
    them exactly, and is twice as fast."""
    colours, table = colours.astype(np.float32), table.astype(np.float32)
    squared = colours @ (-2 * table.T)
    for rows, shape in ((table, (1, -1)), (colours, (-1, 1))):
        squared += np.einsum("nc,nc->n", rows, rows).reshape(shape)
    return np.asarray(squared)


@cache
def _levels(name: str) -> ByteImage:
    """(2**18,) uint8: the level of every colour, by the upper bits of blue, green and red."""
    table, step = _colours(name), 2 ** (8 - _BITS)
    middles = np.arange(2**_BITS) * step + (step - 1) / 2
    green, red = (a.ravel() for a in np.meshgrid(middles, middles, indexing="ij"))
    planes = []
    for blue in middles:  # one at a time, or distances would take half a gigabyte
        colours = np.stack([np.full_like(green, blue), green, red], axis=1)
        level = _squared(table, colours).argmin(axis=1)
        planes.append(np.where(colours.max(axis=1) < _BLACK, 0, level))
    return np.concatenate(planes).astype(np.uint8)
