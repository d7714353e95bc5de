"""What is told of a truth: that its rows mean something else, or lie outside of the image."""

from __future__ import annotations

import re
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sonarrec.advice.results import of_results
from sonarrec.advice.truth import of_positions, sparse
from sonarrec.errors import SonarrecError
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.rows import ScoringOptions
from sonarrec.landmarks import load_landmarks
from sonarrec.truth.match import match_truth
from sonarrec.truth.table import read_truth
from tests.support.command import SAMPLE, sonarrec
from tests.support.crossing import write_crossing
from tests.support.drawn import make_fan
from tests.support.estimates import csv_file
from tests.support.rows import read_rows as csv_rows


@pytest.mark.parametrize(
    ("row", "labelled", "doubt"),
    [
        ("{n},1,2.0,{bearing},1", 24, None),
        ("{n},2,2.0,{bearing},1", 24, "`landmark` 2 .*ID.1"),
        ("{n},1,1.0,{bearing},1", 24, r"range .* \+1 m"),
        ("{n},1,2.0,{doubled},1", 24, r"bearing .* 0\.5"),
        ("{n},1,{scattered},{bearing},1", 24, "0 of 24 rows .* 0 of 24 claims of m meet"),
        ("{n},{either},2.0,{bearing},1", 24, "12 of 24 rows .*other IDs"),
        ("{n},1,2.0,{half},1", 24, "rows would .* sign of their bearings"),
        ("{after},1,2.0,{bearing},1", 23, r"1 frame earlier \(0.25 s\)"),
        ("{n},1,2.0,{turned},1", 24, "sign of their bearings"),
        ("{n},1,2.0,{radians},1", 24, "radians"),
        ("{n},1,2.0,{bearing},0", 24, "`visible` is 0 at most"),
        ("{n},1,2.0,{bearing},0.4", 24, "`visible` is 0.4 at most"),
        ("{n},1,2.0,{bearing},1", 12, "frame 11, and 12 of the 12 frames"),
    ],
)
def test_what_makes_figures_mean_something_else_comes_first(
    tmp_path: Path, row: str, labelled: int, doubt: str | None
) -> None:
    write_crossing(tmp_path, row, range(labelled))
    call = "evaluate", tmp_path / "out", "--ground-truth", tmp_path / "gt.csv"
    said = sonarrec(*call, code=3 if doubt else 0).stderr.partition("\n")[0]
    assert re.search(doubt, said) if doubt else not said


@pytest.mark.parametrize(
    ("frames", "is_sparse"),
    [([*range(0, 60, 10)], True), ([*range(9)], False), ([0, 1, 10, 20, 30, 40], False)],
)
def test_rows_on_every_nth_frame_are_told(frames: list[int], is_sparse: bool) -> None:
    told = sparse(np.repeat(frames, 2), np.arange(100, 160))
    assert bool(told) == is_sparse
    assert not told or "6 of 60 frames, from 100 to 150" in told


@pytest.mark.parametrize(("count", "is_problem"), [(2, False), (12, True)])
def test_many_positions_outside_the_image_are_a_problem(
    tmp_path: Path, count: int, is_problem: bool
) -> None:
    path, fan, frame = tmp_path / "gt.csv", make_fan(), np.arange(40)
    middle = (fan.bearing_min_deg + fan.bearing_max_deg) / 2
    bearings = [fan.bearing_max_deg + 20 if n < count else middle for n in range(40)]
    range_m = (fan.range_min_m + fan.range_max_m) / 2
    rows = [f"{n},1,{range_m},{bearing}" for n, bearing in enumerate(bearings)]
    path.write_text("\n".join(["frame,landmark,range_m,bearing_deg", *rows]))
    basin = load_landmarks("basin")
    log: Any = SimpleNamespace(name="log", landmarks=basin, fan=fan, frame=frame, timestamp_ns=None)
    table = read_truth(path)
    (line,) = of_positions(table, log, match_truth(table, log))
    assert f"{count} of 40 positions lie" in line.text
    assert line.grave == is_problem


@pytest.mark.parametrize("stated", [None, 0.4])
def test_rows_that_count_as_missed_without_need_are_told(
    tmp_path: Path, stated: float | None
) -> None:
    """Discs that the image's edge cuts in the middle, if `visible` is not stated; and doubles."""
    path, fan = tmp_path / "gt.csv", make_fan()
    middle = (fan.bearing_min_deg + fan.bearing_max_deg) / 2
    range_m = (fan.range_min_m + fan.range_max_m) / 2
    cells = [(n, range_m, fan.bearing_max_deg if n < 12 else middle) for n in range(40)]
    cells += [(n, range_m + 0.02, middle) for n in (20, 21)]
    path.write_text(
        "frame,landmark,range_m,bearing_deg,visible\n"
        + "".join(f"{n},1,{r},{b},{stated if n < 12 and stated else 1}\n" for n, r, b in cells)
    )
    basin, frame = load_landmarks("basin"), np.arange(40)
    log: Any = SimpleNamespace(name="log", landmarks=basin, fan=fan, frame=frame, timestamp_ns=None)
    table = read_truth(path)
    *cut, double = of_positions(table, log, match_truth(table, log), min_visible=0.9)
    assert len(cut) == (not stated)
    assert all("12 of 42" in line.text for line in cut)
    assert "2 of 42" in double.text
    assert not any(line.grave for line in (*cut, double))  # by default a landmark is all in view


@pytest.mark.parametrize(
    ("columns", "header", "code"),
    [
        ("x_px,y_px", "y_px,x_px", 3),
        ("range_m,bearing_deg", "bearing_deg,range_m", 1),
        ("x_px,y_px,range_m,bearing_deg", "y_px,x_px,range_m,bearing_deg", 3),
    ],
)
def test_exchanged_columns_are_named(tmp_path: Path, columns: str, header: str, code: int) -> None:
    names = ["frame", "landmark", *columns.split(","), "visible"]
    given = csv_rows(SAMPLE.parent / "pan.gt.csv")
    lines = [",".join(row[name] for name in names) for row in given]
    truth = csv_file(tmp_path / "gt.csv", f"frame,landmark,{header},visible", *lines)
    results = SAMPLE.parent / "regression" / "pan"
    call = "evaluate", results, "--ground-truth", truth, "-q", "-o", tmp_path / "out"
    first = sonarrec(*call, code=code).stderr.partition("\n")[0]
    assert "exchanged" in first
    assert columns[:4] in first


def test_scoring_by_itself_advises_nothing_and_gives_the_same_counts(tmp_path: Path) -> None:
    write_crossing(tmp_path, "{n},1,2.0,{turned},1", range(24))
    results, truth = tmp_path / "out", tmp_path / "gt.csv"
    alone = evaluate_logs(results, truth)
    advised = evaluate_logs(results, truth, ScoringOptions(), of_results)
    assert not alone.unused
    assert len(advised.unused) == 1
    assert alone.confusion.equals(advised.confusion)


@pytest.mark.parametrize(("cell", "rounded"), [("1.7E+18", True), ("1700000000000000000", False)])
def test_times_that_a_spreadsheet_rounded_are_told_by_how_they_are_written(
    tmp_path: Path, cell: str, rounded: bool
) -> None:
    path = csv_file(tmp_path / "gt.csv", "timestamp_ns,landmark,x_px,y_px", f"{cell},1,40,60")
    with pytest.raises(SonarrecError, match="rounded") if rounded else nullcontext():
        read_truth(path)
