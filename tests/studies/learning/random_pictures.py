"""Draws pictures of discs and of what is taken for them, at random, for the reader to learn from.

A simulator shows one kind of sonar on one kind of floor. Here everything that may differ between
sonars and floors is drawn anew for each picture: levels, texture, glitter, light, shadows, silt,
smear, speckle, compression, and how far the track lies off the centre. Each is one averaged shape
matrix as stage 3 has it (track_matrix.py), with what it truly shows.

The fakes are those that mistakes are made of: filled and blank discs with glitter and at low
contrast, discs half under silt, black areas behind stones and tyres, letters and half rings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.random import Generator

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.recogniser.stage3.reader import THETA
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, ShapeSampler
from tests.studies.learning.random_scenes import unlike_codes

MOST_IDS = 12  # of a set, while learning
UNKNOWN = -1


class Examples(NamedTuple):
    """n averaged shape matrices, as Pictures has them, with what they show.

    brightness, count: (n, L, ANGLES). existence, smear: (n,). codes: (n, MOST_IDS, ANGLES) of each
    one's set, zeros beyond its IDs. ids: (n,) how many these are. label: (n,) index of the ID,
    MOST_IDS for none. lit: (n, ANGLES) whether the symbol is lit in a direction, UNKNOWN where that
    is not known. weight: (n,) how often it is learned from, relative to the others.
    """

    brightness: FloatArray
    count: FloatArray
    existence: FloatArray
    smear: FloatArray
    codes: FloatArray
    ids: IntArray
    label: IntArray
    lit: IntArray
    weight: FloatArray


def joined_examples(parts: Sequence[Examples]) -> Examples:
    """Examples of several parts as one."""
    return Examples(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


SIZE, RADIUS = 48, 14.0  # of a picture and of the disc in it, in pixels
CENTRE = (SIZE - 1) / 2
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE].astype(np.float32)
BASIN = load_landmarks("basin")
UNLIKE = 0.13  # a stranger's symbol differs from every ID's in at least this share of directions
LEAST_RING = 0.15  # its contrast in a picture, as stage 1 offers it, in standard deviations
LEAST_IN_VIEW = 0.55  # of a disc's cells: with less, nothing can be learned of its ID
_BANDS = slice(3, 6), slice(6, 8), slice(8, 10)  # of the ring, the gap and the floor outside
STRANGERS, NOTHING = 0.23, 0.42
"""Shares of the pictures that show a disc with a symbol of no ID, and no disc with a symbol."""


def _lit(sectors: FloatArray, angle: FloatArray) -> BoolArray:
    """Whether a code of equal sectors is 1 at these angles."""
    turned = angle % (2 * np.pi) / (2 * np.pi)
    return sectors[(turned * len(sectors)).astype(int) % len(sectors)] > 0


class _Place:
    """Where each pixel lies: right and far (towards the sonar is negative) in disc radii from the
    disc's centre, with its distance and its angle from the line of sight, counter-clockwise."""

    def __init__(self, rng: Generator) -> None:
        # Most tracks lie within .05 of the radius, some up to .15 off.
        off = rng.normal(0, rng.choice([0.035, 0.08]), 2) * RADIUS
        radius = RADIUS * (1 + rng.normal(0, 0.025))
        self.right, self.far = (
            ((axis - CENTRE - by) / radius).astype(np.float32)
            for axis, by in ((COLUMNS, off[0]), (-ROWS + 2 * CENTRE, off[1]))
        )
        self.distance = np.hypot(self.right, self.far)
        self.angle = np.arctan2(-self.right, self.far) % (2 * np.pi)

    def along(self, angle: float) -> FloatArray:
        """The coordinate of each pixel in a direction."""
        return self.right * np.cos(angle) + self.far * np.sin(angle)


