"""Kinds of random scene from other worlds than the basin, as changes to a scene that was drawn."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from sonarrec.simulation.scene import SYMBOLS, FishSection, MotionSection, MultipathSection, Scene

OTHER_WORLDS = (
    *("any_floor", "relief", "light", "debris", "symbols", "wide", "other_symbols"),
    *("slope", "leaning", "silted", "ripples", "multipath", "fish", "vehicle", "glitter"),
)
"""Kinds, in the order in which they were added. New ones go last, because the number of a kind is
part of the seed of its scenes.

Any floor: ring and sectors 5 to 14 dB over a plate that is -12 to +6 dB over the floor, so that
the ring may be as bright as the floor, or darker; short and long pulses. Relief: gravel on a rough
floor, with lit slopes and shadows, without or with little speckle. Light: patches of light and
shade with sharp edges. Debris: twigs and weed, over the landmarks as well, on a coarse, blotchy
floor. Symbols: rings with symbols that no ID has. Wide: 120 to 130 deg, 1-degree beams. Slope: the
floor rises by up to 8 deg some way. Leaning: discs lie tilted by up to 15 deg. Silted: a tenth to
two fifths of each disc is under silt. Ripples: in the sand around the discs. Multipath: a later
copy of the scene, and bands, by way of the surface. Fish: singly and in schools. Vehicle: the
sonar travels and turns, with pitch and roll. Glitter: single stones of ring and sectors, a
twentieth to a third of their area, are 2 to 10 dB brighter than the others in the mean; in every
second recording the floor has little speckle."""
LEARNED_WORLDS = (
    *("any_floor", "relief", "light", "debris", "symbols", "wide"),
    *("leaning", "ripples", "fish", "vehicle", "glitter"),
)
"""Kinds from which `make model` learns, in addition to those of the basin. Left out are
other_symbols, slope, silted and multipath."""
_DISCS = ("blank", "spokes", "half_ring", *SYMBOLS, "filled")


def in_world(scene: Scene, kind: str, rng: np.random.Generator) -> Scene:
    """The scene with the changes of its kind; the same scene if the kind has none."""
    return _CHANGES[kind](scene, rng) if kind in _CHANGES else scene


def _any_floor(scene: Scene, rng: np.random.Generator) -> Scene:
    u, plate = rng.uniform, rng.uniform(-12, 6)
    scene = _with_levels(scene, plate, plate + u(5, 14), rng)
    scene = replace(scene, sonar=replace(scene.sonar, pulse_m=round(u(0.004, 0.02), 4)))
    return _lit(scene, u(2, 6), rng) if u() < 0.3 else scene


def _relief(scene: Scene, rng: np.random.Generator) -> Scene:
    u, plate = rng.uniform, rng.uniform(-12, -2)
    scene = _with_levels(scene, plate, plate + u(5, 14), rng, relief_m=u(0, 0.012))
    scene = _on_floor(
        scene,
        coherence=round(max(u(-0.5, 0.5), 0.0), 3),
        relief_m=round(u(0.001, 0.005), 4),
        relief_size_m=round(u(0.015, 0.04), 4),
    )
    fading = replace(scene.fading, object_db=u(0, 0.5), patch_db=u(0, 1), specular_db=u(0, 3))
    scene = replace(scene, fading=fading)
    return _lit(scene, u(2, 6), rng) if u() < 0.2 else scene


def _light(scene: Scene, rng: np.random.Generator) -> Scene:
    return _lit(scene, rng.uniform(3, 10), rng)


def _debris(scene: Scene, rng: np.random.Generator) -> Scene:
    u, plate = rng.uniform, rng.uniform(-12, 0)
    scene = _with_levels(scene, plate, plate + u(8, 16), rng)
    scene = _on_floor(
        scene,
        texture_db=round(u(1.5, 4.5), 2),
        texture_m=round(u(0.04, 0.2), 3),
        debris_db=round(u(4, 14), 2),
        debris_m=round(u(0.08, 0.4), 3),
    )
    scene = replace(scene, sonar=replace(scene.sonar, pulse_m=round(u(0.005, 0.02), 4)))
    return _lit(scene, u(2, 8), rng) if u() < 0.5 else scene


def _glitter(scene: Scene, rng: np.random.Generator) -> Scene:
    u, plate = rng.uniform, rng.uniform(-12, 0)
    return _on_floor(
        _with_levels(scene, plate, plate + u(5, 14), rng),
        coherence=round(u(0, 0.5), 3) if u() < 0.5 else 1.0,
        glitter_db=round(u(2, 10), 2),
        glitter_m=round(u(0.008, 0.025), 4),
        glitter_share=round(u(0.05, 0.33), 3),
    )


def _slope(scene: Scene, rng: np.random.Generator) -> Scene:
    return _on_floor(scene, slope_deg=round(rng.uniform(1.5, 8), 2), slope_towards_deg=_way(rng))


def _ripples(scene: Scene, rng: np.random.Generator) -> Scene:
    u = rng.uniform
    length = math.exp(u(math.log(0.05), math.log(0.3)))
    return _on_floor(
        scene,
        ripple_length_m=round(length, 4),
        ripple_height_m=round(length * math.exp(u(math.log(0.02), math.log(0.12))), 5),
        ripple_towards_deg=_way(rng),
        ripple_bends=round(u(0.1, 0.5), 2),
    )


def _leaning(scene: Scene, rng: np.random.Generator) -> Scene:
    return _each_disc(
        scene, lambda: {"lean_deg": round(rng.uniform(2, 15), 2), "lean_towards_deg": _way(rng)}
    )


def _silted(scene: Scene, rng: np.random.Generator) -> Scene:
    scene = _on_floor(scene, silt_m=round(rng.uniform(0.02, 0.07), 3))
    return _each_disc(scene, lambda: {"silted": round(rng.uniform(0.1, 0.4), 3)})


def _way(rng: np.random.Generator) -> float:
    return round(rng.uniform(-180, 180), 1)


def _on_floor(scene: Scene, **changed: float) -> Scene:
    return replace(scene, floor=replace(scene.floor, **changed))


def _each_disc(scene: Scene, drawn: Callable[[], dict[str, Any]]) -> Scene:
    """Change landmarks and their fakes in the same way, so that the change does not reveal them."""
    landmarks = tuple(replace(item, **drawn()) for item in scene.landmarks)
    return _each_object(replace(scene, landmarks=landmarks), drawn)


def _each_object(scene: Scene, drawn: Callable[[], dict[str, Any]]) -> Scene:
    """Change the fakes alone."""
    objects = (replace(o, **drawn()) if o.kind in _DISCS else o for o in scene.objects)
    return replace(scene, objects=tuple(objects))


def _fish(scene: Scene, rng: np.random.Generator) -> Scene:
    u = rng.uniform
    fish = FishSection(
        number=int(rng.integers(15, 90)),
        schools=int(rng.integers(0, 4)),
        schooling=round(u(0.3, 0.9), 2),
        length_m=round(math.exp(u(math.log(0.04), math.log(0.3))), 3),
        bright_db=round(u(10, 24), 1),
        height_m=round(u(0.05, 0.35), 3),
        speed_m_s=round(u(0.05, 0.5), 3),
    )
    return replace(scene, fish=fish)


def _multipath(scene: Scene, rng: np.random.Generator) -> Scene:
    """Add a late copy of the scene, bands, or both."""
    u, sonar = rng.uniform, scene.sonar
    which = int(rng.integers(3))
    window = sonar.range_max_m - sonar.range_min_m
    return replace(
        scene,
        multipath=MultipathSection(
            copy_db=round(u(-14, -3), 1) if which != 1 else -100.0,
            delay_m=round(u(0.08, 0.5) * window, 3),
            blur_m=round(u(0.01, 0.08), 3),
            blur_beams=round(u(0.5, 4), 2),
            band_db=round(u(-4, 8), 1) if which != 0 else -100.0,
            band_m=round(sonar.range_min_m + u(0, 0.8) * window, 3),
            band_step_m=round(u(0.2, 0.6) * window, 3),
            band_width_m=round(u(0.02, 0.12), 3),
            drift_m=round(u(0, 0.1), 3),
            drift_s=round(u(3, 15), 1),
        ),
    )


def vehicle_motion(rng: np.random.Generator) -> MotionSection:
    """A vehicle's run: straight on, in a circle, or to and fro; up to 0.5 m/s and 20 deg/s."""
    u = rng.uniform
    way = int(rng.integers(3))
    surge = swing = turn = yaw_swing = 0.0
    if way == 0:  # straight on, with a slow weave
        surge, yaw_swing = u(0.05, 0.35), u(0.5, 4)
    elif way == 1:  # round: a circle of 0.5 to 2 m radius
        turn = u(4, 14) * rng.choice([-1, 1])
        surge = min(u(0.5, 2) * math.radians(abs(turn)), 0.4)
        yaw_swing = u(0, 4)
    else:  # to and fro
        swing, yaw_swing = u(0.1, 0.4), u(2, 16)
    return MotionSection(
        **dict.fromkeys(("pan_min_deg", "pan_max_deg", "pan_start_deg", "pan_deg_s"), 0.0),
        yaw_jitter_deg=round(u(0, 0.3), 3),
        heave_m=round(u(0.003, 0.03), 4),
        heave_period_s=round(u(4, 10), 1),
        surge_m_s=round(surge, 3),
        surge_swing_m_s=round(swing or u(0, 0.1), 3),
        crab_swing_m_s=round(u(0, 0.2), 3),
        yaw_deg_s=round(float(turn), 2),
        yaw_swing_deg_s=round(yaw_swing, 2),
        swing_period_s=round(u(8, 30), 1),
        pitch_deg=round(u(0, 3), 2),
        roll_deg=round(u(0, 3), 2),
        attitude_period_s=round(u(3, 10), 1),
    )


