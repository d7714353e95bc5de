"""`make maps`: maps of simulated vehicle runs against the truth, and what they do for the path.

Each run is a course driven three times past ten landmarks, two of one ID beside each other, and
other discs. It is recognised three times from the same frames: told the true poses, told dead
reckoning that drifts, and told none. Of the first and the last the map is held against the truth,
the last relative to the first frame; of the second the factors go to a pose graph (GTSAM), whose
path is held against dead reckoning alone.

`python -m tests.studies.maps --seeds 8500:8504` is the same on seeds that settings are chosen on.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import gtsam
import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.mapping.axes import CHI2_95
from sonarrec.mapping.build import MapOptions, SiteMap, make_map
from sonarrec.mapping.factors import factors, pose_vertices
from sonarrec.mapping.path import Drift
from sonarrec.mapping.write import write_all
from tests.studies.results.record import judge, options, save, show
from tests.support.simulated import in_processes
from tests.support.vehicle import (
    VehicleRun,
    drifting,
    from_first,
    recognise_run,
    truth_of,
    vehicle_run,
)

TUNING = range(8500, 8600)
"""Seeds that settings are chosen on."""
REPORTED = range(8600, 8630)
"""Seeds of the figures that are reported: nothing is chosen on them."""
DRIFT = Drift(0.1, 5.0)
"""Of dead reckoning: m and deg that it gathers in a minute."""
NEAR_M = 0.2
"""A pass, or a landmark of a map, is of the true one within this."""
NEAR_DRIFTED_M = 0.6
"""Where the path is measured, and strays by some part of its length."""
CAUCHY = 2.0
"""Standard errors from which on a measurement weighs less; chosen on tuning seeds."""


@dataclass(frozen=True, slots=True)
class Placed:
    """The maps of all runs against the truth, n landmarks that were found.

    error_m: (n,). squared: (n,) squared Mahalanobis distance from the truth. turn_deg,
    turn_sigma_deg: (n,) error of the orientation, and the one stated. there: how many landmarks
    there were. missed, twice, joined, false: how many were not in the map, were in it more than
    once, had passes of another one, and were not there at all.
    """

    error_m: FloatArray
    squared: FloatArray
    turn_deg: FloatArray
    turn_sigma_deg: FloatArray
    there: int
    missed: int
    twice: int
    joined: int
    false: int


@dataclass(frozen=True, slots=True)
class PathError:
    """Root mean square distance (m) of a run's path from the true one, over the graph's poses.

    told: of dead reckoning. found: of the pose graph. aligned: both once more, each laid on the
    true path as well as a shift and a turn can.
    """

    told: float
    found: float
    aligned: tuple[float, float]


def recognise_seed(folder: Path, seed: int) -> None:
    """Write the results of a run, told true poses, told dead reckoning and told none."""
    run = vehicle_run(seed)
    rng = np.random.default_rng([seed, 9])
    dead_reckoning = drifting(run.path, rng, DRIFT.position_m, DRIFT.yaw_deg)
    told = {"exact": run.path, "drift": dead_reckoning, "none": None}
    recognise_run(run, {folder / f"{name}_{seed}": poses for name, poses in told.items()})


def placed(run: VehicleRun, site: SiteMap) -> Placed:
    """One map against the truth: of true poses, or relative to the first frame.

    Of true poses each pass by itself tells which landmark it was of; of others `joined` is not
    known.
    """
    exact = site.logs[0].path.from_poses
    truth = truth_of(run) if exact else from_first(run.path, truth_of(run))
    near = NEAR_M if exact else NEAR_DRIFTED_M
    periods = dict(zip(site.landmark_set.ids, site.landmark_set.periods_deg(), strict=True))
    rows, of, joined, false = [], [], 0, 0
    for one in site.landmarks:
        # Where the path strays only those of its ID can be meant.
        true = _nearest(truth, one.position, near, None if exact else one.id)
        if true is None or truth[true, 0] != one.id:
            false += 1
            continue
        if exact:
            joined += any(_nearest(truth, p.position, near) != true for _, p in one.members)
        of.append(true)
        off, period = one.position - truth[true, 1:3], periods[one.id]
        turn = (one.orientation_deg - truth[true, 3] + period / 2) % period - period / 2
        squared = off @ np.linalg.inv(one.covariance) @ off
        rows.append([np.hypot(*off), squared, abs(turn), one.orientation_sigma_deg])
    columns = np.array(rows).reshape(-1, 4).T
    found = len(set(of))
    return Placed(*columns, len(truth), len(truth) - found, len(of) - found, joined, false)


def _nearest(
    truth: FloatArray, place: FloatArray, near: float, number: int | None = None
) -> int | None:
    """The true landmark nearest to a place, of one ID where it is given; None with none near."""
    away = np.hypot(*(truth[:, 1:3] - place).T)
    if number is not None:
        away[truth[:, 0] != number] = np.inf
    return int(away.argmin()) if away.min() < near else None


def pooled(parts: Sequence[Placed]) -> Placed:
    """Several runs as one."""
    arrays = [
        np.concatenate([getattr(p, name) for p in parts])
        for name in ("error_m", "squared", "turn_deg", "turn_sigma_deg")
    ]
    counts = [
        sum(getattr(p, name) for p in parts)
        for name in ("there", "missed", "twice", "joined", "false")
    ]
    return Placed(*arrays, *counts)


def path_error(run: VehicleRun, site: SiteMap, folder: Path) -> PathError:
    """What a pose graph of the map's factors makes of the path."""
    write_all(folder, site)
    vertices = pose_vertices(site, factors(site))
    told, found = optimised(folder / "graph.g2o", len(vertices))
    true = np.column_stack([run.path[:, 2], -run.path[:, 1]])[[row for _, row in vertices]]
    aligned = tuple(_apart(_laid_on(path, true), true) for path in (told, found))
    return PathError(_apart(told, true), _apart(found, true), (aligned[0], aligned[1]))


