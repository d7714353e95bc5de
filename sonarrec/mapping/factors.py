"""A map as factors for a SLAM back end: measurements of landmarks from poses, and a g2o graph."""

from __future__ import annotations

import math
from itertools import groupby, pairwise
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.geometry import floor_depth, ground_range
from sonarrec.mapping.build import SiteMap
from sonarrec.mapping.join import MappedLog, frame_shares
from sonarrec.mapping.passes import (
    COMMON_SHARE,
    HEIGHT_SIGMA_M,
    LEAST_ORIENTATION_DEG,
    LEAST_POSITION_M,
    ORIENTATION_SIGMA_DEG,
    SAME_FRAMES,
    Pass,
)
from sonarrec.tables.outputs import write_csv, write_text

FACTOR_COLUMNS = (
    *("log", "frame", "timestamp_ns", "pose_vertex", "landmark_vertex", "number", "landmark"),
    *("range_m", "ground_range_m", "bearing_deg", "orientation_deg"),
    *("ground_range_sigma_m", "bearing_sigma_deg", "orientation_sigma_deg"),
)
PER_PASS = 5  # most measurements that are taken from one pass
# Given poses without drift are exact, but the numbers in a graph must be finite.
LEAST_STEP_M, LEAST_STEP_DEG = 0.001, 0.01
UNKNOWN_ORIENTATION_DEG = 1e3

Vertices = dict[tuple[int, int], int]
"""The numbers of the poses in a graph by (index of the log, row of its path), rising. Those of the
landmarks follow, in the order of the map."""


class Factor(NamedTuple):
    """The measurement of a landmark from a pose.

    log: index of the map's log. row: of the log's path. number: index of the map's landmark.
    slant_m: slant range. measured: ground range (m), bearing and orientation (deg, as in
    estimates.csv; NaN if not known). If the symbol looks the same after a rotation, it is the
    orientation next to the map's. sigma: standard errors, so large that all measurements of a pass,
    taken as independent, weigh as much as the pass, and passes that share frames as much as one.
    """

    log: int
    row: int
    number: int
    slant_m: float
    measured: tuple[float, float, float]
    sigma: tuple[float, float, float]


def factors(site: SiteMap) -> list[Factor]:
    """The measurements of every landmark of the map: at most PER_PASS from each of its passes."""
    found: list[Factor] = []
    for number, landmark in enumerate(site.landmarks):
        for log, members in groupby(landmark.members, key=itemgetter(0)):
            passes = [one for _, one in members]
            for one, share in zip(passes, frame_shares(passes), strict=True):
                found += _of_pass(site, number, log, one, share)
    return sorted(found, key=itemgetter(0, 1, 2))


def _of_pass(site: SiteMap, number: int, log: int, one: Pass, share: float) -> list[Factor]:
    """The measurements from one pass of a landmark. share: from `frame_shares`."""
    landmark, path, fan = site.landmarks[number], site.logs[log].path, site.logs[log].fan
    length = len(one.row)
    chosen = np.unique(np.linspace(0, length - 1, min(length, PER_PASS)).round().astype(int))
    row, (slant, bearing, orientation) = one.row[chosen], one.polar[chosen].T
    ground = ground_range(fan, slant)
    period = float(site.landmark_set.periods_deg()[site.landmark_set.ids.index(landmark.id)])
    if math.isnan(period):
        orientation = np.full(len(row), np.nan)
    elif not math.isnan(landmark.orientation_deg):
        offset = orientation - (landmark.orientation_deg + path.pose[row, 0])
        orientation = orientation - period * np.round(offset / period)
    # The share of a frame's variance that remains in the mean of the pass.
    remaining = COMMON_SHARE + (1 - COMMON_SHARE) * min(SAME_FRAMES, length) / length
    same = np.ones(len(row))
    own = one.sigma[chosen].T * np.array([slant / ground, same, same])
    least = [
        np.hypot(LEAST_POSITION_M, HEIGHT_SIGMA_M * floor_depth(fan) / ground),
        np.degrees(LEAST_POSITION_M / ground),
        np.full(len(row), math.hypot(LEAST_ORIENTATION_DEG, ORIENTATION_SIGMA_DEG)),
    ]
    sigma = np.sqrt(len(row) * (remaining * own**2 + np.square(least))) / math.sqrt(share)
    measured = np.column_stack([ground, bearing, orientation % 360])
    columns = (row.tolist(), slant.tolist(), measured.tolist(), sigma.T.tolist())
    return [
        Factor(log, at, number, slant_m, tuple(values), tuple(errors))
        for at, slant_m, values, errors in zip(*columns, strict=True)
    ]


def pose_vertices(site: SiteMap, measurements: list[Factor]) -> Vertices:
    """The poses in the graph: those of measurements, and the first and last known of each log."""
    poses = {(one.log, one.row) for one in measurements}
    for log, mapped in enumerate(site.logs):
        known = mapped.path.known.tolist()
        poses |= {(log, row) for row in known[:1] + known[-1:]}
    return {pose: vertex for vertex, pose in enumerate(sorted(poses))}


