"""Made-up results of many logs and their truth, in the sizes that scoring is measured with."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

IDS = (1, 2, 3, 4)
PASS, PAUSE = 120, 40
"""Frames of a landmark in view, and between two."""


def make_logs(place: Path, logs: int, frames: int, kinds: int = 5) -> Path:
    """Results of logs in folders, and a table of pairs; returns the table.

    There are `kinds` different ones, drawn by seed; the others are links to their tables under a
    name and SHA-256 of their own.
    """
    place.mkdir(parents=True)
    made = [_tables(place / f"kind{k}", frames, k) for k in range(min(kinds, logs))]
    rows = []
    for n in range(logs):
        of, folder = made[n % len(made)], place / "out" / f"log{n:04d}"
        folder.mkdir(parents=True)
        for name in ("frames.csv", "estimates.csv"):
            (folder / name).symlink_to(of / name)
        (folder / "run.toml").write_text(
            'finished = true\n[program]\nmethods = ["smi", "framework"]\n'
            f'[input]\nname = "{folder.name}"\nsha256 = "{n:064x}"\n'
        )
        rows.append((folder, of / "gt.csv"))
    table = place / "pairs.csv"
    _write(table, ("results", "ground_truth"), rows)
    return table


def _tables(folder: Path, frames: int, seed: int) -> Path:
    """A landmark after the other in view; a candidate and a track on it, one of each elsewhere."""
    folder.mkdir()
    rng = np.random.default_rng(seed)
    every = np.arange(frames)
    shown = every % (PASS + PAUSE) < PASS
    landmark = rng.integers(1, len(IDS) + 1, frames // (PASS + PAUSE) + 1)[every // (PASS + PAUSE)]
    _write(folder / "frames.csv", ("frame", "timestamp_ns"), zip(every, every * 10**8, strict=True))
    truth = ((f, landmark[f], 2.0, 0.0) for f in every[shown])
    _write(folder / "gt.csv", ("frame", "landmark", "range_m", "bearing_deg"), truth)
    beliefs = [f"p_{i}" for i in IDS] + ["p_none"]
    header = ("frame", "method", "object", "range_m", "bearing_deg", *beliefs)
    rows = []
    for f in every.tolist():
        for method, sure in (("smi", 1.0), ("framework", 6.0)):
            for number, (range_m, true) in enumerate(((2.0, shown[f]), (3.0, False))):
                weight = rng.random(len(beliefs)) + 1e-3
                weight[landmark[f] - 1 if true else -1] += sure * rng.random()
                p = np.round(weight / weight.sum(), 6)
                best = int(np.argmax(p[:-1]))
                at = (f"{range_m + rng.normal(0, 0.03):.4f}", f"{rng.normal(0, 0.5):.3f}")
                told = (IDS[best], f"{p[best]:.6f}", int(p[best] > 0.5))
                rows.append((f, method, number, *at, *(f"{x:.6f}" for x in p), *told))
    _write(folder / "estimates.csv", (*header, "landmark", "score", "declared"), rows)
    return folder


def _write(path: Path, header: tuple[str, ...], rows: object) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)  # type: ignore[arg-type]
