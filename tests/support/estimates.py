"""Estimates and results made up for tests of what is drawn of them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.results.write import ResultsWriter
from sonarrec.sonar.frame import Estimate, Fan, FrameResult
from sonarrec.sonar.geometry import pixel_from_polar
from tests.support.drawn import make_fan
from tests.support.logs import PERIOD_NS

BASIN = load_landmarks("basin")
FAN = make_fan(rows=512)


def estimate(
    x_px: float,
    y_px: float,
    landmark: int = 1,
    *,
    p: float = 0.9,
    declared: bool = True,
    number: int = 0,
    method: str = "framework",
) -> Estimate:
    """An estimate with probability p for its ID, the rest for none of these."""
    beliefs = np.array([p * (i == landmark) for i in BASIN.ids] + [1 - p])
    return Estimate(
        method, number, x_px, y_px, 2.0, 0.0, math.nan, 0.9, beliefs, landmark, p, declared
    )


def at(fan: Fan, range_m: float, bearing_deg: float) -> tuple[float, float]:
    column, row = pixel_from_polar(fan, range_m, bearing_deg)
    return float(column), float(row)


def write_results(
    folder: Path,
    per_frame: list[tuple[Estimate, ...]],
    run: dict[str, Any] | None = None,
    landmarks: LandmarkSet = BASIN,
) -> Path:
    with ResultsWriter(folder, landmarks, {"input": {}} | (run or {})) as writer:
        for n, estimates in enumerate(per_frame):
            writer.write(FrameResult(n, n * PERIOD_NS, 0, len(estimates), estimates))
        writer.finish([])
    return folder


def csv_file(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def noise(count: int, shape: tuple[int, int] = (128, 96)) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.integers(0, 120, shape, dtype=np.uint8) for _ in range(count)]


def moving(count: int) -> list[tuple[Estimate, ...]]:
    """A declared landmark that wanders, and something that is none; nothing in frame 2."""
    return [
        () if n == 2 else (
            estimate(40.0 + n, 60.0, 3, p=0.9, number=1),
            estimate(70.0, 90.0, 1, p=0.2, declared=False, number=2),
        )
        for n in range(count)
    ]  # fmt: skip
