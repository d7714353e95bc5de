"""The acoustic simulator: renders the frames of a scene, with their truth.

The floor is a grid of scatterers: a polar grid, or squares if the sonar is on a vehicle. The echo
of a beam is the coherent sum over all scatterers of reflectivity times beam pattern. So speckle,
and how it behaves when the sonar moves, follow from the geometry. One matrix holds the main lobes,
the side lobes and the leaks between beams. Drawn plates are scatterers of their own (plates.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.simulation.fish import Shoal
from sonarrec.simulation.grid import PolarGrid, SquareGrid
from sonarrec.simulation.motion import Pose, ar1, poses
from sonarrec.simulation.plates import Plates
from sonarrec.simulation.receiver import Picture, Receiver
from sonarrec.simulation.scene import AnyScene, PlateScene, Scene, check_scene, scene_fan
from sonarrec.simulation.truth import Truth, truth_in_view
from sonarrec.simulation.world import PATCHES, World
from sonarrec.sonar.frame import Fan


@dataclass(frozen=True, slots=True)
class SimulatedFrame:
    """One simulated ping."""

    index: int
    timestamp_ns: int
    image: ByteImage
    """uint8, (fan.rows, fan.columns), or (range bins, beams) if polar."""
    fan: Fan
    """The geometry as sonar.toml states it."""
    pan_deg: float
    """The true pan, yaw jitter included."""
    truth: tuple[Truth, ...]
    distractors: tuple[Truth, ...] = ()
    """truth, distractors: landmarks and other objects in view, in the scene's order."""


def render(
    scene: AnyScene, path: Sequence[Pose] | None = None, ground: Scene | None = None
) -> Iterator[SimulatedFrame]:
    """Render the scene's frames in order. The same scene gives the same bytes.

    path: the sonar's pose in every frame, such as a vehicle's; replaces the scene's motion.
    ground: a scene whose range window and sweep, seen from the floor's origin, cover all the floor
    that the path shows; default: the scene itself.
    Raises SonarrecError if the scene contradicts itself.
    """
    fan = scene_fan(scene)
    if isinstance(scene, PlateScene):
        plates = Plates(scene)
        for index in range(scene.frames):
            stamp = round(index * 1e9 / scene.rate_hz)
            yield SimulatedFrame(index, stamp, *plates.frame(index, fan))
        return
    check_scene(scene, scene.name)
    path = poses(scene) if path is None else path
    roams = ground is None and scene.motion.speeds.any()
    grid = SquareGrid(scene, path) if roams else PolarGrid(ground or scene)
    world = World(ground or scene, grid)
    receiver, picture, fading = Receiver(scene), Picture(scene, fan), _Fading(scene)
    corners = [np.array([end(grid.x_m), end(grid.y_m)], float) for end in (np.min, np.max)]
    shoal = Shoal(scene, *corners) if scene.fish.number else None
    fishes = None
    for index, pose in enumerate(path):
        time_s = fading.time_s[index]
        world.fade(fading.object_db[index], fading.patches[index], fading.afterglow_db[index])
        heave = pose.height_m - scene.sonar.height_m
        moved = np.array([pose.x_m, pose.y_m, heave]) * (math.sqrt(2) / scene.floor.speckle_m)
        view = world.view(receiver.range_m, pose, [time_s / scene.floor.speckle_s, *moved])
        if shoal:
            fishes = shoal.positions(time_s)
            rng = np.random.default_rng([scene.seed, 15, index])
            shoal.swim_into(view, receiver.range_m, pose, fishes, rng)
        gains_db = fading.signal_db[index], fading.drift_db[index]
        image = picture(receiver.power(view, pose, time_s, *gains_db))
        stamp, shown = round(index * 1e9 / scene.rate_hz), truth_in_view(scene, fan, pose, fishes)
        yield SimulatedFrame(index, stamp, image, fan, pose.pan_deg, *shown)


class _Fading:
    """How the echoes of a scene fade from frame to frame, all (frames, ...).

    time_s: of the frames. signal_db: gain of the echoes. drift_db: gain of echoes and noise.
    object_db, afterglow_db: of each object, landmarks first. patches: PATCHES, standard normal.
    With fewer frames it is the beginning of the same fading: each process has its own generator.
    """

    def __init__(self, scene: Scene) -> None:
        signal, objects, patches, glow, glow_changes, drift = np.random.default_rng(
            [scene.seed, 5]
        ).spawn(6)
        fading, noise, frames = scene.fading, scene.noise, scene.frames
        count, step_s = len(scene.items), 1 / scene.rate_hz

        def changing(rng: np.random.Generator, size: int) -> FloatArray:
            return ar1(rng, frames, size, step_s, fading.time_s)

        # Single frames fade, and bursts of frames.
        depths, singles, starts, bursts = signal.spawn(4)
        depth = fading.depth_db * depths.gamma(4.0, 0.25, frames)
        self.signal_db = -depth * (singles.random(frames) < fading.frame_probability)
        for begin in np.flatnonzero(starts.random(frames) < fading.burst_probability):
            length = 1 + bursts.geometric(1 / max(fading.burst_frames, 1.0))
            part = self.signal_db[begin : begin + length]
            shape = np.sin(np.pi * (np.arange(len(part)) + 1) / (length + 1)) ** 0.5
            np.minimum(part, -depth[begin] * shape, out=part)
        self.time_s = np.arange(frames) * step_s
        swing = np.sin(2 * np.pi * (self.time_s / noise.gain_drift_s + drift.uniform()))
        self.drift_db = noise.gain_drift_db * swing
        self.object_db = fading.object_db * changing(objects, count)
        self.afterglow_db = glow.normal(0, 3, count) + 2 * changing(glow_changes, count)
        self.patches = changing(patches, PATCHES)
