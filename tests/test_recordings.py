"""Rates on recordings that are not our simulator's: on the first frames, kept in tests/data, and on
all where these are at hand."""

from __future__ import annotations

import cmath
import math
from pathlib import Path

import pytest

import sonarrec
from sonarrec.sonar.frame import Estimate
from tests.support.claims import all_scored, evaluate
from tests.support.clip import family
from tests.support.rows import read_rows

DATA = Path(__file__).parent / "data"
FIELD = Path(__file__).parents[2] / "shared" / "data"
needs_field_data = pytest.mark.skipif(not FIELD.is_dir(), reason=f"{FIELD} not found")


@pytest.mark.parametrize(
    ("log", "preset", "protocol", "least", "most_false"),
    [
        ("low_1dB", "default", "strict", 0.6, 0),
        ("low_1dB", "offline", "strict", 0.7, 0),
        ("basin_b", "default", "paper", 0.6, 0),
        ("basin_b", "offline", "paper", 0.9, 1),
    ],
)
def test_rates_on_recordings_of_other_simulators(
    log: str, preset: str, protocol: str, least: float, most_false: int, tmp_path: Path
) -> None:
    """Rays: rings hardly above the floor. Basin: a tyre, a mesh, wood; an ID comes into view."""
    sonarrec.run(DATA / log, tmp_path / "out", preset=preset)
    scored = all_scored(evaluate(tmp_path / "out" / log, DATA / log / "gt.csv").counts)
    (count,) = [s.count() for s in scored if (s.method, s.protocol) == ("framework", protocol)]
    assert count.tpr >= least
    assert count.fp <= most_false


def test_a_real_tag_is_claimed_where_it_is() -> None:
    truth = {
        int(row["frame"]): (float(row["range_m"]), float(row["bearing_deg"]))
        for row in read_rows(DATA / "actag" / "gt.csv")
    }
    claims: list[tuple[int, Estimate]] = []
    with sonarrec.open_log(DATA / "actag") as log:
        for result in sonarrec.Recogniser(log, landmarks=family()).recognise():
            claims += [(result.index, e) for e in result.estimates if e.declared]
    assert {estimate.landmark for _, estimate in claims} == {0}
    near = [
        frame
        for frame, e in claims
        if abs(_polar(e.range_m, e.bearing_deg) - _polar(*truth[frame])) < 0.06
    ]
    assert len(near) == len(claims) >= 8


@pytest.mark.slow
@needs_field_data
@pytest.mark.parametrize("name", ["basin_a", "basin_b"])
def test_basin(tmp_path: Path, name: str) -> None:
    results = sonarrec.run(FIELD / name, tmp_path).folder
    counts = sonarrec.evaluate(results, FIELD / name / "gt.csv").counts
    framework, smi = (counts.count(method, "strict") for method in ("framework", "smi"))
    assert framework.tpr >= 0.90
    assert framework.fpr <= 0.02
    assert framework.tpr > smi.tpr
    assert framework.fpr < smi.fpr


@pytest.mark.slow
@needs_field_data
def test_nothing_is_declared_in_rivers(tmp_path: Path) -> None:
    frames = declared = 0
    for video in sorted((FIELD / "river").glob("*.avi")):
        results = sonarrec.read_results(sonarrec.run(video, tmp_path).folder)
        frames += len(results.frames)
        claims = results.estimates.query("method == 'framework' and declared == 1")
        declared += claims.frame.nunique()
    assert frames > 200
    assert declared < 0.01 * frames


def _polar(range_m: float, bearing_deg: float) -> complex:
    return cmath.rect(range_m, math.radians(bearing_deg))
