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
part of the seed of its scenes. What is in them: KINDS of results/readme.py."""
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


def rounded(rng: np.random.Generator) -> Callable[[float, float, int], float]:
    """Draws a number from one to another, rounded to so many digits."""
    return lambda low, high, digits: round(rng.uniform(low, high), digits)


def _any_floor(scene: Scene, rng: np.random.Generator) -> Scene:
    """The ring may be as bright as the floor, or darker; short and long pulses."""
    u, plate = rng.uniform, rng.uniform(-12, 6)
    scene = _with_levels(scene, plate, plate + u(5, 14), rng)
    scene = _with_pulse(scene, 0.004, rng)
    return _lit(scene, u(2, 6), rng) if u() < 0.3 else scene


def _relief(scene: Scene, rng: np.random.Generator) -> Scene:
    """Lit slopes and shadows, without or with little speckle."""
    u, plate = rng.uniform, rng.uniform(-12, -2)
    scene = _with_levels(scene, plate, plate + u(5, 14), rng, relief_m=u(0, 0.012))
    coherence = round(max(u(-0.5, 0.5), 0.0), 3)
    relief = {"relief_m": round(u(0.001, 0.005), 4), "relief_size_m": round(u(0.015, 0.04), 4)}
    scene = _on_floor(scene, coherence=coherence, **relief)
    fading = replace(scene.fading, object_db=u(0, 0.5), patch_db=u(0, 1), specular_db=u(0, 3))
    scene = replace(scene, fading=fading)
    return _lit(scene, u(2, 6), rng) if u() < 0.2 else scene


def _light(scene: Scene, rng: np.random.Generator) -> Scene:
    return _lit(scene, rng.uniform(3, 10), rng)


def _debris(scene: Scene, rng: np.random.Generator) -> Scene:
    """Over the landmarks as well."""
    u, r, plate = rng.uniform, rounded(rng), rng.uniform(-12, 0)
    scene = _with_levels(scene, plate, plate + u(8, 16), rng)
    floor = {"texture_db": r(1.5, 4.5, 2), "texture_m": r(0.04, 0.2, 3)}
    scene = _on_floor(scene, **floor, debris_db=r(4, 14, 2), debris_m=r(0.08, 0.4, 3))
    scene = _with_pulse(scene, 0.005, rng)
    return _lit(scene, u(2, 8), rng) if u() < 0.5 else scene


def _glitter(scene: Scene, rng: np.random.Generator) -> Scene:
    """In every second recording the floor has little speckle."""
    u, r, plate = rng.uniform, rounded(rng), rng.uniform(-12, 0)
    scene = _with_levels(scene, plate, plate + u(5, 14), rng)
    scene = _on_floor(scene, coherence=r(0, 0.5, 3) if u() < 0.5 else 1.0)
    stones = {"glitter_db": r(2, 10, 2), "glitter_m": r(0.008, 0.025, 4)}
    return _on_floor(scene, **stones, glitter_share=r(0.05, 0.33, 3))


def _slope(scene: Scene, rng: np.random.Generator) -> Scene:
    return _on_floor(scene, slope_deg=rounded(rng)(1.5, 8, 2), slope_towards_deg=_way(rng))


def _ripples(scene: Scene, rng: np.random.Generator) -> Scene:
    length = math.exp(rng.uniform(math.log(0.05), math.log(0.3)))
    height = length * math.exp(rng.uniform(math.log(0.02), math.log(0.12)))
    ripples = {"ripple_length_m": round(length, 4), "ripple_height_m": round(height, 5)}
    ripples |= {"ripple_towards_deg": _way(rng), "ripple_bends": rounded(rng)(0.1, 0.5, 2)}
    return _on_floor(scene, **ripples)


def _leaning(scene: Scene, rng: np.random.Generator) -> Scene:
    r = rounded(rng)
    return _each_disc(scene, lambda: {"lean_deg": r(2, 15, 2), "lean_towards_deg": _way(rng)})


def _silted(scene: Scene, rng: np.random.Generator) -> Scene:
    r = rounded(rng)
    scene = _on_floor(scene, silt_m=r(0.02, 0.07, 3))
    return _each_disc(scene, lambda: {"silted": r(0.1, 0.4, 3)})


def _way(rng: np.random.Generator) -> float:
    return rounded(rng)(-180, 180, 1)


def _with_pulse(scene: Scene, least_m: float, rng: np.random.Generator) -> Scene:
    return replace(scene, sonar=replace(scene.sonar, pulse_m=rounded(rng)(least_m, 0.02, 4)))


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
    """Singly and in schools."""
    u, r = rng.uniform, rounded(rng)
    shoal = {"number": int(rng.integers(15, 90)), "schools": int(rng.integers(0, 4))}
    shoal |= {"schooling": r(0.3, 0.9, 2)}
    shoal |= {"length_m": round(math.exp(u(math.log(0.04), math.log(0.3))), 3)}
    shoal |= {"bright_db": r(10, 24, 1), "height_m": r(0.05, 0.35, 3), "speed_m_s": r(0.05, 0.5, 3)}
    return replace(scene, fish=FishSection(**shoal))


def _multipath(scene: Scene, rng: np.random.Generator) -> Scene:
    """Add a late copy of the scene, bands, or both."""
    u, r, sonar = rng.uniform, rounded(rng), scene.sonar
    which = int(rng.integers(3))
    window = sonar.range_max_m - sonar.range_min_m
    copy = {"copy_db": r(-14, -3, 1) if which != 1 else -100.0}
    copy |= {"delay_m": round(u(0.08, 0.5) * window, 3), "blur_m": r(0.01, 0.08, 3)}
    copy |= {"blur_beams": r(0.5, 4, 2)}
    band = {"band_db": r(-4, 8, 1) if which != 0 else -100.0}
    band |= {"band_m": round(sonar.range_min_m + u(0, 0.8) * window, 3)}
    band |= {"band_step_m": round(u(0.2, 0.6) * window, 3), "band_width_m": r(0.02, 0.12, 3)}
    drift = {"drift_m": r(0, 0.1, 3), "drift_s": r(3, 15, 1)}
    return replace(scene, multipath=MultipathSection(**copy, **band, **drift))


def vehicle_motion(rng: np.random.Generator) -> MotionSection:
    """A vehicle's run: straight on, in a circle, or to and fro; up to 0.5 m/s and 20 deg/s."""
    u, r = rng.uniform, rounded(rng)
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
    run = dict.fromkeys(("pan_min_deg", "pan_max_deg", "pan_start_deg", "pan_deg_s"), 0.0)
    run |= {"yaw_jitter_deg": r(0, 0.3, 3), "heave_m": r(0.003, 0.03, 4)}
    run |= {"heave_period_s": r(4, 10, 1), "surge_m_s": round(surge, 3)}
    run |= {"surge_swing_m_s": round(swing or u(0, 0.1), 3), "crab_swing_m_s": r(0, 0.2, 3)}
    run |= {"yaw_deg_s": round(float(turn), 2), "yaw_swing_deg_s": round(yaw_swing, 2)}
    run |= {"swing_period_s": r(8, 30, 1), "pitch_deg": r(0, 3, 2), "roll_deg": r(0, 3, 2)}
    return MotionSection(**run, attitude_period_s=r(3, 10, 1))


def _lit(scene: Scene, light_db: float, rng: np.random.Generator) -> Scene:
    """Patches of light and shade with sharp edges."""
    return _on_floor(scene, light_db=round(light_db, 2), light_m=rounded(rng)(0.15, 0.8, 3))


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
