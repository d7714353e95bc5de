"""`make scenes`: every kind of random scene, every method, and the goals they are held to.

`python -m tests.studies.scenes --seeds 2000:2003` is the same on seeds that settings are chosen on.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonarrec.config import preset
from sonarrec.evaluation.counts import ratio
from sonarrec.evaluation.uncertainty import bootstrap_weights, interval
from tests.studies.baseline import METHOD, Settings
from tests.studies.learning.other_worlds import LEARNED_WORLDS, OTHER_WORLDS
from tests.studies.learning.random_scenes import (
    ALL_KINDS,
    KINDS_OF_SCENE,
    STRETCH_KINDS,
    random_scene,
)
from tests.studies.results.readme import POOLED
from tests.studies.results.record import judge, options, save, show
from tests.support.counted import Count, counted
from tests.support.simulated import METHODS, PRESETS, Job, in_processes, recognise, score

TUNING = range(2000, 3000)
"""Seeds that settings are chosen on."""
REPORTED = range(3000, 3016)
"""Seeds of the figures that are reported: nothing is learned or chosen on their recordings."""
FRESH = range(32_000, 32_008)
"""Seeds of the figures with `--ours`."""
FRAMES = 160
IN_TABLES = (*STRETCH_KINDS, *OTHER_WORLDS, *KINDS_OF_SCENE)
"""Kinds in the order of the tables. The page leaves out the last ones, which are pooled as well."""
OURS = ("smi:default", "default", "offline")
"""Methods that are left with `--ours`."""
RESAMPLED = 5000  # times, of a kind's recordings, for the intervals of its rates
WORST = 4  # recordings, whose share of a kind's false claims is told
RATE_GOALS = (
    ("default", "pooled", 0.985, 0.0015),
    ("default", "worst kind", 0.94, 0.006),
    ("default", "no_landmark", None, 0.001),
    ("default", "tiny_discs", 0.85, 0.003),
    ("default", "all_hard", 0.85, 0.005),
    ("offline", "pooled", 0.995, 0.0005),
    *(
        ("default", kind, 0.98, 0.002)
        for kind in ("vehicle", "slope", "leaning", "silted", "ripples", "multipath", "wide")
    ),
)
"""Method, scenes, least TPR, most FPR (strict). The worst kind: of the pool, in each of the two."""


class Recording(NamedTuple):
    """One random scene. folder: of its results and its truth."""

    kind: str
    seed: int
    folder: Path


@dataclass(frozen=True, slots=True)
class Row:
    """One recording scored. passes: of landmarks, whole in view. counts: by protocol, method.
    frames: that were scored."""

    kind: str
    seed: int
    passes: int
    counts: dict[tuple[str, str], Count]
    frames: int = 0


def scored_rows(recordings: Sequence[Recording]) -> list[Row]:
    """Each recording by itself, for the IDs of others may be different ones."""
    rows, named = [], {method: name for name, method in METHODS.items()}
    for kind, seed, folder in recordings:
        found = score([folder])
        counts = {(how, named[of]): c for (how, of), c in counted(found).items() if of in named}
        rows.append(Row(kind, seed, len(found.passes), counts, found.frames))
    return rows


def pooled(rows: Sequence[Row], name: str, protocol: str = "strict") -> Count:
    """The counts of several recordings, summed."""
    counts = [r.counts[protocol, name] for r in rows]
    return Count(*np.sum(counts, axis=0).tolist())


def intervals(rows: Sequence[Row], name: str) -> tuple[tuple[float, float], ...]:
    """95 % intervals of a method's TPR and FPR, strict, over recordings (bootstrap)."""
    counts = np.array([r.counts["strict", name] for r in rows])
    weights = bootstrap_weights(len(counts), np.random.default_rng(0), RESAMPLED)
    tp, tn, fp, fn, _ = (weights @ counts).T
    return tuple(interval(ratio(n, n + of), len(counts)) for n, of in ((tp, fn), (fp, tn)))


def told(value: float, form: str) -> str:
    """A number; a dash where there is none."""
    return "-" if math.isnan(value) else format(value, form)


def rates(count: Count) -> str:
    """TPR / FPR."""
    return f"{told(count.tpr, '.3f')} / {told(count.fpr, '.4f')}"


def name_of(kind: str) -> str:
    """A kind in a table; (*) where nothing was learned from its scenes."""
    return f"`{kind}`{' (*)' if kind in OTHER_WORLDS and kind not in LEARNED_WORLDS else ''}"


