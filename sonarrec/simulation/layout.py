"""Layouts: discs at random positions on the floor of a recording, each whole in view once."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import BoolArray
from sonarrec.errors import SonarrecError, number_of
from sonarrec.geometry import (
    floor_depth,
    ground_range,
    in_image,
    pixel_from_polar,
    points_on_disc,
    slant_range,
)
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Fan
from sonarrec.simulation.background import WHOLE, Background, nearest_floor_m
from sonarrec.simulation.composite import CompositeDisc, DiscKind
from sonarrec.simulation.motion import Pose
from sonarrec.simulation.truth import LandmarkTruth, truth_row, visible_share

SPACING = 2.4  # least distance between centres, in radii
LIT = 0.9  # share of the disc that must lie where the recording shows echoes
MOST_IN_VIEW = 6  # discs in view at once, if the user gives no number
MOST_DISCS = 200
TRIES = 400  # positions tried for one disc


@dataclass(frozen=True, slots=True)
class Layout:
    """Discs on the floor of a recording.

    landmarks: the set that they belong to. seed: of the random numbers that placed them.
    """

    landmarks: LandmarkSet
    discs: tuple[CompositeDisc, ...]
    seed: int

    @property
    def landmark_count(self) -> int:
        """How many of the discs are landmarks; the others are fakes."""
        return sum(disc.kind == "landmark" for disc in self.discs)


def draw_layout(
    background: Background, landmarks: LandmarkSet, seed: int, count: int | None = None
) -> Layout:
    """Place discs at random on the floor that the recording shows, with random orientations.

    count: number of landmarks; every ID comes equally often, and with each round of IDs one blank
    and one filled disc. None: as many as possible with at most MOST_IN_VIEW in view at once. Fewer
    are placed if there is no room. The same seed gives the same layout. Raises SonarrecError if
    there is room for no landmark.
    """
    rng = np.random.default_rng([seed, 17])
    fan, path, radius = background.fan, background.path, landmarks.radius_m
    near, far = (float(ground_range(fan, r)) for r in (nearest_floor_m(fan), fan.range_max_m))
    poses = np.array([(p.pan_deg, p.x_m, p.y_m) for p in path])
    in_view = np.zeros(len(path), dtype=np.int64)
    discs: list[CompositeDisc] = []
    for kind, landmark in _rounds(landmarks.ids, rng, count):
        for _ in range(TRIES):
            pose = path[int(rng.integers(len(path)))]
            # Not by area, because results at short range matter as well.
            ground = rng.uniform(near, far)
            bearing = rng.uniform(fan.bearing_min_deg, fan.bearing_max_deg)
            world = math.radians(bearing + pose.pan_deg)
            x, y = pose.x_m + ground * math.sin(world), pose.y_m + ground * math.cos(world)
            if any(math.hypot(d.x_m - x, d.y_m - y) < SPACING * radius for d in discs):
                continue
            dx, dy = x - poses[:, 1], y - poses[:, 2]
            bearings = (np.degrees(np.arctan2(dx, dy)) - poses[:, 0] + 180) % 360 - 180
            shown = in_image(fan, slant_range(fan, np.hypot(dx, dy)), bearings)
            if count is None and in_view[shown].max(initial=0) >= MOST_IN_VIEW:
                continue
            if _is_lit(fan, background.lit, radius, ground, bearing):
                discs.append(CompositeDisc(kind, landmark, x, y, rng.uniform(0, 360)))
                in_view += shown
                break
        else:
            break  # no room for this disc, so none for more
    layout = Layout(landmarks, tuple(discs), seed)
    if not layout.landmark_count:
        raise SonarrecError(
            f"{background.where}: no place on the floor shows echoes over a whole disc of radius_m "
            f"= {radius:g}; see whether the geometry is right: sonarrec info --preview"
        )
    return layout


def without_room(layouts: Sequence[Layout], count: int | None) -> list[str]:
    """A line if a layout has fewer landmarks than were asked for. count: None if none was."""
    least = min(layout.landmark_count for layout in layouts)
    if count is None or least >= count:
        return []
    where = " in a layout" if len(layouts) > 1 else ""
    return [f"there was room for only {least} of {number_of(count, 'landmark')}{where}"]


def truth_of(background: Background, layout: Layout, frame: int) -> tuple[LandmarkTruth, ...]:
    """The landmarks that are at least partly in view in a frame, in the layout's order."""
    fan, pose = background.fan, background.path[frame]
    rows = []
    for disc in layout.discs:
        if disc.kind == "landmark":
            radius = layout.landmarks.radius_m
            share = round(visible_share(fan, pose, disc.x_m, disc.y_m, radius), 4)
            if share:
                ground, bearing = disc.seen_from(pose)
                seen = float(slant_range(fan, ground)), bearing
                rotation = disc.orientation_deg + pose.pan_deg
                rows.append(LandmarkTruth(disc.landmark, *truth_row(fan, seen, share, rotation)))
    return tuple(rows)


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


def _is_lit(fan: Fan, lit: BoolArray, radius_m: float, ground: float, bearing: float) -> bool:
    """Whether a disc is whole in view where there are echoes. ground, bearing: m and deg."""
    angle = math.radians(bearing)
    x, y = ground * math.sin(angle), ground * math.cos(angle)
    if visible_share(fan, Pose(0.0, floor_depth(fan), 0.0, 0.0), x, y, radius_m) < WHOLE:
        return False
    dx, dy = points_on_disc(radius_m, 200)
    dx, dy = x + dx, y + dy
    column, row = pixel_from_polar(
        fan, slant_range(fan, np.hypot(dx, dy)), np.degrees(np.arctan2(dx, dy))
    )
    column = np.clip(np.rint(column), 0, fan.columns - 1).astype(int)
    row = np.clip(np.rint(row), 0, fan.rows - 1).astype(int)
    return bool(lit[row, column].mean() >= LIT)
