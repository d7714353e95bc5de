"""`make paper-choices`: what the paper leaves open of the framework, on the worlds for choosing.

Every reading of the open choices runs over the same frames. The rule: SMI errs in two ways, it
misses and it claims falsely; of each reading and threshold the worse of the two errors, as a share
of SMI's own, is what counts, and the least wins (protocol paper, all recordings pooled). Table 5
has no part in it. How sharply particles gather and when a group ends are compared first, the other
readings each with what was best, then all combinations of those that gained.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from sonarrec.config import Config, preset, with_table
from sonarrec.nouns import Frame
from sonarrec.recogniser.plane import working_plane
from sonarrec.recogniser.three_stages import SMI, ThreeStages
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import Scene, scene_fan
from tests.studies.paper.published import IDS
from tests.studies.paper.single import HALF, WHOLE, Log, Seen, chained
from tests.studies.paper.world import FAKE, STRAY, kept_worlds
from tests.studies.results.record import add_record_option, save, show
from tests.support.simulated import in_processes

SEEDS = range(6000, 6100)
"""Of the recordings on which readings are compared."""
FRAMES = 372
"""Of each: more than two sweeps."""
CHOSEN = Path(__file__).with_name("choices.toml")
THRESHOLDS = np.arange(0.25, 0.7, 0.01).round(2)

Table = Mapping[str, Mapping[str, Any]]

OPEN = {"z_hit": 0.95, "z_rand": 0.05, "count_strikes": "in_a_row"}
LITERAL: Table = {
    "continuity": {"hit_power": 1.0, "least_in_view": 0.0, **OPEN},
    "features": {"distance_power": 1.0, "least_ring": 0.0},
}
"""Each formula as it is printed: P_hit the map itself, the inverse of the distance itself, a
group deleted for its spread alone, and every measurement taken for one."""
STAGE_2: dict[str, Table] = {
    f"hit^{power:g} view {view:g}": {
        "continuity": {"hit_power": power, "least_in_view": view, **OPEN},
        "features": {"distance_power": 6.0, "least_ring": 0.5},
    }
    for power in (4.0, 8.0)
    for view in (0.0, 0.5)
}
"""How sharply particles gather, and how much of a disc the fan must show for its group to stay."""
REST: dict[str, Table] = {
    "1/d": {"features": {"distance_power": 1.0}},
    "1/d^2": {"features": {"distance_power": 2.0}},
    "own belief only": {"features": {"motion_model": "association"}},
    "z_rand .2": {"continuity": {"z_hit": 0.8, "z_rand": 0.2}},
    "no test of the circle": {"features": {"least_ring": 0.0}},
    "P_hit normalised": {"continuity": {"p_hit": "normalised"}},
    "no gain at the edge": {"candidates": {"edge_gain": "none"}},
    "five strikes in all": {"continuity": {"count_strikes": "in_all"}},
    "new belief by Eq. 5": {"features": {"new_belief": "neighbours"}},
    **{f"circle {share:g}": {"features": {"least_ring": share}} for share in (0.6, 0.7)},
}
"""Eq. 5's inverse distance, the weights of Eq. 4, whether the outer lines test for a circle and how
much of them must be bright, and the literal readings of what else is open."""
STATED: dict[str, Table] = {"threshold alone": {"features": {"decide": "threshold"}}}
"""Measured, not chosen, for the paper states another rule."""
GAIN = 0.05
"""Of the worse error, from which on a reading is tried together with others."""


def named(name: str, table: Table) -> Config:
    """The paper's preset with a reading of what it leaves open."""
    return replace(with_table(preset("paper"), table, name), preset=name)


def laid_over(table: Table, other: Table) -> dict[str, dict[str, Any]]:
    sections = sorted({*table, *other})
    return {s: {**table.get(s, {}), **other.get(s, {})} for s in sections}


@dataclass(frozen=True, slots=True)
class Job:
    """A scene, and the readings that run over its frames."""

    scene: Scene
    configs: Sequence[Config]


