"""How a simulated sonar moves: the pan sweep, a vehicle's run, and disturbances."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.simulation.scene import Scene, speeds, travels


@dataclass(frozen=True, slots=True)
class Pose:
    """The sonar's true pose. x_m, y_m: to the right and forward of the floor's origin.

    pitch_deg: by how much it is tilted more than stated. roll_deg: by how much its right side is
    down.
    """

    pan_deg: float
    height_m: float
    x_m: float
    y_m: float
    pitch_deg: float = 0.0
    roll_deg: float = 0.0


def sweep_deg(low: float, high: float, start: float, travelled: FloatArray | float) -> FloatArray:
    """Pan angle (deg) after `travelled` degrees of a sweep to and fro between low and high.

    It begins at `start`, to the right.
    """
    span = high - low
    if span == 0:
        return np.full(np.shape(travelled), low)
    phase = np.mod(start - low + np.asarray(travelled, dtype=float), 2 * span)
    return np.asarray(low + np.minimum(phase, 2 * span - phase))


def ar1(
    rng: np.random.Generator, steps: int, size: int, step_s: float, time_s: float
) -> FloatArray:
    """(steps, size) first-order autoregressive processes of unit variance.

    step_s: time between steps. time_s: after which the correlation has fallen to 1/e.
    """
    keep = math.exp(-step_s / time_s)
    drawn = rng.standard_normal((steps, size))
    drawn[1:] *= math.sqrt(1 - keep**2)
    for step in range(1, steps):
        drawn[step] += keep * drawn[step - 1]
    return drawn


def run(scene: Scene) -> FloatArray:
    """(frames, 3) heading (deg), x and y (m) of the vehicle; all begin at 0."""
    motion = scene.motion
    phase = np.random.default_rng([scene.seed, 9]).uniform(0, 2 * np.pi, 3)
    # In tenths of a frame, so that the result hardly depends on how the steps are summed.
    time = np.arange((scene.frames - 1) * 10 + 1) / (10 * scene.rate_hz)
    swing = np.sin(2 * np.pi * time[:, None] / motion.swing_period_s + phase)
    throughout, amplitude = np.transpose(speeds(motion))
    ahead, right, turn = (throughout + amplitude * swing).T
    heading = _summed(turn, time)
    sine, cosine = np.sin(np.radians(heading)), np.cos(np.radians(heading))
    x = _summed(ahead * sine + right * cosine, time)
    y = _summed(ahead * cosine - right * sine, time)
    return np.column_stack([heading, x, y])[::10]


def _summed(speed: FloatArray, time: FloatArray) -> FloatArray:
    """The integral of a speed from the first moment on, by the trapezoidal rule."""
    steps = np.diff(time) * (speed[1:] + speed[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])


def poses(scene: Scene) -> list[Pose]:
    """The sonar's true pose in every frame."""
    motion, frames = scene.motion, scene.frames
    rng = np.random.default_rng([scene.seed, 2])
    phase = rng.uniform(0, 2 * np.pi, 3)
    time = np.arange(frames) / scene.rate_hz
    pan = sweep_deg(
        motion.pan_min_deg, motion.pan_max_deg, motion.pan_start_deg, motion.pan_deg_s * time
    )
    jitter = ar1(rng, frames, 1, 1 / scene.rate_hz, motion.yaw_jitter_s)[:, 0]
    pan = pan + motion.yaw_jitter_deg * jitter
    heave = motion.heave_m * np.sin(2 * np.pi * time / motion.heave_period_s + phase[0])
    slow = 2 * np.pi * time / motion.sway_period_s
    heading, x, y = run(scene).T if travels(motion) else np.zeros((3, frames))
    tossed = np.random.default_rng([scene.seed, 10]).uniform(0, 2 * np.pi, 2)
    toss = np.sin(2 * np.pi * time[:, None] / motion.attitude_period_s + tossed)
    attitude = toss * (motion.pitch_deg, motion.roll_deg)
    x = motion.sway_x_m * np.sin(slow + phase[1]) + x
    y = motion.sway_y_m * np.sin(slow + phase[2]) + y
    every = np.column_stack([pan + heading, scene.sonar.height_m + heave, x, y, attitude])
    return [Pose(*values) for values in every.tolist()]
