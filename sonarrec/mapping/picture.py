"""Draws a map: the floor in view, the path, and the landmarks with ellipses and IDs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from sonarrec.arrays import FloatArray
from sonarrec.drawing.pen import landmark_colours
from sonarrec.errors import listed, number_of
from sonarrec.geometry import floor_depth, ground_range
from sonarrec.mapping.build import SiteMap
from sonarrec.mapping.landmarks import Landmark, MappedLog, ellipse
from sonarrec.tables.outputs import escape_mathtext, write_figure

LINES = "#333333"
"""Colour of outlines, which set discs off from the floor, whatever the colour of their IDs."""
MOST_PARTS = 9  # of a paused log without poses that are drawn, each by itself
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
    for n, log in enumerate(logs):
        positions = site.position(log.path.pose[:, 1:])
        label = "path of the sonar" if n == 0 else None
        axes.plot(*positions.T, color="#666666", linewidth=1, zorder=1, label=label)
        start = positions[log.path.known[:1]]
        label = "its first place" if n == 0 else None
        axes.plot(*start.T, "o", color="#666666", markersize=5, zorder=1, label=label)
    axes.set_aspect("equal")
    axes.autoscale_view()
    for number, landmark in enumerate(site.landmarks, 1):
        if site.path_of(landmark.members[0]) == part:
            _draw_landmark(axes, site, landmark, number)
    axes.autoscale_view()
    axes.plot([], [], color=LINES, linewidth=1.2, label="95 % ellipses")
    axes.plot([], [], color=LINES, linewidth=2, label="where the first sector begins")
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
    """Draw a disc in its ID's colour, a mark where its first sector begins, and its ellipse."""
    radius = site.landmark_set.radius_m
    colour = tuple(np.array(landmark_colours(site.landmark_set.ids)[landmark.id]) / 255)
    position = site.position(landmark.position)
    angle = np.linspace(0, 2 * np.pi, 49)
    disc = position + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    axes.fill(*disc.T, facecolor=colour, alpha=0.7, edgecolor=LINES, zorder=2)
    axes.plot(
        *ellipse(position, site.covariance(landmark.covariance)).T,
        color=LINES,
        linewidth=1.2,
        zorder=3,
    )
    if not math.isnan(landmark.orientation_deg):
        sector = math.radians(landmark.orientation_deg - 90 * site.ros_axes)
        tip = position + radius * np.array([math.cos(sector), math.sin(sector)])
        axes.plot(*np.array([position, tip]).T, color=LINES, linewidth=2, zorder=3)
    axes.annotate(
        f"ID.{landmark.id}  ({number})",
        tuple((position + 0.75 * radius).tolist()),
        xytext=(2, 2),
        textcoords="offset points",
        fontsize=9,
        color="black",
        zorder=4,
    )


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
