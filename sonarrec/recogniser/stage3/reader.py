"""The reader: small networks that read a symbol, direction by direction, off a shape matrix.

There are several, since each errs in other pictures; they learned by other chances, and the last
layer takes their mean. They say of each direction how likely the symbol is lit there, whether the
object is a disc with a symbol, and whether that may be a symbol of no ID. Nothing about an ID is
learned: beliefs follow from what is read and the codes of whatever set is used. Layers run round
the circle, so that all directions are read by the same weights; where the line of sight lies is an
input.

With an ID's code c (0 or 1), the log odds l that a direction is lit, and a scale T:

    log p(ID) = D + log mean over rotations of exp(T sum over directions of (c l - log(1 + e^l)))
    log p(none) = log(1 + exp(D + O - T sum over directions of log(1 + e^-|l|)))

The second is the sum of two cases: no disc, and a disc with the symbol that is read.

`make model` learns the weights (tests/studies/learning); `sonarrec calibrate` adapts
those of LAST_LAYER.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IndexArray, joined, selected
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, STEP, SYMBOL_LINES

LAYERS = ((3, 1), (5, 1), (5, 2), (3, 4))
"""Width and dilation of each layer, in directions."""
AROUND = [
    (np.arange(ANGLES)[:, None] + (np.arange(width) - width // 2) * dilation) % ANGLES
    for width, dilation in LAYERS
]
"""The directions that each layer looks at, from each direction: (ANGLES, width)."""
THETA = (np.arange(ANGLES) + 0.5) * STEP
SIGHT = np.stack([np.cos(THETA), np.sin(THETA)], 1)
LAST_LAYER = ("lit", "disc", "other")
"""The names of the weights of l, D and O; the last of each is a bias."""
# Layers' inputs are rounded to multiples of 1 / INPUT_STEPS, weights to those of 1 / WEIGHT_STEPS.
# Their products are then multiples of 2 ** -15, and sums below 512 are exact in single precision,
# in whatever order a processor adds: the results are the same on all of them.
INPUT_STEPS, WEIGHT_STEPS = 64, 512
AT_ONCE = 500
"""Pictures that are read together, which bounds the memory."""
DECIMALS = 6  # of log beliefs, before anything is decided by them
# A rotation is the mean of those within NEAR steps of the likeliest, weighted by their likelihood
# to the power NEAR_EXPONENT. Its standard error is their spread times ROTATION_SIGMA: on tuning
# seeds 2000 and 2001 of eight kinds 68 % of orientations were within .98 of it, 95 % within 1.9.
NEAR, NEAR_EXPONENT, ROTATION_SIGMA = 6, 0.25, 0.28
Weights = dict[str, FloatArray]


@dataclass(frozen=True, slots=True)
class Pictures:
    """Averaged shape matrices of n objects, as the reader takes them."""

    brightness: FloatArray
    """(n, L, ANGLES) in standard deviations of the surroundings."""
    count: FloatArray
    """(n, L, ANGLES) how often each cell was seen."""
    existence: FloatArray
    """(n,) probability of the object by stage 2."""
    smear: FloatArray
    """(n,) the beam's standard deviation across the line of sight, in disc radii."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What is read off n pictures."""

    lit: FloatArray
    """(n, ANGLES) log odds that the symbol is lit in a direction, from the line of sight on,
    counter-clockwise."""
    free: FloatArray
    """(n,) log odds of a disc with the symbol that is read, whatever that is, to no disc."""
    log_beliefs: FloatArray
    """(n, K + 1) not normalised: every ID, then 'none of these'."""
    rotation: FloatArray
    """(n, K) rotation of each ID, in steps."""
    rotation_sigma: FloatArray
    """(n, K) its standard error, in steps."""

    @property
    def probabilities(self) -> FloatArray:
        """(n, K + 1) beliefs: every ID, then 'none of these'; rows sum to 1."""
        likely = np.exp(self.log_beliefs - self.log_beliefs.max(axis=1, keepdims=True))
        return np.asarray(likely / likely.sum(axis=1, keepdims=True))


