"""The reader's network while it learns (jax). stage3/reader.py is the same network at run time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.random import Generator

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.recogniser.stage3.reader import (
    LAYERS,
    THETA,
    Pictures,
    direction_inputs,
    object_inputs,
    seen_directions,
)
from sonarrec.recogniser.stage3.shape_matrix import ANGLES
from tests.studies.learning.random_pictures import MOST_IDS, UNKNOWN, Examples, joined_examples

CHANNELS, HIDDEN = 32, 32
STEPS, BATCH, MOST_RATE = 14_000, 256, 4e-3
KEPT = 0.9985  # of the averaged weights, in each step
DRAWN_SHARE = 0.5  # of a batch that is drawn pictures; the others are tracks of simulated scenes
OF_DIRECTIONS = 0.3  # what is read counts so much of the beliefs
LEFT_OUT = 0.12  # so often the ID of a disc is taken out of its set: it is a stranger then
LEAST_LOG = -6.0  # a probability below exp of this costs little more: truth has errors, too

Weights = dict[str, jax.Array]


def begin(seed: int, inputs: int, widths: tuple[tuple[int, int], ...] = LAYERS) -> Weights:
    """Random weights."""
    rng = np.random.default_rng(seed)

    def normal(size: tuple[int, ...], sigma: float) -> jax.Array:
        return jnp.asarray(rng.normal(0, sigma, size), jnp.float32)

    weights, before = {}, inputs
    for i, (width, _) in enumerate(widths):
        weights[f"conv{i}"] = normal((width * before, CHANNELS), (2 / (width * before)) ** 0.5)
        weights[f"conv{i}_bias"] = jnp.zeros(CHANNELS)
        before = CHANNELS
    of_all = 3 * CHANNELS + 2
    return weights | {
        "lit": normal((CHANNELS + 1,), 0.1).at[-1].set(0.0),
        "hidden": normal((of_all, HIDDEN), (2 / of_all) ** 0.5),
        "hidden_bias": jnp.zeros(HIDDEN),
        "disc": normal((HIDDEN + 1,), 0.1).at[-1].set(-2.0),
        "other": normal((HIDDEN + 1,), 0.1).at[-1].set(-4.0),
        "scale": jnp.array([-1.0]),
    }


class Batch(NamedTuple):
    """What one step learns from, n pictures. of_directions, of_object: the inputs of Reader.layers.

    seen: (n, ANGLES) as seen_directions. codes, label, lit: as of Examples. known: (n, MOST_IDS)
    whether the set has the ID.
    """

    of_directions: FloatArray
    of_object: FloatArray
    seen: BoolArray
    codes: FloatArray
    known: BoolArray
    label: IntArray
    lit: IntArray


def log_beliefs(weights: Weights, batch: Batch) -> tuple[jax.Array, jax.Array]:
    """(n, MOST_IDS + 1) log probabilities, and (n, ANGLES) log odds that a direction is lit."""
    h = batch.of_directions
    for i, (width, dilation) in enumerate(LAYERS):
        taps = [jnp.roll(h, (width // 2 - j) * dilation, axis=1) for j in range(width)]
        new = jnp.concatenate(taps, 2) @ weights[f"conv{i}"] + weights[f"conv{i}_bias"]
        h = jax.nn.relu(new) + (h if i else 0)
    lit = jnp.where(batch.seen, h @ weights["lit"][:-1] + weights["lit"][-1], 0.0)
    parts = jnp.concatenate([h.mean(1), h.max(1), h.min(1), batch.of_object], 1)
    hidden = jax.nn.relu(parts @ weights["hidden"] + weights["hidden_bias"])
    disc, other = (hidden @ weights[k][:-1] + weights[k][-1] for k in ("disc", "other"))
    scale = jnp.exp(weights["scale"])
    rotated = jnp.stack([jnp.roll(lit, -step, axis=1) for step in range(ANGLES)], 1)
    fit = jnp.einsum("nra,nka->nkr", rotated, batch.codes)
    fit = scale * (fit - jax.nn.softplus(lit).sum(1)[:, None, None])
    ids = disc[:, None] + jax.nn.logsumexp(fit, axis=2) - np.log(ANGLES)
    free = disc + other - scale * jax.nn.softplus(-jnp.abs(lit)).sum(1)
    ids = jnp.where(batch.known, ids, -30.0)
    logits = jnp.concatenate([ids, jnp.logaddexp(0.0, free)[:, None]], 1)
    return jax.nn.log_softmax(logits), lit


def learn(
    tracks: Examples, drawn: Examples, seed: int, steps: int = STEPS
) -> dict[str, FloatArray]:
    """The averaged weights after learning from both."""
    weights = begin(seed, 3 * tracks.brightness.shape[1] + 5)
    optimiser = optax.adamw(optax.cosine_onecycle_schedule(steps, MOST_RATE), weight_decay=1e-4)

    def loss(weights: Weights, batch: Batch) -> jax.Array:
        logs, lit = log_beliefs(weights, batch)
        log = logs[jnp.arange(BATCH), batch.label]
        # Beliefs do not change if all that is read is rotated. So where each direction's symbol is
        # known, that is learned as well.
        of_direction = jax.nn.log_sigmoid(jnp.where(batch.lit > 0, lit, -lit))
        of_direction = jnp.where(batch.lit == UNKNOWN, 0.0, of_direction)
        return -(
            jnp.maximum(log, LEAST_LOG + 0.1 * log) + OF_DIRECTIONS * of_direction.mean(1)
        ).mean()

    @jax.jit
    def step(weights, averaged, state, batch, kept):  # type: ignore[no-untyped-def]
        value, gradient = jax.value_and_grad(loss)(weights, batch)
        update, state = optimiser.update(gradient, state, weights)
        weights = optax.apply_updates(weights, update)
        averaged = jax.tree.map(lambda a, b: kept * a + (1 - kept) * b, averaged, weights)
        return weights, averaged, state, value

    state, averaged, total = optimiser.init(weights), weights, 0.0
    for i, batch in enumerate(_batches(tracks, drawn, seed, steps)):
        kept = KEPT if i > 200 else 0.0
        weights, averaged, state, value = step(weights, averaged, state, batch, kept)
        total += float(value)
        if i % 500 == 499:
            print(f"step {i + 1}: {total / 500:.4f}", flush=True)
            total = 0.0
    return {name: np.asarray(value) for name, value in averaged.items()}


def _batches(tracks: Examples, drawn: Examples, seed: int, steps: int) -> Iterator[Batch]:
    rng = np.random.default_rng(seed)
    parts = tracks, drawn
    likely = [np.cumsum(part.weight) for part in parts]
    is_disc = tracks.label < MOST_IDS
    discs, others = tracks.existence[is_disc], tracks.existence[~is_disc]
    split = round(BATCH * (1 - DRAWN_SHARE))
    for _ in range(steps):
        chosen = [
            np.searchsorted(p, p[-1] * rng.random(n))
            for p, n in zip(likely, (split, BATCH - split), strict=True)
        ]
        taken = [Examples(*(c[k] for c in p)) for p, k in zip(parts, chosen, strict=True)]
        batch = joined_examples(taken)
        # A drawn picture exists as surely as a track that shows the like.
        likely_disc = (batch.label[split:] < MOST_IDS) | (rng.random(BATCH - split) < 0.5)
        n = BATCH - split
        batch.existence[split:] = np.where(likely_disc, rng.choice(discs, n), rng.choice(others, n))
        batch = _mirrored(batch, rng)
        harm = harmed(batch.brightness.astype(np.float32), batch.count, rng)
        pictures = Pictures(*harm, batch.existence, batch.smear)
        known = np.arange(MOST_IDS) < batch.ids[:, None]
        label = batch.label.copy()
        out = (rng.random(BATCH) < LEFT_OUT) & (label < MOST_IDS)
        known[out, label[out]] = False
        label[out] = MOST_IDS
        # Sets of fewer IDs.
        known &= (rng.random(known.shape) > 0.15) | (np.arange(MOST_IDS) == label[:, None])
        inputs = (of(pictures).astype(np.float32) for of in (direction_inputs, object_inputs))
        codes = batch.codes.astype(np.float32)
        yield Batch(*inputs, seen_directions(pictures), codes, known, label, batch.lit)


def _mirrored(batch: Examples, rng: Generator) -> Examples:
    """Every second picture mirrored about the line of sight, with its codes."""
    which = rng.random(BATCH) < 0.5
    columns = {}
    for name in ("brightness", "count", "codes", "lit"):
        columns[name] = getattr(batch, name)
        columns[name][which] = columns[name][which][..., ::-1]
    return batch._replace(**columns)


def harmed(x: FloatArray, count: FloatArray, rng: Generator) -> tuple[FloatArray, FloatArray]:
    """Pictures (n, L, ANGLES) made worse at random: glitter, light, speckle, hidden arcs."""
    n = len(x)

    def some(share: float) -> BoolArray:
        return rng.random((n, 1, 1)) < share

    def up_to(most: float) -> FloatArray:
        return rng.uniform(0, most, (n, 1, 1))

    def grain() -> FloatArray:
        g = rng.standard_normal(x.shape, np.float32)
        broad = (g + np.roll(g, 1, 2) + np.roll(g, -1, 2)) / 1.7
        return np.where(some(0.5), g, broad)

    original = x
    lines = rng.normal(0, 0.35, (n, 4))[:, [0, 0, 0, 1, 1, 1, 2, 2, 3, 3]][:, :, None]
    x = x + lines * some(0.5)
    waves = sum(
        rng.normal(0, 1, (n, 1)) * np.cos(k * THETA) + rng.normal(0, 1, (n, 1)) * np.sin(k * THETA)
        for k in (1, 2, 3)
    )
    x = x + some(0.5) * up_to(0.7) * waves[:, None] / 3**0.5
    bright = np.maximum(x - np.median(x, axis=(1, 2), keepdims=True), 0)
    x = x + some(0.6) * up_to(0.9) * grain() * bright
    x = x + some(0.5) * up_to(0.6) * grain()
    most = rng.uniform(1, 4, (n, 1, 1))
    x = np.where(some(0.3), most * np.tanh(x / most), x)
    x = x * np.exp(rng.normal(0, 0.25, (n, 1, 1)))
    x = np.where(some(0.2), original, x)
    # Hidden arcs, and arcs that are out of view.
    ahead = (np.arange(ANGLES) - rng.integers(0, ANGLES, (2, n, 1))) % ANGLES
    hidden = (ahead[0] < rng.integers(5, 20, (n, 1))) & (rng.random((n, 1)) < 0.2)
    floor = x[:, 8:].mean((1, 2), keepdims=True) + rng.normal(0, 0.3, (n, 1, 1))
    floor = floor + grain() * (x[:, 8:].std((1, 2), keepdims=True) + 0.1)
    x = np.where(hidden[:, None], floor, x)
    unseen = (ahead[1] < rng.integers(4, 16, (n, 1))) & (rng.random((n, 1)) < 0.08)
    return x.astype(np.float32), np.where(unseen[:, None], 0, count)
