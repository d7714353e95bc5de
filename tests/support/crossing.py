"""Results and truth of a landmark that crosses the view."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path

ESTIMATES = "frame,method,range_m,bearing_deg,landmark,score,declared\n"
TRUTH = "frame,landmark,range_m,bearing_deg,visible\n"


def write_crossing(case: Path, row: str, labelled: Collection[int]) -> None:
    """A landmark crosses the view in 24 frames, and is claimed where it is."""
    frames, rows, claims = "frame,timestamp_ns\n", "", ""
    for n in range(24):
        of = {"n": n, "after": n + 1, "bearing": n - 7, "turned": 7 - n, "doubled": 2 * (n - 7)}
        of |= {
            "half": n - 7 if n % 2 else 7 - n,
            "either": 1 + n % 2,
            "scattered": 1.2 + 0.5 * (n * 7 % 5 // 2),
        }
        frames += f"{n},{n * 250_000_000}\n"
        claims += f"{n},m,2.0,{n - 7},1,0.9,1\n"
        if n in labelled:
            rows += row.format(**of, radians=math.radians(n - 7)) + "\n"
    (case / "out").mkdir(exist_ok=True)
    (case / "out" / "frames.csv").write_text(frames)
    (case / "out" / "estimates.csv").write_text(ESTIMATES + claims)
    (case / "gt.csv").write_text(TRUTH + rows)