def random_set(rng: Generator) -> LandmarkSet:
    """The basin's discs, or two to six codes of three to twelve sectors with any widths."""
    u = rng.uniform
    if u() < 0.45:
        return BASIN
    symbol, ring = (0.0, 0.62), (0.80, 1.0)
    if u() < 0.5:
        symbol, ring = (u(0, 0.15), u(0.5, 0.7)), (u(0.74, 0.88), 1.0)
    codes = unlike_codes(int(rng.choice([3, 4, 5, 6, 8, 12], p=[0.1, 0.25, 0.15, 0.2, 0.2, 0.1])))
    most = min(int(rng.integers(2, MOST_IDS + 1 if u() < 0.2 else 7)), len(codes))
    chosen = [codes[i] for i in rng.choice(len(codes), most, replace=False)]
    return LandmarkSet("random", 0.1, ring, symbol, tuple(range(1, most + 1)), tuple(chosen))


def _stranger(rng: Generator, known: FloatArray) -> FloatArray:
    """Sectors of a symbol unlike all known codes (K, ANGLES), however turned."""
    turned = np.stack([np.roll(known, step, axis=1) for step in range(ANGLES)])
    while True:
        which = rng.uniform()
        if which < 0.2:
            return np.ones(4)
        if which < 0.3:
            return np.zeros(4)
        size = int(rng.choice([3, 4, 5, 6, 8, 12]))
        sectors = rng.integers(0, 2, size).astype(float)
        if which > 0.85:  # a single wedge
            sectors = (np.arange(12) < rng.integers(1, 11)).astype(float)
        spread = sectors[(THETA / (2 * np.pi) * len(sectors)).astype(int)]
        if np.abs(turned - spread).mean(axis=2).min() > UNLIKE:
            return sectors


