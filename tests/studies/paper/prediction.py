"""`make paper`: Tables 4 and 5, ours beside the published, in worlds used for nothing else.

search.py kept the worlds on Tables 3 and 4 alone. The preset's stage 1 and SMI were chosen on
Table 4 alone, the framework's open choices in six other worlds, so that the worse of its two errors
is small as a share of SMI's (commit 8d855fe2). Eq. 5's exponent is from an early search for what
comes nearest to both Tables 4 and 5 (commit 0d1ce3cc).

A world is one case: rates are told world by world, the test of a difference swaps the two methods
in whole worlds, and intervals draw worlds, in each its recordings, and in each of these the seed of
the particles; those of a TPR at a given FPR draw worlds alone. Worlds with a blank disc among their
fakes are told by themselves, too.
"""

from __future__ import annotations

import math
import shutil
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.config import preset
from sonarrec.evaluation.counts import COUNTS, Counts, add_up, count_log
from sonarrec.evaluation.plots import PUBLISHED
from sonarrec.evaluation.rows import Matched
from sonarrec.evaluation.uncertainty import coin_tosses
from sonarrec.recogniser.three_stages import FRAMEWORK, SMI
from sonarrec.results.run_file import run_table
from sonarrec.results.write import ResultsWriter
from sonarrec.simulation.motion import poses
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import Scene, scene_fan, scene_sonar
from sonarrec.simulation.truth import TRUTH_COLUMNS, truth_in_view, truth_rows
from sonarrec.sonar.frame import Frame, FrameResult
from sonarrec.truth.table import write_truth
from tests.studies.paper.parts import CONTINUITY, ONE, READINGS, Parts, Readings
from tests.studies.paper.published import CLEAR, HALF, IDS, TABLE_4, TABLE_5, WHOLE
from tests.studies.paper.search import HERE, meets
from tests.studies.paper.world import FAKES, World, kept_worlds
from tests.studies.results.record import options, save, show
from tests.support.rows import read_rows
from tests.support.simulated import in_processes, matched

SEEDS = range(7100, 7400)
"""Of the recordings that are reported: nothing is fitted or chosen on them."""
METHODS = {
    "SMI": f"{SMI}:paper",
    "SMI, one claim": f"{SMI}:paper{ONE}",
    "framework": f"{FRAMEWORK}:paper",
    "continuity alone": CONTINUITY,
    "continuity, one claim": CONTINUITY + ONE,
}
"""As they are told: short name, and the one in estimates.csv. One claim: of each ID in a frame."""
PLAIN = {name: METHODS[name] for name in ("SMI", "framework")}
"""Those that the paper has."""
PAIRS = (
    ("SMI", "framework"),
    ("SMI, one claim", "framework"),
    ("SMI", "continuity alone"),
    ("continuity, one claim", "framework"),
)
"""Of which the second less the first is told."""
_IN_1000 = {
    "paper": "83 55 97 76 179 73 25 105 105 79  -3 -30 -5 11 -36 -2 21 -12 10 7",
    "strict": "121 53 132 93 200 131 68 167 178 136  -11 -72 -10 5 -50 -14 14 -32 -18 -30",
}
EARLIER = {how: np.array(v.split(), int).reshape(2, 10).T / 1000 for how, v in _IN_1000.items()}
"""(10, 2) framework less SMI, TPR and FPR, in the ten worlds of the search before, by the same
preset: the table by world in paper.toml of commit 1266013d."""
MOST, PARTICLES = 10, 2
"""Recordings of a world, at most, and seeds of the particles over each."""
SWEEPS = 640
"""Frames of a recording: the pan there and back twice, so that each place is seen as often whatever
the start. The paper speaks of two rotations, and has 992 frames."""
PUBLISHED_GAIN = "framework less SMI, published", "TPR +0.0422, FPR -0.0105", ""
COUNTINGS = ("paper", "strict")
NEAR_PX, DISC_PX = 15.0, 30.0
"""How near to a landmark the object on it lies; the radius of a disc."""
LEAD = 1.5
"""The lead over the next ID at which one stands clear. Faultless measurements reach it after 11
frames by Table 3, and 1.8 after 16."""
PICTURE = Path(__file__).parents[3] / "sample_data" / "paper_roc.png"
COLOURS = {"SMI": "tab:blue", "framework": "tab:orange"}
DRAWS, FLIPS = 4000, 100_000
NOT_CORRECTED = "p is not corrected for their number"


