"""`sonarrec site`: its figures against plain counts, its words, and its page in a browser."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonarrec.landmarks import BUILT_IN
from sonarrec.simulation.simulate import write_recording
from sonarrec.simulation.site.results import (
    ContrastResults,
    RangeRate,
    Rate,
    RecognitionRates,
    sentences,
)
from tests.studies.learning.random_scenes import random_scene
from tests.support.browser import look
from tests.support.command import sonarrec
from tests.support.rows import read_rows


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    scene = replace(random_scene(5, "no_landmark"), frames=24, objects=())
    write_recording(scene, folder / "floor")
    told = sonarrec(
        *("site", folder / "floor", "--contrast", "10,-3", "--layouts", "2", "--count", "3"),
        *("-o", folder / "out", "--keep"),
    )
    assert "layout" in told.stdout
    return folder / "out"


@pytest.mark.slow
def test_the_figures_are_those_of_plain_counts(site: Path) -> None:
    """Each landmark whole in view, and whether its ID is declared within half a disc diameter."""
    for whole in (row for row in read_rows(site / "site.csv") if not row["range_from_m"]):
        db = f"{float(whole['contrast_db']):g}"
        cases = right = claims = 0
        for layout in (1, 2):
            truth = read_rows(site / f"recordings/layout_{layout}/contrast_{db}/gt.csv")
            said = read_rows(site / f"results/layout_{layout}_contrast_{db}/estimates.csv")
            said = [r for r in said if r["method"] == "framework" and r["declared"] == "1"]
            claims += len(said)
            for t in truth:
                if float(t["visible"]) < 0.9:
                    continue
                cases += 1
                right += any(
                    (s["frame"], s["landmark"]) == (t["frame"], t["landmark"])
                    and math.dist(place(s), place(t)) <= 0.15
                    for s in said
                )
        assert (cases, right) == (int(whole["landmark_frames"]), int(whole["recognised"]))
        assert float(whole["tpr"]) == pytest.approx(right / cases, abs=1e-4)
        assert int(whole["false_claims"]) <= claims - right
        steps = [
            row
            for row in read_rows(site / "site.csv")
            if row["range_from_m"] and row["contrast_db"] == whole["contrast_db"]
        ]
        assert sum(int(row["landmark_frames"]) for row in steps) == cases
        assert sum(int(row["recognised"]) for row in steps) == right


def place(row: dict[str, str]) -> tuple[float, float]:
    bearing = math.radians(float(row["bearing_deg"]))
    range_m = float(row["range_m"])
    return range_m * math.sin(bearing), range_m * math.cos(bearing)


@pytest.mark.slow
def test_more_contrast_is_recognised_more_often(site: Path) -> None:
    low, high = (float(r["tpr"]) for r in read_rows(site / "site.csv") if not r["range_from_m"])
    assert high > 0.5 > low


@pytest.mark.slow
def test_the_document_says_the_same(site: Path) -> None:
    document = json.loads((site / "site.json").read_text())
    table = read_rows(site / "site.csv")
    assert [row["tpr"] for row in document["rates"]] == [
        float(row["tpr"]) if row["tpr"] else None for row in table
    ]
    page = (site / "site.html").read_text()
    assert all(sentence in page for sentence in document["summary"])
    assert len(list(site.glob("recordings/*/*/*.png"))) == 2 * 2 * 24


@pytest.mark.slow
def test_a_run_toml_tells_landmarks_and_geometry_as_it_does_run(tmp_path: Path) -> None:
    scene = replace(random_scene(5, "no_landmark"), frames=6, objects=())
    write_recording(scene, tmp_path / "floor")
    geometry = tmp_path / "floor.toml"
    (tmp_path / "floor" / "sonar.toml").rename(geometry)
    discs = tmp_path / "mine.toml"
    text = (BUILT_IN / "basin.toml").read_text().replace("radius_m = 0.15", "radius_m = 0.12")
    discs.write_text(text.replace('"basin"', '"mine"'))
    sonarrec(
        *("run", tmp_path / "floor", "--sonar", geometry, "--flip", "--frames", "0:2"),
        *("--landmarks", discs, "-o", tmp_path / "earlier", "-q"),
    )
    earlier = tmp_path / "earlier" / "floor" / "run.toml"
    out = tmp_path / "out"
    sonarrec(
        *("site", tmp_path / "floor", "--config", earlier, "--contrast", "10", "-o", out, "-q"),
        *("--layouts", "1", "--count", "1"),
    )
    document = json.loads((out / "site.json").read_text())
    assert (document["landmarks"], document["frames"]) == ("mine", 6)
    asis, laid = (
        tomllib.loads((out / "results" / name / "run.toml").read_text())
        for name in ("as_it_is", "layout_1_contrast_10")
    )
    assert asis["sonar"]["flip"]
    assert "flip" not in laid["sonar"]  # the pictures it was laid into are upright by now
    assert asis["input"]["frames_processed"] == 6
    assert asis["landmarks"] == laid["landmarks"]


@pytest.mark.slow
def test_what_there_was_no_room_for_and_what_cannot_be_read_is_told_once(tmp_path: Path) -> None:
    scene = replace(random_scene(5, "no_landmark"), frames=4, objects=())
    write_recording(scene, tmp_path / "floor")
    (tmp_path / "floor" / "000001.png").write_bytes(b"no image")
    out = tmp_path / "out"
    told = sonarrec(
        *("site", tmp_path / "floor", "--contrast", "10", "--layouts", "2", "--count", "90"),
        *("-o", out),
        code=3,
    ).stderr
    assert told.count("000001.png: unreadable image") == 1
    document = json.loads((out / "site.json").read_text())
    laid = min(layout["landmarks"] for layout in document["layouts"])
    room = f"there was room for only {laid} of 90 landmarks in a layout"
    assert told.count(room) == 1
    page = (out / "site.html").read_text()
    for text in (room, "000001.png: unreadable image, skipped"):
        assert text in document["notes"]
        assert page.count(text) == 1


@pytest.mark.slow
def test_a_folder_in_use_is_refused(site: Path) -> None:
    told = sonarrec("site", site / "recordings/layout_1/contrast_10", "-o", site, code=1).stderr
    assert "already exists and is not empty" in told


def at(db: float, shares: list[float], units: int = 8, false: int = 0) -> ContrastResults:
    """A contrast with these rates in steps of a metre from 1 m."""
    mean = float(np.mean(shares))
    alike = mean in (0.0, 1.0) or units < 6
    edge = (math.nan, math.nan) if alike else (mean - 0.02, mean + 0.01)
    steps = tuple(
        RangeRate(1.0 + n, 2.0 + n, Rate(10, 2, round(10 * v), v, math.nan, math.nan))
        for n, v in enumerate(shares)
    )
    whole = Rate(100, units, round(100 * mean), mean, *edge)
    reach = next((n for n, v in enumerate(shares) if v < 0.9), len(shares))
    near, far = (1.0, 1.0 + reach) if reach else (math.nan, math.nan)
    claims = Rate(100, units, false, float(false), math.nan, math.nan)
    return ContrastResults(db, RecognitionRates(whole, steps, claims), near, far)


def test_the_sentence_names_the_least_contrast_that_holds_from_there_on() -> None:
    told = " ".join(
        sentences([at(0, [0.95, 0.95]), at(3, [0.5, 0.4]), at(6, [1.0, 0.94]), at(9, [1, 1])], 0, 9)
    )
    assert "At 6 dB or more over the floor" in told
    assert "1.00 to 3.00 m away" in told
    assert "interval of 0.970 is 0.950 to 0.980" in told
    assert "No false claim" in told


def test_the_sentence_admits_what_so_few_passes_cannot_show() -> None:
    few = " ".join(sentences([at(6, [1.0, 1.0], units=4)], 0, 9))
    assert "4 passes of landmarks through the view, too few for an interval" in few
    unsure = " ".join(sentences([at(6, [0.91, 0.91])], 3, 30))
    assert "not certain: the 95% interval of 0.910 begins at 0.890" in unsure
    assert "the recording itself 10.0 landmarks are claimed in 100 frames" in unsure


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 400])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_in_a_browser(browser: Any, site: Path, width: int, scheme: str) -> None:
    found = look(browser, site / "site.html", width, scheme)
    assert found["console"] == []
    assert found["broken"] == 0
    assert found["pictures"] == 2
    assert found["wide"] <= 0
    assert found["outside"] == []
