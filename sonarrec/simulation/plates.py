"""Simulated recordings of drawn plates, flat or tilted, held before a sonar or lying on a floor.

Every plate is a dense grid of scatterers, whose echoes add up coherently, with the phase of their
range, in the beams and bins of a polar image. What is round it is speckle of uneven strength, with
bright figures of a plate's size, streaks of what holds a plate, arcs and uneven light.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, ByteImage, FloatArray
from sonarrec.errors import SonarrecError
from sonarrec.landmarks import DrawnSet, landmarks_from_table, load_landmarks
from sonarrec.sonar import Sonar
from sonarrec.tables.toml import (
    Count,
    Finite,
    NotNegative,
    Positive,
    Share,
    from_table,
    named_file,
    read_toml,
)

GRID = 110  # scatterers along a plate's side
WAVELENGTH_M = 0.0021
CORNERS = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])  # halves of a side, right and up
FULL_DB = 60.0  # of the image's grey levels


@dataclass(frozen=True, slots=True)
class HeldPlate:
    """A plate, and how it is held. Its pose swings about what is stated, each in its own time."""

    landmark: int
    """Its ID; of `others` where it is none of the set's."""
    range_m: Positive = 1.0
    bearing_deg: Finite = 0.0
    turned_deg: Finite = 0.0
    """Counter-clockwise, in its own plane."""
    tilt_deg: Finite = 0.0
    """Between its plane and that of the image; a plate on the floor: the grazing angle's rest."""
    axis_deg: Finite = 0.0
    """Of the tilt, counter-clockwise from across."""
    mirrored: bool = False
    bright_db: Finite = 9.0
    """Of its rough cells over what is round it."""
    dark_db: Finite = -6.0
    known: bool = True
    """Whether it is of the set, and so in the truth."""


@dataclass(frozen=True, slots=True)
class PlateScene:
    """A recording of plates. others: a set of drawings for plates that are none of the set's."""

    name: str = "plates"
    landmark_set: DrawnSet = field(default_factory=lambda: _actag())
    others: DrawnSet | None = None
    plate: tuple[HeldPlate, ...] = (HeldPlate(0),)
    seed: Count = 0
    frames: Count = 60
    range_min_m: NotNegative = 0.2
    range_max_m: Positive = 1.8
    field_of_view_deg: Positive = 60.0
    beams: Count = 256
    bins: Count = 400
    beam_width_deg: Positive = 0.6
    pulse_m: Positive = 0.006
    rate_hz: Positive = 10.0
    swing: Share = 0.5
    """How much the poses change: 1 is .1 m, 12 deg."""
    streaks: Count = 3
    """Lines of echoes behind each plate."""
    light_db: NotNegative = 3.0
    clutter: Count = 3
    """Bright figures of about a plate's size."""
    floor_db: Finite = 14.0
    """Of the background over the noise."""
    height_m: NotNegative = 0.0
    """Of the sonar over the plates: one without tilt and swing lies on the floor."""
    blank_every: Count = 0
    """Each so many frames one shows noise alone; 0: none."""


@dataclass(frozen=True, slots=True)
class PlateTruth:
    """Where a plate is in a frame: its middle, and its corners, (4, 2) of range (m) and bearing
    (deg), clockwise from the drawing's top left where it is not mirrored."""

    landmark: int
    range_m: float
    bearing_deg: float
    visible: float
    orientation_deg: float
    corners: FloatArray


@dataclass(frozen=True, slots=True)
class PlateFrame:
    """A frame: its polar image, (bins, beams), near range first, and its truth."""

    index: int
    timestamp_ns: int
    image: ByteImage
    truth: tuple[PlateTruth, ...]


def _actag() -> DrawnSet:
    chosen = load_landmarks("actag24h10")
    assert isinstance(chosen, DrawnSet)
    return chosen


def plate_scene(source: str | Path) -> PlateScene | None:
    """The scene in a TOML file, or a built-in one, of kind = "plates"; None if it is another.

    Raises SonarrecError if it is of that kind and not valid.
    """
    path = named_file(source, Path(__file__).parent / "scenes")
    table = {} if path is None else read_toml(path)
    if table.pop("kind", "") != "plates":
        return None
    where = str(source)
    for key in {"landmark_set", "others"} & set(table):
        chosen = table[key]
        named = isinstance(chosen, str)
        chosen = load_landmarks(chosen, where) if named else landmarks_from_table(chosen, where)
        if not isinstance(chosen, DrawnSet):
            raise SonarrecError(f"{where}: {key} must be a set of drawn plates")
        table[key] = chosen
    scene = from_table(PlateScene, table, where)
    for plate in scene.plate:
        family = scene.landmark_set if plate.known else scene.others
        if family is None or plate.landmark not in family.ids:
            of = "landmark_set" if plate.known else "others"
            raise SonarrecError(f"{where}: there is no ID {plate.landmark} in {of}")
    if scene.range_min_m >= scene.range_max_m or not (scene.beams and scene.bins):
        raise SonarrecError(
            f"{where}: range_min_m must be below range_max_m, beams and bins be some"
        )
    return scene


