"""A map as factors for a SLAM back end: measurements of landmarks from poses, and a g2o graph."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.files.outputs import write_csv, write_text
from sonarrec.geometry import floor_depth, ground_range
from sonarrec.mapping.build import SiteMap
from sonarrec.mapping.join import MappedLog, frame_shares
from sonarrec.mapping.passes import (
    COMMON_SHARE,
    HEIGHT_SIGMA_M,
    LEAST_PLACE_M,
    LEAST_TURN_DEG,
    SAME_FRAMES,
    TURN_SIGMA_DEG,
    periods_of,
)

FACTOR_COLUMNS = (
    *("log", "frame", "timestamp_ns", "pose_vertex", "landmark_vertex", "number", "landmark"),
    *("range_m", "ground_range_m", "bearing_deg", "orientation_deg"),
    *("ground_range_sigma_m", "bearing_sigma_deg", "orientation_sigma_deg"),
)
PER_PASS = 5
"""Most measurements that are taken from one pass."""
# Given poses without drift are exact, but the numbers in a graph must be finite.
LEAST_STEP_M, LEAST_STEP_DEG = 0.001, 0.01
UNKNOWN_TURN_DEG = 1e3


@dataclass(frozen=True, slots=True)
class Factors:
    """Measurements of landmarks from poses, n of them.

    log: (n,) index of the map's log. row: (n,) of the log's path. number: (n,) index of the map's
    landmark. slant_m: (n,) slant range. measured: (n, 3) ground range (m), bearing and orientation
    (deg, as in estimates.csv; NaN if not known). If the symbol looks the same after a turn, it is
    the orientation next to the map's. sigma: (n, 3) standard errors, so large that all measurements
    of a pass, taken as independent, weigh as much as the pass, and passes that share frames as much
    as one.
    """

    log: IntArray
    row: IntArray
    number: IntArray
    slant_m: FloatArray
    measured: FloatArray
    sigma: FloatArray


def factors(site: SiteMap) -> Factors:
    """The measurements of every landmark of the map: at most PER_PASS from each of its passes."""
    rows: list[FloatArray] = [np.empty((0, 10))]
    for number, landmark in enumerate(site.landmarks):
        for g, members in groupby(landmark.members, key=itemgetter(0)):
            passes = [k for _, k in members]
            for k, share in zip(passes, frame_shares(site.logs[g], passes), strict=True):
                of_pass = _of_pass(site, number, g, k)
                of_pass[:, 7:] /= math.sqrt(share)
                rows.append(of_pass)
    table = np.concatenate(rows)
    table = table[np.lexsort([table[:, 2], table[:, 1], table[:, 0]])]
    log, row, number = table[:, :3].astype(np.int64).T
    return Factors(log, row, number, table[:, 3], table[:, 4:7], table[:, 7:10])


def _of_pass(site: SiteMap, number: int, g: int, k: int) -> FloatArray:
    """(n, 10) measurements from one pass of a landmark.

    The columns are log, row, number, slant range, three of `measured` and three of `sigma`.
    """
    log, landmark = site.logs[g], site.landmarks[number]
    passes, declared = log.passes, log.declared
    length = int(passes.estimates[k])
    take = np.unique(np.linspace(0, length - 1, min(length, PER_PASS)).round().astype(int))
    estimates = passes.order[passes.begin[k] + take]
    row, (slant, bearing, turn) = declared.row[estimates], declared.polar[estimates].T
    ground = ground_range(log.fan, slant)
    period = float(periods_of(site.landmark_set, np.array([landmark.id]))[0])
    if math.isnan(period):
        turn = np.full(len(row), np.nan)
    elif not math.isnan(landmark.turn_deg):
        off = turn - (landmark.turn_deg + log.path.pose[row, 0])
        turn = turn - period * np.round(off / period)
    # The share of a frame's variance that remains in the mean of the pass.
    share = COMMON_SHARE + (1 - COMMON_SHARE) * min(SAME_FRAMES, length) / length
    own = declared.sigma[estimates].T * np.array(
        [slant / ground, np.ones(len(row)), np.ones(len(row))]
    )
    least = [
        np.hypot(LEAST_PLACE_M, HEIGHT_SIGMA_M * floor_depth(log.fan) / ground),
        np.degrees(LEAST_PLACE_M / ground),
        np.full(len(row), math.hypot(LEAST_TURN_DEG, TURN_SIGMA_DEG)),
    ]
    sigma = np.sqrt(len(row) * (share * own**2 + np.square(least)))
    same = np.ones(len(row))
    measured = [ground, bearing, turn % 360]
    return np.column_stack([g * same, row, number * same, slant, *measured, *sigma])


def write_factors(path: Path, site: SiteMap, measurements: Factors, graph: Graph) -> None:
    """Write factors.csv: a row per measurement."""

    def rows() -> Iterator[list[object]]:
        for n in range(len(measurements.log)):
            log = site.logs[measurements.log[n]]
            ground, bearing, turn = measurements.measured[n].tolist()
            sigma = measurements.sigma[n].tolist()
            known = not math.isnan(turn)
            yield [
                log.name,
                int(log.path.frame[measurements.row[n]]),
                int(log.path.timestamp_ns[measurements.row[n]]),
                graph.vertex(int(measurements.log[n]), int(measurements.row[n])),
                graph.first_landmark + int(measurements.number[n]),
                int(measurements.number[n]) + 1,
                site.landmarks[measurements.number[n]].id,
                f"{measurements.slant_m[n]:.4f}",
                f"{ground:.4f}",
                f"{bearing:.3f}",
                f"{turn:.2f}" if known else "",
                f"{sigma[0]:.4f}",
                f"{sigma[1]:.3f}",
                f"{sigma[2]:.2f}" if known else "",
            ]

    write_csv(path, FACTOR_COLUMNS, rows())


@dataclass(frozen=True, slots=True)
class Graph:
    """The vertices of a pose graph: poses of the logs, one log after the other, then landmarks.

    rows: of each log the (n,) frames whose poses are in it, as indices of its path, rising.
    first: the number of each log's first vertex. first_landmark: that of the first landmark.
    """

    rows: list[IntArray]
    first: list[int]
    first_landmark: int

    def vertex(self, log: int, row: int) -> int:
        """The number of the pose in a frame of a log."""
        return self.first[log] + int(np.searchsorted(self.rows[log], row))


def graph_of(site: SiteMap, measurements: Factors) -> Graph:
    """The graph's poses: those of measurements, and the first and last known pose of each log."""
    rows = []
    for g, log in enumerate(site.logs):
        known = np.flatnonzero(np.isfinite(log.path.pose).all(axis=1))
        ends = known[[0, -1]] if len(known) else known
        rows.append(np.unique(np.concatenate([ends, measurements.row[measurements.log == g]])))
    first = np.cumsum([0, *(len(r) for r in rows)]).tolist()
    return Graph(rows, first[:-1], first[-1])