@dataclass(frozen=True, slots=True)
class Job:
    """A recording of a world. folders: of the results with each seed of the particles. readings: of
    those of all readings with the first of these seeds; None if they are not to run."""

    scene: Scene
    folders: tuple[Path, ...]
    readings: Path | None = None


def record(job: Job) -> None:
    """Write the results of all methods over one recording, and its truth."""
    scene, fan, landmarks = job.scene, scene_fan(job.scene), job.scene.landmark_set
    configs = [replace(preset("paper"), seed=PARTICLES * scene.seed + n) for n in range(PARTICLES)]
    parts = [Parts(config, fan, landmarks) for config in configs]
    stages, folders = parts[0].stages, list(job.folders)
    methods = [list(METHODS.values())] * PARTICLES
    readings = Readings(configs[0], fan, landmarks)
    if job.readings is not None:
        configs.append(configs[0])
        folders.append(job.readings)
        methods.append([*PLAIN.values(), *READINGS])
    truth: list[list[object]] = []
    with ExitStack() as stack:
        writers = []
        for folder, config, names in zip(folders, configs, methods, strict=True):
            shutil.rmtree(folder, ignore_errors=True)
            about = scene_sonar(scene), fan, landmarks, (scene.name, 0, "")
            run = run_table([config], names, *about)
            writers.append(stack.enter_context(ResultsWriter(folder, landmarks, run)))
        for seen in render(scene):
            frame = Frame(seen.index, seen.timestamp_ns, seen.image, fan)
            image = stages.working_image(frame)
            selection = stages.stage1(image)  # no particles in it
            made = [part.step(frame, image, selection) for part in parts]
            if job.readings is not None:
                plain = [e for e in made[0] if e.method in PLAIN.values()]
                made.append([*plain, *readings.step(frame, image, selection)])
            for writer, of in zip(writers, made, strict=True):
                writer.write(FrameResult(seen.index, seen.timestamp_ns, 0, 0, tuple(of)))
            truth.extend(truth_rows(seen.index, seen.truth))
        for writer in writers:
            writer.finish([])
    for folder in folders:
        write_truth(folder / "gt.csv", [*TRUTH_COLUMNS], truth)


def summed(logs: Sequence[Matched], folders: Sequence[Path]) -> Counts:
    """The rates over some results."""
    return add_up([count_log(log, rates_only=True) for log in logs], folders)


