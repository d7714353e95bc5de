"""Simulated truth: which landmarks and other objects a frame shows, and where."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.simulation.fish import Fishes
from sonarrec.simulation.motion import Plane, Pose
from sonarrec.simulation.objects import object_radius, raised_m
from sonarrec.simulation.scene import Placed, PlacedLandmark, Scene, position_of
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import in_image, pixel_from_polar, points_on_disc


class Truth(NamedTuple):
    """An object that is at least partly in view of a frame, even if something hides it."""

    landmark: int
    """Its ID; 0 of other objects, which have a kind."""
    x_px: float
    y_px: float
    """x_px, y_px: centre in fan pixels."""
    range_m: float
    """Slant range."""
    bearing_deg: float
    """Positive to the right."""
    visible: float
    """Share of its area that is inside the fan image, 0 to 1."""
    orientation_deg: float
    """Where the first sector begins, counter-clockwise from the image's right, seen from above."""
    kind: str = ""
    corners: FloatArray | None = None
    """Of a drawn plate, (4, 2) of range (m) and bearing (deg), clockwise from the drawing's top
    left if it is not mirrored."""


TRUTH_COLUMNS = ("frame", *Truth._fields[:7])  # of gt.csv


def truth_rows(frame: int, truth: Iterable[Truth]) -> Iterator[list[object]]:
    """The rows of gt.csv for one frame."""
    return ([frame, *item[:7]] for item in truth)


def visible_share(fan: Fan, pose: Pose, item: Placed, radius_m: float, plane: Plane) -> float:
    """Share of a disc's area that is inside the fan image, 0 to 1.

    Where it leans, its lower edge touches the floor.
    """
    (dx, dy), up = points_on_disc(radius_m, 2000), np.zeros(1)
    if item.lean_deg:
        tilt, towards = math.radians(item.lean_deg), math.radians(item.lean_towards_deg)
        along = dx * math.sin(towards) + dy * math.cos(towards)
        up = (along + radius_m) * math.sin(tilt)
        level = along * (math.cos(tilt) - 1)
        dx, dy = dx + level * math.sin(towards), dy + level * math.cos(towards)
    x, y = position_of(item)
    return float(np.mean(in_image(fan, *plane.seen(pose, x + dx, y + dy, up))))


def truth_in_view(
    scene: Scene, fan: Fan, pose: Pose, fishes: Fishes | None
) -> tuple[tuple[Truth, ...], tuple[Truth, ...]]:
    """Landmarks and other objects in view of a frame, rounded to the digits of gt.csv."""
    plane = Plane.of(scene)
    landmarks, others = [], []
    for item in scene.items:
        size = object_radius(scene, item)
        share = round(visible_share(fan, pose, item, size, plane), 4)
        if share == 0:
            continue
        seen = plane.seen(pose, *position_of(item), raised_m(item, size))
        row = _rounded(fan, *seen, share, item.orientation_deg + pose.pan_deg)
        if isinstance(item, PlacedLandmark):
            landmarks.append(Truth(item.id, *row))
        else:
            others.append(Truth(0, *row, item.kind))
    if fishes is not None:
        slant, bearing = plane.seen(pose, fishes.x_m, fishes.y_m, fishes.up_m)
        for n in np.flatnonzero(in_image(fan, slant, bearing)):
            rotation = 90 - float(fishes.heading_deg[n]) + pose.pan_deg
            others.append(Truth(0, *_rounded(fan, slant[n], bearing[n], 1.0, rotation), "fish"))
    return tuple(landmarks), tuple(others)


def _rounded(
    fan: Fan, slant_m: FloatArray, bearing_deg: FloatArray, share: float, rotation_deg: float
) -> tuple[float, float, float, float, float, float]:
    """The fields of Truth from x_px to orientation_deg."""
    slant, bearing = float(slant_m), float(bearing_deg)
    column, row = pixel_from_polar(fan, slant, bearing)
    pixel = round(float(column), 3), round(float(row), 3)
    return *pixel, round(slant, 5), round(bearing, 4), share, round(rotation_deg % 360, 3)