class Reader:
    """Reads the symbols of one set off averaged shape matrices."""

    every_frame: ClassVar = False  # see Reads in appearance.py

    def __init__(self, weights: Weights, codes: FloatArray) -> None:
        """weights: from model_file.py; the first axis of those before LAST_LAYER is the networks.

        codes: (ANGLES, K, ANGLES) from `rotated_codes`.
        """
        self._weights = {name: values.astype(np.float32) for name, values in weights.items()}
        own = [name for name in weights if name not in (*LAST_LAYER, "scale")]
        self._networks = [
            {name: self._weights[name][m] for name in own} for m in range(len(weights["hidden"]))
        ]
        self.scale = float(np.exp(weights["scale"][0]))
        self._codes = codes.reshape(-1, ANGLES).T
        self._ids = codes.shape[1]

    def __call__(self, pictures: Pictures) -> Reading:
        """Read n pictures. Objects do not affect each other."""
        return joined(
            [
                self.judged(*self.last_layer(selected(pictures, rows)))
                for rows in blocks(len(pictures.smear))
            ]
        )

    def last_layer(self, pictures: Pictures) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n, ANGLES), (n,) and (n,): l, D and O. Of a direction never seen l is exactly 0."""
        of_directions, of_object = self.layers(pictures)
        lit, disc, other = (self._weights[name] for name in LAST_LAYER)
        results = of_directions @ lit, of_object @ disc, of_object @ other
        return results[0].astype(float), results[1].astype(float), results[2].astype(float)

    def layers(self, pictures: Pictures) -> tuple[FloatArray, FloatArray]:
        """(n, ANGLES, C) and (n, H), what the last layer judges: each direction, and the object.

        The results of all networks, and a last column of ones, for the bias. Directions of which
        nothing was seen are all 0, so that they are not read: their log odds are 0.
        """
        inputs = _steps(direction_inputs(pictures)), object_inputs(pictures)
        of_directions, of_object = zip(*(_results(w, *inputs) for w in self._networks), strict=True)
        seen = seen_directions(pictures)[..., None]
        return _with_ones(*of_directions) * seen, _with_ones(*of_object)

    def judged(self, lit: FloatArray, disc: FloatArray, other: FloatArray) -> Reading:
        """Beliefs by what `last_layer` read."""
        fit = self._fit(lit)
        ids = disc[:, None] + np.logaddexp.reduce(fit, axis=1) - np.log(ANGLES)
        free = disc + other - self.scale * np.logaddexp(0, -np.abs(lit)).sum(axis=1)
        logs = np.concatenate([ids, np.logaddexp(0, free)[:, None]], axis=1)
        return Reading(lit, free, np.round(logs, DECIMALS), *_rotation(fit))

    def _fit(self, lit: FloatArray) -> FloatArray:
        """(n, ANGLES, K) log likelihood of what is read, by rotation and ID."""
        fit = (lit @ self._codes).reshape(len(lit), ANGLES, self._ids)
        return np.asarray(self.scale * (fit - np.logaddexp(0, lit).sum(axis=1)[:, None, None]))


def blocks(n: int) -> list[slice]:
    """Slices of AT_ONCE of n pictures; one that is empty if there are none."""
    return [slice(first, min(first + AT_ONCE, n)) for first in range(0, max(n, 1), AT_ONCE)]


def sigmoid(x: FloatArray) -> FloatArray:
    """The probability of log odds x."""
    return np.asarray(0.5 * (1 + np.tanh(x / 2)))


def _steps(values: FloatArray) -> FloatArray:
    """The values rounded to multiples of 1 / INPUT_STEPS, in single precision."""
    steps = np.float32(INPUT_STEPS)
    rounded = np.rint(values * steps).astype(np.float32, copy=False)
    rounded /= steps
    return np.asarray(rounded)


def _with_ones(*values: FloatArray) -> FloatArray:
    """The values side by side, with a column of ones behind the last."""
    ones = np.ones((*values[0].shape[:-1], 1), np.float32)
    return np.concatenate([*values, ones], axis=-1)


def _results(w: Weights, h: FloatArray, of_object: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, ANGLES, C) and (n, H) the results of one network with these weights.

    h, of_object: from `direction_inputs`, in steps, and `object_inputs`.
    """
    for i, around in enumerate(AROUND):
        taps = np.take(h, around, axis=1).reshape(len(h) * ANGLES, around.shape[1] * h.shape[2])
        new = taps @ w[f"conv{i}"]
        new += w[f"conv{i}_bias"]
        np.maximum(new, 0, out=new)
        new = new.reshape(len(h), ANGLES, new.shape[1])
        if i:
            new += h
        h = _steps(new)
    parts = [h.mean(axis=1), h.max(axis=1), h.min(axis=1), of_object]
    hidden = _steps(np.concatenate(parts, axis=1)) @ w["hidden"] + w["hidden_bias"]
    return h, _steps(np.maximum(hidden, 0))


