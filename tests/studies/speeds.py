"""`make speeds`: vehicles of several speeds and turns, whose poses nobody tells.

The motion between frames is measured in the images. It is held against the true one, frame by
frame and added up over the run, and the IDs against the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from sonarrec.arrays import FloatArray
from sonarrec.config import preset
from sonarrec.simulation.motion import Pose, poses
from sonarrec.simulation.scene import Scene
from tests.studies.learning.random_scenes import random_scene
from tests.studies.results.record import options, save, show
from tests.studies.scenes import rates
from tests.support.simulated import METHODS, Job, in_processes, recognise, score

REPORTED = range(3000, 3004)
FRAMES = 160
NAMES = ("default", "offline")
FAST = ((0.1, 0.0), (0.25, 0.0), (0.5, 0.0), (0.25, 10.0), (0.5, 10.0), (0.0, 20.0), (0.5, 20.0))
SLOW = (
    (0.01, 4.0),
    (0.02, 4.0),
    (0.04, 4.0),
    (0.02, 15.0),
    (0.05, 15.0),
    (0.1, 15.0),
    (0.25, 15.0),
)
RUNS = (*((*run, 4.0) for run in FAST), *((speed, 0.0, rate) for speed, rate in SLOW))
"""Speed ahead (m/s), turn (deg/s) and frames a second. SLOW: small steps, which must add up."""
MOVED = ("dx_m", "dy_m", "dyaw_deg")
SIGMA = ("dx_sigma_m", "dy_sigma_m", "dyaw_sigma_deg")


@dataclass(frozen=True, slots=True)
class Steps:
    """From frame to frame, n that were measured of `of`.

    error: (n, 3) to the right (m), ahead (m) and turned (deg), measured less true. sigma: (n, 3)
    their stated standard errors. end: how far from the true place the path ends, m; stated: the
    standard error that its steps state for it.
    """

    error: FloatArray
    sigma: FloatArray
    of: int
    end: float
    stated: float


def steady(seed: int, speed_m_s: float, turn_deg_s: float, rate_hz: float, frames: int) -> Scene:
    """A random vehicle scene at a steady speed, with the heave, pitch and roll drawn."""
    drawn = random_scene(seed, "vehicle").motion
    still = dict.fromkeys(("surge_swing_m_s", "crab_swing_m_s", "yaw_swing_deg_s"), 0.0)
    motion = replace(drawn, surge_m_s=speed_m_s, yaw_deg_s=turn_deg_s, **still)
    name = f"vehicle_{seed}_{speed_m_s:g}_{turn_deg_s:g}_{rate_hz:g}"
    drawn_scene = random_scene(seed, "vehicle", motion=motion, name=name, frames=frames)
    return replace(drawn_scene, rate_hz=rate_hz)


def true_steps(path: Sequence[Pose]) -> FloatArray:
    """(n - 1, 3) to the right and ahead (m), as it looked before, and turned (deg)."""
    x, y, pan = np.array([(p.x_m, p.y_m, p.pan_deg) for p in path]).T
    dx, dy, angle = np.diff(x), np.diff(y), np.radians(pan[:-1])
    right = dx * np.cos(angle) - dy * np.sin(angle)
    ahead = dx * np.sin(angle) + dy * np.cos(angle)
    return np.column_stack([right, ahead, np.diff(pan)])


def path_end(steps: FloatArray) -> FloatArray:
    """(2,) where a path of such steps ends, right and ahead of where it began, m."""
    heading = np.radians(np.cumsum(steps[:, 2]) - steps[:, 2])
    right, ahead = steps[:, 0], steps[:, 1]
    x = right * np.cos(heading) + ahead * np.sin(heading)
    y = ahead * np.cos(heading) - right * np.sin(heading)
    return np.array([x.sum(), y.sum()])


def measured(scene: Scene, folder: Path) -> Steps:
    """What frames.csv says of the steps of a recording."""
    table = pd.read_csv(folder / "frames.csv")
    found = table[[*MOVED, *SIGMA]].to_numpy(float)[1:]
    there = np.isfinite(found[:, :3]).all(axis=1)
    true = true_steps(poses(scene))
    error = found[:, :3] - true
    end = path_end(np.where(there[:, None], found[:, :3], 0)) - path_end(true)
    sigma = found[there, 3:]
    return Steps(
        error[there],
        sigma,
        len(found),
        float(np.hypot(*end)),
        float(np.sqrt((sigma[:, :2] ** 2).sum())),
    )


def row(run: tuple[float, float, float], scenes: Sequence[Scene], out: Path) -> dict[str, str]:
    """All recordings of one speed and turn."""
    steps = [measured(scene, out / scene.name) for scene in scenes]
    error = np.concatenate([s.error for s in steps])
    sigma = np.concatenate([s.sigma for s in steps])
    place = 1000 * np.hypot(*error[:, :2].T)
    turn = np.abs(error[:, 2])
    within = (np.abs(error) <= 2 * sigma).mean(axis=0)
    line = {
        "m/s, deg/s, Hz": f"{run[0]:g}, {run[1]:g}, {run[2]:g}",
        "measured": f"{len(error)} of {sum(s.of for s in steps)}",
        "mm": f"{np.median(place):.1f} / {np.quantile(place, 0.95):.1f}",
        "deg": f"{np.median(turn):.2f} / {np.quantile(turn, 0.95):.2f}",
        "within 2 sigma": " ".join(f"{w:.3f}" for w in within),
        "end, m": f"{np.mean([s.end for s in steps]):.3f}",
        "stated": f"{np.mean([s.stated for s in steps]):.3f}",
    }
    found = score([out / scene.name for scene in scenes]).scored
    scored = {s.method: s for s in found if s.protocol == "strict"}
    for name in NAMES:
        line[name] = rates(scored[METHODS[name]].count())
    return line


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, recognise, measure and tell."""
    asked = options("speeds", __doc__, REPORTED, FRAMES).parse_args(arguments)
    drawn = {run: [steady(seed, *run, asked.frames) for seed in asked.seeds] for run in RUNS}
    configs = [preset(name) for name in NAMES]
    in_processes(
        recognise, [Job(s, asked.out / s.name, configs) for some in drawn.values() for s in some]
    )
    show(
        "Steps from frame to frame: how many were measured, and off by, median / 95 %; share of\n"
        "them within two stated sigmas, to the right, ahead, turned; how far off the path ends,\n"
        "and the error stated for that, but the heading's; IDs, TPR / FPR, strict",
        [row(run, some, asked.out) for run, some in drawn.items()],
    )
    save(asked.record)


if __name__ == "__main__":
    main()
