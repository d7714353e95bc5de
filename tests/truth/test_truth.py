"""Ground truth and results read back: matching by time, and every fault one clear line."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

from sonarrec.results.read import read_log
from sonarrec.truth.match import Truth, match_truth
from sonarrec.truth.table import read_truth
from tests.support.command import sonarrec
from tests.support.crossing import write_crossing
from tests.support.rows import read_rows

FRAMES = "frame,timestamp_ns\n0,1000000000\n1,1250000000\n3,1750000000\n"
ESTIMATES = (
    "frame,method,range_m,bearing_deg,landmark,score,declared\n"
    "0,m,2.0,0.0,1,0.9,1\n"
    "3,m,2.0,1.0,2,0.4,0\n"
)
TRUTH = "frame,landmark,range_m,bearing_deg,visible\n0,1,2.0,0.0,1\n1,1,2.0,1.0,0.95\n"


@pytest.fixture
def case(tmp_path: Path) -> Path:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "frames.csv").write_text(FRAMES)
    (tmp_path / "out" / "estimates.csv").write_text(ESTIMATES)
    (tmp_path / "gt.csv").write_text(TRUTH)
    return tmp_path


def run(case: Path, *more: str, code: int = 0) -> Result:
    truth = ("--ground-truth", case / "gt.csv")
    return sonarrec("evaluate", *truth, case / "out", *more, code=code)


def failure(case: Path, code: int = 1) -> str:
    """The one line said of a fault; nothing may have been written as a result."""
    done = run(case, code=code)
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert not (case / "out" / "evaluation").exists()
    return line


def matched(case: Path, tolerance_s: float | None = None) -> Truth:
    return match_truth(read_truth(case / "gt.csv"), read_log(case / "out"), tolerance_s)


def test_position_columns_left_blank_count_as_absent(case: Path) -> None:
    (case / "gt.csv").write_text("frame,landmark,range_m,bearing_deg,x_px,y_px\n0,1,,,50,60\n")
    table = read_truth(case / "gt.csv")
    assert table.position is not None
    assert table.position[0] == "pixel"


def test_position_is_metres_in_the_fan_plane(case: Path) -> None:
    (case / "gt.csv").write_text("frame,landmark,range_m,bearing_deg\n0,1,2.0,30.0\n")
    np.testing.assert_allclose(matched(case).position, [[1.0, 3**0.5]])


def stamps(case: Path, *times_ms: int) -> None:
    rows = "".join(f"{t * 1_000_000},1\n" for t in times_ms)
    (case / "gt.csv").write_text("timestamp_ns,landmark\n" + rows)


def test_time_matching_against_brute_force(case: Path) -> None:
    rng = np.random.default_rng(2)
    frame_ms = np.sort(rng.choice(5000, 40, replace=False))
    rows = "".join(f"{i},{t * 1_000_000}\n" for i, t in enumerate(frame_ms))
    (case / "out" / "frames.csv").write_text("frame,timestamp_ns\n" + rows)
    truth_ms = rng.choice(5000, 300, replace=False)
    stamps(case, *truth_ms)
    expected = set()
    for i, frame in enumerate(frame_ms):
        mine = [t for t in truth_ms if np.argmin(np.abs(frame_ms - t)) == i]
        near = min(mine, key=lambda t: (abs(t - frame), t), default=None)
        if near is not None and abs(near - frame) <= 30:
            expected.add(i)
    truth = matched(case, 0.03)
    assert set(truth.frame_index.tolist()) == expected
    assert len(truth.frame_index) == len(expected)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("image,id\n0,1", "frame,landmark,x_px,y_px,visible"),
        ("landmark,x_px,y_px\n1,2,3", "neither frame nor timestamp_ns"),
        ("time_s,landmark\n1.5,1", "time_s by 1e9"),
        ("timestamp_ns,landmark\n1.5,1", "1000000000.*'1.5'"),
        ("timestamp_ns,landmark\n1.5,1", "multiply"),
        ("timestamp_ns,landmark\n2024-05-01T12:00:00Z,1", "1714564800000000000"),
        ("timestamp_ns,landmark\n2024-05-01 12:00:00,1", "UTC offset"),
        ("timestamp_ns,landmark\n1.79517E+18,1\n1.79518E+18,1", "rounded"),
        ("frame,landmark,x_px,y_px\n0,1,5,5,6,5", "decimals"),
        ("frame,landmark,x_px,y_px\n0,1,5,6\n1,1,5,5,6,5", "decimals"),
        ("frame,method,landmark,declared\n0,m,1,1", "of results"),
        ("frame,candidates,tracks\n0,1,1", "of results"),
        ("protocol,method,landmark\npaper,m,total", "of results"),
        ("frame,landmark\n0,1\n\none,1", "line 4: frame .*'one'"),
        ("frame,landmark\n0,north", "line 2: landmark .*'north'"),
        ("frame,landmark,visible\n0,1,95", "line 2: visible"),
        ("frame,landmark,range_m,bearing_deg\n0,1,2,3\n1,1,,", "line 3: range_m or bearing_deg"),
        ("frame,landmark,x_px,y_px\n0,1,5,6\n1,1,5,6\n0,1,5,6", "line 4: .*line 2"),
        ("frame,landmark\n0,7", "landmark 7 .*basin"),
        ("frame,landmark\n500,1\n501,1", r"none of its 2 rows \(frame 500 to 501\)"),
        ("timestamp_ns,landmark\n5,1", "none of its 1 rows .*0.1875 s .*1000000000 to 1750000000"),
        ("log,frame,landmark\nother,0,1", "log column .*out"),
        ("frame,landmark,x_px,y_px,visible", "no row"),
    ],
)
def test_bad_truth(case: Path, text: str, said: str) -> None:
    (case / "gt.csv").write_text(text + "\n")
    assert re.search(f"gt.csv.*{said}", failure(case))


def test_truth_beyond_the_processed_frames_is_counted_and_said(case: Path) -> None:
    (case / "gt.csv").write_text("frame,landmark\n0,1\n2,1\n4,1\n")
    done = run(case, code=3)
    assert "2 of 3 rows lie" in done.stderr
    assert "protocol paper" in done.stdout


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("frames.csv", "index\n0\n", "frames.csv: .*no frame"),
        ("frames.csv", "frame\n0\n1\n0\n", "frames.csv line 4: frame 0"),
        ("estimates.csv", "frame,method\n0,m\n", "no landmark, score, declared"),
        ("estimates.csv", ESTIMATES + "0,m,2,0,9,0.5,1\n", "line 4: landmark 9"),
        ("estimates.csv", ESTIMATES.splitlines()[0] + "\n", "no method"),
    ],
)
def test_bad_results(case: Path, name: str, text: str, said: str) -> None:
    (case / "out" / name).write_text(text)
    assert re.search(said, failure(case))


def test_no_results(case: Path) -> None:
    (case / "out" / "estimates.csv").unlink()
    assert "estimates.csv" in failure(case)
    (case / "out" / "frames.csv").unlink()
    assert "no results" in failure(case, 2)


def test_estimates_off_the_listed_frames_are_counted_and_said(case: Path) -> None:
    (case / "out" / "estimates.csv").write_text(ESTIMATES + "2,m,2,0,1,0.5,1\n")
    assert "1 estimates lie" in run(case, code=3).stderr


def test_an_empty_run_of_ours_is_scored(case: Path) -> None:
    """Nothing seen at all, as on a riverbed, is a result and no fault."""
    (case / "out" / "estimates.csv").write_text(ESTIMATES.splitlines()[0] + "\n")
    text = '[program]\nname = "sonarrec"\nmethods = ["framework"]\n'
    (case / "out" / "run.toml").write_text(text)
    run(case)


def test_several_logs_need_a_log_column(case: Path) -> None:
    logs = case / "logs"
    for name in ("a", "b"):
        shutil.copytree(case / "out", logs / name)
    (logs / "b" / "estimates.csv").write_text(ESTIMATES.replace("0.9,1", "0.8,1"))
    several = ("evaluate", "--ground-truth", case / "gt.csv", logs)
    assert "2 logs (a, b)" in sonarrec(*several, code=1).stderr
    (case / "gt.csv").write_text("log,frame,landmark\na,0,1\nc,0,1\n")
    (line,) = sonarrec(*several, code=3).stderr.splitlines()
    assert "1 of 2 rows name logs that were not given (c)" in line
    assert (logs / "evaluation" / "confusion.csv").is_file()


@pytest.mark.parametrize(
    "labelled", [range(0, 24, 5), range(1, 24, 2), [*range(8), *range(16, 24)]]
)
def test_frames_without_a_row_may_be_left_out(case: Path, labelled: Collection[int]) -> None:
    """Claims on them count as false, which is told, or not at all."""
    write_crossing(case, "{n},1,2.0,{bearing},1", labelled)
    assert "--labelled-only" in run(case, code=3).stderr
    unlabelled = 24 - len(labelled)
    assert false_claims(case) == unlabelled
    assert f"{len(labelled)} of 24" in run(case, "--labelled-only").stdout.partition("\n")[0]
    assert false_claims(case) == 0
    found = json.loads((case / "out" / "evaluation" / "evaluation.json").read_text())
    assert found["labelled_only"]
    assert (found["frames"], found["frames_left_out"]) == (len(labelled), unlabelled)
    shutil.copytree(case / "out", case / "again")
    compared = sonarrec(
        *("evaluate", "--compare", case / "out", case / "again", "--labelled-only"),
        *("--ground-truth", case / "gt.csv", "-o", case / "compared"),
    )
    assert f"{len(labelled)} of 24" in compared.stdout


def false_claims(case: Path) -> int:
    rows = read_rows(case / "out" / "evaluation" / "confusion.csv")
    return int(next(r["fp"] for r in rows if (r["protocol"], r["landmark"]) == ("paper", "total")))


def test_a_frame_labelled_as_empty_counts(case: Path) -> None:
    write_crossing(case, "{n},1,2.0,{bearing},1", range(12))
    with (case / "gt.csv").open("a") as file:
        file.write("".join(f"{n},none,2.0,0,1\n" for n in range(12, 18)))
    run(case, "--labelled-only")
    assert false_claims(case) == 6


def test_sparse_labels_make_one_pass_of_labelled_frames(case: Path) -> None:
    """Each of every twentieth frame would else be a pass of its own, and a case by itself."""
    write_crossing(case, "{n},1,2.0,{bearing},1", [0, 12])
    run(case, "--labelled-only")
    passes = read_rows(case / "out" / "evaluation" / "passes.csv")
    assert {(row["first_frame"], row["last_frame"]) for row in passes} == {("0", "12")}


def test_rows_of_other_logs_are_told_where_one_log_is_scored(case: Path) -> None:
    header, row, _ = TRUTH.split()
    (case / "gt.csv").write_text(f"{header},log\n{row},out\n{row},in\n")
    assert "1 of 2 rows name" in run(case).output
