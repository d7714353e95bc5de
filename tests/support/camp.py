"""A camp of many logs as a user has them: parts of a sample log, and some that make trouble."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import cv2
import numpy as np

from sonarrec.landmarks import load_landmarks
from tests.support.command import SAMPLE

BROKEN, OTHER_SET, WITHOUT_TRUTH, WORST = "dive03", "dive05", "dive07", "dive11"
"""Of twenty: images cut short; IDs 11 to 14; no gt.csv; noise that hides everything."""


def make_camp(folder: Path, count: int, frames: int = 12, trouble: bool = True) -> Path:
    """dive01, dive02 ...: each `frames` frames of the sample from another one on, with its truth.

    trouble: the logs named above are what they say, if there are so many.
    """
    truth = [*csv.reader((SAMPLE / "gt.csv").read_text(encoding="utf-8").splitlines())]
    for n in range(count):
        name, first = f"dive{n + 1:02d}", n * (128 - frames) // max(count - 1, 1)
        place = folder / name
        place.mkdir(parents=True)
        shutil.copy(SAMPLE / "sonar.toml", place)
        for frame in range(frames):
            shutil.copy(SAMPLE / f"{first + frame:06d}.png", place / f"{frame:06d}.png")
        rows = [[str(int(f) - first), *rest] for f, *rest in truth[1:]]
        rows = [row for row in rows if 0 <= int(row[0]) < frames]
        if trouble:
            _spoil(place, rows)
        if not trouble or name != WITHOUT_TRUTH:
            lines = [",".join(row) for row in [truth[0], *rows]]
            (place / "gt.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def _spoil(place: Path, truth: list[list[str]]) -> None:
    """Make the log what its name says. truth: its rows, changed in place."""
    images = sorted(place.glob("*.png"))
    if place.name == BROKEN:
        for image in images:
            image.write_bytes(image.read_bytes()[:40])
    elif place.name == OTHER_SET:
        lines = ['name = "camp"', "radius_m = 0.15", "ring = [0.8, 1.0]", "symbol = [0.0, 0.62]"]
        for number, sectors in enumerate(load_landmarks("basin").sectors, 11):
            lines += ["[[landmark]]", f"id = {number}", f"sectors = {[int(s) for s in sectors]}"]
        (place / "landmarks.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
        for row in truth:
            row[1] = str(int(row[1]) + 10)
    elif place.name == WORST:
        rng = np.random.default_rng(1)
        for path in images:
            shape = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).shape
            cv2.imwrite(str(path), rng.integers(0, 200, shape, dtype=np.uint8))
