"""Truth proposed from results: which tracks are taken, what is filled in, how near it comes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import pytest
from click.testing import Result

from sonarrec import evaluate
from sonarrec.api.run import run as run_log
from sonarrec.config import preset
from sonarrec.truth.table import read_truth
from tests.support.command import SAMPLE, sonarrec
from tests.support.logs import SONAR_TOML
from tests.support.rows import read_rows

RUN = f"""\
finished = true
{SONAR_TOML}\
[fan]
rows = 300
columns = 320
metres_per_pixel = 0.01
apex_px = [160.0, 400.0]
"""
COLUMNS = "frame,method,object,range_m,bearing_deg,landmark,score,declared"


def results(
    folder: Path, estimates: Sequence[tuple[object, ...]], frames: Sequence[int] = range(60)
) -> Path:
    """A results folder; an estimate is (frame, object, range, bearing, ID, score, declared)."""
    folder.mkdir(parents=True)
    (folder / "run.toml").write_text(RUN)
    (folder / "frames.csv").write_text("frame\n" + "".join(f"{n}\n" for n in frames))
    lines = [",".join(map(str, (e[0], "framework", *e[1:]))) for e in estimates]
    (folder / "estimates.csv").write_text("\n".join([COLUMNS, *lines]) + "\n")
    return folder


def track(
    number: int, frames: Sequence[int], landmark: int = 1, score: float = 0.95, declared: int = 1
) -> list[tuple[object, ...]]:
    """A track that turns half a degree a frame and draws nearer by a millimetre."""
    return [(n, number, 2 - n / 1000, n / 2 - 7, landmark, score, declared) for n in frames]


def run(*arguments: str | Path, code: int = 0) -> Result:
    return sonarrec("truth", "propose", *arguments, code=code)


def proposed(folder: Path, *more: str | Path) -> list[dict[str, str]]:
    out = folder.parent / "proposed.csv"
    out.unlink(missing_ok=True)
    run(folder, "--out", out, *more)
    read_truth(out)
    return read_rows(out)


def test_a_confident_track_is_taken_over_its_whole_life(tmp_path: Path) -> None:
    """Also before it first declared its ID: looking back, one knows what it was."""
    undecided = track(3, range(5), landmark=2, score=0.2, declared=0)
    rows = proposed(results(tmp_path / "log", undecided + track(3, range(5, 20))))
    assert [int(row["frame"]) for row in rows] == list(range(20))
    assert {(row["landmark"], row["track"], row["source"]) for row in rows} == {
        ("1", "3", "tracked")
    }
    for row in rows:
        n = int(row["frame"])
        range_m, bearing = 2 - n / 1000, math.radians(n / 2 - 7)
        place = 160 + 100 * range_m * math.sin(bearing), 400 - 100 * range_m * math.cos(bearing)
        assert (float(row["x_px"]), float(row["y_px"])) == pytest.approx(place, abs=0.01)
        assert 0 < float(row["visible"]) <= 1


@pytest.mark.parametrize(
    ("estimates", "said"),
    [
        (track(1, range(20), score=0.89), "below 0.9"),
        (track(1, range(4)), "4 frames only"),
        (track(1, range(10)) + track(1, range(10, 13), landmark=2), "ID.1, ID.2"),
    ],
)
def test_tracks_left_out_are_told(
    tmp_path: Path, estimates: list[tuple[object, ...]], said: str
) -> None:
    folder = results(tmp_path / "log", estimates)
    assert proposed(folder) == []
    assert said in run(folder, "--out", tmp_path / "again.csv").stdout


def test_short_gaps_are_filled_in_and_long_ones_are_not(tmp_path: Path) -> None:
    seen = [*range(6), *range(9, 15), *range(30, 36)]
    rows = proposed(results(tmp_path / "log", track(1, seen)), "--max-gap", "3")
    assert [int(row["frame"]) for row in rows] == [*range(15), *range(30, 36)]
    filled = [row for row in rows if row["source"] == "interpolated"]
    assert [int(row["frame"]) for row in filled] == [6, 7, 8]
    # The track moves evenly, so what is filled in is what would have been seen.
    whole = proposed(results(tmp_path / "whole", track(1, range(36))))
    by_frame = {row["frame"]: (row["x_px"], row["y_px"], row["visible"]) for row in whole}
    assert all((row["x_px"], row["y_px"], row["visible"]) == by_frame[row["frame"]] for row in rows)
    none = proposed(tmp_path / "log", "--max-gap", "2")
    assert all(row["source"] == "tracked" for row in none)


def test_frames_that_were_not_processed_are_not_filled_in(tmp_path: Path) -> None:
    """A broken image: truth on it could not be scored."""
    frames = [n for n in range(20) if n != 7]
    seen = [n for n in frames if n != 8]
    rows = proposed(results(tmp_path / "log", track(1, seen), frames))
    assert [int(row["frame"]) for row in rows] == frames


def test_discs_out_of_view_are_no_rows(tmp_path: Path) -> None:
    rows = proposed(results(tmp_path / "log", track(1, range(60))))
    assert all(float(row["visible"]) > 0 for row in rows)
    # 0.15 m at 1.88 m on the floor is 4.6 deg beyond the edge at 14.4 deg.
    assert max(int(row["frame"]) for row in rows) / 2 - 7 == pytest.approx(19, abs=1)


def test_a_second_track_on_one_disc_is_passed_over(tmp_path: Path) -> None:
    twice = track(1, range(10)) + track(2, range(30))
    rows = proposed(results(tmp_path / "log", twice))
    assert [int(row["frame"]) for row in rows] == list(range(30))
    assert {row["track"] for row in rows} == {"2"}


def test_several_logs_have_a_log_column(tmp_path: Path) -> None:
    results(tmp_path / "out" / "a", track(1, range(10)))
    results(tmp_path / "out" / "b", track(1, range(5)))
    rows = proposed(tmp_path / "out")
    assert [row["log"] for row in rows] == ["a"] * 10 + ["b"] * 5


def test_what_a_run_left_that_was_stopped_is_told(tmp_path: Path) -> None:
    part = results(tmp_path / "out" / "dive.part", track(1, range(10)))
    (part / "run.toml").write_text(RUN.replace("finished = true", "finished = false"))
    done = run(part, "--out", tmp_path / "gt.csv", code=3)
    assert "dive.part" in done.stderr
    assert "60 frames" in done.stderr
    done = run(tmp_path / "out" / "dive", "--out", tmp_path / "other.csv", code=2)
    assert str(part) in done.stderr


def test_a_log_that_cannot_be_read_is_left_out(tmp_path: Path) -> None:
    """Where no other is left there is no file, and no half of one."""
    results(tmp_path / "out" / "a", track(1, range(10)))
    bad = results(tmp_path / "out" / "b", track(1, range(5))) / "estimates.csv"
    bad.write_text("nothing")
    empty = results(tmp_path / "out" / "c.part", (), ()) / "frames.csv"
    done = run(tmp_path / "out", "--out", tmp_path / "gt.csv", code=3)
    first, second = done.stderr.splitlines()
    assert first.startswith(f"sonarrec: {bad}: ")
    assert second.startswith(f"sonarrec: {empty}: no frame")
    assert [row["log"] for row in read_rows(tmp_path / "gt.csv")] == ["a"] * 10
    (tmp_path / "gt.csv").unlink()
    (tmp_path / "out" / "a" / "frames.csv").write_text("frame\n")
    done = run(tmp_path / "out", "--out", tmp_path / "gt.csv", code=1)
    assert "a/frames.csv: no frame" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_faults(tmp_path: Path) -> None:
    folder = results(tmp_path / "log", track(1, range(10)))
    out = tmp_path / "gt.csv"
    out.write_text("corrected by hand")
    done = run(folder, "--out", out, code=1)
    assert out.read_text() == "corrected by hand"
    assert "exists" in done.stderr
    out.unlink()
    done = run(folder, "--out", out, "--method", "other", code=2)
    assert "method other" in done.stderr
    assert done.stderr.endswith("--method: framework\n")  # not smi, which is refused
    run(folder, "--out", out, "--min-score", "2", code=2)
    assert "no tracks" in run(folder, "--out", out, "--method", "smi", code=2).stderr
    assert "results folder" in run(tmp_path / "gone", "--out", out, code=2).stderr
    (folder / "run.toml").unlink()
    assert "sonar's geometry" in run(folder, "--out", out, code=1).stderr
    assert not out.exists()


@pytest.mark.slow
def test_proposal_of_the_sample_comes_near_its_truth(tmp_path: Path) -> None:
    """Every landmark in view for at least 0.9 is proposed, none that is not there, and in place.

    Half a disc radius is what a person would not have to correct to score under either protocol.
    """
    summary = run_log(SAMPLE, tmp_path / "out", preset=preset("default"))
    found = {
        (int(r["frame"]), int(r["landmark"])): (float(r["x_px"]), float(r["y_px"]))
        for r in proposed(summary.folder)
    }
    true = {(int(r["frame"]), int(r["landmark"])): r for r in read_rows(SAMPLE / "gt.csv")}
    whole = [key for key, row in true.items() if float(row["visible"]) >= 0.9]
    assert sum(key in found for key in whole) >= 0.98 * len(whole)
    assert found.keys() <= true.keys()
    metres_per_pixel = 2.5 / 256
    for key, (x, y) in found.items():
        apart = math.hypot(x - float(true[key]["x_px"]), y - float(true[key]["y_px"]))
        assert apart * metres_per_pixel < 0.075
    gt = summary.folder.parent / "proposed.csv"
    sonarrec("truth", "check", gt, SAMPLE)


def test_scoring_counts_the_rows_that_nobody_has_checked(tmp_path: Path) -> None:
    """Of results against a proposal made from them: every rate is 1, and nothing was said."""
    folder, gt = results(tmp_path / "log", track(1, range(20))), tmp_path / "proposed.csv"
    proposed(folder)
    call = ("evaluate", folder, "--ground-truth", gt)
    assert "20 of 20 rows" in sonarrec(*call, code=3).stderr.splitlines()[0]
    with pytest.warns(UserWarning, match="20 of 20 rows"):
        evaluate(folder, gt)
    lines = gt.read_text().splitlines()
    lines[1:16] = [line.replace(",tracked", ",") for line in lines[1:16]]
    gt.write_text("\n".join(lines) + "\n")
    assert "5 of 20 rows" in sonarrec(*call, code=3).stderr
    gt.write_text(gt.read_text().replace(",tracked", ",diver"))
    assert "truth propose" not in sonarrec(*call).output
