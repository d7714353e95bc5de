"""The clip of a real AcTag, which is no part of the repository, and what is claimed in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sonarrec.landmarks import DrawnSet, load_landmarks
from sonarrec.readers import open_log
from sonarrec.runs.run import Recogniser
from tests.support.rows import read_rows

ACTAG = Path(__file__).parents[3] / "shared" / "data" / "actag"


def family() -> DrawnSet:
    found = load_landmarks("actag24h10")
    assert isinstance(found, DrawnSet)
    return found


def clip_claims(
    folder: Path, landmarks: DrawnSet, preset: str
) -> tuple[set[int], list[tuple[int, int]], int]:
    """Frames that declare ID 0 within 6 cm, all claims (frame, ID), how many frames have truth."""
    truth = {
        int(row["frame"]): (float(row["range_m"]), float(row["bearing_deg"]))
        for row in read_rows(folder / "actag_first.gt.csv")
    }
    sonar = {"range_order": "far_first"}
    right, claims = set(), []
    with open_log(folder / "actag_first.mp4", sonar=sonar) as log:
        for result in Recogniser(log, preset, landmarks=landmarks).recognise():
            for estimate in result.estimates:
                if not estimate.declared:
                    continue
                claims.append((result.index, estimate.landmark))
                if estimate.landmark == 0 and result.index in truth:
                    (r, b), (q, a) = truth[result.index], (estimate.range_m, estimate.bearing_deg)
                    off = r * np.exp(1j * np.radians(b)) - q * np.exp(1j * np.radians(a))
                    if abs(off) < 0.06:
                        right.add(result.index)
    assert not [frame for frame, _ in claims if frame not in truth]  # blank pings claim nothing
    return right, claims, len(truth)
