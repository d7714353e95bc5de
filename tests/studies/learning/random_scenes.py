"""Draws random scenes, by kind, for learning and for studies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.simulation.motion import Pose, poses
from sonarrec.simulation.objects import object_radius
from sonarrec.simulation.scene import (
    KINDS,
    LEARNED_SYMBOLS,
    OTHER_SYMBOLS,
    SYMBOLS,
    FadingSection,
    FloorSection,
    MotionSection,
    NoiseSection,
    PictureSection,
    PlacedLandmark,
    PlacedObject,
    Scene,
    SonarSection,
    check_scene,
    position_of,
)
from tests.studies.learning.other_worlds import OTHER_WORLDS, in_world, rounded, vehicle_motion

KINDS_OF_SCENE = (
    *("plain", "low_contrast", "window_1_25", "window_5", "jitter", "ring_widths", "fading"),
    *("occluded", "near_miss", "fast_pan", "small_discs", "no_landmark"),
)
# In addition: discs of 0.06 m radius at a window of 2.5 m; everything hard at once; landmark sets,
# windows and images unlike the basin's.
STRETCH_KINDS = ("tiny_discs", "all_hard", "other_sets")
ALL_KINDS = KINDS_OF_SCENE + STRETCH_KINDS + OTHER_WORLDS
LEAST_LIT_DB = -12.0
"""Least power of the vertical beam where an object may lie, relative to the beam's axis. Where less
sound reaches the floor, the image is black and nobody would look for landmarks."""
RUN_FRAMES = 160  # of a vehicle's run along which landmarks are placed
FIRST_FRAMES = 16  # of a run; they show the first two landmarks
_UNSTEADY = ("jitter", "all_hard")
_FADING = ("fading", "all_hard")
_SYMBOLIC = ("symbols", "other_symbols")
_FAKES = ("near_miss", "no_landmark", "all_hard")
# By kind of scene: (range_min_m, range_max_m, height_m, tilt_deg), which are then varied.
_WINDOWS = {"window_1_25": (1.4, 2.65, 0.66, 20.0), "window_5": (1.25, 6.25, 1.0, 18.0)}


def _sonar(kind: str, rng: np.random.Generator) -> SonarSection:
    low, high, height, tilt = _WINDOWS.get(kind, (1.25, 3.75, 0.68, 20.0))
    bins = 512
    if kind == "other_sets":
        bins = int(rng.choice([256, 512, 768, 1024]))
        window = float(rng.choice([1.25, 2.5, 5.0, 10.0]))
        low, height, tilt = (1.25, 0.68, 20.0) if window < 5 else (1.5, 0.2 * window, 19.0)
        high = low + window
    r = rounded(rng)
    window_m = {"range_min_m": low, "range_max_m": high, "range_bins": bins}
    height_m = round(height * rng.uniform(0.9, 1.1), 3)
    place = {"height_m": height_m, "tilt_deg": round(tilt + rng.uniform(-2, 2), 2)}
    beams = {"beam_width_deg": r(0.32, 0.5, 3), "side_lobe_db": r(-36, -26, 1)}
    beams |= {"stray_db": r(-42, -29, 1), "cross_talk_db": r(-42, -29, 1)}
    pulse_m = round(rng.uniform(1.0, 2.2) * (high - low) / 512, 4)
    if kind == "wide":
        view = {"field_of_view_deg": r(115, 132, 1), "beams": int(rng.choice([256, 512]))}
        beams |= view | {"beam_width_deg": r(0.8, 1.2, 3), "vertical_beam_deg": 20.0}
    if kind in _UNSTEADY:
        place |= {"tilt_error_deg": r(-3, 3, 2), "height_error_m": r(-0.05, 0.05, 3)}
    return SonarSection(**window_m, **place, **beams, pulse_m=pulse_m)


def _motion(kind: str, rng: np.random.Generator) -> MotionSection:
    r, jitter = rounded(rng), kind in _UNSTEADY
    pan = {"pan_min_deg": -31, "pan_max_deg": 31, "pan_start_deg": float(rng.integers(-31, 32))}
    pan |= {"pan_deg_s": r(6, 12, 2) if kind == "fast_pan" else r(1.6, 2.8, 2)}
    sway = {"yaw_jitter_deg": r(0.2, 0.5, 3) if jitter else r(0, 0.08, 3)}
    sway |= {"heave_m": r(0.01, 0.03, 4) if jitter else r(0, 0.003, 4)}
    sway |= {"heave_period_s": r(4, 10, 1)}
    sway |= {name: r(0.01, 0.06, 3) if jitter else 0.0 for name in ("sway_x_m", "sway_y_m")}
    return MotionSection(**pan, **sway)


def _floor(rng: np.random.Generator) -> FloorSection:
    r = rounded(rng)
    texture = {"texture_db": r(0.6, 2.2, 2), "texture_m": r(0.08, 0.4, 3)}
    angle_exponent, speckle_s = r(0, 1.6, 2), math.exp(rng.uniform(math.log(3), math.log(200)))
    return FloorSection(**texture, angle_exponent=angle_exponent, speckle_s=round(speckle_s, 1))


def _fading(kind: str, wide: bool, rng: np.random.Generator) -> FadingSection:
    r, hard, most_db = rounded(rng), kind in _FADING, 4.5 if wide else 3.5
    spread = {"object_db": r(2, most_db, 2) if hard else r(0.5, 2, 2)}
    spread |= {"patch_db": r(2, most_db, 2) if hard else r(0.8, 2.4, 2)}
    spread |= {"patch_m": r(0.04, 0.12, 3), "time_s": r(2, 12, 1), "specular_db": r(0, 5, 2)}
    bursts = {"frame_probability": r(0.01, 0.06, 4) if hard else r(0, 0.02, 4)}
    bursts |= {"burst_probability": r(0.01, 0.03, 4) if hard else r(0, 0.003, 4)}
    bursts |= {"burst_frames": r(3, 10, 1), "depth_db": r(6, 12, 1) if hard else r(4, 9, 1)}
    ghost = {"ghost_db": r(-16, -8, 1) if hard or kind == "near_miss" else r(-24, -12, 1)}
    ghost |= {"ghost_shift_m": r(0.03, 0.2, 3), "ghost_blur_m": r(0.02, 0.08, 3)}
    return FadingSection(**spread, **bursts, **ghost)


def _noise(kind: str, wide: bool, rng: np.random.Generator) -> NoiseSection:
    r, faint = rounded(rng), kind == "low_contrast"
    least, most = (4 if wide else 8, 14) if faint else (10, 26)
    noise = {"snr_db": 9.0 if kind == "all_hard" else r(least, most, 1)}
    noise |= {"smear": r(0, 0.5, 2), "shadow_db": r(-20, -9, 1)}
    gain = {"gain_drift_db": r(1.5, 4, 2) if faint or kind in _FADING else r(0, 1.5, 2)}
    gain |= {"gain_drift_s": r(40, 200, 1), "group_gain_db": r(0.2, 1.2, 2)}
    gain |= {"beam_gain_db": r(0.1, 0.6, 2), "hot_beams": int(rng.integers(0, 5))}
    return NoiseSection(**noise, **gain, hot_beam_db=r(1, 4, 2))


def _picture(rng: np.random.Generator) -> PictureSection:
    r = rounded(rng)
    black_db, range_db = r(-24, -12, 1), r(40, 66, 1)
    return PictureSection(black_db=black_db, dynamic_range_db=range_db, gamma=r(0.8, 1.3, 2))


def _landmark_set(kind: str, sonar: SonarSection, rng: np.random.Generator) -> LandmarkSet:
    discs = load_landmarks("basin")
    if kind == "other_sets":
        return _other_set(sonar, rng)
    if kind == "tiny_discs":
        return replace(discs, name="tiny_discs", radius_m=0.06)
    if kind == "ring_widths":
        inner = rng.uniform(0.72, 0.88)
        symbol = round(rng.uniform(0, 0.15), 3), round(inner - rng.uniform(0.1, 0.24), 3)
        return replace(discs, name="ring_widths", ring=(round(inner, 3), 1.0), symbol=symbol)
    if kind == "small_discs":
        return replace(discs, name="small_discs", radius_m=round(rng.uniform(0.09, 0.12), 3))
    return discs


def _other_set(sonar: SonarSection, rng: np.random.Generator) -> LandmarkSet:
    """Draw a set of three to eight IDs with three to six sectors, no two alike when turned."""
    codes = unlike_codes(int(rng.integers(3, 7)))
    count = min(int(rng.integers(3, 9)), len(codes))
    drawn = rng.choice(len(codes), count, replace=False)
    share = rng.uniform(0.04, 0.1) * (sonar.range_max_m - sonar.range_min_m)
    radius_m = round(float(np.clip(share, 0.08, 0.5)), 3)
    chosen = tuple(codes[i] for i in sorted(drawn))
    ids = tuple(range(1, count + 1))
    return LandmarkSet("other_sets", radius_m, (0.80, 1.00), (0.0, 0.62), ids, chosen)


@cache
def unlike_codes(size: int) -> list[tuple[int, ...]]:
    """Every code of so many sectors, of those that are equal when turned only one."""
    every = [tuple((n >> bit) & 1 for bit in range(size)) for n in range(1, 2**size - 1)]
    return sorted({min(c[i:] + c[:i] for i in range(size)) for c in every})


class _FreePlaces:
    """Finds free places: circles that do not touch others and lie in the sonar's range window.

    path: poses of a vehicle. Places then lie in front of it at random moments; the first two at the
    beginning of its run.
    """

    def __init__(
        self, sonar: SonarSection, rng: np.random.Generator, path: Sequence[Pose] | None = None
    ) -> None:
        self._rng = rng
        self._path = path
        self._sonar = sonar
        self._near = math.sqrt(max(sonar.range_min_m**2 - sonar.height_m**2, 0.04))
        self._far = math.sqrt(sonar.range_max_m**2 - sonar.height_m**2)
        self._taken: list[tuple[float, float, float]] = []

    def find(self, radius_m: float, share: float = 1.0) -> tuple[float, float] | None:
        """(ground_m, azimuth_deg) of a free circle; None if none was found.

        It lies within the nearest `share` of the range window, and its centre within the beam.
        """
        near = self._near + 1.15 * radius_m
        far = max(self._near + share * (self._far - self._near) - 1.15 * radius_m, near + 0.02)
        for _ in range(200):
            ground = self._rng.uniform(near, far)
            azimuth, sonar = self._rng.uniform(-40, 40), self._sonar
            sine = min(sonar.height_m / math.hypot(ground, sonar.height_m), 1.0)
            off_axis = (np.degrees(np.arcsin(sine)) - sonar.tilt_deg) / sonar.vertical_beam_deg
            if -40 * math.log10(2) * off_axis**2 < LEAST_LIT_DB:
                continue
            if self._path is not None:
                moments = len(self._path) if len(self._taken) > 1 else FIRST_FRAMES
                pose = self._path[int(self._rng.integers(moments))]
                ground, azimuth = _from_origin(pose, ground, azimuth * 0.3)
            angle = math.radians(azimuth)
            x, y = ground * math.sin(angle), ground * math.cos(angle)
            if all(math.hypot(x - a, y - b) > radius_m + c + 0.05 for a, b, c in self._taken):
                self._taken.append((x, y, radius_m))
                return round(ground, 3), round(azimuth, 2)
        return None


def _from_origin(pose: Pose, ground: float, bearing_deg: float) -> tuple[float, float]:
    """(ground_m, azimuth_deg) from the floor's origin, of a place in front of a sonar at `pose`."""
    angle = math.radians(pose.pan_deg + bearing_deg)
    x, y = pose.x_m + ground * math.sin(angle), pose.y_m + ground * math.cos(angle)
    return math.hypot(x, y), math.degrees(math.atan2(x, y))


