"""Draws a map: the floor in view, the path, and the landmarks with ellipses and IDs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import PatchCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon, Wedge

from sonarrec.arrays import FloatArray
from sonarrec.drawing.pen import landmark_colours
from sonarrec.errors import listed, number_of
from sonarrec.landmarks import DrawnSet, LandmarkSet
from sonarrec.mapping.build import SiteMap
from sonarrec.mapping.landmarks import Landmark, MappedLog, ellipse
from sonarrec.sonar.geometry import floor_depth, ground_range
from sonarrec.tables.outputs import escape_mathtext, write_figure

LINES = "#333333"
"""Colour of outlines, which set discs off from the floor, whatever the colour of their IDs."""
PLATE = "#555555"
"""Colour of what is dark to a sonar."""
MOST_PARTS = 9  # of a paused log without poses that are drawn, each by itself
LEAST_PATH_M = 0.05  # extent of a path that its first place's mark does not cover
MOST_FANS = 150  # fans that are drawn for each log, at most, to show the floor in view


def draw_map(path: Path, site: SiteMap) -> None:
    """Write the map as a PNG."""
    figure = Figure(figsize=(8, 8), dpi=120, layout="constrained")
    shown = site.parts[:MOST_PARTS]
    side = math.ceil(math.sqrt(len(shown)))
    for n, logs in enumerate(shown, 1):
        axes = figure.add_subplot(math.ceil(len(shown) / side), side, n)
        _draw_part(axes, site, logs, n)
        if len(site.parts) > 1:
            first, last = logs[0].path.frame[[0, -1]]
            axes.set_title(f"path {n} of {len(site.parts)}, frames {first} to {last}", fontsize=9)
    if len(site.parts) > 1:
        figure.suptitle(_title(site), fontsize=10)
        entries = figure.axes[0].get_legend_handles_labels()
        figure.legend(*entries, loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    else:
        axes.set_title(_title(site), fontsize=10)
        below = (0.5, -0.08)
        axes.legend(loc="upper center", bbox_to_anchor=below, ncols=2, fontsize=8, frameon=False)
    write_figure(path, figure)


def _draw_part(axes: Any, site: SiteMap, logs: Sequence[MappedLog], part: int) -> None:
    """Draw what has common axes."""
    for log in logs:
        fans = [site.position(fan) for fan in _floor_seen(log)]
        axes.add_collection(PolyCollection(fans, facecolors="#e9eef2", edgecolors="none", zorder=0))
    paths = [site.position(log.path.pose[:, 1:]) for log in logs]
    travels = any(
        np.ptp(path[log.path.known], axis=0).max() > LEAST_PATH_M
        for path, log in zip(paths, logs, strict=True)
    )
    for n, (path, log) in enumerate(zip(paths, logs, strict=True)):
        if travels:
            label = "path of the sonar" if n == 0 else None
            axes.plot(*path.T, color="#666666", linewidth=1, zorder=1, label=label)
        start = path[log.path.known[:1]]
        label = ("first place of the sonar" if travels else "the sonar") if n == 0 else None
        axes.plot(*start.T, "o", color="#666666", markersize=5, zorder=1, label=label)
    axes.set_aspect("equal")
    axes.autoscale_view()
    of_part = [
        (number, landmark)
        for number, landmark in enumerate(site.landmarks, 1)
        if site.path_of(landmark.members[0]) == part
    ]
    for number, landmark in of_part:
        _draw_landmark(axes, site, landmark, number)
    axes.autoscale_view()
    if of_part:
        axes.plot([], [], color=LINES, linewidth=1.2, label="95 % ellipses")
    axes.set_xlabel("x, m: ahead at yaw 0" if site.ros_axes else "x, m: to the right at yaw 0")
    axes.set_ylabel("y, m: to the left at yaw 0" if site.ros_axes else "y, m: ahead at yaw 0")
    axes.grid(color="white", linewidth=0.8, zorder=0)
    axes.set_facecolor("#f8f8f8")


def _title(site: SiteMap) -> str:
    count = number_of(len(site.landmarks), "landmark")
    names = list(dict.fromkeys(log.name for log in site.logs))
    logs = listed(names, 3)
    return escape_mathtext(f"{count} of {site.landmark_set.name}: {logs}")


def _draw_landmark(axes: Any, site: SiteMap, landmark: Landmark, number: int) -> None:
    """Draw a landmark in its ID's colour as it lies, its symbol where that is known, and its
    ellipse."""
    radius, ids = site.landmark_set.radius_m, site.landmark_set.ids
    colour = tuple(np.array(landmark_colours(ids)[landmark.id]) / 255)
    position = site.position(landmark.position)
    rotation_deg = landmark.orientation_deg - 90 * site.ros_axes
    dark, lit = _drawing(site.landmark_set, ids.index(landmark.id), position, rotation_deg)
    for parts, inside in ((dark, PLATE), (lit, colour)):
        axes.add_collection(PatchCollection(parts, facecolors=[inside], linewidths=0, zorder=2))
    axes.plot(
        *ellipse(position, site.covariance(landmark.covariance)).T,
        color=LINES,
        linewidth=1.2,
        zorder=3,
    )
    axes.annotate(
        f"ID.{landmark.id}  ({number})",
        tuple((position + 0.75 * radius).tolist()),
        xytext=(2, 2),
        textcoords="offset points",
        fontsize=9,
        color="black",
        zorder=4,
    )


def _drawing(
    landmarks: LandmarkSet, k: int, position: FloatArray, rotation_deg: float
) -> tuple[list[Patch], list[Patch]]:
    """The k-th landmark as it lies: what is dark to a sonar, and what is bright.

    rotation_deg: counter-clockwise from the x axis; NaN: not known, then no symbol is drawn.
    """
    radius, known = landmarks.radius_m, not math.isnan(rotation_deg)
    if isinstance(landmarks, DrawnSet):
        drawing = landmarks.drawings()[k]
        side, angle = 2 * radius / len(drawing), math.radians(rotation_deg if known else 0)
        rotate = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        square = np.array([[0, 0], [1, 0], [1, -1], [0, -1]])

        def cell(row: float, column: float, size: float) -> Patch:
            corners = np.array([column * side - radius, radius - row * side]) + size * square
            return Polygon(position + corners @ rotate)

        plate = [cell(0, 0, 2 * radius)]
        if not known:
            return [], plate
        return plate, [cell(row, column, side) for row, column in np.argwhere(drawing).tolist()]
    x, y = position.tolist()
    (inner, outer), sectors = landmarks.symbol, landmarks.sectors[k]
    step = 360 / len(sectors)
    ring_width = radius * (landmarks.ring[1] - landmarks.ring[0])
    lit: list[Patch] = [Wedge((x, y), radius * landmarks.ring[1], 0, 360, width=ring_width)]
    for n in np.flatnonzero(sectors).tolist() if known else ():
        first = rotation_deg + n * step
        width = radius * (outer - inner)
        lit.append(Wedge((x, y), radius * outer, first, first + step, width=width))
    return [Wedge((x, y), radius, 0, 360)], lit


def _floor_seen(log: MappedLog) -> FloatArray:
    """(n, points, 2) outlines of the floor in view, in at most MOST_FANS frames."""
    known = log.path.known
    chosen = known[np.linspace(0, len(known) - 1, min(len(known), MOST_FANS)).round().astype(int)]
    fan = log.fan
    nearest = max(fan.range_min_m, floor_depth(fan))
    near, far = (float(ground_range(fan, r)) for r in (nearest, fan.range_max_m))
    bearing = np.radians(np.linspace(fan.bearing_min_deg, fan.bearing_max_deg, 13))
    angle = np.concatenate([bearing, bearing[::-1]])
    reach = np.repeat([far, near], len(bearing))
    sight = np.radians(log.path.pose[chosen, :1]) + angle
    offset = reach[:, None] * np.stack([np.sin(sight), np.cos(sight)], axis=-1)
    return np.asarray(offset + log.path.pose[chosen, None, 1:])