@dataclass(frozen=True, slots=True)
class Group:
    """Worlds by their numbers, with their recordings: jobs is (worlds,) of (recordings,)."""

    numbers: Sequence[int]
    jobs: Sequence[Sequence[Job]]
    pooled: Counts
    worlds: Sequence[Counts]

    def only(self, at: Sequence[int]) -> Group:
        """The worlds of these indices; `pooled` still is of all."""
        numbers, jobs, worlds = ([v[i] for i in at] for v in (self.numbers, self.jobs, self.worlds))
        return Group(numbers, jobs, self.pooled, worlds)

    @property
    def every_job(self) -> list[Job]:
        return [job for jobs in self.jobs for job in jobs]

    def counts(self, method: str, how: str) -> IntArray:
        """(worlds, recordings, seeds, K, 4) TP, TN, FP, FN."""
        each = []
        for world in self.worlds:
            of = (METHODS.get(method, method), how)
            cells = [(log, landmark) for log in world.logs for landmark in world.landmarks[:-1]]
            each.append([world.confusion[*of, *cell][: len(COUNTS)] for cell in cells])
        return np.reshape(each, (len(each), len(self.jobs[0]), -1, len(IDS), len(COUNTS)))

    def rates(self, method: str, how: str) -> FloatArray:
        """(worlds, 2) TPR and FPR."""
        return rates_of(self.counts(method, how).sum(axis=(1, 2, 3)))

    def together(self, method: str, how: str) -> FloatArray:
        """(2,) TPR and FPR of all worlds together."""
        return rates_of(self.counts(method, how).sum(axis=(0, 1, 2, 3)))

    def told(self, method: str, how: str) -> str:
        """TPR / FPR of all worlds together."""
        return "{:.4f} / {:.4f}".format(*self.together(method, how))

    def tpr_at(self, method: str, how: str, fpr: float) -> FloatArray:
        """(worlds,) the highest TPR of each world's ROC up to this FPR."""
        curves = (world.curve(METHODS.get(method, method), how) for world in self.worlds)
        return np.array([curve["tpr"][curve["fpr"] <= fpr].max() for curve in curves])


def rates_of(counts: IntArray) -> FloatArray:
    """(..., 2) TPR and FPR of (..., 4) TP, TN, FP, FN; 0/0 is NaN."""
    tp, tn, fp, fn = np.moveaxis(counts, -1, 0)
    with np.errstate(invalid="ignore"):
        return np.stack([tp / (tp + fn), fp / (fp + tn)], axis=-1)


def drawn(counts: IntArray) -> IntArray:
    """(DRAWS, worlds, ...) of (worlds, recordings, seeds, ...): worlds, recordings, seeds drawn."""
    rng = np.random.default_rng(0)
    w, r, p = counts.shape[:3]
    worlds = rng.integers(w, size=(DRAWS, w, 1))
    recordings, seeds = (rng.integers(n, size=(DRAWS, w, r)) for n in (r, p))
    return np.asarray(counts[worlds, recordings, seeds].sum(axis=2))


def interval_of(values: FloatArray) -> tuple[float, float]:
    """95 % interval of the mean of (worlds,) values: worlds drawn."""
    w = len(values)
    means = values[np.random.default_rng(0).integers(w, size=(DRAWS, w))].mean(axis=1)
    low, high = np.percentile(means, (2.5, 97.5)).tolist()
    return low, high


def flipped(difference: FloatArray) -> float:
    """p of the sign-flip test over (worlds,) differences, two-sided; exact for up to 16."""
    signs = 1 - 2 * coin_tosses(len(difference), np.random.default_rng(0), FLIPS)
    means = np.abs(signs @ difference)
    return float(np.mean(means >= abs(difference.sum()) - 1e-12))


def told(changes: FloatArray, many: FloatArray | None = None) -> str:
    """(worlds, 2) changes of TPR and FPR: their means, p, and in how many worlds each is better.

    many: (DRAWS, 2) means that were drawn, for 95 % intervals.
    """
    cells = []
    for n, name in enumerate(("TPR", "FPR")):
        change, sign = changes[:, n], (1, -1)[n]
        low, high = ("", "") if many is None else np.percentile(many[:, n], (2.5, 97.5))
        interval = "" if many is None else f" ({low:+.3f} to {high:+.3f})"
        better = int((change * sign > 0).sum())
        p = f"p = {flipped(change):.3g}; {better} of {len(change)}"
        cells.append(f"{name} {change.mean():+.4f}{interval}, {p}")
    return "; ".join(cells)


def compared(group: Group, a: str, b: str, how: str) -> str:
    """b less a, mean over worlds, with interval and p, and in how many worlds it is for b."""
    many = [rates_of(drawn(group.counts(m, how).sum(axis=3))).mean(axis=1) for m in (a, b)]
    return told(group.rates(b, how) - group.rates(a, how), many[1] - many[0])


