"""How the echoes of a simulated recording fade from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.simulation.motion import ar1
from sonarrec.simulation.scene import Scene
from sonarrec.simulation.world import World


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