def _lit(scene: Scene, light_db: float, rng: np.random.Generator) -> Scene:
    light_m = round(rng.uniform(0.15, 0.8), 3)
    return _on_floor(scene, light_db=round(light_db, 2), light_m=light_m)


def _with_levels(
    scene: Scene, plate_db: float, bright_db: float, rng: np.random.Generator, relief_m: float = 0.0
) -> Scene:
    """Give landmarks and their fakes other levels, as if they were of other materials.

    plate_db, bright_db: of the plate, and of ring and sectors, over the floor. relief_m: mean
    height of the gravel that ring and sectors are made of.
    """

    def near(**levels_db: float) -> dict[str, Any]:
        drawn = {name: round(db + rng.normal(0, 0.7), 2) for name, db in levels_db.items()}
        return drawn | {"relief_m": round(relief_m, 4)}

    levels = {"bright_db": bright_db, "symbol_db": bright_db - 0.5, "plate_db": plate_db}
    scene = replace(scene, landmarks=tuple(replace(i, **near(**levels)) for i in scene.landmarks))
    del levels["symbol_db"]
    return _each_object(scene, lambda: near(**levels))


# random_scenes draws symbols, wide and vehicle.
_CHANGES: dict[str, Callable[[Scene, np.random.Generator], Scene]] = {
    change.__name__.removeprefix("_"): change
    for change in (
        *(_any_floor, _relief, _light, _debris, _slope, _leaning, _silted, _ripples),
        *(_multipath, _fish, _glitter),
    )
}