def difference_lines(group: Group) -> list[dict[str, str]]:
    """A line for each of PAIRS, then the ten earlier worlds, and these with all others."""
    rows = [(f"{b} less {a}", *(compared(group, a, b, how) for how in COUNTINGS)) for a, b in PAIRS]
    earlier = "the same in ten earlier worlds", *(told(EARLIER[how]) for how in COUNTINGS)
    both = {
        how: np.vstack([group.rates("framework", how) - group.rates("SMI", how), EARLIER[how]])
        for how in COUNTINGS
    }
    together = f"the same in all {len(both['paper'])}", *map(told, both.values())
    rows = [PUBLISHED_GAIN, rows[0], earlier, together, *rows[1:]]
    return [dict(zip(("difference", *COUNTINGS), row, strict=True)) for row in rows]


def equal_fpr_lines(group: Group) -> list[dict[str, str]]:
    """The TPR of each method at the FPR that SMI has, and at that of the framework."""
    fprs = {(m, how): float(group.together(m, how)[1]) for how in COUNTINGS for m in PLAIN}
    columns = {f"{how}, at {m}'s FPR, {v:.4f}": (how, v) for (m, how), v in fprs.items()}
    at = {(m, c): group.tpr_at(m, *of) for m in METHODS for c, of in columns.items()}
    shown = [m for m in METHODS if not METHODS[m].endswith(ONE)]
    lines = [{"TPR": m} | {c: spanned(at[m, c]) for c in columns} for m in shown]
    for a, b in PAIRS:
        line = {"TPR": f"{b} less {a}"}
        for c in columns:
            change = at[b, c] - at[a, c]
            better = f"{int((change > 0).sum())} of {len(change)}"
            line[c] = f"{spanned(change, '+.3f')}, p = {flipped(change):.2g}; {better}"
        lines.append(line)
    return lines


def spanned(values: FloatArray, form: str = ".3f") -> str:
    """The mean of (worlds,) values with its interval."""
    low, high = (format(v, form) for v in interval_of(values))
    return f"{values.mean():{form}} ({low} to {high})"


def reading_lines(group: Group) -> list[dict[str, str]]:
    """SMI, the preset and each reading. group: of Job.readings."""
    smi, worlds = group.rates("SMI", "paper"), len(group.numbers)
    fpr = float(group.together("SMI", "paper")[1])
    base = group.tpr_at("SMI", "paper", fpr)
    names = {"SMI": "SMI", "the preset": "framework", **{name: name for name in READINGS}}
    lines = []
    for label, method in names.items():
        higher, lower = ((group.rates(method, "paper") - smi) * (1, -1) > 0).sum(axis=0).tolist()
        at = group.tpr_at(method, "paper", fpr)
        line = {"reading": label} | {how: group.told(method, how) for how in COUNTINGS}
        line["better than SMI, TPR; FPR"] = f"{higher}; {lower} of {worlds}"
        line[f"TPR at SMI's FPR, {fpr:.4f}"] = f"{at.mean():.3f}"
        line["less SMI's"] = spanned(at - base, "+.3f")
        lines.append(line)
    lines[0] |= dict.fromkeys(("better than SMI, TPR; FPR", "less SMI's"), "")
    return lines


def beyond_limits(group: Group) -> int:
    """The number of worlds that search.py would not keep by these recordings."""
    rates = rates_of(group.counts("SMI", "paper")[:, :, 0])  # particles play no part
    seven = np.concatenate([rates[:, :, HERE, 0], rates[..., 1]], axis=2)
    chance = np.sqrt(seven.var(axis=1, ddof=1).mean(axis=0))
    return sum(not meets(world, chance, seven.shape[1]) for world in seven.mean(axis=1))