def watch(job: Job) -> dict[str, Seen]:
    """What SMI and every reading say of a scene. Readings with equal candidates share stage 1."""
    fan, landmarks = scene_fan(job.scene), job.scene.landmark_set
    stages = [
        ThreeStages(c, fan, landmarks, None, c.preset, None if i else SMI)
        for i, c in enumerate(job.configs)
    ]
    plane = working_plane("fan", fan, landmarks.radius_m, 1.0)
    share = plane.disc_share()
    logs = {name: Log(share) for name in (SMI, *(c.preset for c in job.configs))}
    for frame in render(job.scene):
        image = stages[0].working_image(Frame(frame.index, frame.timestamp_ns, frame.image, fan))
        selected: dict[Any, Any] = {}
        for config, stage in zip(job.configs, stages, strict=True):
            if config.candidates not in selected:
                selected[config.candidates] = stage.stage1(image)
            (result,) = stage.stage3([stage.stage2(image, selected[config.candidates])])
            for method in {config.preset, *([SMI] if stage is stages[0] else [])}:
                mine = [e for e in result.estimates if e.method == method]
                n = len(mine)
                logs[method].add(
                    frame,
                    np.array([(e.x_px, e.y_px) for e in mine]).reshape(n, 2),
                    np.array([e.existence for e in mine]),
                    np.array([e.score for e in mine]),
                    np.array([e.probabilities[:-1] for e in mine]).reshape(n, len(IDS)),
                )
    return {name: log.seen() for name, log in logs.items()}


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading at its best threshold. worse: the larger of both errors, in shares of SMI's.

    doubles: further claims of an ID in view. false_1: FPR of ID.1; of these false claims the share
    on circular fakes, on landmarks, on neither, and on discs not whole in the fan.
    """

    name: str
    worse: float
    threshold: float
    tpr: float
    fpr: float
    doubles: int
    false_1: float
    shares: tuple[float, ...]

    def line(self) -> dict[str, object]:
        """As it is told."""
        return {
            "reading": self.name,
            "worse error": f"{self.worse:.3f}",
            "threshold": self.threshold,
            "TPR / FPR": f"{self.tpr:.4f} / {self.fpr:.4f}",
            "double claims": self.doubles,
            "FPR of ID.1": f"{self.false_1:.3f}",
            "on fakes, landmarks, neither": ", ".join(f"{x:.0%}" for x in self.shares[:3]),
            "at the edge": f"{self.shares[3]:.0%}",
        }


def judged(name: str, seen: Seen, smi: Seen, thresholds: Sequence[float]) -> Reading:
    """Where the worse of the two errors, as a share of SMI's at its operating point, is least."""
    tpr, fpr = (r[-1] for r in smi.rates(smi.score >= preset("paper").smi.declare))
    best: Reading | None = None
    for threshold in thresholds:
        claim = seen.score >= threshold
        t, f = seen.rates(claim)
        worse = max((1 - t[-1]) / (1 - tpr), f[-1] / fpr)
        if best is None or worse < best.worse:
            false = seen.false(0, claim)
            on = seen.on[false]
            kinds = on == FAKE, (on >= 0) & (on < FAKE), on == STRAY, seen.inside[false] < WHOLE
            shares = tuple(float(k.sum() / max(len(on), 1)) for k in kinds)
            cells = seen.cells(claim)[seen.visible >= HALF]
            double = int(np.maximum(cells - 1, 0).sum())
            told = map(float, (worse, threshold, t[-1], f[-1]))
            best = Reading(name, *told, double, float(f[0]), shares)
    assert best is not None
    return best


def compare(scenes: Sequence[Scene], readings: Mapping[str, Table]) -> list[Reading]:
    """Every reading over the scenes, best first."""
    configs = [named(name, table) for name, table in readings.items()]
    found = in_processes(watch, [Job(scene, configs) for scene in scenes])
    pooled = {name: chained([log[name] for log in found]) for name in found[0]}
    told = [judged(SMI, pooled[SMI], pooled[SMI], [preset("paper").smi.declare])]
    told += sorted(
        (judged(name, pooled[name], pooled[SMI], THRESHOLDS) for name in readings),
        key=lambda r: r.worse,
    )
    show(f"{len(scenes)} recordings of {scenes[0].frames} frames", [r.line() for r in told])
    return told[1:]


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare the readings, choose, and keep what was chosen."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.paper.choices", description=__doc__
    )
    add_record_option(parser)
    asked = parser.parse_args(arguments)
    worlds = kept_worlds("choice")
    scenes = [w.scene(seed, FRAMES) for w, seed in zip(worlds, SEEDS, strict=False)]
    told = compare(scenes, {"literal": LITERAL} | STAGE_2)
    best = STAGE_2[next(r.name for r in told if r.name != "literal")]
    told = compare(
        scenes,
        {"best so far": best} | {n: laid_over(best, t) for n, t in (REST | STATED).items()},
    )
    least = next(r.worse for r in told if r.name == "best so far") - GAIN
    gained: dict[str, str] = {}  # the best one of each setting
    for name in (r.name for r in told if r.worse < least and r.name in REST):
        gained.setdefault(str([(s, *t) for s, t in REST[name].items()]), name)
    together = {"best so far": best}
    for size in range(1, len(gained) + 1):
        for names in combinations(gained.values(), size):
            together[", ".join(names)] = reduce(laid_over, (REST[n] for n in names), best)
    winner = compare(scenes, together)[0]
    threshold = {"features": {"declare": winner.threshold}}
    chosen = laid_over(together[winner.name], threshold)
    CHOSEN.write_text(tomli_w.dumps({"preset": chosen}), encoding="utf-8")
    save(asked.record)
    print(f"\n{CHOSEN}: {chosen}")


if __name__ == "__main__":
    main()