def seen_directions(pictures: Pictures) -> BoolArray:
    """(n, ANGLES) whether anything of the symbol was seen in a direction."""
    return np.asarray((pictures.count[:, :SYMBOL_LINES] > 0).any(axis=1))


def direction_inputs(pictures: Pictures) -> FloatArray:
    """(n, ANGLES, 3 L + 5): each direction's cells, by contrast and by level, and how often they
    were seen; the direction; then what holds for the whole picture."""
    seen = pictures.count > 0
    level = np.where(seen, pictures.brightness, 0.0)
    number = np.maximum(seen.sum(axis=(1, 2), keepdims=True), 1)
    mean = level.sum(axis=(1, 2), keepdims=True) / number
    around = np.where(seen, level - mean, 0.0)
    spread = np.sqrt((around**2).sum(axis=(1, 2), keepdims=True) / number + 1e-3)
    cells = [
        np.clip(around / spread, -4, 4),
        np.clip(level, -6, 8) / 3,
        np.minimum(pictures.count, 8) / 8,
    ]
    of_picture = [np.log(spread[:, 0, 0]), mean[:, 0, 0] / 3, np.clip(pictures.smear, 0, 0.5) * 5]
    shape = len(level), ANGLES
    parts = [
        np.concatenate(cells, axis=1).transpose(0, 2, 1),
        np.broadcast_to(SIGHT, (*shape, 2)),
        np.broadcast_to(np.stack(of_picture, axis=1)[:, None], (*shape, len(of_picture))),
    ]
    return np.concatenate(parts, axis=2)


def object_inputs(pictures: Pictures) -> FloatArray:
    """(n, 2): the log odds of the object, and the smear."""
    existence = np.clip(pictures.existence, 1e-3, 1 - 1e-3)
    return np.stack([np.log(existence / (1 - existence)) / 3, pictures.smear * 5], axis=1)


def _rotation(fit: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, K) the rotation by log likelihoods (n, ANGLES, K), and its standard error, in steps."""
    best: IndexArray = np.round(fit, DECIMALS).argmax(axis=1)[:, None]
    off = np.arange(-NEAR, NEAR + 1)[None, :, None]
    near = NEAR_EXPONENT * np.take_along_axis(fit, (best + off) % ANGLES, axis=1)
    weight = np.exp(near - near.max(axis=1, keepdims=True, initial=-np.inf))
    weight /= weight.sum(axis=1, keepdims=True)
    mean = (weight * off).sum(axis=1)
    variance = (weight * (off - mean[:, None]) ** 2).sum(axis=1)
    return best[:, 0] + mean, ROTATION_SIGMA * np.sqrt(variance)
