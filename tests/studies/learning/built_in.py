"""The built-in appearance model, learned from simulated recordings.

`make model` (`python -m tests.studies.learning.built_in`) makes it again.

A picture is described under two opinions on noise, which agree in the simulator's worlds more than
elsewhere. Curves learned on both together rely on whichever the simulator favours. So each opinion
has curves of its own, and the log odds of sharp pictures are a weighted sum of the two, which is
again one sum of curves. Its weights are learned on kinds of scene that neither was learned from.
Smeared pictures have the first opinion alone: wide beams do correlate neighbouring cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from sonarrec.arrays import FloatArray
from sonarrec.config import preset
from sonarrec.geometry import PolarToFan, plane_from_polar
from sonarrec.learning.fit import fit
from sonarrec.learning.samples import Samples, describe, label
from sonarrec.recogniser.stage3.description import FEATURES
from sonarrec.recogniser.stage3.model import BUILT_IN, AppearanceModel, smeared_share
from sonarrec.records import Frame
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import scene_sonar
from sonarrec.simulation.truth import Truth
from tests.studies.learning.other_worlds import LEARNED_WORLDS
from tests.studies.learning.random_scenes import (
    ALL_KINDS,
    KINDS_OF_SCENE,
    STRETCH_KINDS,
    random_scene,
)
from tests.support.simulated import in_processes

FRAMES = 64  # of each recording: more recordings teach more than longer ones
EVERY = 3  # so many frames apart are those that teach: neighbours are much the same
# Seeds of the built-in model. Those from 2000 on are for choosing settings (tuning seeds), those
# from 3000 on for figures that are reported: no recording serves two purposes.
MODEL_SEEDS = range(1000, 1060)
# How many recordings of each kind. Kinds beyond the basin, and those whose discs are few beams
# wide, have more: they differ more from one recording to the next.
RECORDINGS = {
    **dict.fromkeys(KINDS_OF_SCENE + STRETCH_KINDS, 24),
    **dict.fromkeys(LEARNED_WORLDS, 60),
    "tiny_discs": 60,
    # These change only the geometry or the floor, so they are near the basin's.
    **dict.fromkeys(("leaning", "ripples", "fish", "vehicle"), 12),
}

SECOND = tuple(name for name in FEATURES if name.startswith("independent_"))
FIRST = tuple(name.removeprefix("independent_") for name in SECOND)
"""Features of the fits under correlated and under independent noise; all others serve both."""
FOLDS = 3
LEAST_LIKELY = 0.01  # a probability that is lower costs no more: else few samples decide
Recordings = Sequence[tuple[str, Samples]]
"""Samples with the kind of scene that they are from."""


def folds(kinds: Iterable[str], count: int = FOLDS) -> list[list[str]]:
    """The kinds that are left out together, every kind once."""
    shuffled = np.random.default_rng(5).permutation(sorted(set(kinds))).tolist()
    return [shuffled[i::count] for i in range(count)]


def opinions(recordings: Sequence[Samples], names: Sequence[str]) -> list[AppearanceModel]:
    """The curves learned under each opinion on noise. names: of the samples' features."""
    return [
        fit([replace(s, features=s.features[..., _columns(names, other)]) for s in recordings])
        for other in (SECOND, FIRST)
    ]


def _columns(names: Sequence[str], without: Sequence[str]) -> list[int]:
    return [i for i, name in enumerate(names) if name not in without]


def both_log_odds(
    models: Sequence[AppearanceModel], samples: Samples, names: Sequence[str]
) -> FloatArray:
    """(2, n, K) log odds by each opinion; models: from `opinions`."""
    return np.stack(
        [
            model.log_odds(samples.features[..., _columns(names, other)], samples.smear)
            for model, other in zip(models, (SECOND, FIRST), strict=True)
        ]
    )


def weights_of(left_out: Sequence[tuple[str, FloatArray, Samples]]) -> FloatArray:
    """(3,) weights of the two opinions and the bias, of least log loss over kinds left out.

    left_out: kind of each recording, (2, n, K) log odds from other kinds, and its samples, of which
    the sharp ones count. Every kind counts as much as any other, every recording as much as any of
    its kind.
    """
    sharp = [
        (kind, odds[:, clear], s.label[clear])
        for kind, odds, s in left_out
        if (clear := smeared_share(s.smear) < 0.5).any()
    ]
    kinds = [kind for kind, _, _ in sharp]

    def loss(weights: FloatArray) -> float:
        total = 0.0
        for kind, odds, truth in sharp:
            logits = np.pad(np.tensordot(weights[:2], odds, 1) + weights[2], ((0, 0), (0, 1)))
            likely = np.exp(logits - logits.max(axis=1, keepdims=True))
            true = likely[np.arange(len(truth)), truth] / likely.sum(axis=1)
            total -= float(np.log(np.maximum(true, LEAST_LIKELY)).mean()) / kinds.count(kind)
        return total

    found = minimize(loss, [0.5, 0.5, 0.2], method="Nelder-Mead").x
    return np.asarray(found.round(2))


