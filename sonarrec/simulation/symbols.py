"""Symbols of fakes: patterns inside a ring that no ID of the landmark set has."""

from __future__ import annotations

import math

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, FloatArray
from sonarrec.landmarks import LandmarkSet

LEARNED_SYMBOLS = ("wedges", "blobs")
"""Kinds that the built-in model learns from: wedges of any width, and patches of any shape."""
OTHER_SYMBOLS = ("eighths", "foreign", "bar", "cross", "letter")
"""Kinds that the built-in model never learns from: wedges of 45 degrees; three, five or six
sectors; a bar; a cross; capital letters."""
LEAST_DIFFERENCE = 0.12
"""Share of the circle in which sectors must differ from every ID, however they are turned."""
LEAST_DIFFERENCE_BLOBS = 0.18
"""The same for patches, as a share of the area; more, because patches have edges all over."""
DIRECTIONS = 360  # into which the circle is divided
LETTERS = "AEFHKLNTVXYZ"
_GLYPH = 96  # pixels


def symbol(
    kind: str, number: int, landmarks: LandmarkSet, x: FloatArray, y: FloatArray
) -> BoolArray:
    """Whether a symbol of this kind is bright at x, y; has the shape of x and y.

    number: seed of the symbol. x, y: from its centre, in radii of the landmarks' symbols. Beyond
    radius 1 it is dark.
    """
    rng = np.random.default_rng([number, (*LEARNED_SYMBOLS, *OTHER_SYMBOLS).index(kind)])
    within = np.hypot(x, y) <= 1
    if kind == "bar":
        return np.asarray(within & (np.abs(y) < rng.uniform(0.15, 0.3)))
    if kind == "cross":
        half = rng.uniform(0.15, 0.3)
        return np.asarray(within & (np.minimum(np.abs(x), np.abs(y)) < half))
    if kind == "letter":
        text, face, thick = str(rng.choice(list(LETTERS))), cv2.FONT_HERSHEY_SIMPLEX, 14
        picture = np.zeros((_GLYPH, _GLYPH), np.uint8)
        (width, height), _ = cv2.getTextSize(text, face, 2.4, thick)
        corner = (_GLYPH - width) // 2, (_GLYPH + height) // 2
        cv2.putText(picture, text, corner, face, 2.4, 255, thick)
        return np.asarray(within & _values(picture > 0, x, y))
    if kind == "blobs":
        return np.asarray(within & _values(_blobs(landmarks, rng), x, y))
    lit = _sectors(kind, landmarks, rng)
    way = np.mod(np.arctan2(y, x), 2 * math.pi) / (2 * math.pi) * DIRECTIONS
    return np.asarray(within & lit[np.minimum(way.astype(int), DIRECTIONS - 1)])


def _values(picture: BoolArray, x: FloatArray, y: FloatArray) -> BoolArray:
    """Values of a square picture, which the symbol's circle fills, at x and y (in radii)."""
    size = len(picture)
    row, column = (np.clip((v + 1) / 2 * size, 0, size - 1).astype(int) for v in (-y, x))
    return np.asarray(picture[row, column])


def _blobs(landmarks: LandmarkSet, rng: np.random.Generator) -> BoolArray:
    """(_GLYPH, _GLYPH) smooth patches that differ from every ID, however it is turned."""
    y, x = 1 - 2 * (np.mgrid[:_GLYPH, :_GLYPH] + 0.5) / _GLYPH
    within = np.hypot(x, y) <= 1
    way = np.mod(np.arctan2(y, -x), 2 * math.pi)[within] / (2 * math.pi) * DIRECTIONS
    rotations = _rotations(landmarks)[:, np.minimum(way.astype(int), DIRECTIONS - 1)]
    while True:
        noise = rng.standard_normal((_GLYPH, _GLYPH))
        smooth = cv2.GaussianBlur(noise, (0, 0), rng.uniform(0.08, 0.2) * _GLYPH)
        lit = smooth > np.quantile(smooth, rng.uniform(0.3, 0.7))
        if np.mean(rotations != lit[within], axis=1).min() >= LEAST_DIFFERENCE_BLOBS:
            return np.asarray(lit)


def _sectors(kind: str, landmarks: LandmarkSet, rng: np.random.Generator) -> BoolArray:
    """(DIRECTIONS,) sectors round the circle that differ from every ID, however it is turned."""
    rotations = _rotations(landmarks)
    while True:
        if kind == "wedges":
            lit = np.zeros(DIRECTIONS, bool)
            for _ in range(int(rng.integers(1, 5))):
                begin, width = rng.integers(DIRECTIONS), int(rng.integers(25, 151))
                lit[(begin + np.arange(width)) % DIRECTIONS] = True
        else:
            parts = 8 if kind == "eighths" else int(rng.choice([3, 5, 6]))
            lit = (rng.random(parts) < 0.5)[np.arange(DIRECTIONS) * parts // DIRECTIONS]
        if 0 < lit.mean() < 1 and np.mean(rotations != lit, axis=1).min() >= LEAST_DIFFERENCE:
            return np.asarray(lit)


def _rotations(landmarks: LandmarkSet) -> BoolArray:
    """(rotations x K, DIRECTIONS) the sectors of every ID, rotated in steps of 5 degrees."""
    direction = (np.arange(DIRECTIONS) + 0.5) * 2 * math.pi / DIRECTIONS
    codes = landmarks.codes(direction) > 0.5
    return np.concatenate([np.roll(codes, step, axis=1) for step in range(0, DIRECTIONS, 5)])
