"""`make transfer`: what a choice of features is worth in kinds of world it was not learned from.

Whole kinds of the simulator's scenes are left out in turn. Single frames are judged, without
pooling along tracks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.learning.samples import Samples
from sonarrec.recogniser.stage3.description import FEATURES
from tests.studies.learning.built_in import (
    LEAST_LIKELY,
    both_log_odds,
    folds,
    joined_model,
    opinions,
    samples_of,
    weights_of,
)
from tests.studies.learning.random_scenes import ALL_KINDS
from tests.studies.results.record import options, save, show
from tests.support.simulated import in_processes

SEEDS = range(2000, 2004)
DECLARE = 0.75
BOLD = (0.75, 0.9)
FALSE_RATES = (0.001, 0.002, 0.004)  # false claims to a track in a frame
WITHOUT: dict[str, tuple[str, ...]] = {
    "all": (),
    "correlated noise alone": (),
    "without single lines": ("weakest_line_step_share",),
    "without halves of sectors": ("weakest_bright_half_share", "strongest_dark_half_share"),
    "without rivals": ("rival_misfit", "independent_rival_misfit"),
    "without structure": ("structure", "independent_structure"),
    "without the ring": ("bright_over_ring_share", "weakest_ring_share", "ring_texture_share"),
}
"""Candidates, by the features that they lack."""
ALONE = {"correlated noise alone": np.array([1.0, 0.0, 0.0])}
"""Those of which the weights of the opinions are given."""


def left_out(samples: Sequence[tuple[str, Samples]], candidate: str) -> list[FloatArray]:
    """Probabilities of every recording by a model that was learned from other kinds.

    So are the weights of the model's two opinions.
    """
    names = [name for name in FEATURES if name not in WITHOUT[candidate]]
    columns = [FEATURES.index(name) for name in names]
    few = [(kind, replace(s, features=s.features[..., columns])) for kind, s in samples]
    parts = folds(kind for kind, _ in few)
    models = [opinions([s for kind, s in few if kind not in part], names) for part in parts]
    part_of = [next(n for n, part in enumerate(parts) if kind in part) for kind, _ in few]
    odds = [
        (kind, both_log_odds(models[n], s, names), s)
        for n, (kind, s) in zip(part_of, few, strict=True)
    ]
    joined = []
    for n in range(len(parts)):
        others = [one for one, part in zip(odds, part_of, strict=True) if part != n]
        weights = ALONE[candidate] if candidate in ALONE else weights_of(others)
        joined.append(joined_model(models[n], weights, names))
    return [
        joined[n].probabilities(s.features, s.smear) for n, (_, s) in zip(part_of, few, strict=True)
    ]


def figures(
    samples: Sequence[tuple[str, Samples]], beliefs: Sequence[FloatArray]
) -> dict[str, str]:
    """Log loss (a mean over kinds of scene), rates, and how honest bold beliefs are."""
    losses: dict[str, list[float]] = {}
    belief, right, on = [], [], 0
    for (kind, s), p in zip(samples, beliefs, strict=True):
        true = p[np.arange(len(p)), s.label]
        losses.setdefault(kind, []).extend(-np.log(np.maximum(true, LEAST_LIKELY)))
        best = p[:, :-1].argmax(axis=1)
        belief.append(p[np.arange(len(p)), best])
        right.append(best == s.label)
        on += int((s.label < p.shape[1] - 1).sum())
    score, good = np.concatenate(belief), np.concatenate(right)
    order = np.argsort(-score, kind="stable")
    bad, hits = np.cumsum(~good[order]), np.cumsum(good[order])
    bold, declared = (score >= BOLD[0]) & (score < BOLD[1]), score >= DECLARE
    at = [int(np.searchsorted(bad, rate * len(score), side="right")) - 1 for rate in FALSE_RATES]
    bins = np.minimum((score * 10).astype(int), 9)
    gap = sum(abs((score - good)[bins == i].sum()) for i in range(10)) / len(score)
    return {
        "log loss": f"{np.mean([np.mean(of) for of in losses.values()]):.4f}",
        "TPR": f"{(declared & good).sum() / on:.3f}",
        "false": f"{(declared & ~good).sum()} of {len(score)}",
        **{
            f"TPR at {1000 * rate:g} of 1000": f"{hits[i] / on:.3f}"
            for rate, i in zip(FALSE_RATES, at, strict=True)
        },
        "right of .75 to .9": f"{good[bold].mean():.2f} of {int(bold.sum())}",
        "ECE": f"{gap:.3f}",
    }


def main(arguments: list[str] | None = None) -> None:
    """Recognise as far as stage 2, and print a table of all candidates."""
    parser = options("transfer", __doc__, SEEDS)
    parser.add_argument("--only", nargs="*", choices=WITHOUT, default=list(WITHOUT))
    asked = parser.parse_args(arguments)
    wanted = [(kind, n) for kind in ALL_KINDS for n in asked.seeds]
    made = in_processes(samples_of, wanted)
    samples = [(kind, one) for (kind, _), one in zip(wanted, made, strict=True)]
    table = []
    for name in asked.only:
        found = figures(samples, left_out(samples, name))
        table.append({"features": name, "number": len(FEATURES) - len(WITHOUT[name]), **found})
    show("Kinds of the simulator, each left out of learning", table)
    save(asked.record)


if __name__ == "__main__":
    main()