def optimised(path: Path, poses_in_all: int) -> tuple[FloatArray, FloatArray]:
    """(n, 2) the poses of a g2o file as they are in it, and as GTSAM makes them.

    Measurements of landmarks weigh less the worse they fit (Cauchy), as wrong ones do occur.
    """
    read, first = gtsam.readG2o(str(path), False)
    factor_graph = gtsam.NonlinearFactorGraph()
    for n in range(read.size()):
        edge = read.at(n)
        noise = edge.noiseModel()
        if max(edge.keys()) >= poses_in_all:
            cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY)
            noise = gtsam.noiseModel.Robust.Create(cauchy, noise)
        factor_graph.add(gtsam.BetweenFactorPose2(*edge.keys(), edge.measured(), noise))
    fixed = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-4))
    factor_graph.add(gtsam.PriorFactorPose2(0, first.atPose2(0), fixed))
    found = gtsam.LevenbergMarquardtOptimizer(factor_graph, first).optimize()
    poses = range(poses_in_all)
    return tuple(  # type: ignore[return-value]
        np.array([values.atPose2(k).translation() for k in poses]) for values in (first, found)
    )


def _apart(one: FloatArray, other: FloatArray) -> float:
    return float(np.sqrt(((one - other) ** 2).sum(axis=1).mean()))


def _laid_on(path: FloatArray, true: FloatArray) -> FloatArray:
    """The path shifted and turned onto the true one (Umeyama, without scale)."""
    centre, onto = path.mean(axis=0), true.mean(axis=0)
    left, _, right = np.linalg.svd((true - onto).T @ (path - centre))
    turn = left @ np.diag([1, np.linalg.det(left @ right)]) @ right
    return np.asarray((path - centre) @ turn.T + onto)


def show_maps(of: Placed) -> None:
    """The maps of true poses, and their goals."""
    cover = _show("Maps of true poses", of, {"joined wrongly": str(of.joined)})
    print("\nErrors: median and 95 %.\n\nGoals\n")
    judge("place error, median, m", float(np.median(of.error_m)), 0.05)
    judge("orientation error, median, deg", float(np.median(of.turn_deg)), 5)
    judge("share within the 95 % ellipse", cover, 0.90, at_least=True)
    judge("share within the 95 % ellipse", cover, 0.99)
    judge("landmarks twice", of.twice, 0)
    judge("landmarks joined wrongly", of.joined, 0)


def _show(title: str, of: Placed, more: dict[str, str]) -> float:
    """Print maps against the truth; the share of truths within the 95 % ellipses."""
    error, turn = of.error_m, of.turn_deg
    cover = float(np.mean(of.squared <= CHI2_95))
    show(
        title,
        [
            {
                "landmarks": str(of.there),
                "missed": str(of.missed),
                "twice": str(of.twice),
                **more,
                "not there": str(of.false),
                "place m": f"{np.median(error):.4f}  {np.quantile(error, 0.95):.4f}",
                "in 95 % ellipse": f"{cover:.3f}",
                "orientation deg": f"{np.median(turn):.1f}  {np.quantile(turn, 0.95):.1f}",
                "within 1.96 sigma": f"{np.mean(turn <= 1.96 * of.turn_sigma_deg):.3f}",
            }
        ],
    )
    return cover


def show_paths(errors: Sequence[PathError]) -> None:
    """The paths of dead reckoning with and without the factors, and their goal."""
    lines = []
    for name, pairs in (
        ("from the first pose", [(e.told, e.found) for e in errors]),
        ("laid on the true path", [e.aligned for e in errors]),
    ):
        told, found = np.array(pairs).T
        lines.append(
            {
                "path": name,
                "dead reckoning m": f"{np.median(told):.3f}  {told.max():.3f}",
                "pose graph m": f"{np.median(found):.3f}  {found.max():.3f}",
                "factor of the mean squares": f"{_factor(told, found):.1f}",
                "median factor": f"{np.median(told / found):.1f}",
                "worst": f"{(told / found).min():.1f}",
            }
        )
    show("Dead reckoning, and the pose graph with the factors: error of the path", lines)
    print("\nErrors: median and worst of the runs' root mean squares.\n\nGoal\n")
    told, found = np.array([(e.told, e.found) for e in errors]).T
    judge("path error, factor of the mean squares", _factor(told, found), 3, at_least=True)


def _factor(told: FloatArray, found: FloatArray) -> float:
    """By how much the root mean square over all runs falls."""
    return float(np.sqrt((told**2).mean() / (found**2).mean()))


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, recognise, map, optimise and tell."""
    asked = options("maps", __doc__, REPORTED).parse_args(arguments)
    begun = time.monotonic()
    in_processes(partial(recognise_seed, asked.out), asked.seeds)
    maps, alone, errors = [], [], []
    for seed in asked.seeds:
        run = vehicle_run(seed)
        maps.append(placed(run, make_map([asked.out / f"exact_{seed}"])))
        alone.append(placed(run, make_map([asked.out / f"none_{seed}"])))
        folder = asked.out / f"drift_{seed}"
        errors.append(path_error(run, make_map([folder], MapOptions(drift=DRIFT)), folder / "map"))
    print(f"{len(asked.seeds)} runs: seeds {asked.seeds.start} to {asked.seeds.stop - 1}")
    show_maps(pooled(maps))
    _show(
        "Maps without poses, relative to the first frame, by the measured motion", pooled(alone), {}
    )
    show_paths(errors)
    save(asked.record)
    print(f"\n{asked.out}; {(time.monotonic() - begun) / 60:.1f} minutes")


if __name__ == "__main__":
    main()
