"""The acoustic simulator: renders the frames of a scene, with their truth.

The floor is a grid of scatterers: a polar grid, or squares if the sonar is on a vehicle. The echo
of a beam is the coherent sum over all scatterers of reflectivity times beam pattern. So speckle,
and how it behaves when the sonar moves, follow from the geometry. One matrix holds the main lobes,
the side lobes and the leaks between beams.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.nouns import Fan
from sonarrec.simulation.fish import Shoal
from sonarrec.simulation.grid import PolarGrid, SquareGrid, corners
from sonarrec.simulation.motion import Pose, ar1, poses
from sonarrec.simulation.receiver import Multipath, Picture, Receiver, shifted, vertical_pattern
from sonarrec.simulation.scene import Scene, check_scene, scene_fan, travels
from sonarrec.simulation.truth import DistractorTruth, LandmarkTruth, truth_in_view
from sonarrec.simulation.world import View, World


@dataclass(frozen=True, slots=True)
class SimulatedFrame:
    """One simulated ping.

    image: uint8, (fan.rows, fan.columns), or (range bins, beams) if polar. fan: the geometry as
    sonar.toml states it. pan_deg: the true pan, yaw jitter included. truth, distractors: what is in
    view, in the scene's order.
    """

    index: int
    timestamp_ns: int
    image: ByteImage
    fan: Fan
    pan_deg: float
    truth: tuple[LandmarkTruth, ...]
    distractors: tuple[DistractorTruth, ...]


def render(
    scene: Scene, path: Sequence[Pose] | None = None, ground: Scene | None = None, every: int = 1
) -> Iterator[SimulatedFrame]:
    """Render the scene's frames in order. The same scene gives the same bytes.

    path: the sonar's pose in every frame, such as a vehicle's; replaces the scene's motion.
    ground: a scene whose range window and sweep, seen from the floor's origin, cover all the floor
    that the path shows; default: the scene itself. every: leave out all frames but each `every`-th.
    Raises SonarrecError if the scene contradicts itself.
    """
    check_scene(scene, scene.name)
    fan, sonar = scene_fan(scene), scene.sonar
    path = poses(scene) if path is None else path
    floor_scene = ground or scene
    roams = ground is None and travels(scene.motion)
    grid = SquareGrid(scene, path) if roams else PolarGrid(floor_scene)
    world = World(floor_scene, np.random.default_rng([scene.seed, 1]), grid)
    receiver = Receiver(scene, np.random.default_rng([scene.seed, 3]))
    bin_m = fan.window_m / sonar.range_bins
    range_m = sonar.range_min_m + (np.arange(sonar.range_bins) + 0.5) * bin_m
    reception = _Reception(scene, receiver, range_m)
    picture = Picture(scene, fan)
    fading = Fading.of(scene)
    shoal = Shoal(scene, *corners(grid)) if scene.fish.number else None
    for index, pose in enumerate(path):
        if index % every:
            continue
        time_s = fading.time_s[index]
        world.fade(fading.object_db[index], fading.patches[index], fading.afterglow_db[index])
        heave = pose.height_m - sonar.height_m
        moved = np.array([pose.x_m, pose.y_m, heave]) * (math.sqrt(2) / scene.floor.speckle_m)
        view = world.view(range_m, pose, [time_s / scene.floor.speckle_s, *moved])
        fishes = shoal.at(time_s) if shoal else None
        if shoal and fishes:
            rng = np.random.default_rng([scene.seed, 15, index])
            shoal.swim_into(view, range_m, pose, fishes, rng)
        power = reception.power(view, pose, time_s, fading.signal_db[index])
        power *= (receiver.gain * np.float32(10 ** (fading.drift_db[index] / 20))) ** 2
        stamp, shown = round(index * 1e9 / scene.rate_hz), truth_in_view(scene, fan, pose, fishes)
        yield SimulatedFrame(index, stamp, picture(power), fan, pose.pan_deg, *shown)


class _Reception:
    """Turns the scatterers in view into the power that the sonar receives."""

    def __init__(self, scene: Scene, receiver: Receiver, range_m: FloatArray) -> None:
        """range_m: (bins,) slant ranges of the centres of the range bins."""
        self._scene, self._receiver = scene, receiver
        self._rng = np.random.default_rng([scene.seed, 4])
        self._noise = np.float32(10 ** (-scene.noise.snr_db / 20) / math.sqrt(2))
        bin_m = scene_fan(scene).window_m / scene.sonar.range_bins
        self._glow_sigma = min(max(scene.fading.ghost_blur_m / bin_m, 0.3), len(range_m))
        self._glow_shift = round(scene.fading.ghost_shift_m / bin_m)
        self._late = Multipath(scene, range_m)

    def power(self, view: View, pose: Pose, time_s: float, signal_db: float) -> np.ndarray:
        """(bins, beams) float32 power of the next frame. signal_db: gain of its echoes, dB."""
        scene, receiver = self._scene, self._receiver
        patterns = receiver.patterns(view.azimuth_deg, pose.pan_deg)
        strength = vertical_pattern(scene, view.depression_deg, view.sine, pose.pitch_deg)
        strength = strength.astype(np.float32)
        field = receiver.beams(view.echoes * strength, patterns)
        received = np.square(patterns.real) + np.square(patterns.imag)
        # An afterglow is the sum of many late paths: smooth in power, not coherent.
        glow = (view.glow * strength**2) @ received
        glow = cv2.GaussianBlur(glow, (0, 0), sigmaX=1.0, sigmaY=self._glow_sigma)
        glow = shifted(glow, self._glow_shift)
        signal = np.float32(10 ** (signal_db / 20))
        hiss = self._rng.standard_normal((*field.shape, 2), dtype=np.float32)
        field = field * signal
        random: np.ndarray | np.float32 = self._noise
        late_power = None
        if self._late.comes:
            # Speckle that is new in every frame is hiss, only not as even.
            late_power = self._late.power(field.real**2 + field.imag**2, time_s)
            random = np.sqrt(random**2 + late_power / 2)
        field = field + hiss.view(np.complex64)[..., 0] * random
        power = field.real**2 + field.imag**2
        incoherent = np.float32(1 - scene.floor.coherence)
        if incoherent > 0:
            power = power * np.float32(scene.floor.coherence)
            even = receiver.even(view.power * strength**2, received)
            power += incoherent * even * signal**2
            if late_power is not None:
                power += incoherent * late_power
        power += glow * signal**2
        if scene.noise.smear:
            smooth = cv2.GaussianBlur(power, (0, 0), sigmaX=0.8, sigmaY=2.0)
            power += np.float32(scene.noise.smear) * (smooth - power)
        return np.asarray(power)


@dataclass(frozen=True, slots=True)
class Fading:
    """How the echoes fade from frame to frame.

    time_s: (frames,). signal_db: (frames,) gain of the echoes. drift_db: (frames,) gain of echoes
    and noise. object_db, afterglow_db: (frames, objects), landmarks first. patches: (frames,
    World.PATCHES), standard normal.
    """

    time_s: FloatArray
    signal_db: FloatArray
    drift_db: FloatArray
    object_db: FloatArray
    afterglow_db: FloatArray
    patches: FloatArray

    @classmethod
    def of(cls, scene: Scene) -> Fading:
        """Draw the fading of a scene. With fewer frames it is the beginning of the same fading."""
        # That is why each process has a generator of its own.
        signal, objects, patches, glow, glow_changes, drift = np.random.default_rng(
            [scene.seed, 5]
        ).spawn(6)
        fading, noise, frames = scene.fading, scene.noise, scene.frames
        count, step_s = len(scene.landmarks) + len(scene.objects), 1 / scene.rate_hz

        def changing(rng: np.random.Generator, size: int) -> FloatArray:
            return ar1(rng, frames, size, step_s, fading.time_s)

        time_s = np.arange(frames) * step_s
        swing = np.sin(2 * np.pi * (time_s / noise.gain_drift_s + drift.uniform()))
        return cls(
            time_s,
            _signal_gain_db(scene, signal),
            noise.gain_drift_db * swing,
            fading.object_db * changing(objects, count),
            glow.normal(0, 3, count) + 2 * changing(glow_changes, count),
            changing(patches, World.PATCHES),
        )


def _signal_gain_db(scene: Scene, rng: np.random.Generator) -> FloatArray:
    """(frames,) gain of the echoes, dB: single frames fade, and bursts of frames."""
    fading, frames = scene.fading, scene.frames
    depths, singles, starts, bursts = rng.spawn(4)
    depth = fading.depth_db * depths.gamma(4.0, 0.25, frames)
    gain = -depth * (singles.random(frames) < fading.frame_probability)
    begins = np.flatnonzero(starts.random(frames) < fading.burst_probability)
    for begin in begins:
        length = 1 + bursts.geometric(1 / max(fading.burst_frames, 1.0))
        part = gain[begin : begin + length]
        shape = np.sin(np.pi * (np.arange(len(part)) + 1) / (length + 1)) ** 0.5
        np.minimum(part, -depth[begin] * shape, out=part)
    return np.asarray(gain)
