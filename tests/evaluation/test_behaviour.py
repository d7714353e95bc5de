"""Beyond rates: errors and calibration, counted by hand."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from sonarrec.evaluation.figures import Summary, summarise
from tests.support.claims import counts, matched
from tests.support.command import sonarrec
from tests.support.rows import read_rows


def summary_of(frames: int, truth: list, claims: list, **options) -> Summary:
    return summarise(counts(matched(frames, truth, claims, **options)))


def value(summary: Summary, name: str, method: str = "a", landmark: str = "total") -> float:
    figure = summary.figure("strict", method, name, landmark)
    assert figure is not None
    return figure.value


def claim(frame: int, landmark: int = 1, x: float = 0.0, **more) -> tuple:
    told = {"method": 0, "score": 0.9, "declared": True, **more}
    return (
        *(told["method"], frame, landmark, x, 0, told["score"], told["declared"]),
        *told.get("p", ()),
    )


def test_position_errors() -> None:
    truth = [(f, 1, 0, 0, True) for f in range(100)]
    away = np.linspace(0.001, 0.1, 100)
    claims = [claim(f, x=d) for f, d in enumerate(away.tolist())] + [claim(5, x=0.16)]
    summary = summary_of(100, truth, claims)
    assert value(summary, "position_error_median_m") == pytest.approx(0.05)
    assert value(summary, "position_error_95_m") == pytest.approx(0.095)


def test_orientation_errors() -> None:
    """Angles wrap round, and ID.2 (1010) looks the same after half a turn."""
    ones = [(f, 1, 0, 0, True, a) for f, a in enumerate((359, 182, 3))]
    twos = [(f, 2, 1, 0, True, a) for f, a in enumerate((359, 182, math.nan))]
    claims = [claim(f, k + 1, x=k) for f in range(3) for k in (0, 1)]
    summary = summary_of(3, ones + twos, claims)
    assert value(summary, "orientation_error_median_deg", landmark="1") == 3
    assert value(summary, "orientation_error_95_deg", landmark="1") == 178
    assert value(summary, "orientation_error_95_deg", landmark="2") == 2
    untold = summary_of(3, [row[:5] for row in ones], claims)
    assert untold.figure("strict", "a", "orientation_error_median_deg") is None


def test_calibration_by_hand() -> None:
    truth = [(0, 1, 0, 0, True), (1, 2, 0, 0, True), (2, 1, 0, 0, False)]
    claims = [
        claim(0, p=(0.8, 0.1, 0, 0, 0.1)),  # on ID.1
        claim(1, p=(0.8, 0.2, 0, 0, 0)),  # on ID.2
        claim(2, p=(0, 0, 0, 0, 1)),  # partly in view: left out
        claim(3, 3, x=1.0, p=(0, 0, 0.25, 0, 0.75)),  # on nothing
        claim(4, p=()),  # says no probabilities
    ]
    summary = summary_of(10, truth, claims)
    # Most probable: .8 right, .8 wrong, .75 right.
    assert value(summary, "ece") == pytest.approx((abs(1.6 - 1) + abs(0.75 - 1)) / 3)


def test_files_tell_what_the_summary_holds(tmp_path: Path) -> None:
    """Eight passes, one frame in ten missed by a, none by b; objects have names here."""
    (tmp_path / "frames.csv").write_text(
        "frame,timestamp_ns\n" + "".join(f"{f},{f * 250_000_000}\n" for f in range(240))
    )
    view = [f for f in range(240) if f % 30 < 10]
    (tmp_path / "gt.csv").write_text(
        "frame,landmark,range_m,bearing_deg\n" + "".join(f"{f},1,2,0\n" for f in view)
    )
    rows = [
        f"{f},{m},T{f // 30},2.01,0,1,0.9,{int(m == 'b' or f % 30 != f // 30 % 2)},.9,0,0,0,.1"
        for f in view
        for m in "ab"
    ]
    (tmp_path / "estimates.csv").write_text(
        "frame,method,object,range_m,bearing_deg,landmark,score,declared,p_1,p_2,p_3,p_4,p_none\n"
        + "\n".join(rows)
    )
    done = sonarrec("evaluate", "--ground-truth", tmp_path / "gt.csv", tmp_path, "--details")
    assert "95% intervals over 8 passes" in done.output
    assert "minus a, TPR: +0.100, p = 0.0078" in done.output
    assert re.search(r"^FPR  +0\.0000 \(0\.0000-0\.1226\)", done.output, re.MULTILINE)
    assert max(len(line) for line in done.output.splitlines()[:-1]) <= 100
    rows = read_rows(tmp_path / "evaluation" / "passes.csv")
    passes = [r for r in rows if (r["method"], r["protocol"]) == ("a", "strict")]
    assert {(r["frames"], r["right"]) for r in passes} == {("10", "9")}
