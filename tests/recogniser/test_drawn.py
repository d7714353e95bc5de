"""Drawn plates: the clip of a real one, where it is at hand, and what the stages are made of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonarrec.landmarks import DrawnSet, load_landmarks
from sonarrec.readers import open_log
from sonarrec.recogniser.drawn.drawings import FINE, Drawings, as_drawn, best, shown
from sonarrec.runs.frames import Recogniser
from tests.support.rows import read_rows

ACTAG = Path(__file__).parents[3] / "shared" / "data" / "actag"


def family() -> DrawnSet:
    found = load_landmarks("actag24h10")
    assert isinstance(found, DrawnSet)
    return found


def test_every_way_of_showing_a_drawing_is_undone() -> None:
    drawing = np.arange(9, dtype=np.float32).reshape(3, 3)
    views = [shown(drawing, way) for way in range(8)]
    assert len({view.tobytes() for view in views}) == 8
    for way, view in enumerate(views):
        assert np.array_equal(as_drawn(view, way), drawing)


def test_smeared_drawings_match_those_of_a_fine_convolution() -> None:
    """Against a blur of the drawing at forty samples a cell."""
    drawings = Drawings(family())
    smear = (0.12, 0.06)
    cells = family().drawings()[3].astype(np.float32)
    fine = np.pad(np.kron(cells, np.ones((40, 40), np.float32)), 280)
    sigma = [s * 140 for s in smear]
    blurred = cv2.GaussianBlur(fine, (0, 0), sigmaX=sigma[0], sigmaY=sigma[1])[280:560, 280:560]
    wanted = blurred.reshape(FINE, 10, FINE, 10).mean(axis=(1, 3))
    assert drawings.seen(FINE, smear)[3] == pytest.approx(wanted, abs=0.02)


@pytest.mark.parametrize("way", range(8))
def test_a_drawing_is_told_in_every_way_through_uneven_light(way: int) -> None:
    drawings = Drawings(family())
    u, v = np.meshgrid(*(np.linspace(-1, 1, FINE),) * 2)
    for k in range(drawings.count):
        seen = shown(drawings.seen(FINE, (0.06, 0.06))[k], way)
        picture = (40 * seen + 90 + 30 * u - 50 * v + 25 * v**2).astype(np.float32)
        column, match = best(drawings.matches(picture, np.array([0.0, 1.0]), (0.06, 0.06)))
        assert match.argmax() == k
        assert drawings.ways[column[k]] == way
        assert match[k] == pytest.approx(1, abs=1e-3)


def clip_claims(landmarks: DrawnSet, preset: str) -> tuple[set[int], list[tuple[int, int]], int]:
    """Frames that declare ID 0 within 6 cm, all claims (frame, ID), how many frames have truth."""
    truth = {
        int(row["frame"]): (float(row["range_m"]), float(row["bearing_deg"]))
        for row in read_rows(ACTAG / "actag_first.gt.csv")
    }
    sonar = {"range_order": "far_first"}
    right, claims = set(), []
    with open_log(ACTAG / "actag_first.mp4", sonar=sonar) as log:
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


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "least"), [("default", 0.99), ("offline", 1.0)])
def test_a_real_tag_is_read_on_a_real_sonar(preset: str, least: float) -> None:
    if not ACTAG.is_dir():
        pytest.skip(f"{ACTAG}: the clip is not at hand")
    right, claims, frames = clip_claims(family(), preset)
    assert len(right) >= least * frames
    assert {landmark for _, landmark in claims} == {0}


@pytest.mark.slow
def test_a_real_tag_that_is_not_in_the_set_is_none_of_it() -> None:
    if not ACTAG.is_dir():
        pytest.skip(f"{ACTAG}: the clip is not at hand")
    tags = family()
    others = replace(tags, ids=tags.ids[1:], cells=tags.cells[1:])
    _, claims, _ = clip_claims(others, "default")
    assert not claims
