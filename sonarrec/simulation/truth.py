"""Simulated truth: which landmarks and other objects a frame shows, and where."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from functools import lru_cache

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.geometry import in_image, pixel_from_polar, points_on_disc
from sonarrec.nouns import Fan
from sonarrec.simulation.fish import Fishes
from sonarrec.simulation.motion import Pose
from sonarrec.simulation.objects import object_radius, raised_m
from sonarrec.simulation.plane import FLAT, Plane
from sonarrec.simulation.scene import PlacedLandmark, PlacedObject, Scene, position_of


@dataclass(frozen=True, slots=True)
class LandmarkTruth:
    """A landmark that is at least partly in view of a frame: a row of gt.csv.

    x_px, y_px: centre in fan pixels. range_m: slant range. bearing_deg: positive to the right.
    visible: share of the disc's area that is inside the fan image, 0 to 1. orientation_deg: where
    the first sector begins, counter-clockwise from the image's right, seen from above.
    """

    landmark: int
    x_px: float
    y_px: float
    range_m: float
    bearing_deg: float
    visible: float
    orientation_deg: float


TRUTH_COLUMNS = ("frame", *(f.name for f in fields(LandmarkTruth)))  # of gt.csv


def truth_rows(frame: int, truth: Iterable[LandmarkTruth]) -> Iterator[list[object]]:
    """The rows of gt.csv for one frame."""
    return ([frame, *asdict(landmark).values()] for landmark in truth)


@dataclass(frozen=True, slots=True)
class DistractorTruth:
    """Any other object in view, even if something hides it. The fields are as in LandmarkTruth."""

    kind: str
    x_px: float
    y_px: float
    range_m: float
    bearing_deg: float
    visible: float
    orientation_deg: float


def visible_share(
    fan: Fan,
    pose: Pose,
    x_m: float,
    y_m: float,
    radius_m: float,
    plane: Plane = FLAT,
    lean: tuple[float, float] = (0.0, 0.0),
) -> float:
    """Share of a disc's area that is inside the fan image, 0 to 1.

    x_m, y_m: its centre on the floor. lean: by how much the disc leans and the azimuth towards
    which it does, deg; its lower edge touches the floor.
    """
    dx, dy, up = _disc(radius_m, lean)
    slant, bearing = plane.seen(pose, x_m + dx, y_m + dy, up)
    return float(np.mean(in_image(fan, slant, bearing)))


@lru_cache(maxsize=256)
def _disc(
    radius_m: float, lean: tuple[float, float]
) -> tuple[FloatArray, FloatArray, FloatArray | float]:
    """Points of a disc: to the right of its centre, ahead of it, and up, m.

    lean: as in `visible_share`.
    """
    dx, dy = points_on_disc(radius_m, 2000)
    up: FloatArray | float = 0.0
    if lean[0]:
        tilt, towards = math.radians(lean[0]), math.radians(lean[1])
        along = dx * math.sin(towards) + dy * math.cos(towards)
        up = (along + radius_m) * math.sin(tilt)
        level = along * (math.cos(tilt) - 1)
        dx, dy = dx + level * math.sin(towards), dy + level * math.cos(towards)
    return dx, dy, up


def truth_in_view(
    scene: Scene, fan: Fan, pose: Pose, fishes: Fishes | None
) -> tuple[tuple[LandmarkTruth, ...], tuple[DistractorTruth, ...]]:
    """Landmarks and distractors in view of a frame, rounded to the digits of gt.csv."""
    radius = scene.landmark_set.radius_m
    plane = Plane.of(scene)
    items: list[tuple[PlacedLandmark | PlacedObject, float]]
    items = [(item, radius) for item in scene.landmarks]
    items += [(item, object_radius(scene, item)) for item in scene.objects]
    landmarks, distractors = [], []
    for item, size in items:
        x, y = position_of(item)
        lean = (item.lean_deg, item.lean_towards_deg)
        share = round(visible_share(fan, pose, x, y, size, plane, lean), 4)
        if share == 0:
            continue
        seen = plane.seen(pose, x, y, raised_m(item, size))
        row = truth_row(fan, seen, share, item.orientation_deg + pose.pan_deg)
        if isinstance(item, PlacedObject):
            distractors.append(DistractorTruth(item.kind, *row))
        else:
            landmarks.append(LandmarkTruth(item.id, *row))
    if fishes is not None:
        slant, bearing = plane.seen(pose, fishes.x_m, fishes.y_m, fishes.up_m)
        for n in np.flatnonzero(in_image(fan, slant, bearing)):
            rotation = 90 - float(fishes.heading_deg[n]) + pose.pan_deg
            row = truth_row(fan, (slant[n], bearing[n]), 1.0, rotation)
            distractors.append(DistractorTruth("fish", *row))
    return tuple(landmarks), tuple(distractors)


def truth_row(
    fan: Fan, seen: tuple[FloatArray | float, FloatArray | float], share: float, rotation_deg: float
) -> tuple[float, float, float, float, float, float]:
    """The fields of a row of truth after the object's name, rounded.

    seen: (slant range in m, bearing in deg). share: the part of it in view, 0 to 1. rotation_deg:
    its orientation.
    """
    slant, bearing = (float(value) for value in seen)
    column, row = pixel_from_polar(fan, slant, bearing)
    pixel = round(float(column), 3), round(float(row), 3)
    return *pixel, round(slant, 5), round(bearing, 4), share, round(rotation_deg % 360, 3)
