"""`make transfer`: what a choice of features is worth in kinds of world it was not learned from.

Whole kinds of the simulator's scenes are left out in turn. Single frames are judged, without
pooling along tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.learning.fit import fit
from sonarrec.learning.samples import Samples
from sonarrec.recogniser.stage3.description import FEATURES
from tests.studies.learning.built_in import samples_of
from tests.studies.learning.random_scenes import ALL_KINDS
from tests.studies.results.record import options, save, show
from tests.support.simulated import in_processes

SEEDS = range(2000, 2004)
EVERY = 3  # so many frames apart are those that are judged: neighbours are much the same
FOLDS = 5
DECLARE = 0.75
BOLD = (0.75, 0.9)
LEAST_LIKELY = 0.01  # a probability that is lower costs no more: else few samples decide
FALSE_RATES = (0.001, 0.002, 0.004)  # false claims to a track in a frame
WITHOUT: dict[str, tuple[str, ...]] = {
    "all": (),
    "without texture": ("texture", "texture_share"),
    "without edges": ("edge", "weakest_edge"),
    "without halves of sectors": ("weakest_bright_half_share", "strongest_dark_half_share"),
    "without rivals": ("rival_misfit",),
    "without structure": ("structure",),
    "without the ring over the floor": ("ring_over_floor",),
}
"""Candidates, by the features that they lack."""


def folds(kinds: Iterable[str]) -> list[list[str]]:
    """The kinds that are left out together, every kind once."""
    shuffled = np.random.default_rng(5).permutation(sorted(set(kinds))).tolist()
    return [shuffled[i::FOLDS] for i in range(FOLDS)]


def left_out(samples: Sequence[tuple[str, Samples]], names: Sequence[str]) -> list[FloatArray]:
    """Probabilities of every recording by a model that was learned from other kinds, without some
    features."""
    columns = [i for i, name in enumerate(FEATURES) if name not in names]
    few = [(kind, replace(s, features=s.features[..., columns])) for kind, s in samples]
    found: list[FloatArray] = [np.empty(0)] * len(few)
    for fold in folds(kind for kind, _ in few):
        model = fit([s for kind, s in few if kind not in fold])
        for i, (kind, s) in enumerate(few):
            if kind in fold:
                found[i] = model.probabilities(s.features, s.smear)
    return found


def figures(
    samples: Sequence[tuple[str, Samples]], probabilities: Sequence[FloatArray]
) -> dict[str, str]:
    """Log loss (a mean over kinds of scene), rates, and how honest bold beliefs are."""
    losses: dict[str, list[float]] = {}
    belief, right, on = [], [], 0
    for (kind, s), p in zip(samples, probabilities, strict=True):
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
    made = in_processes(partial(samples_of, every=EVERY), wanted)
    samples = [(kind, one) for (kind, _), one in zip(wanted, made, strict=True)]
    table = []
    for name in asked.only:
        found = figures(samples, left_out(samples, WITHOUT[name]))
        table.append({"features": name, "number": len(FEATURES) - len(WITHOUT[name]), **found})
    show("Kinds of the simulator, each left out of learning", table)
    save(asked.record)


if __name__ == "__main__":
    main()
