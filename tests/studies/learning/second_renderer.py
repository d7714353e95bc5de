"""Another way to render a scene, which shares nothing with the simulator but truth and geometry.

A map of the floor's echo power is looked up along each beam and smeared. Relief is lit, not
coherent; speckle is K-distributed, in part frozen to the floor, in part new in each frame. What is
chosen by the simulator's worlds alone may hang on how it makes speckle; here that would show.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, FloatImage
from sonarrec.geometry import PolarToFan
from sonarrec.nouns import Frame
from sonarrec.simulation.motion import poses
from sonarrec.simulation.objects import symbol
from sonarrec.simulation.scene import (
    SYMBOLS,
    PlacedLandmark,
    PlacedObject,
    Scene,
    position_of,
    scene_bearings,
    scene_fan,
    scene_sonar,
)
from sonarrec.simulation.truth import Truth, truth_in_view
from tests.studies.learning.random_scenes import random_scene

MAP_KINDS = ("map_plain", "map_low", "map_relief", "map_amplitude", "map_buried", "map_clutter")
"""Plain: rings 5 to 13 dB over the floor. Low: -2 to 2 dB. Relief: 1 to 8 dB on a rough floor.
Amplitude: grey levels are amplitudes, not decibels. Buried: parts of most discs are under silt.
Clutter: no landmark, but rings with symbols of no ID, letters among them."""
BASES = ("plain", "near_miss", "window_1_25", "low_contrast", "small_discs", "jitter")
PIXEL_M = 0.004  # of the map
MARGIN_M = 0.3  # of the map round all that the sonar sees
RAYS = 3  # to a beam


def map_scene(seed: int, kind: str, frames: int) -> Scene:
    """The scene of a kind: landmarks and objects of one of BASES, seen by a polar sonar."""
    scene = random_scene(seed, BASES[seed % len(BASES)], wide=True, frames=frames)
    sonar = replace(scene.sonar, layout="polar", tilt_error_deg=0.0, height_error_m=0.0)
    scene = replace(scene, sonar=sonar)
    if kind != "map_clutter":
        return scene
    rng = np.random.default_rng(seed)
    fakes = [
        PlacedObject(
            str(rng.choice([*SYMBOLS, "letter", "tyre"])),
            one.ground_m,
            one.azimuth_deg,
            one.orientation_deg,
        )
        for one in scene.landmarks
    ]
    return replace(scene, landmarks=(), objects=(*scene.objects, *fakes))


def map_frames(scene: Scene, kind: str, truth: list[tuple[int, Truth]]) -> Iterator[Frame]:
    """The frames as a reader would give them; their truth is added to `truth`."""
    rng = np.random.default_rng([scene.seed, MAP_KINDS.index(kind), 77])
    sonar, fan = scene.sonar, scene_fan(scene)
    power, far = _floor(scene, kind, rng)
    beam_deg = np.asarray(scene_bearings(scene))
    rays = (np.arange(len(beam_deg) * RAYS) + 0.5) / RAYS - 0.5
    ray_deg = np.interp(rays, np.arange(len(beam_deg)), beam_deg)
    smear = max(sonar.beam_width_deg / 2.355 / float(np.diff(beam_deg).mean()) * RAYS, 0.3)
    bin_m = fan.window_m / sonar.range_bins
    range_m = sonar.range_min_m + (np.arange(sonar.range_bins) + 0.5) * bin_m
    picture = _Picture(kind, rng)
    looks, noise = int(rng.integers(1, 4)), 10 ** (-rng.uniform(10, 25) / 10)
    fall_off = (range_m / range_m.mean())[:, None] ** rng.uniform(-0.5, 0.5)
    polar = PolarToFan(scene_sonar(scene).complete(scene.name), sonar.range_bins, len(beam_deg))
    for index, pose in enumerate(poses(scene)):
        ground = np.sqrt(np.maximum(range_m**2 - pose.height_m**2, 0))[:, None]
        way = np.radians(ray_deg + pose.pan_deg)
        column = (pose.x_m + ground * np.sin(way) + far) / PIXEL_M
        row = (pose.y_m + ground * np.cos(way) + MARGIN_M) / PIXEL_M
        echo = cv2.remap(power, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR)
        echo[range_m < pose.height_m] = 0
        echo = cv2.GaussianBlur(echo, (0, 0), sigmaX=smear, sigmaY=1.2)[:, RAYS // 2 :: RAYS]
        fresh = rng.exponential(1, (looks, *echo.shape)).mean(axis=0)
        echo = echo * (0.65 + 0.35 * fresh) * fall_off + noise * rng.exponential(1, echo.shape)
        truth += [(index, one) for one in truth_in_view(scene, fan, pose, None)[0]]
        stamp = round(index * 1e9 / scene.rate_hz)
        yield Frame(index, stamp, picture(echo), fan, polar=polar)


class _Picture:
    """Grey levels of echo power: decibels through a curve, or amplitudes."""

    def __init__(self, kind: str, rng: np.random.Generator) -> None:
        self._black_db, self._range_db = rng.uniform(-25, -12), rng.uniform(35, 60)
        self._gamma = rng.uniform(0.6, 1.5)
        self._amplitude = kind == "map_amplitude" or rng.uniform() < 0.15
        self._white = 0.0

    def __call__(self, power: FloatArray) -> np.ndarray:
        if self._amplitude:
            self._white = self._white or float(np.quantile(np.sqrt(power), 0.999))
            share = np.sqrt(power) / self._white
        else:
            share = (10 * np.log10(power + 1e-9) - self._black_db) / self._range_db
            share = np.clip(share, 0, 1) ** self._gamma
        return np.clip(np.rint(255 * share), 0, 255).astype(np.uint8)


def _floor(scene: Scene, kind: str, rng: np.random.Generator) -> tuple[FloatImage, float]:
    """Map of the echo power, 1 on the floor, forward down and right across; how far it reaches to
    either side, m."""
    u = rng.uniform
    far = scene.sonar.range_max_m + MARGIN_M
    x = np.arange(-far, far, PIXEL_M) + PIXEL_M / 2
    y = np.arange(-MARGIN_M, far, PIXEL_M) + PIXEL_M / 2
    shape = (len(y), len(x))
    level_db = u(0.5, 2.5) * _blotches(rng, shape, u(0.1, 0.4))
    level_db += u(0, 1.5) * _blotches(rng, shape, u(0.02, 0.06))
    height_m = u(0.0005, 0.003) * (2.5 if kind == "map_relief" else 1.0)
    height = height_m * _blotches(rng, shape, u(0.01, 0.04))
    spans = {"map_low": (-2, 2), "map_relief": (1, 8)}
    ring_db = u(*spans.get(kind, (5, 13)))
    plate_db = u(-16, -8) if kind == "map_low" else u(-12, -2)
    symbol_db, radius_m = ring_db + u(-2, 0.5), scene.landmark_set.radius_m
    for item in (*scene.landmarks, *scene.objects):
        at_x, at_y = position_of(item)
        some = tuple(
            slice(*np.searchsorted(axis, [at - 1.4 * radius_m, at + 1.4 * radius_m]).tolist())
            for axis, at in ((y, at_y), (x, at_x))
        )
        disc = np.meshgrid((x[some[1]] - at_x) / radius_m, (y[some[0]] - at_y) / radius_m)
        plate, ring, lit = _parts(item, scene, *disc, rng)
        if kind == "map_buried" and isinstance(item, PlacedLandmark) and u() < 0.7:
            angle = u(0, 2 * math.pi)
            bare = disc[0] * math.cos(angle) + disc[1] * math.sin(angle) < u(-0.2, 0.5)
            plate, ring, lit = plate & bare, ring & bare, lit & bare
        level_db[some][plate], level_db[some][ring] = plate_db, ring_db
        level_db[some][lit] = symbol_db
        height[some][plate] = 0
        rough = ring | lit
        height[some][rough] = u(0.001, 0.005) * np.abs(rng.standard_normal(int(rough.sum())))
    # Lit from the floor's origin: slopes that face it are bright.
    smooth = cv2.GaussianBlur(height, (0, 0), 1.2)
    rise = [cv2.Sobel(smooth, cv2.CV_32F, *by, scale=1 / 8) / PIXEL_M for by in ((1, 0), (0, 1))]
    facing = (rise[0] * x + rise[1] * y[:, None]) / np.hypot(x, y[:, None])
    power = 10 ** (level_db / 10) * np.clip(1 + 5.7 * facing, 0.1, 8)
    spikes = u(1.5, 6)
    half = (shape[0] // 2 + 1, shape[1] // 2 + 1)
    frozen, looks = u(0.3, 0.9), int(rng.integers(1, 4))
    speckle = 1 - frozen + frozen * rng.exponential(1, (looks, *half)).mean(axis=0)
    grain = (speckle * rng.gamma(spikes, 1 / spikes, half)).astype(np.float32)
    power = power * cv2.resize(grain, shape[::-1], interpolation=cv2.INTER_NEAREST)
    return power.astype(np.float32), far


def _parts(
    item: PlacedLandmark | PlacedObject,
    scene: Scene,
    x: FloatArray,
    y: FloatArray,
    rng: np.random.Generator,
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Where a thing is dark plate, bright ring, and bright symbol; x, y: in disc radii."""
    discs = scene.landmark_set
    angle = math.radians(item.orientation_deg)
    along = x * math.cos(angle) + y * math.sin(angle)
    across = y * math.cos(angle) - x * math.sin(angle)
    radius, none = np.hypot(x, y), np.zeros(x.shape, bool)
    plate = radius <= 1
    ring = (radius >= discs.ring[0]) & (radius <= discs.ring[1])
    inner = (radius >= discs.symbol[0]) & (radius <= discs.symbol[1])
    if isinstance(item, PlacedLandmark):
        sectors = np.array(discs.sectors[discs.ids.index(item.id)])
        turn = np.mod(np.arctan2(across, along), 2 * math.pi) / (2 * math.pi)
        sector = np.minimum((turn * len(sectors)).astype(int), len(sectors) - 1)
        return plate, ring, inner & (sectors[sector] > 0)
    if item.kind in SYMBOLS:
        number, scale = int(rng.integers(1_000_000)), discs.symbol[1]
        lit = symbol(item.kind, number, discs, along / scale, across / scale)
        return plate, ring, inner & lit
    return {
        "blank": (plate, ring, none),
        "filled": (plate, ring, inner),
        "spokes": (plate, ring, inner & (np.minimum(np.abs(along), np.abs(across)) < 0.08)),
        "half_ring": (plate, ring & (across > 0), none),
        "tyre": (none, (radius > 0.45) & (radius < 0.75), none),
        "stone": (none, radius < 0.3, none),
    }.get(item.kind, (none, none, none))


def _blotches(rng: np.random.Generator, shape: tuple[int, int], size_m: float) -> FloatImage:
    """A smooth random field of unit deviation with blotches of this size."""
    step = max(1, int(size_m / PIXEL_M // 3))
    coarse = rng.standard_normal((shape[0] // step + 8, shape[1] // step + 8)).astype(np.float32)
    coarse = cv2.GaussianBlur(coarse, (0, 0), size_m / PIXEL_M / step)
    size = (coarse.shape[1] * step, coarse.shape[0] * step)
    fine = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)[: shape[0], : shape[1]]
    return np.asarray(fine / fine.std(), np.float32)
