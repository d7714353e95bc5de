"""How near the proposals of `sonarrec truth propose` come, uncorrected, to the truth.

`python -m tests.studies.proposals`, through the real commands, on the sample logs and on the basins
of an unrelated simulator where they are at hand.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from sonarrec.geometry import pixel_from_polar
from sonarrec.nouns import Fan
from sonarrec.results.read import read_log
from tests.studies.scenes import show

ROOT = Path(__file__).resolve().parents[2]
WHOLE, NEAR_M = 0.9, 0.15


def sonarrec(*words: str | Path) -> None:
    """One command."""
    subprocess.run([sys.executable, "-m", "sonarrec", *map(str, words)], check=True, cwd=ROOT)


def in_pixels(truth: pd.DataFrame, fan: Fan) -> pd.DataFrame:
    """The truth with x_px and y_px, where it has slant ranges and bearings."""
    if "x_px" in truth:
        return truth
    x, y = pixel_from_polar(fan, truth["range_m"].to_numpy(), truth["bearing_deg"].to_numpy())
    return truth.assign(x_px=x, y_px=y)


def row(log: Path, out: Path) -> dict[str, str]:
    """A line of the table: of one log, which has its gt.csv in it."""
    proposal = out / f"{log.name}.csv"
    proposal.unlink(missing_ok=True)
    sonarrec("run", log, "--out", out, "--overwrite", "-q")
    sonarrec("truth", "propose", out / log.name, "--out", proposal, "-q")
    fan = read_log(out / log.name).fan
    true, found = in_pixels(pd.read_csv(log / "gt.csv"), fan), pd.read_csv(proposal)
    both = true.merge(found, on=["frame", "landmark"], suffixes=("", "_found"))
    off_px = np.hypot(both["x_px"] - both["x_px_found"], both["y_px"] - both["y_px_found"])
    both["off"] = off_px * fan.metres_per_pixel
    near = both[both["off"] < NEAR_M].sort_values("off").drop_duplicates(["frame", "landmark"])
    whole = true[true["visible"] >= WHOLE]
    there = near[near["visible"] >= WHOLE]
    off = 1000 * near["off"].to_numpy()
    return {
        "recording": log.name,
        "proposed of those in view": f"{len(there)} of {len(whole)}",
        "rows of no landmark": f"{len(found) - len(near)} of {len(found)}",
        "centre off by, mm": " / ".join(f"{np.quantile(off, q):.1f}" for q in (0.5, 0.95, 1)),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Recognise, propose, compare and tell."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.proposals", description=__doc__)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--out", type=Path, default=Path("build") / "proposals")
    asked = parser.parse_args(arguments)
    logs = [ROOT / "sample_data" / name for name in ("pan", "polar")]
    logs += [asked.data / f"basin_{letter}" for letter in "abc"]
    missing = [log.name for log in logs if not log.is_dir()]
    show(
        f"Landmarks with {WHOLE:g} of their disc in view; centres: median, 95 %, most",
        [row(log, asked.out) for log in logs if log.is_dir()],
    )
    if missing:
        print(f"\nnot at hand: {', '.join(missing)}")


if __name__ == "__main__":
    main()