def false_by_thing(job: Job, landmark: int) -> dict[str, Counter[str]]:
    """Of SMI and the framework the false claims of an ID, by the thing on which they lie."""
    fan = scene_fan(job.scene)
    frames = [truth_in_view(job.scene, fan, pose, None) for pose in poses(job.scene)]
    counts = {METHODS[name]: Counter[str]() for name in COLOURS}
    for row in read_rows(job.folders[0] / "estimates.csv"):
        truth, others = frames[int(row["frame"])]
        is_in_view = any(t.landmark == landmark and t.visible >= HALF for t in truth)
        claim = row["method"] in counts, row["declared"], row["landmark"]
        if is_in_view or claim != (True, "1", str(landmark)):
            continue
        things = [(t.x_px, t.y_px, f"ID.{t.landmark}") for t in truth]
        things += [(t.x_px, t.y_px, t.kind) for t in others if t.kind in FAKES]
        at = float(row["x_px"]), float(row["y_px"])
        near = [(math.dist((x, y), at), kind) for x, y, kind in things]
        away, kind = min(near, default=(math.inf, ""))
        counts[row["method"]][kind if away < DISC_PX else "elsewhere"] += 1
    return {name: counts[METHODS[name]] for name in COLOURS}


def table_lines(group: Group) -> list[dict[str, str]]:
    """Tables 4 and 5: ours with 95 % intervals, and the published rates."""
    lines = []
    for name, published in (("SMI", TABLE_4), ("framework", TABLE_5)):
        counts = group.counts(name, "paper")
        counts = np.concatenate([counts, counts.sum(axis=3, keepdims=True)], axis=3)
        value = rates_of(counts.sum(axis=(0, 1, 2)))
        low, high = np.percentile(rates_of(drawn(counts).sum(axis=1)), (2.5, 97.5), axis=0)
        for n, kind in enumerate(("tpr", "fpr")):
            ours = [
                "0/0" if math.isnan(v) else f"{v:.4f} ({a:.3f}-{b:.3f})"
                for v, a, b in zip(value[:, n], low[:, n], high[:, n], strict=True)
            ]
            cells = [f"{v}; {p:.4f}" for v, p in zip(ours, published[kind], strict=True)]
            lines.append(dict(zip(COLUMNS, [f"{name}, {kind.upper()}", *cells], strict=True)))
    return lines


COLUMNS = ("ours; published", *(f"ID.{i}" for i in IDS), "Total")


