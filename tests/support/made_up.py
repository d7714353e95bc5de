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


def make_sides(place: Path, logs: int, frames: int, kinds: int = 5) -> tuple[Path, Path, Path]:
    """Old results of logs, new ones and a table of pairs that names the truth of the old.

    The new lack every seventh frame of one method, claim another ID in every eleventh, and hold
    back every thirteenth claim of the other method; of every fifth log the last 20 frames are
    missing.
    """
    pairs = make_logs(place, logs, frames, kinds)
    old, new = place / "out", place / "new"
    for n in range(logs):
        was, folder = old / f"log{n:04d}", new / f"log{n:04d}"
        folder.mkdir(parents=True)
        short = n % 5 == 4
        of = (was / "frames.csv").resolve().parent
        made = place / f"{of.name}{'short' if short else 'new'}"
        if not made.is_dir():
            made.mkdir()
            _changed(of, made, frames - 20 if short else frames)
        for name in ("frames.csv", "estimates.csv"):
            (folder / name).symlink_to(made / name)
        text = (was / "run.toml").read_text()
        (folder / "run.toml").write_text(text + f"[config]\nseed = {n % 2}\n")
    return old, new, pairs


def _changed(of: Path, to: Path, frames: int) -> None:
    head, *lines = (of / "frames.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    (to / "frames.csv").write_text(head + "".join(lines[:frames]), encoding="utf-8")
    with (of / "estimates.csv").open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        header, rows = tuple(reader.fieldnames or ()), []
        for row in reader:
            frame, method = int(row["frame"]), row["method"]
            if frame >= frames or (method == "framework" and frame % 7 == 3):
                continue
            if method == "framework" and frame % 11 == 0:
                row["landmark"] = str(IDS[int(row["landmark"]) % len(IDS)])
            if method == "smi" and frame % 13 == 0:
                row["declared"] = "0"
            rows.append(tuple(row.values()))
    _write(to / "estimates.csv", header, rows)


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
