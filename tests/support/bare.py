"""Simulated scenes without faults, and the power that their images stand for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from sonarrec.simulation.render import render
from sonarrec.simulation.scene import Scene


def changed(scene: Scene, **changes: Any) -> Scene:
    """The scene with other values; a dictionary changes some of a section's."""
    sections = {name for name, value in changes.items() if isinstance(value, dict)}
    changes |= {name: replace(getattr(scene, name), **changes[name]) for name in sections}
    return replace(scene, **changes)


# A still sonar over an even floor, without faults. speckle_s far below the frame time gives every
# frame speckle of its own, so that a mean over frames tends to the expected power.
_LEAKS = dict.fromkeys(("side_lobe_db", "stray_db", "cross_talk_db"), -200)
BARE = changed(
    Scene(),
    frames=1,
    sonar=_LEAKS | {"vertical_beam_deg": 1000, "beam_width_deg": 0.3},
    motion=dict.fromkeys(("pan_min_deg", "pan_max_deg", "pan_start_deg", "pan_deg_s"), 0),
    floor={"texture_db": 0, "angle_exponent": 0, "speckle_s": 1e9},
    fading=dict.fromkeys(("object_db", "patch_db", "specular_db", "frame_probability"), 0)
    | {"ghost_db": -200},
    noise={"snr_db": 80}
    | dict.fromkeys(("smear", "group_gain_db", "beam_gain_db", "hot_beams"), 0),
    picture={"black_db": -50, "dynamic_range_db": 80},
)
POLAR = changed(BARE, sonar={"layout": "polar"})
BIN_M = 2.5 / 512
RANGE_M = 1.25 + (np.arange(512) + 0.5) * BIN_M  # of their samples


def looking(scene: Scene, pan_deg: float) -> Scene:
    """The scene, seen from a still sonar that is turned so far to the right."""
    return changed(
        scene, motion=dict.fromkeys(("pan_min_deg", "pan_max_deg", "pan_start_deg"), pan_deg)
    )


def power(image: np.ndarray, scene: Scene) -> np.ndarray:
    """Undo the log compression."""
    decibel = image / 255 * scene.picture.dynamic_range_db + scene.picture.black_db
    return np.asarray(10 ** (decibel / 10))


def mean_power(scene: Scene, frames: int) -> np.ndarray:
    scene = changed(scene, frames=frames, floor={"speckle_s": 1e-3})
    return np.asarray(np.mean([power(f.image, scene) for f in render(scene)], axis=0))


def even_power(scene: Scene) -> np.ndarray:
    """The same of one frame of a world without speckle."""
    (frame,) = render(changed(scene, frames=1, floor={"coherence": 0.0}))
    return power(frame.image, scene)
