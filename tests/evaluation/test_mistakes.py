"""mistakes.csv: what each method got wrong, by hand, against loops and against the counts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sonarrec.errors import Diagnostics
from sonarrec.evaluation.evaluate import LogToScore, evaluate_logs, score_logs
from sonarrec.evaluation.rows import PROTOCOLS, ScoringOptions
from tests.support.claims import all_scored, evaluate
from tests.support.command import sonarrec
from tests.support.pages import random_results, tables
from tests.support.rows import read_rows

COLUMNS = ["log", "method", "kind", "landmark", "other"]
COLUMNS += ["first_frame", "last_frame", "frames", "score"]


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_mistakes_add_up_to_the_counts(tmp_path: Path, protocol: str) -> None:
    log = random_results(tmp_path / "log")
    truth = log / "gt.csv"
    if protocol == "paper":  # without positions in the truth only this one is scored
        rows = [line.split(",") for line in truth.read_text().splitlines()]
        truth = tmp_path / "gt.csv"
        truth.write_text("".join(f"{r[0]},{r[1]},{r[4]}\n" for r in rows))
    found = evaluate(log, truth)
    wrong = found.counts.mistakes
    assert [m.frames for m in wrong] == sorted((m.frames for m in wrong), reverse=True)
    for one in (s for s in all_scored(found.counts) if s.protocol == protocol):
        mine, count = [m for m in wrong if m.method == one.method], one.count()
        assert sum(m.times for m in mine if m.kind == "false") == count.fp > 50
        assert sum(m.times for m in mine if m.kind == "missed") == count.fn > 50
        for m in mine:
            assert m.first_frame <= m.worst_frame <= m.last_frame
            assert m.frames <= min(m.times, m.last_frame - m.first_frame + 1)
            assert (m.protocol, m.log) == (protocol, "log")
            assert np.isnan(m.score) or 0 <= m.score <= 1


def test_mistakes_by_hand(tmp_path: Path) -> None:
    log = tmp_path / "log"
    # ID.2 claimed at 20 deg, where nothing lies: frames 0 to 3, 8 and 14 (gaps of 4 and 5).
    claims = [f"{n},mine,2,2.0,20,{0.5 + n / 100},1" for n in (0, 1, 2, 3, 8, 14)]
    # ID.1 lies at 0 deg in frames 20 to 22; called ID.3 there, then twice scored too low.
    claims += ["20,mine,3,2.0,0,0.8,1", "21,mine,1,2.0,0,0.3,0", "22,mine,1,2.0,0,0.4,0"]
    claims.append("31,mine,4,2.0,0,0.9,1")  # right
    tables(log, range(40), "frame,method,landmark,range_m,bearing_deg,score,declared", claims)
    truth = "20,1,2.0,0\n21,1,2.0,0\n22,1,2.0,0\n30,4,2.0,0\n31,4,2.0,0\n0,4,3.0,0\n"
    (log / "gt.csv").write_text("frame,landmark,range_m,bearing_deg\n" + truth)
    sonarrec("evaluate", log, "--ground-truth", log / "gt.csv", "-q")
    rows = read_rows(log / "evaluation" / "mistakes.csv")
    assert [*rows[0]][: len(COLUMNS)] == COLUMNS
    assert [",".join(row[c] for c in COLUMNS[2:]) + f",{row['worst_frame']}" for row in rows] == [
        "false,2,,0,8,5,0.58,8",
        "missed,1,1,20,22,3,0.4,22",
        "false,3,1,20,20,1,0.8,20",
        "false,2,,14,14,1,0.64,14",
        "missed,4,,0,0,1,,0",
        "missed,4,,30,30,1,,30",
    ]
    assert [row["at_start"] for row in rows] == ["0", "0", "0", "0", "1", "0"]
    found = evaluate_logs(log, log / "gt.csv")
    assert [m.in_words for m in found.counts.mistakes][:3] == [
        "ID.2 declared (0.58) where no landmark lies",
        "ID.1 in view and not declared: best guess ID.1 (0.40)",
        "ID.3 declared (0.80) on what is ID.1",
    ]
    assert found.mistakes.columns[: len(COLUMNS)].tolist() == COLUMNS
    assert found.mistakes["frames"].sum() == 12


def test_there_may_be_more_methods_than_int8_counts(tmp_path: Path) -> None:
    log, count = tmp_path / "log", 131
    claims = [f"0,m{n},{1 + (n < 128)},2.0,0,0.9,1" for n in range(count)]
    tables(log, range(3), "frame,method,landmark,range_m,bearing_deg,score,declared", claims)
    (log / "gt.csv").write_text("frame,landmark,range_m,bearing_deg\n0,1,2.0,0\n")
    scored = LogToScore((log,), log / "gt.csv", "log")
    _, [found], _ = score_logs([scored], ScoringOptions(), "scored", Diagnostics(), log)
    right = [found.count(f"m{n}", "strict").tp for n in range(count)]
    assert right == [0] * 128 + [1] * 3


def test_a_log_that_lacks_a_method_missed_all_of_it(tmp_path: Path) -> None:
    """As the counts say."""
    head = "frame,method,landmark,range_m,bearing_deg,score,declared"
    for name, method in (("a", "mine"), ("b", "other")):
        claims = [f"{n},{method},1,2.0,0,0.9,1" for n in range(10)]
        tables(tmp_path / "out" / name, range(10), head, claims)
    lines = ["log,frame,landmark,range_m,bearing_deg"]
    lines += [f"{log},{n},1,2.0,0" for log in "ab" for n in range(10)]
    (tmp_path / "gt.csv").write_text("\n".join(lines) + "\n")
    counts = evaluate_logs(tmp_path / "out", tmp_path / "gt.csv").counts
    assert [(m.log, m.method, m.kind, m.frames) for m in counts.mistakes] == [
        ("b", "mine", "missed", 10),
        ("a", "other", "missed", 10),
    ]


def test_a_mistake_ends_at_a_pause(tmp_path: Path) -> None:
    """An hour before frame 22, after which it is another one."""
    log, hour = tmp_path / "log", 3600 * 10**9
    frames = [(n, n * 250_000_000 + hour * (n >= 22)) for n in range(40)]
    head = "frame,method,landmark,range_m,bearing_deg,score,declared"
    claims = [f"{n},mine,1,2.0,0,0.9,1" for n in range(40)]
    claims += [f"{n},mine,2,2.0,20,0.8,1" for n in (20, 21, 22)]
    tables(log, frames, head, sorted(claims, key=lambda row: int(row.partition(",")[0])))
    truth = "".join(f"{n},1,2.0,0\n" for n in range(40))
    (log / "gt.csv").write_text("frame,landmark,range_m,bearing_deg\n" + truth)
    found = evaluate_logs(log, log / "gt.csv").counts.mistakes
    assert [(m.first_frame, m.last_frame, m.kind) for m in found] == [
        (20, 21, "false"),
        (22, 22, "false"),
    ]


@pytest.mark.parametrize(("frames", "at_start"), [(1, "0"), (2, "1")])
def test_a_single_frame_has_no_start(tmp_path: Path, frames: int, at_start: str) -> None:
    log = tmp_path / "log"
    tables(
        log,
        range(frames),
        "frame,method,landmark,range_m,bearing_deg,score,declared",
        ["0,framework,3,2.0,0,0.4,0"],
    )
    (log / "gt.csv").write_text("frame,landmark,range_m,bearing_deg\n0,4,3.0,0\n")
    sonarrec("evaluate", log, "--ground-truth", log / "gt.csv", "-q")
    assert [r["at_start"] for r in read_rows(log / "evaluation" / "mistakes.csv")] == [at_start]