class _Looks(NamedTuple):
    """How landmarks and objects look, and where they lie.

    bright, plate: levels over the floor, dB. share: the nearest part of the range window, in which
    they lie.
    """

    bright: float
    plate: float
    share: float


def _landmarks(
    kind: str, discs: LandmarkSet, places: _FreePlaces, looks: _Looks, rng: np.random.Generator
) -> list[PlacedLandmark]:
    """Draw the landmarks of a scene; fewer if there is no room."""
    count = 0 if kind == "no_landmark" else int(rng.integers(3, 5))
    if kind in _SYMBOLIC:
        count = 2
    if kind == "vehicle":
        count = int(rng.integers(6, 11))
    landmarks = []
    for number in rng.choice(discs.ids, count, replace=count > len(discs.ids)):
        place = places.find(discs.radius_m, looks.share)
        if place:
            levels = {"bright_db": (looks.bright, 0), "symbol_db": (looks.bright, -0.7)}
            levels |= {"plate_db": (looks.plate, 0)}
            turn = round(rng.uniform(0, 360), 1)
            drawn = {k: round(db + rng.normal(off, 0.7), 2) for k, (db, off) in levels.items()}
            landmarks.append(PlacedLandmark(int(number), *place, turn, **drawn))
    return landmarks


def _objects(
    kind: str, scene: Scene, places: _FreePlaces, looks: _Looks, rng: np.random.Generator
) -> list[PlacedObject]:
    """Draw the objects that are no landmarks, as the kind of scene asks; fewer without room."""
    names = ["blank", "filled", "tyre", "stone", "stone", *rng.choice(["mesh", "beam", "stone"], 2)]
    fakes = ["spokes", "half_ring", "blank", "filled"]
    if kind == "symbols":
        names += [*rng.choice(LEARNED_SYMBOLS, 5)]
    elif kind == "other_symbols":
        names += [*rng.choice(OTHER_SYMBOLS, 5)]
    elif kind in ("any_floor", "relief", "light", "debris", "wide", "glitter"):
        names += [*rng.choice([*LEARNED_SYMBOLS, "blank", "half_ring"], 2)]
    else:
        names += fakes if kind in _FAKES else [*rng.choice(fakes, 1)]
    objects = []
    for name in map(str, names):
        size = {"orientation_deg": round(rng.uniform(0, 360), 1)}
        size |= {"size_m": _random_size(name, scene.landmark_set.radius_m, rng)}
        bright_db = round(KINDS[name][3] + (looks.bright - 12) + rng.normal(0, 1), 2)
        levels = {"bright_db": bright_db, "plate_db": round(looks.plate + rng.normal(0, 0.7), 2)}
        number = int(rng.integers(2**31)) if name in SYMBOLS else 0
        draft = PlacedObject(name, 1.0, 0.0, **size, **levels, number=number)
        place = places.find(object_radius(scene, draft), looks.share)
        if place:
            objects.append(replace(draft, ground_m=place[0], azimuth_deg=place[1]))
    return objects


