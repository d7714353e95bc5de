"""`make worlds`: recordings that our own simulator did not make, each through the real commands.

The recordings are no part of the repository: `--data` names the folder that holds them. Nothing is
learned from them and nothing chosen on them. What is missing is told and left out.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from sonarrec.recogniser.three_stages import FRAMEWORK
from tests.studies.results.record import options, save, show
from tests.studies.scenes import rates
from tests.support.claims import evaluate
from tests.support.clip import clip_claims, family
from tests.support.counted import Count, counted

ROOT = Path(__file__).resolve().parents[2]
PRESETS = ("default", "offline")
WORLDS = {
    "stonefish, bright, 8 bit": ("stonefish/bright_8bit",),
    "stonefish, bright, 16 bit": ("stonefish/bright_16bit",),
    "stonefish, base, 8 bit": ("stonefish/base_8bit",),
    "stonefish, base, 16 bit": ("stonefish/base_16bit",),
    "river composites, ring +10 dB": ("river_composites/b10_g-6_s4", "river_composites/b10_g0_s3"),
    "river composites, ring +6 dB": ("river_composites/b6_g-6_s1", "river_composites/b6_g-6_s2"),
    "basin_a": ("basin_a",),
    "basin_b": ("basin_b",),
    "basin_c": ("basin_c",),
    "ray-traced, ring 1 dB over the floor": ("rays/low_1dB",),
    "ray-traced, ring 2 dB under it": ("rays/low_minus2dB",),
    "ray-traced, half buried": ("rays/buried",),
}
"""Recordings with landmarks, by how they are told."""
RIVERS = ("river/lamprey1.avi", "river/lamprey2.avi", "river/pike1.avi")
"""Recordings without one."""
RADII_M = (0.08, 0.15, 0.25, 0.35)
"""Of the landmarks looked for in those."""


def recognise(log: Path, out: Path, *more: str) -> Path:
    """The results of one log by `sonarrec run`."""
    words = [sys.executable, "-m", "sonarrec", "run", str(log), "--out", str(out), "--overwrite"]
    words += ["-q", "--preset", ",".join(PRESETS), *more]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT)
    if done.returncode not in (0, 3):
        raise SystemExit(f"sonarrec run {log}\nexit {done.returncode}\n{done.stderr}")
    return out / log.stem


def world(name: str, logs: Sequence[Path], out: Path) -> dict[str, str]:
    """A line of the table: the recordings of one world, pooled, by protocol strict."""
    frames, total = 0, dict.fromkeys(PRESETS, np.zeros(5, np.int64))
    for log in logs:
        results = recognise(log, out / log.parent.name)
        frames += len(pd.read_csv(results / "frames.csv"))
        counts = counted(evaluate(results, log / "gt.csv").counts)
        for preset in PRESETS:
            total[preset] = total[preset] + counts["strict", f"{FRAMEWORK}:{preset}"]
    line = {"recordings": name, "frames": str(frames)}
    for preset, numbers in total.items():
        count = Count(*numbers.tolist())
        line[preset] = rates(count)
        line[f"{preset}, false per 100 frames"] = f"{100 * count.fp / frames:.2f}"
    return line


def river(log: Path, radius_m: float, out: Path) -> dict[str, str]:
    """A line of the table: frames in which anything is declared of a log without a landmark."""
    discs = (ROOT / "sonarrec" / "landmark_sets" / "basin.toml").read_text(encoding="utf-8")
    landmarks = out / f"{radius_m}" / "landmarks.toml"
    landmarks.parent.mkdir(parents=True, exist_ok=True)
    landmarks.write_text(discs.replace("radius_m = 0.15", f"radius_m = {radius_m}"))
    results = recognise(log, landmarks.parent, "--landmarks", str(landmarks))
    frames = len(pd.read_csv(results / "frames.csv"))
    table = pd.read_csv(results / "estimates.csv")
    line = {"recording": log.stem, "radius": f"{radius_m:g} m", "frames": str(frames)}
    for preset in PRESETS:
        made = table[(table["method"] == f"{FRAMEWORK}:{preset}") & (table["declared"] == 1)]
        line[f"{preset}: frames with a claim"] = str(made["frame"].nunique())
    return line


def clip(folder: Path) -> dict[str, str]:
    """The line of a table: in how many frames each preset names the tag at its position."""
    claimed = {preset: clip_claims(folder, family(), preset) for preset in PRESETS}
    line = {"recording": "AcTag", "frames with the tag": str(claimed["default"][2])}
    for preset, (right, claims, _) in claimed.items():
        line[f"{preset}: named"] = str(len(right))
        line[f"{preset}: wrong ID"] = str(sum(landmark != 0 for _, landmark in claims))
    return line


def main(arguments: Sequence[str] | None = None) -> None:
    """Recognise, score and tell."""
    parser = options("worlds", __doc__)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    asked = parser.parse_args(arguments)
    lines, missing = [], []
    for name, parts in WORLDS.items():
        logs = [asked.data / part for part in parts]
        if all((log / "gt.csv").is_file() for log in logs):
            lines.append(world(name, logs, asked.out))
        else:
            missing.append(name)
    if lines:
        show("TPR / FPR at the operating point, protocol strict", lines)
    rivers = [asked.data / part for part in RIVERS]
    missing += [log.stem for log in rivers if not log.is_file()]
    lines = [river(r, m, asked.out / "rivers") for r in rivers if r.is_file() for m in RADII_M]
    if lines:
        show("Real recordings without a landmark", lines)
    if (asked.data / "actag").is_dir():
        show("A clip of a real AcTag", [clip(asked.data / "actag")])
    else:
        missing.append("actag")
    save(asked.record)
    for name in missing:
        print(f"worlds: SKIPPED, not in {asked.data}: {name}", file=sys.stderr)


if __name__ == "__main__":
    main()