def write_g2o(path: Path, site: SiteMap, measurements: Factors, graph: Graph) -> None:
    """Write graph.g2o: poses and landmarks as VERTEX_SE2, motion and measurements as EDGE_SE2.

    The axes are those of back ends: x ahead and y to the left of a sonar whose yaw is 0, angles
    counter-clockwise in rad. A landmark's own x axis points to where its first sector begins. The
    first pose of each log is fixed.
    """
    lines = []
    poses = [_se2(log.path.pose[rows]) for log, rows in zip(site.logs, graph.rows, strict=True)]
    for first, trail in zip(graph.first, poses, strict=True):
        lines += [_vertex(first + n, pose) for n, pose in enumerate(trail.tolist())]
    for n, landmark in enumerate(site.landmarks):
        turn = 0.0 if math.isnan(landmark.turn_deg) else math.radians(landmark.turn_deg - 90)
        lines.append(
            _vertex(graph.first_landmark + n, [landmark.place[1], -landmark.place[0], turn])
        )
    for log, rows, first, trail in zip(site.logs, graph.rows, graph.first, poses, strict=True):
        for n in range(len(rows) - 1):
            step, covariance = _step(log, rows[n], rows[n + 1], trail[n], trail[n + 1])
            lines.append(_edge(first + n, first + n + 1, step, np.linalg.inv(covariance)))
    for n in range(len(measurements.log)):
        ground, bearing, turn = measurements.measured[n].tolist()
        sigma = measurements.sigma[n].copy()
        if math.isnan(turn):
            turn, sigma[2] = 0.0, UNKNOWN_TURN_DEG
        angle = math.radians(bearing)
        measured = [ground * math.cos(angle), -ground * math.sin(angle), math.radians(turn - 90)]
        # Along the line of sight and across it, in the axes ahead and to the left.
        along = np.array([math.cos(angle), -math.sin(angle), 0])
        across = np.array([math.sin(angle), math.cos(angle), 0]) * ground * math.radians(1)
        turned = np.array([0, 0, math.radians(1)])
        errors = np.column_stack([along, across, turned]) * sigma
        pose = graph.vertex(int(measurements.log[n]), int(measurements.row[n]))
        information = np.linalg.inv(errors @ errors.T)
        lines.append(
            _edge(pose, graph.first_landmark + int(measurements.number[n]), measured, information)
        )
    # At the end, because GTSAM stops reading at such a line.
    lines += [f"FIX {first}" for first, trail in zip(graph.first, poses, strict=True) if len(trail)]
    write_text(path, "\n".join([*lines, ""]))


def _se2(pose: FloatArray) -> FloatArray:
    """(n, 3) x ahead, y left, angle counter-clockwise (rad) of (n, 3) yaw (deg), right, ahead."""
    yaw, right, ahead = pose.T
    return np.column_stack([ahead, -right, -np.radians(yaw)])


def _step(
    log: MappedLog, before: int, after: int, start: FloatArray, end: FloatArray
) -> tuple[list[float], FloatArray]:
    """The motion between two poses as seen from the first, and its covariance."""
    cos, sin = math.cos(start[2]), math.sin(start[2])
    away, turn = end[:2] - start[:2], (end[2] - start[2] + math.pi) % (2 * math.pi) - math.pi
    into = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    axes = into @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, -1]])
    covariance = axes @ log.path.step_covariance(before, after) @ axes.T
    least = np.square([LEAST_STEP_M, LEAST_STEP_M, math.radians(LEAST_STEP_DEG)])
    return [*(into[:2, :2] @ away).tolist(), turn], covariance + np.diag(least)


def _vertex(number: int, pose: list[float]) -> str:
    x, y, angle = pose
    return f"VERTEX_SE2 {number} {x:.6f} {y:.6f} {math.remainder(angle, 2 * math.pi):.8f}"


def _edge(start: int, end: int, measured: list[float], information: FloatArray) -> str:
    """What is seen of the end from the start, and its information (3, 3) by the start's axes.

    Back ends take the error by the axes of the end, as measured: so the file has it.
    """
    x, y, angle = measured
    cos, sin = math.cos(angle), math.sin(angle)
    into = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    upper = " ".join(f"{v:.8g}" for v in (into @ information @ into.T)[np.triu_indices(3)])
    return (
        f"EDGE_SE2 {start} {end} {x:.6f} {y:.6f} {math.remainder(angle, 2 * math.pi):.8f} {upper}"
    )