def plate_sonar(scene: PlateScene) -> Sonar:
    """The geometry of a scene's images."""
    return Sonar(
        layout="polar",
        range_min_m=scene.range_min_m,
        range_max_m=scene.range_max_m,
        field_of_view_deg=scene.field_of_view_deg,
        tilt_deg=30.0,
        frame_rate_hz=scene.rate_hz,
        height_m=scene.height_m or None,
        beam_width_deg=scene.beam_width_deg,
    )


def render_plates(scene: PlateScene) -> Iterator[PlateFrame]:
    """The frames of a scene; the same scene gives the same."""
    world = _World(scene)
    for index in range(scene.frames):
        stamp = round(index * 1e9 / scene.rate_hz)
        if scene.blank_every and index % scene.blank_every == scene.blank_every - 1:
            yield PlateFrame(index, stamp, world.image(index, []), ())
            continue
        poses = [world.pose(i, index) for i in range(len(scene.plate))]
        truth = tuple(
            world.truth(plate, pose)
            for plate, pose in zip(scene.plate, poses, strict=True)
            if plate.known
        )
        yield PlateFrame(index, stamp, world.image(index, poses), truth)


class _World:
    """What stays from frame to frame."""

    def __init__(self, scene: PlateScene) -> None:
        self._scene = scene
        rng = np.random.default_rng([scene.seed, 1])
        self._shape = scene.bins, scene.beams
        self._bin_m = (scene.range_max_m - scene.range_min_m) / scene.bins
        self._beam_deg = scene.field_of_view_deg / scene.beams
        self._plates = [self._scatterers(plate, rng) for plate in scene.plate]
        self._swings = rng.uniform(0, 2 * np.pi, (len(scene.plate), 6)), rng.uniform(20, 80, 6)
        # The background: broad and fine unevenness, and bright figures with a texture of their own.
        uneven = _noise(rng, self._shape, 40) * 2 + _noise(rng, self._shape, 8) * 1.5
        side = 2 * scene.landmark_set.radius_m
        for _ in range(scene.clutter):
            uneven = np.maximum(uneven, self._figure(rng, side))
        gain = np.linspace(-1, 1, scene.bins)[:, None] * rng.normal(0, 2)
        self._floor = uneven + scene.floor_db + gain
        self._frozen = _complex(rng, self._shape)
        light = [_noise(rng, self._shape, 90) for _ in range(2)]
        self._light = scene.light_db * np.array(light)

    def pose(self, plate: int, index: int) -> tuple[FloatArray, FloatArray]:
        """(3,) middle and (3, 2) axes, to the right and up the drawing, in halves of a side; of
        right, ahead and up from the image's plane, m."""
        stated, scene = self._scene.plate[plate], self._scene
        phase, period = self._swings[0][plate], self._swings[1]
        wave = np.sin(phase + 2 * np.pi * index / period) * scene.swing
        distance = stated.range_m + 0.1 * wave[0]
        bearing = math.radians(stated.bearing_deg + 4 * wave[1])
        turned, tilt, axis = (
            math.radians(angle + 12 * w)
            for angle, w in zip(
                (stated.turned_deg, stated.tilt_deg, stated.axis_deg), wave[2:5], strict=True
            )
        )
        spin = _spin_up(axis - bearing) @ _tip(tilt) @ _spin_up(turned - axis)
        axes = spin[:, :2] * scene.landmark_set.radius_m
        if stated.mirrored:
            axes = axes * (-1, 1)
        ground = math.sqrt(max(distance**2 - scene.height_m**2, 0))
        middle = np.array([ground * math.sin(bearing), ground * math.cos(bearing), -scene.height_m])
        return middle, axes

    def truth(self, plate: HeldPlate, pose: tuple[FloatArray, FloatArray]) -> PlateTruth:
        middle, axes = pose
        polar = _polar(np.concatenate([middle[None], middle + CORNERS @ axes.T]))
        share, scene = np.linspace(-0.95, 0.95, 20), self._scene
        points = np.stack(np.meshgrid(share, share), axis=2).reshape(-1, 2)
        range_of, bearing_of = _polar(middle + points @ axes.T).T
        inside = (range_of >= scene.range_min_m) & (range_of <= scene.range_max_m)
        inside &= np.abs(bearing_of) <= scene.field_of_view_deg / 2
        visible = round(float(inside.mean()), 3)
        turn = math.degrees(math.atan2(axes[1, 0], axes[0, 0])) % 360
        (range_m, bearing_deg), rest = polar[0].tolist(), polar[1:]
        return PlateTruth(plate.landmark, range_m, bearing_deg, visible, turn, rest)

    def image(self, index: int, poses: list[tuple[FloatArray, FloatArray]]) -> ByteImage:
        """The frame's grey levels; without poses, noise alone."""
        scene, rng = self._scene, np.random.default_rng([self._scene.seed, 2, index])
        field = _complex(rng, self._shape)
        level = 0.0
        if poses:
            # The background is now of other scatterers, in part: the water moves.
            speckle = 0.8 * self._frozen + 0.6 * _complex(rng, self._shape)
            amplitude = 10 ** (self._floor / 20)
            for (middle, axes), plate in zip(poses, self._plates, strict=True):
                amplitude = amplitude * ~self._covered(middle, axes)
                echoes = np.zeros(self._shape, complex)
                points, strength = plate
                world = middle + points @ np.column_stack([axes, _normal(axes)]).T
                self._add(echoes, world, strength)
                field = field + self._seen(echoes) * 10 ** (scene.floor_db / 20)
            field = field + self._seen(speckle * amplitude) / 1.6
            w = math.sin(index / 25)
            level = self._light[0] * w + self._light[1] * (1 - abs(w))
            level = level + self._arcs(rng)
        decibels = 20 * np.log10(np.maximum(np.abs(field), 1e-3)) + level
        grey = np.clip((decibels + 8) / FULL_DB, 0, 1) * 255
        return np.rint(grey).astype(np.uint8)

    def _scatterers(
        self, plate: HeldPlate, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """(n, 3) points in the plate's own axes, halves of a side, and (n,) complex strengths."""
        family = self._scene.landmark_set if plate.known else self._scene.others
        assert family is not None
        k = family.ids.index(plate.landmark)
        x, y = rng.uniform(-1, 1, (2, GRID * GRID))
        bright = family.pattern(k, x, y)
        decibels = np.where(bright > 0.5, plate.bright_db, plate.dark_db)
        points: list[FloatArray] = [np.stack([x, y, np.zeros_like(x)], axis=1)]
        # An area's echoes add up to the level of one cell of beam and pulse, about a centimetre.
        side_m = 2 * self._scene.landmark_set.radius_m
        per_cell = (0.01 / (side_m / GRID)) ** 2
        strength: list[FloatArray] = [
            10 ** (decibels / 20) * _complex(rng, x.shape) / math.sqrt(per_cell)
        ]
        for _ in range(self._scene.streaks):
            n = 60
            ends = rng.uniform([-1.2, 1.1, -1], [1.2, 2.6, 1], (2, 3))
            ends[1, 1] = ends[0, 1] + rng.normal(0, 0.15)
            share = rng.random((n, 1))
            points.append(ends[0] * share + ends[1] * (1 - share) + rng.normal(0, 0.03, (n, 3)))
            bright_db = plate.bright_db + rng.uniform(-4, 6)
            strength.append(10 ** (bright_db / 20) * _complex(rng, (n,)))
        return np.concatenate(points), np.concatenate(strength)

    def _covered(self, middle: FloatArray, axes: FloatArray) -> BoolArray:
        """(bins, beams) which cells a plate takes."""
        cells = self._cells(middle + CORNERS @ axes.T)[:, ::-1]
        mask = np.zeros(self._shape, np.uint8)
        cv2.fillConvexPoly(mask, np.rint(cells).astype(np.int32), 1)
        return mask > 0

    def _cells(self, points: FloatArray) -> FloatArray:
        """(n, 2) bin and beam, in part, of (n, 3) points."""
        polar, scene = _polar(points), self._scene
        bins = (polar[:, 0] - scene.range_min_m) / self._bin_m - 0.5
        beams = (polar[:, 1] + scene.field_of_view_deg / 2) / self._beam_deg - 0.5
        return np.stack([bins, beams], axis=1)

    def _add(self, echoes: FloatArray, points: FloatArray, strength: FloatArray) -> None:
        """Add the echoes of (n, 3) points, shared among the four cells round each."""
        cells = self._cells(points)
        phase = np.exp(4j * np.pi / WAVELENGTH_M * np.linalg.norm(points, axis=1))
        low = np.floor(cells).astype(int)
        part = cells - low
        for down in (0, 1):
            for right in (0, 1):
                row, column = low[:, 0] + down, low[:, 1] + right
                share = np.abs(1 - down - part[:, 0]) * np.abs(1 - right - part[:, 1])
                there = (row >= 0) & (row < self._shape[0])
                there &= (column >= 0) & (column < self._shape[1])
                value = (strength * phase * np.sqrt(share))[there]
                index, size = row[there] * self._shape[1] + column[there], echoes.size
                sums = [np.bincount(index, part, size) for part in (value.real, value.imag)]
                echoes += (sums[0] + 1j * sums[1]).reshape(self._shape)

    def _seen(self, echoes: FloatArray) -> FloatArray:
        """Echoes through beam and pulse, each of power 1 in the middle."""
        wide = self._scene.beam_width_deg / 1.665 / self._beam_deg  # of amplitudes, two-way
        long = self._scene.pulse_m / 1.665 / self._bin_m
        both = [
            cv2.GaussianBlur(np.ascontiguousarray(part), (0, 0), sigmaX=wide, sigmaY=long)
            for part in (echoes.real, echoes.imag)
        ]
        return (both[0] + 1j * both[1]) * 2 * math.sqrt(math.pi * wide * long)

    def _figure(self, rng: np.random.Generator, side_m: float) -> FloatArray:
        """(bins, beams) dB of a bright figure somewhere: an even or blotchy blob, or stripes."""
        scene = self._scene
        bins, beams = np.mgrid[: self._shape[0], : self._shape[1]]
        range_m = rng.uniform(scene.range_min_m + side_m, scene.range_max_m - side_m / 2)
        beam = rng.uniform(0.1, 0.9) * scene.beams
        x = np.radians((beams - beam) * self._beam_deg) * range_m / side_m * 2
        y = (scene.range_min_m + bins * self._bin_m - range_m) / side_m * 2
        turn, squeeze = rng.uniform(0, np.pi), rng.uniform(0.5, 1)
        u = x * math.cos(turn) + y * math.sin(turn)
        v = (y * math.cos(turn) - x * math.sin(turn)) / squeeze
        power = rng.choice([2, 8])
        inside = np.abs(u) ** power + np.abs(v) ** power < rng.uniform(0.6, 1.3)
        kind = rng.integers(3)
        texture = 4 * _noise(rng, self._shape, 14) if kind == 1 else np.zeros(self._shape)
        if kind == 2:
            texture = 6 * np.sign(np.sin(u * rng.uniform(4, 12)))
        return np.where(inside, rng.uniform(5, 12) + texture, -99.0)

    def _arcs(self, rng: np.random.Generator) -> FloatArray:
        """(bins, 1) dB by which whole ranges are darker or brighter in this frame."""
        arcs = np.zeros((self._shape[0], 1))
        for _ in range(rng.poisson(1.5)):
            begin, length = rng.integers(self._shape[0]), rng.integers(3, 14)
            arcs[begin : begin + length] += rng.uniform(-6, 2)
        return arcs


def _complex(rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
    """Circular Gaussian numbers of mean power 1."""
    both = rng.standard_normal((2, *shape)) * math.sqrt(0.5)
    return np.asarray(both[0] + 1j * both[1])


def _noise(rng: np.random.Generator, shape: tuple[int, int], sigma: float) -> FloatArray:
    """A smooth random field of deviation 1."""
    smooth = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), sigma)
    return np.asarray(smooth / smooth.std())


def _polar(points: FloatArray) -> FloatArray:
    """(n, 2) slant range, m, and bearing, deg, of (n, 3) points."""
    bearing = np.degrees(np.arctan2(points[:, 0], points[:, 1]))
    return np.stack([np.linalg.norm(points, axis=1), bearing], axis=1)


def _spin_up(angle: float) -> FloatArray:
    """(3, 3) counter-clockwise rotation in the image's plane, rad."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _tip(angle: float) -> FloatArray:
    """(3, 3) rotation about the axis across, rad."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _normal(axes: FloatArray) -> FloatArray:
    """(3,) a half of a side off the plate."""
    normal = np.cross(axes[:, 0], axes[:, 1])
    return np.asarray(normal / np.linalg.norm(normal) * np.linalg.norm(axes[:, 0]))