def write_factors(
    path: Path, site: SiteMap, measurements: list[Factor], vertices: Vertices
) -> None:
    """Write factors.csv: a row per measurement."""
    rows = []
    for one in measurements:
        log, landmark = site.logs[one.log], site.landmarks[one.number]
        (ground, bearing, orientation), sigma = one.measured, one.sigma
        known = not math.isnan(orientation)
        rows.append(
            [
                *(log.name, log.path.frame[one.row], log.path.timestamp_ns[one.row]),
                *(vertices[one.log, one.row], len(vertices) + one.number),
                *(one.number + 1, landmark.id),
                *(f"{one.slant_m:.4f}", f"{ground:.4f}", f"{bearing:.3f}"),
                f"{orientation:.2f}" if known else "",
                *(f"{sigma[0]:.4f}", f"{sigma[1]:.3f}"),
                f"{sigma[2]:.2f}" if known else "",
            ]
        )
    write_csv(path, FACTOR_COLUMNS, rows)


def write_g2o(path: Path, site: SiteMap, measurements: list[Factor], vertices: Vertices) -> None:
    """Write graph.g2o: poses and landmarks as VERTEX_SE2, motion and measurements as EDGE_SE2.

    The axes are those of back ends: x ahead and y to the left of a sonar whose yaw is 0, angles
    counter-clockwise in rad. A landmark's own x axis points to where its first sector begins. The
    first pose of each log is fixed.
    """
    lines = []
    for (log, row), vertex in vertices.items():
        lines.append(_vertex(vertex, *_se2(site.logs[log], row)))
    for n, landmark in enumerate(site.landmarks, len(vertices)):
        known = not math.isnan(landmark.orientation_deg)
        angle = math.radians(landmark.orientation_deg - 90) if known else 0.0
        lines.append(_vertex(n, landmark.position[1], -landmark.position[0], angle))
    fixed = []
    for log, poses in groupby(vertices, key=itemgetter(0)):
        rows = [row for _, row in poses]
        fixed.append(f"FIX {vertices[log, rows[0]]}")
        for before, after in pairwise(rows):
            step, covariance = _step(site.logs[log], before, after)
            ends = vertices[log, before], vertices[log, after]
            lines.append(_edge(*ends, step, np.linalg.inv(covariance)))
    for one in measurements:
        (ground, bearing, orientation), sigma = one.measured, np.array(one.sigma)
        if math.isnan(orientation):
            orientation, sigma[2] = 0.0, UNKNOWN_ORIENTATION_DEG
        angle = math.radians(bearing)
        cos, sin = math.cos(angle), math.sin(angle)
        measured = [ground * cos, -ground * sin, math.radians(orientation - 90)]
        # Along the line of sight and across it, in the axes ahead and to the left.
        along = np.array([cos, -sin, 0])
        across = np.array([sin, cos, 0]) * ground * math.radians(1)
        errors = np.column_stack([along, across, [0, 0, math.radians(1)]]) * sigma
        ends = vertices[one.log, one.row], len(vertices) + one.number
        lines.append(_edge(*ends, measured, np.linalg.inv(errors @ errors.T)))
    # At the end, because GTSAM stops reading at such a line.
    write_text(path, "\n".join([*lines, *fixed, ""]))


def _se2(log: MappedLog, row: int) -> tuple[float, float, float]:
    """x ahead, y left (m) and the angle counter-clockwise (rad) of a pose."""
    yaw, right, ahead = log.path.pose[row].tolist()
    return ahead, -right, -math.radians(yaw)


def _step(log: MappedLog, before: int, after: int) -> tuple[list[float], FloatArray]:
    """The motion between two poses as seen from the first, and its covariance."""
    start, end = np.array(_se2(log, before)), np.array(_se2(log, after))
    cos, sin = math.cos(start[2]), math.sin(start[2])
    rotation = (end[2] - start[2] + math.pi) % (2 * math.pi) - math.pi
    into = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    axes = into @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, -1]])
    covariance = axes @ log.path.step_covariance(before, after) @ axes.T
    least = np.square([LEAST_STEP_M, LEAST_STEP_M, math.radians(LEAST_STEP_DEG)])
    shift = into[:2, :2] @ (end[:2] - start[:2])
    return [*shift.tolist(), rotation], covariance + np.diag(least)


def _vertex(number: int, x: float, y: float, angle: float) -> str:
    return f"VERTEX_SE2 {number} {x:.6f} {y:.6f} {math.remainder(angle, 2 * math.pi):.8f}"


def _edge(start: int, end: int, measured: list[float], information: FloatArray) -> str:
    """An edge. information: (3, 3) in the axes of the start; in the file it is in those of the end,
    as back ends take it."""
    x, y, angle = measured
    cos, sin = math.cos(angle), math.sin(angle)
    into = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    upper = " ".join(f"{v:.8g}" for v in (into @ information @ into.T)[np.triu_indices(3)])
    return (
        f"EDGE_SE2 {start} {end} {x:.6f} {y:.6f} {math.remainder(angle, 2 * math.pi):.8f} {upper}"
    )