def draw_roc(path: Path, pooled: Counts, worlds: Sequence[Counts]) -> None:
    """The curves of SMI and the framework: a thin line for each world, a thick one for all."""
    figure = Figure(figsize=(10, 5), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    both = figure.subplots(1, 2, sharey=True)
    for axes, protocol in zip(both, ("paper", "strict"), strict=True):
        for name, colour in COLOURS.items():
            for n, world in enumerate(worlds):
                curve = world.corners(METHODS[name], protocol)
                label = None if n else f"{name}, a world"
                axes.plot(curve["fpr"], curve["tpr"], color=colour, lw=0.5, alpha=0.3, label=label)
            curve, point = (of(METHODS[name], protocol) for of in (pooled.corners, pooled.count))
            label = f"{name}, all worlds; its operating point"
            style = {"marker": "o", "mec": "black", "mew": 0.5, "ms": 7}
            axes.plot(curve["fpr"], curve["tpr"], color=colour, lw=2.4)
            axes.plot(point.fpr, point.tpr, color=colour, lw=2.4, label=label, **style)
        # A root shows the low rates without cutting off any other.
        axes.set_xscale("function", functions=(np.sqrt, np.square))
        ticks = [0, 0.01, 0.05, 0.1, 0.2, 0.4, 0.7, 1]
        axes.set(title=f"protocol {protocol}", xlabel="FPR (root scale)", ylim=(0, 1))
        axes.set(xlim=(0, 1), xticks=ticks, xticklabels=[f"{tick:g}" for tick in ticks])
        axes.grid(color="0.9")
    for (name, fpr, tpr), marker in zip(PUBLISHED, "s^", strict=True):
        label = f"{name}, published"
        both[0].plot(fpr, tpr, marker, color=COLOURS[name], mec="black", ms=10, label=label)
    both[0].set_ylabel("TPR")
    both[0].legend(loc="lower right", frameon=False)
    figure.savefig(path)


def beliefs(results: Path, method: str, landmark: int) -> dict[int, FloatArray]:
    """Frame: (K,) beliefs of the object nearest to a landmark that is whole in view."""
    where = places(results / "gt.csv", landmark)
    found: dict[int, tuple[float, FloatArray]] = {}
    for row in read_rows(results / "estimates.csv"):
        frame = int(row["frame"])
        if row["method"] != method or frame not in where:
            continue
        away = math.dist((float(row["x_px"]), float(row["y_px"])), where[frame])
        if away < found.get(frame, (NEAR_PX,))[0]:
            found[frame] = away, np.array([float(row[f"p_{i}"]) for i in IDS])
    return {frame: belief for frame, (_, belief) in found.items()}


def places(truth: Path, landmark: int) -> dict[int, tuple[float, float]]:
    """Frame: fan pixel of a landmark, where it is whole in view."""
    return {
        int(r["frame"]): (float(r["x_px"]), float(r["y_px"]))
        for r in read_rows(truth)
        if int(r["landmark"]) == landmark and float(r["visible"]) >= WHOLE
    }


def frames_until_clear(results: Path, method: str, landmark: int) -> list[int]:
    """Per pass over a landmark: frames from whole in view until its belief stands clear.

    Clear: the right ID is LEAD times as probable as the next, and from then on the most probable
    one in every frame of the pass. A pass in which that never happens counts as its full length.
    """
    k = IDS.index(landmark)
    lead = {
        frame: belief[k] / max(np.delete(belief, k).max(), 1e-9)
        for frame, belief in beliefs(results, method, landmark).items()
    }
    frames = np.array(sorted(places(results / "gt.csv", landmark)))
    waits = []
    for part in np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1):
        leads = np.array([lead.get(f, 0.0) for f in part.tolist()])
        wrong = np.flatnonzero((leads > 0) & (leads <= 1))
        after = wrong[-1] + 1 if wrong.size else 0
        clear = np.flatnonzero(leads[after:] >= LEAD)
        waits.append(int(after + clear[0]) if clear.size else len(part))
    return waits


def jobs_of(world: World, first: int, each: int, frames: int, folder: Path) -> list[Job]:
    """Recordings of a world, with the seeds from SEEDS[first] on. Readings run over the first."""
    return [
        Job(
            world.scene(SEEDS[first + n], frames),
            tuple(folder / f"{n}_{p}" for p in range(PARTICLES)),
            None if n else folder / "readings",
        )
        for n in range(each)
    ]


