"""The one place where pixels become the 8-bit grey of recognition, on a logarithmic scale.

| pixels | `pixel_scale` | `full_scale`, which becomes 255 |
|---|---|---|
| 8 bit | linear: sonars compress before they store so few bits; but log if the speckle of the
  first frames is that of amplitudes (`holds_amplitudes`) | 255; log: by the first frame |
| 16 bit | linear, but log if the first frame would be almost black, or if the speckle is that of
  amplitudes | 65535; log: by the first frame |
| floating-point images within 0 to 1 | linear | 1 |
| floating-point, most negative | db: decibels | by the first frame |
| 32 and 64 bit, all other floating-point | log: echo amplitudes | by the first frame |

`linear` is 255 v / full_scale, `log` 255 (1 + 20 log10(v / full_scale) / dynamic_range_db), `db`
255 (1 + (v - full_scale) / dynamic_range_db), each clipped to 0 to 255. These are the defaults;
keys of the geometry override them. The maxval of a PGM is used in place of 255 and 65535. "By the
first frame": such that the median of its echoes becomes a third of the range; this median is floor
speckle, whatever bright things lie on the floor. Later frames do not change the scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, quantile
from sonarrec.errors import SonarrecError
from sonarrec.readers.decode.colour import (
    LUMINANCE,
    distance,
    find_map,
    is_coloured,
    map_levels,
    strays,
)
from sonarrec.readers.decode.layout import Stated
from sonarrec.readers.raw import StoredFrame, UnusableError
from sonarrec.sonar.stated import Sonar

DYNAMIC_RANGE_DB = 50.0
# Floating-point values from here down are no echo in decibels, but mark pixels without data, as
# -9999 and -32768 do.
NO_DATA = -500.0
_MEDIAN_AT = 1 / 3  # of the range, for floor speckle: high enough for shadows to show
_MOSTLY = 0.5  # share of pixels; single ones decide nothing
_STRAY = 0.01  # share of pixels out of bounds that are a fault
_EVERY = 8  # row and column counts for a picture's mean level
_DISTINCT = 30  # levels between a picture's mean and that of the reversed one; else either may be
_NEXT_TO_BLACK = 1 / 32  # of full scale: no compressed image has its median below

# For `holds_amplitudes`: rows and columns of a block, which blocks are used, and the sum of slope
# and skew above which pixels are amplitudes. In simulated pictures (77 of tuning and model seeds)
# this sum is at most .94 for logarithms, and at least 1.05 for 95 of 100 pictures of amplitudes;
# the others show a floor in relief without speckle.
_BLOCK = (16, 4)
_MOST_BLACK, _LEAST_LEVEL, _LEAST_SPREAD, _LEAST_BLOCKS = 0.2, 4.0, 0.5, 50
_DIM, _LEAST_SPECKLE = 1 / 8, 0.2  # of full scale; spread over level
_LEAST_RANGE = 0.12  # standard deviation of the logarithm of levels
_AMPLITUDES = 1.0

Scale = Literal["linear", "log", "db"]


@dataclass(frozen=True, slots=True)
class GreyScale:
    """How the pixels of one log become grey; see the module."""

    pixel_scale: Scale
    full_scale: float
    dynamic_range_db: float
    bounded: bool = False
    """Whether finite pixels below 0 or above full_scale are a fault, not black or white."""

    def as_table(self) -> dict[str, Any]:
        """The keys of the geometry that state this scale."""
        keys = ["pixel_scale", "full_scale", "dynamic_range_db"]
        return {key: getattr(self, key) for key in keys[: 2 if self.pixel_scale == "linear" else 3]}


def single_channel(pixels: np.ndarray, colour_map: str = LUMINANCE) -> np.ndarray:
    """(rows, columns) in this machine's byte order, of a StoredFrame's pixels. 8-bit colours become
    the levels of the colour map. Other colours, and all with LUMINANCE, become grey by OpenCV's
    weights (.299 R + .587 G + .114 B, without alpha). Floating-point pixels of NO_DATA and below
    become NaN. Raises UnusableError for other pixels."""
    if pixels.dtype.kind not in "uif" or pixels.dtype == np.float16:
        raise UnusableError(f"{pixels.dtype} pixels are not supported")
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    if pixels.dtype == np.float64:
        with np.errstate(over="ignore"):  # values beyond 32 bits become infinite, which is white
            pixels = pixels.astype(np.float32)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    if pixels.ndim == 3 and pixels.shape[2] in (3, 4):
        if pixels.dtype not in (np.uint8, np.uint16, np.float32):
            raise UnusableError(f"{pixels.dtype} colour pixels are not supported")
        if colour_map != LUMINANCE and pixels.dtype == np.uint8:
            return map_levels(pixels, colour_map)
        code = cv2.COLOR_BGR2GRAY if pixels.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        pixels = cv2.cvtColor(np.ascontiguousarray(pixels), code)
    if pixels.ndim != 2 or not pixels.size:
        raise UnusableError(f"an image of shape {pixels.shape} is not supported")
    if pixels.dtype.kind == "f" and (no_data := pixels <= NO_DATA).any():
        return np.where(no_data, np.float32(np.nan), pixels)
    return np.asarray(pixels)


def grey_scale(
    sonar: Sonar, pixels: np.ndarray, amplitudes: bool, white: int | None = None
) -> GreyScale | None:
    """The scale of a log by its first frame, as far as `sonar` does not state it. pixels: from
    single_channel. amplitudes: whether they are known to be echo amplitudes; then floating-point
    values within 0 to 1 are too. white: of its file. Returns None if the frame is blank, since it
    is black on any scale. Raises SonarrecError for an invalid full scale."""
    values = pixels[np.isfinite(pixels)]
    if not values.any():
        return None
    floating = pixels.dtype.kind == "f"
    decibels = floating and below_zero(values) > _MOSTLY
    unit = floating and not amplitudes and not decibels and values.max() <= 1
    largest = 1.0 if unit else None
    if not floating and pixels.itemsize <= 2:
        largest = float(white or np.iinfo(pixels.dtype).max)
    scale: Scale = sonar.pixel_scale or "linear"
    if sonar.pixel_scale is None:
        if largest is None:
            scale = "db" if decibels else "log"
        elif (amplitudes and not floating) or (
            values.itemsize == 2 and next_to_black(values, largest)
        ):
            scale = "log"
    span = sonar.dynamic_range_db or DYNAMIC_RANGE_DB
    if sonar.full_scale is not None:
        if sonar.full_scale <= 0 and scale != "db":
            raise SonarrecError(
                f"full_scale = {sonar.full_scale:g} must be above 0 ({scale} scale)"
            )
        return GreyScale(scale, sonar.full_scale, span)
    if scale == "linear":
        full = float(values.max()) if largest is None else largest
        return GreyScale(scale, full, span, bounded=unit and values.min() >= 0)
    above = (1 - _MEDIAN_AT) * span
    if scale == "db":
        return GreyScale(scale, float(np.median(values)) + above, span)
    echoes = values[values > 0]
    if not echoes.size:
        return None
    return GreyScale(scale, float(np.median(echoes) * 10 ** (above / 20)), span)


def below_zero(values: np.ndarray) -> float:
    """The share of pixels below 0, of those that are not 0 and finite."""
    values = values[np.isfinite(values) & (values != 0)]
    return float(np.mean(values < 0)) if values.size else 0.0


def _middle(values: np.ndarray) -> float:
    """The median without zeros."""
    return float(np.median(values[values != 0]))


def next_to_black(pixels: np.ndarray, white: float | None) -> bool:
    """Whether 16-bit integers, not all 0, are so dark that they are read as log."""
    return _middle(pixels) < _NEXT_TO_BLACK * (white or np.iinfo(pixels.dtype).max)


def dim_level(pixels: np.ndarray, white: int | None) -> str | None:
    """How dim 16-bit integers, not all 0, would be as linear grey; None if not dim."""
    middle, full = _middle(pixels), white or np.iinfo(pixels.dtype).max
    return f"median {middle:.0f} of {full}" if middle < _DIM * full else None


def holds_amplitudes(images: Sequence[np.ndarray]) -> bool:
    """Whether images of integers hold echo amplitudes rather than their logarithm, by speckle.

    images: from single_channel, all of 8 or all of 16 bits; 16-bit ones must not be next to black.
    In amplitudes the spread of speckle is proportional to its level, and peaks reach farther than
    troughs; in logarithms the spread is even, and troughs reach farther. An 8-bit picture that is
    so dim that distant echoes are next to black is taken for amplitudes too: if it holds
    logarithms, little is lost. Measured in small blocks; False if too few show speckle.
    """
    # The content may fill only a small part of 16 bits: its brightest pixel counts as white.
    deep = bool(images) and images[0].dtype != np.uint8
    white = np.float32(max(image.max() for image in images)) if deep else None
    parts = [_speckle(image, white) for image in images]
    level, spread, skews = np.concatenate([np.empty((3, 0), np.float32), *parts], axis=1)
    if len(level) < _LEAST_BLOCKS:
        return False
    dim = not deep and quantile(level, 0.5) < _DIM * 256
    if dim and quantile(spread / level, 0.5) > _LEAST_SPECKLE:
        return True
    if np.log(level).std() < _LEAST_RANGE:  # levels too similar to find a slope
        return False
    slope = np.polyfit(np.log(level), np.log(spread), 1)[0]  # 1 of amplitudes, 0 of logarithms
    return bool(slope + quantile(skews, 0.5) > _AMPLITUDES)


def _speckle(image: np.ndarray, white: np.float32 | None) -> FloatArray:
    """(3, n) level, spread and skew of an image's blocks, without those that show no speckle.
    white: what counts as 255; None: 255 itself."""
    rows, columns = _BLOCK
    down, across = image.shape[0] // rows, image.shape[1] // columns
    blocks = image[: down * rows, : across * columns].reshape(down, rows, across, columns)
    block = blocks.swapaxes(1, 2).reshape(-1, rows * columns).astype(np.float32)
    if white is not None:
        block = block * 255 / white
    level, spread = block.mean(axis=1), block.std(axis=1)
    # Black has no speckle, and clipping at either end changes it.
    usable = ((block == 0).mean(axis=1) < _MOST_BLACK) & (block.max(axis=1) < 255)
    usable &= (level > _LEAST_LEVEL) & (spread > _LEAST_SPREAD)
    block, level, spread = block[usable], level[usable], spread[usable]
    off = (block - level[:, None]) / spread[:, None]
    skew = (off * off * off).mean(axis=1)  # ** 3 takes twenty times as long
    return np.stack([level, spread, skew])


def to_grey8(pixels: np.ndarray, scale: GreyScale) -> ByteImage:
    """(rows, columns) uint8, from the pixels of single_channel; NaN (no data) becomes 0. Raises
    UnusableError if pixels are out of bounds."""
    full = scale.full_scale
    if scale.pixel_scale == "linear":
        if pixels.dtype == np.uint8 and full == 255:
            return np.ascontiguousarray(pixels)
        if pixels.dtype == np.uint16:
            return _rounded(np.ascontiguousarray(pixels), 255 / full)
    values = np.nan_to_num(pixels.astype(np.float32), nan=0.0, posinf=np.inf, neginf=-np.inf)
    # Infinities are allowed, because `grey_scale` uses finite values only.
    out_of_bounds = ((values < 0) | (values > full)) & np.isfinite(values) if scale.bounded else 0
    if np.mean(out_of_bounds) > _STRAY:
        raise UnusableError(
            f"floating-point pixels must lie in 0 to {full:g}, as in the first frame"
        )
    if scale.pixel_scale == "log":
        decibels = np.log10(np.maximum(values, np.finfo(np.float32).tiny)) * np.float32(20)
        values = decibels - np.float32(20 * np.log10(full)) + np.float32(scale.dynamic_range_db)
    elif scale.pixel_scale == "db":
        no_data = np.isnan(pixels)
        values = values - np.float32(full - scale.dynamic_range_db)
        values[no_data] = 0
    white = full if scale.pixel_scale == "linear" else scale.dynamic_range_db
    return _rounded(np.clip(values, 0, np.float32(white)), 255 / white)


def _rounded(values: np.ndarray, factor: float) -> ByteImage:
    return np.asarray(cv2.convertScaleAbs(values, alpha=factor), np.uint8)


# What the first frames of one log decide, and later ones follow


@dataclass(frozen=True, slots=True)
class Levels:
    """How pixels become grey."""

    colour_map: str
    in_colour: bool = False
    """Whether a frame was, and its map was looked for."""
    off: float | None = None
    """The distance of colours from the map in the first frame."""
    strayed: bool = False
    """Whether a note was made that colours are of another map."""
    amplitudes: frozenset[np.dtype[Any]] = frozenset()
    """Types of integers that hold them."""
    scales: Mapping[np.dtype[Any], GreyScale] = field(default_factory=dict)
    """By type of pixels, each from its first usable frame."""
    usual: float | None = None
    """The mean grey level of echoes in the first frame that shows something."""
    is_reversed: bool = False
    """Whether a note was made that a frame is reversed."""


def first_levels(stated: Stated, first: Sequence[StoredFrame]) -> Levels:
    """What the first frames hold; notes name the colour map, and the types that hold amplitudes or
    are dim."""
    sonar, levels = stated.sonar, Levels(stated.sonar.colour_map or LUMINANCE)
    pictures = [f.pixels for f in first if f.pixels is not None and _in_colour(f.pixels)]
    if pictures and not sonar.colour_map:
        levels = _of_map(levels, pictures, stated)
    if sonar.pixel_scale is not None:
        return levels
    deep = [f.pixels for f in first if f.pixels is not None and f.pixels.dtype != np.uint8]
    if deep and all(map(_within_8_bits, deep)):
        stated.note(
            f"{deep[0].dtype} pixels hold 0 to 255 alone, and are read as amplitudes; if they are "
            'grey levels, write pixel_scale = "linear", full_scale = 255 in sonar.toml'
        )
    floating = [(f, f.pixels) for f in first if f.pixels is not None and f.pixels.dtype.kind == "f"]
    if floating:  # what most of them hold, echoes in decibels or others, decides the scale
        negative = [below_zero(pixels) > _MOSTLY for _, pixels in floating]
        usual = negative.index(2 * sum(negative) > len(negative))
        with suppress(UnusableError):
            levels, _ = grey_of(levels, *floating[usual], stated)
        return levels
    images: dict[np.dtype[Any], list[np.ndarray]] = {}
    for frame in first:
        if (grey := _grey_of_integers(frame, levels.colour_map)) is not None:
            images.setdefault(grey.dtype, []).append(grey)
    white = next((frame.white for frame in first if frame.white), None)
    for dtype, of_type in images.items():
        bits = 8 * dtype.itemsize
        dim = dim_level(of_type[0], white) if bits == 16 and sonar.full_scale is None else None
        if holds_amplitudes(of_type):
            levels = replace(levels, amplitudes=levels.amplitudes | {dtype})
            stated.note(
                f"{bits}-bit pixels read as amplitudes, since their speckle is that of "
                "amplitudes; --pixel-scale linear if they are logarithms"
            )
        elif dim:
            stated.note(
                f"{bits}-bit pixels read as grey levels, though dim ({dim}); --pixel-scale log if "
                "they are amplitudes, or a lower full_scale in sonar.toml"
            )
    return levels


def grey_of(
    levels: Levels, frame: StoredFrame, pixels: np.ndarray, stated: Stated
) -> tuple[Levels, ByteImage]:
    """(the levels, completed by what the frame is the first to show; its grey image)."""
    colour_map = levels.colour_map
    if not stated.sonar.colour_map and not levels.in_colour and _in_colour(pixels):
        since = f"begin at {frame.name} after grey frames, and are "
        levels = _of_map(levels, [pixels], stated, since)
        colour_map = levels.colour_map
    elif levels.in_colour and colour_map != LUMINANCE and not _in_colour(pixels):
        colour_map = LUMINANCE  # a grey frame among others
    elif levels.in_colour and not levels.strayed and colour_map != LUMINANCE:
        if levels.off is None:
            levels = replace(levels, off=distance(pixels, colour_map))
        elif strays(pixels, colour_map, levels.off):
            levels = replace(levels, strayed=True)
            stated.note(
                f"from {frame.name} on colours are not of the map {colour_map}, by which they are "
                "read; if the map was changed, run each part as a log of its own"
            )
    grey = single_channel(pixels, colour_map)
    scale = levels.scales.get(grey.dtype)
    if scale is None:
        of_ping = frame.ping is not None and grey.dtype.kind == "f"
        amplitudes = of_ping or grey.dtype in levels.amplitudes
        scale = grey_scale(stated.sonar, grey, amplitudes, frame.white)
        if scale is None:  # a blank frame decides nothing
            return levels, np.zeros(grey.shape, np.uint8)
        below = below_zero(grey)
        if grey.dtype.kind == "f" and below and stated.sonar.pixel_scale is None:
            kinds = {"db": "decibels", "log": "amplitudes", "linear": "grey levels"}
            stated.note(
                f"{below:.2%} of the pixels are below 0; all are read as "
                f"{kinds[scale.pixel_scale]}; --pixel-scale states another scale"
            )
        levels = replace(levels, scales={**levels.scales, grey.dtype: scale})
    image = to_grey8(grey, scale)
    if not (levels.is_reversed or levels.strayed):
        levels = _of_level(levels, image, frame.name, stated)
    return levels, image


def _of_level(levels: Levels, image: ByteImage, name: str, stated: Stated) -> Levels:
    """With the usual level. A note tells of a frame nearer to 255 less this, as a reversed one."""
    some = image[::_EVERY, ::_EVERY]
    if not (some := some[some > 0]).size:
        return levels
    level = float(some.mean())
    if levels.usual is None:
        return replace(levels, usual=level)
    if (
        255 - 2 * levels.usual < _DISTINCT
        or 255 - levels.usual - level >= (level - levels.usual) / 4
    ):
        return levels
    stated.note(
        f"{name} is as bright as a reversed picture (mean level {level:.0f}, in the first frame "
        f"{levels.usual:.0f}); if it is one, run each part as a log of its own"
    )
    return replace(levels, is_reversed=True)


def _of_map(
    levels: Levels, pictures: Sequence[np.ndarray], stated: Stated, since: str = ""
) -> Levels:
    """With the colour map of pictures, which a note names. since: the frame, if not the first."""
    name = find_map(pictures) or LUMINANCE
    how = f"read as levels of the colour map {name}"
    if name == LUMINANCE:
        how = "of no known colour map, and read by their luminance"
    stated.note(f"colours {since}{how}; colour_map in sonar.toml states another")
    return replace(levels, colour_map=name, in_colour=True)


def _within_8_bits(pixels: np.ndarray) -> bool:
    """Whether deeper pixels hold nothing but 0 to 255, and more than a few of these."""
    return bool(
        pixels.dtype.kind in "uif"
        and _DISTINCT < pixels.max(initial=0) <= 255
        and pixels.min(initial=0) == 0
        and (pixels == np.rint(pixels)).all()
    )


def _in_colour(pixels: np.ndarray) -> bool:
    """Whether these are 8-bit pixels with several channels that are not all grey."""
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    return pixels.dtype == np.uint8 and channels in (3, 4) and is_coloured(pixels)


def _grey_of_integers(frame: StoredFrame, colour_map: str) -> np.ndarray | None:
    """The grey levels of integer pixels, whose speckle tells what they hold; None for others."""
    pixels = frame.pixels
    if pixels is not None and pixels.dtype.kind in "ui" and pixels.itemsize <= 2:
        with suppress(UnusableError):
            grey = single_channel(pixels, colour_map)
            deep = grey.itemsize == 2 and grey.any() and not next_to_black(grey, frame.white)
            if grey.dtype == np.uint8 or deep:
                return grey
    return None
