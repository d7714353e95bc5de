"""Chooses places for discs on the floor of a recording, at random.

Each disc is whole in view in at least one frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from sonarrec.arrays import BoolArray
from sonarrec.errors import SonarrecError
from sonarrec.geometry import (
    STEEPEST,
    floor_depth,
    ground_range,
    in_image,
    pixel_from_polar,
    points_on_disc,
    slant_range,
)
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Fan
from sonarrec.simulation.composite import DiscKind, LaidDisc
from sonarrec.simulation.motion import Pose
from sonarrec.simulation.truth import visible_share

APART = 2.4  # least distance between centres, in radii
WHOLE = 0.99  # share of the disc that is in view in the frame for which it is placed
LIT = 0.9  # share of the disc that must lie where the recording shows echoes
MOST_IN_VIEW = 6  # discs in view at once, if the user gives no number
MOST_DISCS = 200
TRIES = 400  # places tried for one disc


def check_room(fan: Fan, landmarks: LandmarkSet, where: str) -> None:
    """Raise SonarrecError if no whole disc can be in view. where: names the recording."""
    nearest = max(fan.range_min_m, STEEPEST * floor_depth(fan))
    if nearest >= fan.range_max_m:
        raise SonarrecError(
            f"{where}: nothing of the floor is in view: from height_m = {floor_depth(fan):g} it "
            f"begins at {nearest:.2f} m and range_max_m = {fan.range_max_m:g}; correct one of them"
        )
    near, far = (float(ground_range(fan, r)) for r in (nearest, fan.range_max_m))
    middle = math.radians((fan.bearing_min_deg + fan.bearing_max_deg) / 2)
    here = Pose(0.0, floor_depth(fan), 0.0, 0.0)
    shares = [
        visible_share(fan, here, g * math.sin(middle), g * math.cos(middle), landmarks.radius_m)
        for g in np.linspace(near, far, 40).tolist()
    ]
    if max(shares) < WHOLE:
        raise SonarrecError(
            f"{where}: a disc of radius_m = {landmarks.radius_m:g} is nowhere whole in view: the "
            f"fan shows {nearest:.2f} to {fan.range_max_m:.2f} m of the floor and "
            f"{fan.bearing_max_deg - fan.bearing_min_deg:.1f} deg; choose smaller --landmarks"
        )


def lay_out(
    fan: Fan,
    path: Sequence[Pose],
    lit: BoolArray,
    landmarks: LandmarkSet,
    rng: np.random.Generator,
    count: int | None = None,
) -> list[LaidDisc]:
    """Place discs at random on the floor that the path shows, with random orientations.

    path: the sonar's pose in every frame. lit: (fan.rows, fan.columns) where the recording shows
    echoes. count: number of landmarks; every ID comes equally often, and with each round of IDs one
    blank and one filled disc. None: as many as possible with at most MOST_IN_VIEW in view at once.
    Fewer are placed if there is no room.
    """
    near = float(ground_range(fan, max(fan.range_min_m, STEEPEST * floor_depth(fan))))
    far = float(ground_range(fan, fan.range_max_m))
    poses = np.array([(p.pan_deg, p.x_m, p.y_m) for p in path])
    in_view = np.zeros(len(path), dtype=np.int64)
    discs: list[LaidDisc] = []
    for kind, landmark in _rounds(landmarks.ids, rng, count):
        for _ in range(TRIES):
            pose = path[int(rng.integers(len(path)))]
            # Not by area, because results at short range matter as well.
            ground = rng.uniform(near, far)
            bearing = rng.uniform(fan.bearing_min_deg, fan.bearing_max_deg)
            world = math.radians(bearing + pose.pan_deg)
            x, y = pose.x_m + ground * math.sin(world), pose.y_m + ground * math.cos(world)
            apart = APART * landmarks.radius_m
            if any(math.hypot(d.x_m - x, d.y_m - y) < apart for d in discs):
                continue
            there = _in_view(fan, poses, x, y)
            if count is None and in_view[there].max(initial=0) >= MOST_IN_VIEW:
                continue
            if not _shows(fan, lit, landmarks.radius_m, ground, bearing):
                continue
            turn = rng.uniform(0, 360)
            discs.append(LaidDisc(kind, landmark, x, y, turn))
            in_view += there
            break
        else:
            break  # no room for this disc, so none for more
    return discs


def _rounds(
    ids: Sequence[int], rng: np.random.Generator, count: int | None
) -> Iterator[tuple[DiscKind, int]]:
    """The (kind, ID) of discs in order: every ID in random order, a blank, a filled one; again."""
    left = MOST_DISCS if count is None else count
    while left > 0:
        chosen = [ids[i] for i in rng.permutation(len(ids))][:left]
        yield from (("landmark", landmark) for landmark in chosen)
        yield "blank", 0
        yield "filled", 0
        left -= len(chosen) + (2 if count is None else 0)


def _in_view(fan: Fan, poses: np.ndarray, x: float, y: float) -> BoolArray:
    """(frames,) whether a place is in view. poses: (frames, 3) pan (deg), x, y (m)."""
    dx, dy = x - poses[:, 1], y - poses[:, 2]
    bearing = (np.degrees(np.arctan2(dx, dy)) - poses[:, 0] + 180) % 360 - 180
    return np.asarray(in_image(fan, slant_range(fan, np.hypot(dx, dy)), bearing), dtype=bool)


def _shows(fan: Fan, lit: BoolArray, radius_m: float, ground: float, bearing: float) -> bool:
    """Whether a disc is whole in view and lies where there are echoes.

    ground, bearing: of its centre, m and deg. lit: as in `lay_out`.
    """
    angle = math.radians(bearing)
    x, y = ground * math.sin(angle), ground * math.cos(angle)
    here = Pose(0.0, floor_depth(fan), 0.0, 0.0)
    if visible_share(fan, here, x, y, radius_m) < WHOLE:
        return False
    dx, dy = points_on_disc(radius_m, 200)
    dx, dy = x + dx, y + dy
    column, row = pixel_from_polar(
        fan, slant_range(fan, np.hypot(dx, dy)), np.degrees(np.arctan2(dx, dy))
    )
    column = np.clip(np.rint(column), 0, fan.columns - 1).astype(int)
    row = np.clip(np.rint(row), 0, fan.rows - 1).astype(int)
    return bool(lit[row, column].mean() >= LIT)