def random_scene(seed: int, kind: str = "plain", wide: bool = False, **overrides: Any) -> Scene:
    """Draw a scene of a kind of ALL_KINDS: landmarks, distractors and disturbances.

    wide: draw fading and noise from wider ranges, for learning. overrides: fields of Scene that
    replace those drawn. A given `sonar`, `landmark_set` or motion of a vehicle also decides where
    things lie; a given `landmarks` or `objects` only replaces what was drawn.
    Raises SonarrecError if the scene contradicts itself.
    """
    rng = np.random.default_rng([seed, ALL_KINDS.index(kind)])
    sonar = overrides.get("sonar") or _sonar(kind, rng)
    discs = overrides.get("landmark_set") or _landmark_set(kind, sonar, rng)
    parts = {"motion": _motion(kind, rng), "floor": _floor(rng)}
    parts |= {"fading": _fading(kind, wide, rng), "noise": _noise(kind, wide, rng)}
    parts |= {"sonar": sonar, "landmark_set": discs, "picture": _picture(rng)}
    scene = Scene(name=f"{kind}_{seed}", seed=seed, **parts)
    if kind == "vehicle":
        motion = vehicle_motion(rng)
        scene = replace(scene, frames=RUN_FRAMES, motion=overrides.get("motion", motion))
    places = _FreePlaces(scene.sonar, rng, poses(scene) if kind == "vehicle" else None)
    faint = rng.uniform(3, 7 if wide else 5) if kind == "low_contrast" else 0.0
    # Far out the beam hardly reaches the floor, and no sonar would be used there.
    share = 0.6 if scene.sonar.range_max_m > 4 else 0.85
    looks = _Looks(rng.uniform(9, 14) - faint, rng.uniform(-10, -4) + faint / 2, share)
    landmarks = _landmarks(kind, scene.landmark_set, places, looks, rng)
    objects = _objects(kind, scene, places, looks, rng)
    if kind == "occluded":
        objects += [_cover(landmark, scene.landmark_set.radius_m, rng) for landmark in landmarks]
    if rng.uniform() < 0.5 and kind != "vehicle":
        far = math.sqrt(scene.sonar.range_max_m**2 - scene.sonar.height_m**2)
        turn = round(rng.uniform(-12, 12), 1)
        objects.append(PlacedObject("wall", round(0.95 * far, 3), 0.0, turn))
    drawn = replace(scene, landmarks=tuple(landmarks), objects=tuple(objects))
    drawn = replace(in_world(drawn, kind, rng), **overrides)
    check_scene(drawn, drawn.name)
    return drawn


def _random_size(kind: str, disc_m: float, rng: np.random.Generator) -> float:
    """A likely size (m); round fakes may be a little larger or smaller than the discs."""
    spans_m = {"stone": (0.02, 0.07), "mesh": (0.25, 0.5), "beam": (0.4, 0.9)}
    if kind in spans_m:
        return round(rng.uniform(*spans_m[kind]), 3)
    return round(disc_m * rng.uniform(*((0.65, 1.0) if kind == "tyre" else (0.9, 1.1))), 3)


def _cover(landmark: PlacedLandmark, disc_m: float, rng: np.random.Generator) -> PlacedObject:
    """Sediment that covers a tenth to a quarter of a disc, across its rim."""
    away = disc_m * rng.uniform(0.9, 1.15)
    angle = rng.uniform(0, 2 * math.pi)
    x, y = position_of(landmark)
    x, y = x + away * math.cos(angle), y + away * math.sin(angle)
    place = round(math.hypot(x, y), 3), round(math.degrees(math.atan2(x, y)), 2)
    return PlacedObject("cover", *place, size_m=round(disc_m * rng.uniform(0.5, 0.75), 3))