def show_rates(rows: Sequence[Row], keep: bool) -> None:
    """Of the kinds pooled, and per kind of scene."""
    of_kind = {kind: [r for r in rows if r.kind == kind] for kind in ALL_KINDS}
    pool = [r for r in rows if r.kind in KINDS_OF_SCENE]
    parts = [(POOLED, pool, "strict"), (f"{POOLED}, protocol paper", pool, "paper")]
    parts += [(name_of(kind), of_kind[kind], "strict") for kind in IN_TABLES]
    lines = []
    for label, some, protocol in parts:
        if some:
            line = {"kind of scene": label, "passes": str(sum(r.passes for r in some))}
            names = [name for name in METHODS if (protocol, name) in some[0].counts]
            line |= {f"`{name}`": rates(pooled(some, name, protocol)) for name in names}
            lines.append(line)
    show("TPR / FPR at the operating point, protocol strict", lines, keep=keep)


def show_intervals(rows: Sequence[Row], keep: bool) -> None:
    """Per kind of scene and pooled: how sure the rates of our presets are, and the false claims."""
    parts = [(POOLED, [r for r in rows if r.kind in KINDS_OF_SCENE])]
    parts += [(name_of(kind), [r for r in rows if r.kind == kind]) for kind in IN_TABLES]
    lines = []
    for label, some in parts:
        if len(some) < 2:
            continue
        line = {"kind of scene": label, "`smi`": rates(pooled(some, "smi:default"))}
        for name in ("default", "offline"):
            count = pooled(some, name)
            both = zip((count.tpr, count.fpr), intervals(some, name), (".3f", ".4f"), strict=True)
            line[f"`{name}`"] = " / ".join(
                f"{told(rate, form)} ({told(low, form)}-{told(high, form)})"
                for rate, (low, high), form in both
            )
            false = sorted(r.counts["strict", name].fp for r in some)
            per_100 = f"{100 * sum(false) / sum(r.frames for r in some):.2f}"
            line[f"`{name}`, false"] = f"{per_100} ({sum(false)}, {sum(false[-WORST:])})"
        lines.append(line)
    if lines:
        show(
            "TPR / FPR strict with 95 % intervals over recordings; false claims per 100 frames\n"
            f"(how many they are, and how many of them in the {WORST} recordings that have most)",
            lines,
            keep=keep,
        )


def show_goals(rows: Sequence[Row]) -> None:
    """Each goal that the run can tell something of."""
    print("\nGoals\n")
    pool = [r for r in rows if r.kind in KINDS_OF_SCENE]
    for name, scenes, least, most in RATE_GOALS:
        if scenes == "worst kind":
            parts = [[r for r in pool if r.kind == kind] for kind in {r.kind for r in pool}]
        else:
            parts = [pool if scenes == "pooled" else [r for r in rows if r.kind == scenes]]
        counts = [pooled(part, name) for part in parts if part]
        for rate, bound, values, worst in (
            ("TPR", least, [c.tpr for c in counts if c.tp + c.fn], min),
            ("FPR", most, [c.fpr for c in counts], max),
        ):
            if bound is not None and values:
                judge(f"{name}, {scenes}: {rate}", worst(values), bound, at_least=rate == "TPR")


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, recognise, score and tell."""
    parser = options("scenes", __doc__, REPORTED, FRAMES)
    parser.add_argument("--kinds", nargs="+", choices=ALL_KINDS, default=ALL_KINDS)
    parser.add_argument("--ours", action="store_true", help="without `paper` and `hough`")
    asked = parser.parse_args(arguments)
    begun = time.monotonic()
    recordings = [
        Recording(kind, seed, asked.out / "logs" / f"{kind}_{seed}")
        for kind in asked.kinds
        for seed in asked.seeds
    ]
    configs = [preset(name) for name in PRESETS if name in OURS or not asked.ours]
    rivals = {} if asked.ours else {METHOD: Settings()}
    jobs = [
        Job(random_scene(seed, kind, frames=asked.frames), folder, configs, rivals)
        for kind, seed, folder in recordings
    ]
    in_processes(recognise, jobs)
    rows = scored_rows(recordings)
    print(
        f"{len(recordings)} recordings of {asked.frames} frames: seeds {asked.seeds.start} to "
        f"{asked.seeds.stop - 1} of {len(asked.kinds)} kinds of scene"
    )
    show_rates(rows, keep=not asked.ours)
    show_intervals(rows, keep=asked.ours)
    show_goals(rows)
    save(asked.record)
    print(f"\n{asked.out}; {(time.monotonic() - begun) / 60:.1f} minutes")


if __name__ == "__main__":
    main()
