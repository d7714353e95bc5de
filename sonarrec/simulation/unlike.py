"""Kinds of random scene beyond the basin's: what of a drawn scene they change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonarrec.simulation.scene import SYMBOLS, PlacedLandmark, PlacedObject, Scene

LEARNED_UNLIKE = ("any_floor", "relief", "light", "debris", "symbols", "wide")
"""Any floor: ring and sectors 5 to 14 dB over a plate that is -12 to +6 dB over the floor, so that
the ring may be as bright as the floor, or darker; short and long pulses. Relief: gravel on a rough
floor, with lit slopes and shadows, without or with little speckle. Light: patches of light and
shade with sharp edges. Debris: twigs and weed, over the landmarks as well, on a coarse, blotchy
floor. Symbols: rings with symbols that no ID has. Wide: 120 to 130 deg, 1-degree beams."""
OTHER_UNLIKE = ("other_symbols",)
"""Never learned from: symbols of other kinds."""
_PLATED = ("blank", "spokes", "half_ring", *SYMBOLS)


def made_unlike(scene: Scene, kind: str, rng: np.random.Generator) -> Scene:
    """The scene as its kind has it; of kinds that change nothing as it is."""
    u = rng.uniform
    if kind == "any_floor":
        plate = u(-12, 6)
        scene = _with_levels(scene, plate, plate + u(5, 14), rng)
        scene = replace(scene, sonar=replace(scene.sonar, pulse_m=round(u(0.004, 0.02), 4)))
        return _lit(scene, u(2, 6), rng) if u() < 0.3 else scene
    if kind == "relief":
        plate = u(-12, -2)
        scene = _with_levels(scene, plate, plate + u(5, 14), rng, relief_m=u(0, 0.012))
        floor = replace(
            scene.floor,
            coherence=round(max(u(-0.5, 0.5), 0.0), 3),
            relief_m=round(u(0.001, 0.005), 4),
            relief_size_m=round(u(0.015, 0.04), 4),
        )
        fading = replace(scene.fading, object_db=u(0, 0.5), patch_db=u(0, 1), specular_db=u(0, 3))
        scene = replace(scene, floor=floor, fading=fading)
        return _lit(scene, u(2, 6), rng) if u() < 0.2 else scene
    if kind == "light":
        return _lit(scene, u(3, 10), rng)
    if kind == "debris":
        plate = u(-12, 0)
        scene = _with_levels(scene, plate, plate + u(8, 16), rng)
        floor = replace(
            scene.floor,
            texture_db=round(u(1.5, 4.5), 2),
            texture_m=round(u(0.04, 0.2), 3),
            debris_db=round(u(4, 14), 2),
            debris_m=round(u(0.08, 0.4), 3),
        )
        sonar = replace(scene.sonar, pulse_m=round(u(0.005, 0.02), 4))
        scene = replace(scene, floor=floor, sonar=sonar)
        return _lit(scene, u(2, 8), rng) if u() < 0.5 else scene
    return scene


def _lit(scene: Scene, light_db: float, rng: np.random.Generator) -> Scene:
    light_m = round(rng.uniform(0.15, 0.8), 3)
    return replace(scene, floor=replace(scene.floor, light_db=round(light_db, 2), light_m=light_m))


def _with_levels(
    scene: Scene,
    plate_db: float,
    bright_db: float,
    rng: np.random.Generator,
    relief_m: float = 0.0,
) -> Scene:
    """Landmarks and their fakes of other materials."""

    def near(level_db: float) -> float:
        return round(level_db + rng.normal(0, 0.7), 2)

    relief_m = round(relief_m, 4)
    landmarks: list[PlacedLandmark] = [
        replace(
            item,
            bright_db=near(bright_db),
            symbol_db=near(bright_db - 0.5),
            plate_db=near(plate_db),
            relief_m=relief_m,
        )
        for item in scene.landmarks
    ]
    objects: list[PlacedObject] = []
    for item in scene.objects:
        if item.kind in (*_PLATED, "filled"):
            item = replace(
                item, bright_db=near(bright_db), plate_db=near(plate_db), relief_m=relief_m
            )
        objects.append(item)
    return replace(scene, landmarks=tuple(landmarks), objects=tuple(objects))