def grouped(
    worlds: Sequence[World], jobs: Sequence[Sequence[Job]], readings: bool = False
) -> Group:
    """The worlds scored. readings: by the first job of each, with all readings."""
    if readings:
        jobs = [[replace(of[0], folders=(of[0].readings,))] for of in jobs]
    folders = [[f for job in of_world for f in job.folders] for of_world in jobs]
    flat = [f for of_world in folders for f in of_world]
    logs, each = in_processes(matched, flat), len(folders[0])
    mine = [logs[n : n + each] for n in range(0, len(logs), each)]
    scored = [summed(log, folder) for log, folder in zip(mine, folders, strict=True)]
    return Group([w.number for w in worlds], jobs, summed(logs, flat), scored)


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, recognise, score and tell."""
    parser = options("paper.prediction", __doc__, frames=SWEEPS)
    parser.add_argument("--recordings", type=int, default=4, help="of each world, at most 10")
    asked = parser.parse_args(arguments)
    begun, worlds = time.monotonic(), kept_worlds()
    jobs = [
        jobs_of(world, MOST * w, asked.recordings, asked.frames, asked.out / str(w))
        for w, world in enumerate(worlds)
    ]
    in_processes(record, [job for of_world in jobs for job in of_world])
    show(
        "Readings: all formulas as printed, and the preset with one choice undone; TPR / FPR over "
        "the first recording of each world, one seed of the particles",
        reading_lines(grouped(worlds, jobs, readings=True)),
    )
    group = grouped(worlds, jobs)
    tell(group, group.only([n for n, w in enumerate(worlds) if "blank" in w.fakes]))
    draw_roc(PICTURE, group.pooled, group.worlds)
    save(asked.record)
    print(f"\n{asked.out}; {(time.monotonic() - begun) / 60:.0f} minutes")


def tell(group: Group, blank: Group) -> None:
    """All tables but that of readings. blank: the worlds with a blank disc."""
    show(
        "TPR at equal FPR, mean over worlds (95 % interval); of differences also the sign-flip "
        f"test over worlds, and in how many it is positive; {NOT_CORRECTED}",
        equal_fpr_lines(group),
    )
    show(
        "Differences at the operating points: mean over worlds (95 % interval), sign-flip test "
        f"over worlds, in how many it is better; {NOT_CORRECTED}",
        difference_lines(group),
    )
    show("Tables 4 and 5, protocol paper, all worlds together", table_lines(group))
    lines = [
        {"method": m}
        | {how: group.told(m, how) for how in COUNTINGS}
        | {f"{how}, with a blank": blank.told(m, how) for how in COUNTINGS}
        for m in METHODS
    ]
    show("All worlds together, TPR / FPR; with a blank disc", lines)
    show("By world, SMI -> framework, TPR / FPR", world_lines(group))
    by_thing = [false_by_thing(j, 1) for j in group.every_job]
    total = {name: sum((c[name] for c in by_thing), Counter[str]()) for name in COLOURS}
    things = sorted({*total["SMI"], *total["framework"]})
    lines = [{"thing": t} | {name: total[name][t] for name in COLOURS} for t in things]
    show(f"False claims of ID.1 in {len(by_thing)} recordings, by the thing they lie on", lines)
    show("Beside", [{"figure": k, "value": v} for k, v in beside(group).items()])


def world_lines(group: Group) -> list[dict[str, str]]:
    """A line for each world."""
    lines = []
    for w, (number, jobs) in enumerate(zip(group.numbers, group.jobs, strict=True)):
        fakes = "+".join(o.kind for o in jobs[0].scene.objects if o.kind in FAKES)
        line = {"world": str(number), "fakes": fakes}
        for how in COUNTINGS:
            a, b = (group.rates(m, how)[w] for m in COLOURS)
            line[how] = f"{a[0]:.3f} / {a[1]:.3f} -> {b[0]:.3f} / {b[1]:.3f}"
        lines.append(line)
    return lines


def beside(group: Group) -> dict[str, object]:
    """Other figures beside the paper's."""
    first = [j.folders[0] for j in group.every_job]
    waits = np.concatenate([frames_until_clear(f, METHODS["framework"], 1) for f in first])
    told: dict[str, object] = {
        f"frames until ID.1 is {LEAD:g} times as probable as the next, median": np.median(waits),
        f"the same, nine of ten passes (paper: about {CLEAR})": np.percentile(waits, 90),
        "passes": len(waits),
    }
    for how in COUNTINGS:
        each = rates_of(group.counts("framework", how).sum(axis=3))
        tpr, fpr = np.sqrt(each.var(axis=2, ddof=1).mean(axis=(0, 1))).round(4).tolist()
        told[f"framework {how}, spread by the particles' seed alone, TPR"] = tpr
        told[f"framework {how}, spread by the particles' seed alone, FPR"] = fpr
    told["worlds that miss the search's limits on these recordings"] = beyond_limits(group)
    for name, fpr, tpr in PUBLISHED:
        curve = group.pooled.curve(METHODS[name], "paper")
        reached = float(curve["tpr"][curve["fpr"] <= fpr].max())
        told[f"{name}, TPR at the published FPR of {fpr} (published {tpr})"] = round(reached, 4)
    return told


if __name__ == "__main__":
    main()