def _field(rng: Generator, scale: float) -> FloatArray:
    """A random field of standard deviation 1. scale: of its patches, in disc radii."""
    noise, sigma = rng.standard_normal((SIZE, SIZE), np.float32), max(scale * RADIUS, 0.4)
    smooth = cv2.GaussianBlur(noise, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    return smooth / np.float32(max(smooth.std(), 1e-6))


class _Scene:
    """Levels in dB over the floor, pixel by pixel, and where something shines or is a plate."""

    def __init__(self, rng: Generator, place: _Place) -> None:
        u = rng.uniform
        self.rng, self.place = rng, place
        self.level = np.zeros((SIZE, SIZE), np.float32)
        self.shines = np.zeros((SIZE, SIZE), bool)
        above_plate = u(3, 6) if u() < 0.15 else u(5, 15)
        # Where nothing of a disc is brighter than the floor it cannot be told from a shadow.
        self.lit_db = max(u(-14, 3) + above_plate, u(-3, 2))
        self.plate_db = self.lit_db - above_plate
        self.ring_db = self.lit_db + u(-4, 3)

    def set(self, where: FloatArray, level_db: float, shines: bool = False) -> None:
        self.level[where] = level_db
        self.shines |= where & shines

    def disc(
        self, landmarks: LandmarkSet, symbol: FloatArray | bool, ring: FloatArray | bool = True
    ) -> None:
        """A plate with a ring and a symbol, where these are."""
        away, (inner, outer) = self.place.distance, landmarks.ring
        self.set(away < 1, self.plate_db)
        self.set((away >= inner) & (away <= outer) & ring, self.ring_db, shines=True)
        inside = (away >= landmarks.symbol[0]) & (away <= landmarks.symbol[1])
        self.set(inside & symbol, self.lit_db, shines=True)


# What is taken for a disc: each draws into a scene.


def _letter(scene: _Scene, landmarks: LandmarkSet) -> None:
    rng, strokes = scene.rng, np.zeros((SIZE, SIZE), bool)
    for _ in range(rng.integers(1, 4)):
        angle, off = rng.uniform(0, np.pi), rng.uniform(-0.4, 0.4)
        strokes |= np.abs(scene.place.along(angle) - off) < rng.uniform(0.07, 0.18)
    scene.disc(landmarks, strokes, ring=bool(rng.uniform() < 0.8))


def _half_ring(scene: _Scene, landmarks: LandmarkSet) -> None:
    rng = scene.rng
    arc = (scene.place.angle - rng.uniform(0, 2 * np.pi)) % (2 * np.pi) < rng.uniform(2, 4.6)
    scene.disc(landmarks, arc & (rng.uniform() < 0.4), ring=arc)


def _blobs(scene: _Scene, _: LandmarkSet) -> None:
    rng, place = scene.rng, scene.place
    for _ in range(rng.integers(1, 8)):
        right, far = rng.normal(0, 0.6, 2)
        square = (place.right - right) ** 2 + (place.far - far) ** 2
        blob = rng.uniform(4, 16) - 4 * square / rng.uniform(0.02, 0.2)
        scene.level = np.maximum(scene.level, blob)


def _edge(scene: _Scene, _: LandmarkSet) -> None:
    rng = scene.rng
    side = scene.place.along(rng.uniform(0, 2 * np.pi)) > rng.uniform(-0.6, 0.6)
    scene.level = scene.level + rng.uniform(3, 12) * side


def _stone(scene: _Scene, _: LandmarkSet) -> None:
    """Stones, each with the black area behind it."""
    rng, place = scene.rng, scene.place
    for _ in range(rng.integers(1, 4)):
        right, far = rng.normal(0, 0.55), rng.normal(-0.2, 0.5)
        wide, deep = rng.uniform(0.15, 0.9, 2)
        # It may be narrower than the stone, and lean.
        lean = rng.normal(0, 0.15) * (place.far - far)
        behind = np.abs(place.right - right - lean) < wide * rng.uniform(0.6, 1.1)
        behind &= (place.far > far) & (place.far < far + deep + rng.uniform(0.2, 1.8))
        scene.set(behind, -rng.uniform(5, 20))
        scene.shines &= ~behind
        stone = ((place.right - right) / wide) ** 2 + ((place.far - far) / deep) ** 2 < 1
        scene.set(stone, rng.uniform(3, 14), shines=True)


def _shadow(scene: _Scene, _: LandmarkSet) -> None:
    """Black areas of any outline, often with a bright front."""
    rng, place = scene.rng, scene.place
    for _ in range(rng.integers(1, 3)):
        angle, (right, far) = rng.normal(0, 0.5), rng.normal(0, 0.45, 2)
        across = (place.right - right) * np.cos(angle) + (place.far - far) * np.sin(angle)
        along = (place.far - far) * np.cos(angle) - (place.right - right) * np.sin(angle)
        wide, deep = rng.uniform(0.2, 1.2, 2)
        bent = along + rng.normal(0, 0.5) * across**2
        power = rng.choice([1.0, 2.0, 8.0])  # a rhomb, an ellipse, nearly a rectangle
        inside = np.abs(across / wide) ** power + np.abs(bent / deep) ** power < 1
        scene.set(inside, -rng.uniform(6, 20))
        if rng.uniform() < 0.6:
            front = (np.abs(across) < wide) & (bent < -deep)
            front &= bent > -deep - rng.uniform(0.1, 0.5)
            scene.set(front, rng.uniform(3, 14), shines=True)


def _tyre(scene: _Scene, _: LandmarkSet) -> None:
    """A bright ring of another size, dark within or behind, or neither."""
    rng, place = scene.rng, scene.place
    radius = rng.uniform(0.5, 1.2)
    if rng.uniform() < 0.6:
        scene.set(place.distance < radius, -rng.uniform(2, 16))
    if rng.uniform() < 0.6:
        behind = np.hypot(place.right, place.far - rng.uniform(0.1, 0.5)) < radius * 1.05
        scene.set(behind & (place.distance > radius), -rng.uniform(4, 18))
    band = np.abs(place.distance - radius) < rng.uniform(0.08, 0.3)
    scene.set(band, rng.uniform(4, 14), shines=True)
    # The near side is often the brighter.
    scene.level = scene.level - band * place.far / radius * rng.uniform(-1, 4)


def _square(scene: _Scene, _: LandmarkSet) -> None:
    rng, place = scene.rng, scene.place
    angle = rng.uniform(0, np.pi)
    away = np.maximum(np.abs(place.along(angle)), np.abs(place.along(angle + np.pi / 2)))
    scene.set(away < rng.uniform(0.4, 1.0), rng.uniform(-10, 12))
    if rng.uniform() < 0.5:
        scene.set((away > 0.8) & (away < 1), rng.uniform(2, 12), shines=True)


def _twigs(scene: _Scene, _: LandmarkSet) -> None:
    rng = scene.rng
    for _ in range(rng.integers(1, 4)):
        angle, long = rng.uniform(0, np.pi), rng.uniform(0.5, 2)
        twig = np.abs(scene.place.along(angle) - rng.uniform(-0.9, 0.9)) < rng.uniform(0.04, 0.12)
        twig &= np.abs(scene.place.along(angle + np.pi / 2)) < long
        scene.level = scene.level + twig * rng.uniform(3, 14)


def _blank(scene: _Scene, landmarks: LandmarkSet) -> None:
    scene.disc(landmarks, False)


def _filled(scene: _Scene, landmarks: LandmarkSet) -> None:
    scene.disc(landmarks, True)


def _floor(scene: _Scene, landmarks: LandmarkSet) -> None:
    """Nothing but the floor."""


FAKES: tuple[tuple[Callable[[_Scene, LandmarkSet], None], float], ...] = (
    (_floor, 0.02), (_blank, 0.09), (_filled, 0.12), (_half_ring, 0.09), (_blobs, 0.05),
    (_edge, 0.04), (_twigs, 0.04), (_letter, 0.08), (_stone, 0.24), (_tyre, 0.06),
    (_square, 0.03), (_shadow, 0.14),
)  # fmt: skip


def _covered(scene: _Scene) -> None:
    """What lies over objects: the shadow behind a plate, silt, twigs, light."""
    place, u = scene.place, scene.rng.uniform
    if u() < 0.4:
        behind = (place.distance > 1) & (np.hypot(place.right, place.far - u(0.05, 0.4)) < 1.02)
        scene.level = scene.level - behind * u(3, 18)
    if u() < 0.1:
        _twigs(scene, BASIN)
    if u() < 0.25:  # silt, up to a little more than half
        edge = u(-0.15, 0.85)
        bent = u(-0.3, 0.3) * place.along(angle := u(0, 2 * np.pi)) ** 2
        hidden = place.along(angle + np.pi / 2) + bent > edge
        scene.set(hidden, u(-2, 2))
        scene.shines &= ~hidden
    if u() < 0.08:  # a shadow of something else
        dark = np.abs(place.along(u(0, np.pi)) - u(-0.8, 0.8)) < u(0.1, 0.5)
        scene.level = scene.level - dark * u(4, 18)


def _seen(scene: _Scene, rng: Generator) -> tuple[FloatArray, FloatArray, float]:
    """The mean picture and a single one as a sonar shows them, and the beam's smear."""
    u = rng.uniform
    texture = _field(rng, np.exp(u(np.log(0.05), np.log(1.5)))) * u(0, 4.2)
    glitter = _field(rng, u(0.04, 0.3)) * u(0, 7) * (u() < 0.75)
    plate = _field(rng, u(0.05, 0.4)) * u(0, 3)
    on_plate = scene.place.distance < 1
    level = scene.level + np.where(scene.shines, glitter, np.where(on_plate, plate, texture))
    if u() < 0.5:
        level = level + u(0, 4) * scene.place.along(u(0, 2 * np.pi))
    level = level.astype(np.float32)
    power = 10 ** (level / 10) + np.float32(10 ** (-u(4 if u() < 0.3 else 8, 25) / 10))
    smear = float(np.exp(u(np.log(0.01), np.log(0.25))))
    across, along = max(smear * RADIUS, 0.3), u(0.3, 1.8)

    def blurred(image: FloatArray, share: float) -> FloatArray:
        return cv2.GaussianBlur(
            image, (0, 0), max(across * share, 0.3),
            sigmaY=max(along * share, 0.3), borderType=cv2.BORDER_REFLECT,
        )  # fmt: skip

    power = blurred(power, 1.0)
    looks = u(0.6, 4)
    frames = np.exp(u(np.log(2), np.log(60)))
    stays = u()  # the share of the speckle that stays with the floor
    speckle = blurred(rng.standard_gamma(looks, (SIZE, SIZE), np.float32) / looks, 0.7)
    speckle = (speckle - 1) / max(speckle.std(), 1e-6) * looks**-0.5 * u(0.3, 1)
    changes = blurred(rng.standard_normal((SIZE, SIZE), np.float32), 0.7)
    changes *= speckle.std() / max(changes.std(), 1e-6)
    how = rng.choice(3, p=[0.4, 0.4, 0.2])
    shown = (lambda p: 10 * np.log10(np.maximum(p, 1e-3)), np.sqrt, lambda p: p)[how]
    single = shown(power * np.maximum(1 + speckle, 0.02))
    rest = stays * speckle + (1 - stays) * changes / np.sqrt(frames)
    mean = shown(power * np.maximum(1 + rest, 0.02))
    mean = mean + rng.normal(0, 0.3 * single.std() / np.sqrt(frames), mean.shape)
    if u() < 0.25:
        most = np.percentile(single, u(85, 99.5))
        single, mean = np.minimum(single, most), np.minimum(mean, most)
    return (mean - single.mean()) / (single.std() + 1e-6), frames, smear


def draw(rng: Generator) -> Examples:
    """One picture with what it shows; with a ring, since stage 1 offers nothing else."""
    while True:
        drawn = _draw(rng)
        ring, gap, outer = (drawn.brightness[0, rows].mean() for rows in _BANDS)
        if ring - (gap + outer) / 2 > LEAST_RING:
            return drawn


def _draw(rng: Generator) -> Examples:
    landmarks, place = random_set(rng), _Place(rng)
    codes, scene = landmarks.codes(THETA), _Scene(rng, place)
    rotation, which, label = rng.uniform(0, 2 * np.pi), rng.uniform(), MOST_IDS
    lit = np.int8(UNKNOWN)
    if STRANGERS <= which < STRANGERS + NOTHING:
        fakes, shares = zip(*FAKES, strict=True)
        fakes[rng.choice(len(fakes), p=shares)](scene, landmarks)
    else:
        if which < STRANGERS:
            sectors = _stranger(rng, codes)
        else:
            label = int(rng.integers(len(codes)))
            sectors = np.asarray(landmarks.sectors[label])
        scene.disc(landmarks, _lit(sectors, place.angle - rotation))
        lit = np.int8(_lit(sectors, THETA - rotation))
    _covered(scene)
    picture, frames, smear = _seen(scene, rng)
    radii = ShapeSampler(landmarks, (RADIUS, RADIUS)).radii
    right, far = -RADIUS * np.outer(radii, np.sin(THETA)), RADIUS * np.outer(radii, np.cos(THETA))
    columns, rows = (CENTRE + right).astype(np.float32), (CENTRE - far).astype(np.float32)
    brightness = cv2.remap(picture.astype(np.float32), columns, rows, cv2.INTER_LINEAR)
    count = np.full(brightness.shape, 40 * (1 - np.exp(-frames / 40)))
    if rng.uniform() < 0.12:  # the fan's edge
        angle = rng.uniform(0, 2 * np.pi)
        outside = (right * np.cos(angle) + far * np.sin(angle)) / RADIUS > rng.uniform(-0.1, 1.0)
        count[outside] = 0
        if outside.mean() > 1 - LEAST_IN_VIEW:
            label = MOST_IDS
    known = np.zeros((1, MOST_IDS, ANGLES), np.uint8)
    known[0, : len(codes)] = codes
    seen = brightness[None].astype(np.float16), count[None].astype(np.float16)
    existence = np.full(1, 0.5, np.float32)  # drawn while learning, see network.py
    of_set = known, np.full(1, len(codes))
    shown = np.full(1, label), np.full((1, ANGLES), lit), np.ones(1)
    return Examples(*seen, existence, np.full(1, smear, np.float32), *of_set, *shown)