def learn(
    recordings: Recordings, names: Sequence[str] = FEATURES
) -> tuple[AppearanceModel, FloatArray]:
    """The model of both opinions over the features of these names, and its weights."""
    left_out: list[tuple[str, FloatArray, Samples]] = []
    for fold in folds(ALL_KINDS):
        models = opinions([s for kind, s in recordings if kind not in fold], names)
        left_out += [
            (kind, both_log_odds(models, s, names), s) for kind, s in recordings if kind in fold
        ]
    weights = weights_of(left_out)
    return joined_model(opinions([s for _, s in recordings], names), weights, names), weights


def joined_model(
    models: Sequence[AppearanceModel], weights: FloatArray, names: Sequence[str]
) -> AppearanceModel:
    """The weighted sum of the opinions' curves. models: from `opinions`; weights: `weights_of`."""
    # Sharp, smeared.
    of_each = np.array([[weights[0], 1.0], [weights[1], 0.0]])
    bias = of_each[0] * models[0].bias + of_each[1] * models[1].bias + [weights[2], 0.0]
    curves: dict[str, tuple[FloatArray, FloatArray]] = {}
    for model, weight, other in zip(models, of_each, (SECOND, FIRST), strict=True):
        of_model = [name for name in names if name not in other]
        for name, knots, values in zip(of_model, model.knots, model.values, strict=True):
            # The same samples: a feature of both has the same knots in each.
            before = curves[name][1] if name in curves else 0.0
            curves[name] = knots, before + weight[:, None] * values
    knots, values = zip(*(curves[name] for name in names), strict=True)
    return AppearanceModel(bias, knots, values)


def samples_of(recording: tuple[str, int], every: int = EVERY) -> Samples:
    """Samples from a random recording of a kind and seed. every: so many frames apart."""
    kind, seed = recording
    truth: list[tuple[int, Truth]] = []
    scene = random_scene(seed, kind, wide=True, frames=FRAMES)

    def frames() -> Iterator[Frame]:  # as a reader would give them
        polar = None
        for frame in render(scene):
            truth.extend((frame.index, landmark) for landmark in frame.truth)
            if scene.sonar.layout == "polar" and polar is None:
                polar = PolarToFan(scene_sonar(scene).complete(scene.name), *frame.image.shape)
            yield Frame(frame.index, frame.timestamp_ns, frame.image, frame.fan, polar=polar)

    tracks = describe(frames(), preset("default"), scene.landmark_set)
    chosen = np.flatnonzero(tracks.row % every == 0)
    columns = ("row", "number", "position", "features", "smear")
    tracks = replace(tracks, **{name: getattr(tracks, name)[chosen] for name in columns})
    polar = np.array([(t.range_m, t.bearing_deg) for _, t in truth]).reshape(-1, 2)
    return label(
        tracks,
        np.array([row for row, _ in truth], np.int64),
        np.array([tracks.landmarks.ids.index(t.landmark) for _, t in truth], np.int64),
        plane_from_polar(*polar.T),
    )


def make_model() -> None:
    """Learn and write the built-in model, from every kind of scene that may be learned from."""
    recordings = [(kind, seed) for kind, n in RECORDINGS.items() for seed in MODEL_SEEDS[:n]]
    parts = in_processes(samples_of, recordings)
    write_model([(kind, s) for (kind, _), s in zip(recordings, parts, strict=True)])


def write_model(recordings: Recordings) -> None:
    """Learn the model from these and write it."""
    model, (first, second, bias) = learn(recordings)
    count = sum(len(s.label) for _, s in recordings)
    head = (
        "# Log odds of an ID against 'none of these' = bias + the curves of all features, which\n"
        "# description.py names: of sharp pictures and, as smeared_, of smeared ones.\n"
        "# Between the two their weighted mean (model.py).\n"
        f"# Made by `make model`: {len(recordings)} simulated recordings of {FRAMES} frames, from\n"
        f"# seed {MODEL_SEEDS.start} on, of {len(RECORDINGS)} kinds of scene; {count} tracks in "
        f"every {EVERY}rd frame.\n"
        f"# Of sharp pictures the curves under correlated noise count {first:.2f}, those under\n"
        f"# independent noise {second:.2f}, as is best on kinds left out; the bias has\n"
        f"# {bias:.2f} more.\n"
    )
    BUILT_IN.write_text(head + model.as_toml(), encoding="utf-8", newline="")


if __name__ == "__main__":
    make_model()
