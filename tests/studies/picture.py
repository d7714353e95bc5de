"""The README's picture: `python -m tests.studies.picture` writes sample_data/picture.png.

Two frames of the sample log as `sonarrec overlay` draws them.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from sonarrec.config import preset
from sonarrec.overlay.overlay import Targets, write_overlay
from sonarrec.pipeline import run as run_log

SAMPLES = Path(__file__).resolve().parents[2] / "sample_data"
BUILD = SAMPLES.parent / "build" / "picture"
LOG = SAMPLES / "pan"
SHOWN = (34, 100)


def main() -> None:
    """Run the sample log and draw."""
    results = run_log(LOG, BUILD, preset=preset("default"))
    images = BUILD / "frames"
    write_overlay(LOG, Targets(images=images), results=results.folder)
    pictures = [cv2.imread(str(images / f"{number:06d}.png")) for number in SHOWN]
    between = np.full((len(pictures[0]), 8, 3), 255, np.uint8)
    assert cv2.imwrite(str(SAMPLES / "picture.png"), np.hstack([pictures[0], between, pictures[1]]))


if __name__ == "__main__":
    main()
