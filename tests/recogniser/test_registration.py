"""Motions of pictures of one floor, which are known since the pictures are made of it."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from sonarrec.arrays import FloatImage
from sonarrec.recogniser.motion.registration import FloorRegistration
from tests.support.drawn import make_fan

FAN = make_fan(rows=256)
ROWS, COLUMNS = 128, 192
RANGE_M = np.linspace(FAN.range_min_m, FAN.range_max_m, ROWS)
BEARING_DEG = np.linspace(-14.3, 14.3, COLUMNS)
REGISTRATION = FloorRegistration(FAN, RANGE_M, BEARING_DEG, np.ones((ROWS, COLUMNS), np.float32))
CELL_M = 0.004
"""Of the floor, in which a grain of speckle is some cells wide."""


def floor(rng: np.random.Generator) -> FloatImage:
    """(2048, 2048) levels of a floor of 8 m on a side, the sonar's first place in its middle."""
    return cv2.GaussianBlur(rng.standard_normal((2048, 2048)).astype(np.float32), (0, 0), 3)


def seen_from(levels: FloatImage, right: float, ahead: float, turn: float) -> FloatImage:
    """What a sonar at a place and heading sees of the floor, by its own geometry; no mean."""
    depth = FAN.height_m or 0.0
    ground = np.sqrt(np.maximum(RANGE_M**2 - depth**2, 0.01))[:, None]
    toward = np.radians(BEARING_DEG)[None] + turn
    x = right + ground * np.sin(toward)
    y = ahead + ground * np.cos(toward)
    column, row = (np.float32(1024 + v / CELL_M) for v in (x, y))
    picture = cv2.remap(levels, column, row, cv2.INTER_CUBIC)
    picture -= picture.mean(axis=1, keepdims=True)
    return picture - picture.mean(axis=0)


@pytest.mark.parametrize("turn_deg", [0.0, 3.0])
@pytest.mark.parametrize(("right", "ahead"), [(0.0, 0.0), (0.03, 0.08), (-0.06, 0.025)])
def test_a_motion_is_found_from_a_cell_away(right: float, ahead: float, turn_deg: float) -> None:
    """Half of each picture's power is noise of its own, as where speckle changes."""
    rng = np.random.default_rng(11)
    levels = floor(rng)
    true = np.array([right, ahead, math.radians(turn_deg)])
    pictures = []
    for motion in (np.zeros(3), true):
        one, own = seen_from(levels, *motion), seen_from(floor(rng), 0, 0, 0)
        pictures.append(REGISTRATION.picture(one + own))
    off = np.array([0.012, -0.02, math.radians(0.15)])  # a cell is 2 cm, .15 deg
    found = REGISTRATION.refined(*pictures, true + off)
    assert found is not None
    assert found.match == pytest.approx(0.5, abs=0.1)
    assert (np.abs(found.motion - true) < (0.008, 0.006, math.radians(0.2))).all()
    assert (np.abs(found.motion - true) < 4 * found.sigma).all()
    assert (found.sigma < (0.006, 0.006, math.radians(0.15))).all()


def test_other_floors_have_no_motion_in_common() -> None:
    rng = np.random.default_rng(12)
    pictures = [REGISTRATION.picture(seen_from(floor(rng), 0, 0, 0)) for _ in range(2)]
    found = REGISTRATION.refined(*pictures, np.zeros(3))
    assert found is None or found.loose or found.match < 0.1
