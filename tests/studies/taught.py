"""`make taught`: the default with models that were taught less than the built-in one.

Each is fitted anew to the samples of `make model`, without some features, kinds of scene or smears;
the bias and all other curves have made up for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from learning.built_in import lessons
from learning.random_scenes import KINDS_OF_SCENE, STRETCH_KINDS
from sonarrec.learning.fit import fit
from sonarrec.learning.samples import Samples
from sonarrec.recogniser.stage3_features.description import FEATURES
from sonarrec.recogniser.stage3_features.model import AppearanceModel, read_model
from tests.studies.ablation import Ablation, compare, parser

LearningReport = Callable[[str, Samples], Samples | None]
"""What of a recording of a kind of scene is taught; None: nothing."""


def whole(kind: str, samples: Samples) -> Samples:  # noqa: ARG001
    """All of it, as the built-in model."""
    return samples


def without(features: Sequence[str], kind: str, samples: Samples) -> Samples:  # noqa: ARG001
    """A feature that is the same everywhere tells nothing: its curve is level."""
    known = ~np.isin(FEATURES, features)
    assert np.count_nonzero(~known) == len(features)
    return replace(samples, features=samples.features * known)


def as_sharp(kind: str, samples: Samples) -> Samples:  # noqa: ARG001
    """Smeared pictures as if they were sharp: one set of curves."""
    return replace(samples, smear=np.zeros_like(samples.smear))


def among(kinds: Sequence[str], kind: str, samples: Samples) -> Samples | None:
    """Recordings of some kinds alone."""
    return samples if kind in kinds else None


def not_among(kinds: Sequence[str], kind: str, samples: Samples) -> Samples | None:
    """Recordings of all kinds but some."""
    return None if kind in kinds else samples


@dataclass(frozen=True, slots=True)
class Taught:
    """Stands in place of `built_in_model`."""

    path: Path

    def __call__(self) -> AppearanceModel:
        return read_model(self.path).model

    def __str__(self) -> str:
        return self.path.name


RING_OVER_GAP = ("ring_over_gap", "weakest_ring_over_gap")
BESIDE = (
    *("local_weakest_bright", "local_strongest_dark", "strongest_dark_over_floor"),
    *("weakest_bright_half_share", "strongest_dark_half_share"),
)
LESSONS: dict[str, LearningReport] = {
    "all that the built-in model is taught": whole,
    "no rivals: symbols that no ID has": partial(without, ("rival_misfit",)),
    "what an ID leaves unexplained not looked at": partial(without, ("structure",)),
    "the ring counted over the floor alone": partial(without, RING_OVER_GAP),
    "sectors not counted from what lies beside them": partial(without, BESIDE),
    "the same curves for sharp and smeared": as_sharp,
    "never taught rings with symbols that are nobody's": partial(not_among, ("symbols",)),
    "never taught debris": partial(not_among, ("debris",)),
    "taught the basin's kinds alone": partial(among, KINDS_OF_SCENE + STRETCH_KINDS),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Gather samples, fit, recognise, score and tell."""
    asked = parser("taught", __doc__).parse_args(arguments)
    gathered = lessons()
    asked.out.mkdir(parents=True, exist_ok=True)
    taught = {}
    for i, (name, lesson) in enumerate(LESSONS.items()):
        parts = [lesson(kind, samples) for kind, samples in gathered]
        path = asked.out / f"model_{i}.toml"
        path.write_text(fit([p for p in parts if p is not None]).as_toml(), encoding="utf-8")
        taught[name] = Ablation(code={"recogniser.built_in_model": Taught(path)})
    compare(taught, asked)


if __name__ == "__main__":
    main()
