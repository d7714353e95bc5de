"""`make bound`: how often `evaluate --bound` holds, in campaigns drawn from one bank of passes.

The bank's passes are of scenes of many kinds, those with strange symbols and rubbish among them,
recognised with a low `declare`, so that there is something to bound. A campaign draws its passes
from it, with replacement; the bound holds if no larger share is false in the whole bank.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sonarrec.config import preset
from sonarrec.errors import SonarrecError
from sonarrec.evaluation.behaviour import DECLARES
from sonarrec.evaluation.bound import least_declare
from sonarrec.evaluation.count import NOBODY
from sonarrec.recogniser.three_stages import FRAMEWORK
from tests.studies.learning.other_worlds import OTHER_WORLDS
from tests.studies.learning.random_scenes import KINDS_OF_SCENE, random_scene
from tests.studies.results.record import judge, options, save, show
from tests.support.simulated import Job, in_processes, recognise, score

REPORTED = range(64_000, 64_005)
KINDS = (*KINDS_OF_SCENE, *(kind for kind in OTHER_WORLDS if kind not in ("wide", "vehicle")))
FRAMES = 64
LOW = DECLARES[-1]
CAMPAIGNS = 200
SHARES, SIZES = (0.01, 0.02), (200, 500, 1000)


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, recognise, draw campaigns and tell."""
    asked = options("bound", __doc__, REPORTED, FRAMES).parse_args(arguments)
    default = preset("default")
    low = replace(default, features=replace(default.features, declare=LOW))
    scenes = [
        random_scene(seed, kind, frames=asked.frames) for kind in KINDS for seed in asked.seeds
    ]
    scenes = [replace(s, sonar=replace(s.sonar, range_bins=256)) for s in scenes]  # quick to render
    folders = [asked.out / str(n) for n in range(len(scenes))]
    in_processes(recognise, [Job(s, f, [low]) for s, f in zip(scenes, folders, strict=True)])
    parts = score(folders).parts
    claims = np.concatenate([p.sums["claimed", FRAMEWORK] for p in parts])[:, :-1]
    whole = np.concatenate(
        [p.sums["declared", "strict", NOBODY][:, :, 3].sum(axis=1) for p in parts]
    )
    total = claims.sum(axis=2)
    with np.errstate(invalid="ignore"):
        false = np.nanmean(claims[:, :, 1] / total, axis=0)
    of_frames = claims[:, :, 1].sum(axis=0) / total.sum(axis=0)
    tpr = claims[:, :, 0].sum(axis=0) / whole.sum()
    rng, lines, least = np.random.default_rng(0), [], 1.0
    for share in SHARES:
        for size in SIZES:
            given: list[int] = []
            for _ in range(CAMPAIGNS):
                drawn = claims[rng.integers(len(claims), size=size)]
                # The results' own declare is the least of DECLARES: the last column is that.
                drawn = np.concatenate([drawn, drawn[:, -1:]], axis=1)
                try:
                    given.append(DECLARES.index(least_declare(drawn, share, LOW)[0]))
                except SonarrecError:
                    continue
            held, of_all = (
                1 - sum(truth[d] > share for d in given) / CAMPAIGNS for truth in (false, of_frames)
            )
            least = min(least, held)
            middle = DECLARES[int(np.median(given))] if given else None
            lines.append(
                {
                    "bound": share,
                    "passes": size,
                    "given": f"{len(given) / CAMPAIGNS:.3f}",
                    "holds": f"{held:.3f}",
                    "of all claims, too": f"{of_all:.3f}",
                    "declare, median": "-" if middle is None else f"{middle:g}",
                    "TPR, mean": f"{tpr[given].mean():.3f}" if given else "-",
                }
            )
    show(
        f"{CAMPAIGNS} campaigns each: in how many a bound was given, in how many no larger share\n"
        "is false in the bank (refused ones count as such), and what it costs",
        lines,
    )
    show(
        f"The bank, {len(claims)} passes: mean over passes of the share of claims that is false, "
        "that share of all claims, and TPR",
        [
            {"declare": d, "of a pass": f"{f:.4f}", "of all": f"{a:.4f}", "TPR": f"{t:.3f}"}
            for d, f, a, t in zip(DECLARES, false, of_frames, tpr, strict=True)
        ],
    )
    judge("campaigns in which the bound holds, least", least, 0.95, at_least=True)
    save(asked.record)


if __name__ == "__main__":
    main()
