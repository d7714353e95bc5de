"""Forty runs stopped at random moments, by three signals: no result lost, none half passed off."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from tests.support.kills import stop_at_random

SAMPLE = Path(__file__).parents[2] / "sample_data" / "pan"
FRAMES = 40
MOMENTS = 40


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "dive"
        log.mkdir()
        for name in (*(f"{i:06d}.png" for i in range(FRAMES)), "sonar.toml"):
            shutil.copy(SAMPLE / name, log)
        parts, done = stop_at_random(log, Path(folder) / "out", MOMENTS)
    print(
        f"{MOMENTS} of {MOMENTS} runs stopped: results whole after each; {parts} times a part "
        f"readable to its last frame beside them, {done} times the new ones"
    )


if __name__ == "__main__":
    main()
