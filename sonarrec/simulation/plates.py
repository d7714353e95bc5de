"""Drawn plates, flat or tilted, held before a sonar or lying on a floor, in polar images.

Every plate is a dense grid of scatterers, whose echoes add up coherently, with the phase of their
range, in the beams and bins of the image. What is round it is speckle of uneven strength, with
bright figures of a plate's size, streaks of what holds a plate, arcs and uneven light.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, ByteImage, FloatArray
from sonarrec.simulation.scene import HeldPlate, PlateScene
from sonarrec.simulation.truth import Truth
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import pixel_from_polar

GRID = 110  # scatterers along a plate's side
WAVELENGTH_M = 0.0021
CORNERS = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])  # halves of a side, right and up
FULL_DB = 60.0  # of the image's grey levels

Held = tuple[FloatArray, FloatArray]
"""How a plate is held: (3,) its middle and (3, 2) its axes, to the right and up the drawing, in
halves of a side; of right, ahead and up from the image's plane, m."""


class Plates:
    """All plates of a scene and what is behind them."""

    def __init__(self, scene: PlateScene) -> None:
        self._scene = scene
        rng = np.random.default_rng([scene.seed, 1])
        self._shape = shape = scene.bins, scene.beams
        self._bin_m = (scene.range_max_m - scene.range_min_m) / scene.bins
        self._beam_deg = scene.field_of_view_deg / scene.beams
        self._plates = [self._scatterers(plate, rng) for plate in scene.plate]
        self._swings = rng.uniform(0, 2 * np.pi, (len(scene.plate), 6)), rng.uniform(20, 80, 6)
        # The background: broad and fine unevenness, and bright figures with a texture of their own.
        uneven = _noise(rng, shape, 40) * 2 + _noise(rng, shape, 8) * 1.5
        for _ in range(scene.clutter):
            uneven = np.maximum(uneven, self._figure(rng, 2 * scene.landmark_set.radius_m))
        gain = np.linspace(-1, 1, scene.bins)[:, None] * rng.normal(0, 2)
        self._floor = 10 ** ((uneven + scene.floor_db + gain) / 20)
        self._frozen = _complex(rng, shape)
        self._light = [scene.light_db * _noise(rng, shape, 90) for _ in range(2)]

    def frame(self, index: int, fan: Fan) -> tuple[ByteImage, Fan, float, tuple[Truth, ...]]:
        """The image, (bins, beams), near range first; its fan; the pan; the truth."""
        scene = self._scene
        if scene.blank_every and index % scene.blank_every == scene.blank_every - 1:
            return self._image(index, []), fan, 0.0, ()
        held = [self._held(i, index) for i in range(len(scene.plate))]
        both = zip(scene.plate, held, strict=True)
        truth = [self._truth(plate, fan, *pose) for plate, pose in both if plate.known]
        return self._image(index, held), fan, 0.0, tuple(truth)

    def _held(self, plate: int, index: int) -> Held:
        stated, scene = self._scene.plate[plate], self._scene
        phase, period = self._swings[0][plate], self._swings[1]
        wave = np.sin(phase + 2 * np.pi * index / period) * scene.swing
        distance = stated.range_m + 0.1 * wave[0]
        bearing = math.radians(stated.bearing_deg + 4 * wave[1])
        angles = (stated.turned_deg, stated.tilt_deg, stated.axis_deg)
        rotation, tilt, axis = (
            math.radians(angle + 12 * w) for angle, w in zip(angles, wave[2:5], strict=True)
        )
        spin = _rotation(axis - bearing, 2) @ _rotation(tilt, 0) @ _rotation(rotation - axis, 2)
        axes = spin[:, :2] * scene.landmark_set.radius_m
        if stated.mirrored:
            axes = axes * (-1, 1)
        ground = math.sqrt(max(distance**2 - scene.height_m**2, 0))
        middle = np.array([ground * math.sin(bearing), ground * math.cos(bearing), -scene.height_m])
        return middle, axes

    def _truth(self, plate: HeldPlate, fan: Fan, middle: FloatArray, axes: FloatArray) -> Truth:
        scene, share = self._scene, np.linspace(-0.95, 0.95, 20)
        points = np.stack(np.meshgrid(share, share), axis=2).reshape(-1, 2)
        range_of, bearing_of = _polar(middle + points @ axes.T).T
        inside = (range_of >= scene.range_min_m) & (range_of <= scene.range_max_m)
        inside &= np.abs(bearing_of) <= scene.field_of_view_deg / 2
        rotation = math.degrees(math.atan2(axes[1, 0], axes[0, 0])) % 360
        polar = _polar(np.concatenate([middle[None], middle + CORNERS @ axes.T]))
        range_m, bearing_deg = polar[0].tolist()
        column, row = pixel_from_polar(fan, range_m, bearing_deg)
        where = float(column), float(row), range_m, bearing_deg
        visible = round(float(inside.mean()), 3)
        return Truth(plate.landmark, *where, visible, rotation, "", polar[1:])

    def _image(self, index: int, held: list[Held]) -> ByteImage:
        """The frame's grey levels; without plates, noise alone."""
        scene, rng = self._scene, np.random.default_rng([self._scene.seed, 2, index])
        field = _complex(rng, self._shape)
        level: FloatArray | float = 0.0
        if held:
            # The background is now of other scatterers, in part: the water moves.
            speckle = 0.8 * self._frozen + 0.6 * _complex(rng, self._shape)
            amplitude = self._floor
            for (middle, axes), (points, strength) in zip(held, self._plates, strict=True):
                amplitude = amplitude * ~self._covered(middle, axes)
                world = middle + points @ np.column_stack([axes, _normal(axes)]).T
                echoes = self._echoes(world, strength)
                field = field + self._seen(echoes) * 10 ** (scene.floor_db / 20)
            field = field + self._seen(speckle * amplitude) / 1.6
            w = math.sin(index / 25)
            level = self._light[0] * w + self._light[1] * (1 - abs(w))
            arcs = np.zeros((scene.bins, 1))  # whole ranges are darker or brighter
            for _ in range(rng.poisson(1.5)):
                begin, length = rng.integers(scene.bins), rng.integers(3, 14)
                arcs[begin : begin + length] += rng.uniform(-6, 2)
            level = level + arcs
        decibels = 20 * np.log10(np.maximum(np.abs(field), 1e-3)) + level
        grey = np.clip((decibels + 8) / FULL_DB, 0, 1) * 255
        return np.rint(grey).astype(np.uint8)

    def _scatterers(
        self, plate: HeldPlate, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """(n, 3) points in the plate's own axes, halves of a side, and (n,) complex strengths."""
        family = self._scene.landmark_set if plate.known else self._scene.others
        assert family is not None
        x, y = rng.uniform(-1, 1, (2, GRID * GRID))
        bright = family.pattern(family.ids.index(plate.landmark), x, y)
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

    def _echoes(self, points: FloatArray, strength: FloatArray) -> FloatArray:
        """(bins, beams) echoes of (n, 3) points, shared among the four cells round each."""
        echoes = np.zeros(self._shape, complex)
        cells = self._cells(points)
        phase = np.exp(4j * np.pi / WAVELENGTH_M * np.linalg.norm(points, axis=1))
        low = np.floor(cells).astype(int)
        part = cells - low
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            row, column = low[:, 0] + down, low[:, 1] + right
            share = np.abs(1 - down - part[:, 0]) * np.abs(1 - right - part[:, 1])
            inside = (row >= 0) & (row < self._shape[0])
            inside &= (column >= 0) & (column < self._shape[1])
            value = (strength * phase * np.sqrt(share))[inside]
            index = row[inside] * self._shape[1] + column[inside]
            sums = [np.bincount(index, v, echoes.size) for v in (value.real, value.imag)]
            echoes += (sums[0] + 1j * sums[1]).reshape(self._shape)
        return np.asarray(echoes)

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
        rotation, squeeze = rng.uniform(0, np.pi), rng.uniform(0.5, 1)
        u = x * math.cos(rotation) + y * math.sin(rotation)
        v = (y * math.cos(rotation) - x * math.sin(rotation)) / squeeze
        power = rng.choice([2, 8])
        inside = np.abs(u) ** power + np.abs(v) ** power < rng.uniform(0.6, 1.3)
        kind = rng.integers(3)
        texture = 4 * _noise(rng, self._shape, 14) if kind == 1 else np.zeros(self._shape)
        if kind == 2:
            texture = 6 * np.sign(np.sin(u * rng.uniform(4, 12)))
        return np.where(inside, rng.uniform(5, 12) + texture, -99.0)


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


def _rotation(angle: float, axis: int) -> FloatArray:
    """(3, 3) counter-clockwise rotation, rad, about axis 0, across, or 2, up."""
    matrix, others = np.eye(3), [i for i in range(3) if i != axis]
    c, s = math.cos(angle), math.sin(angle)
    matrix[np.ix_(others, others)] = [[c, -s], [s, c]]
    return matrix


def _normal(axes: FloatArray) -> FloatArray:
    """(3,) a half of a side off the plate."""
    normal = np.cross(axes[:, 0], axes[:, 1])
    return np.asarray(normal / np.linalg.norm(normal) * np.linalg.norm(axes[:, 0]))
