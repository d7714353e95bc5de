"""Whether results are good enough: worse than before, or beyond a limit. Counted by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from sonarrec.api.evaluate import compare
from sonarrec.evaluation.compare import EACH, Limits, change_text, judge
from sonarrec.evaluation.pairs import Pair
from sonarrec.reports.screen import MOST_ROWS, comparison
from tests.evaluation.test_compare import FRAMES, TRUTH, claims, command
from tests.evaluation.test_evaluation import write_case

RIGHT = set(range(5, 25))
"""The frames in which ID.1 is in view: 20."""


def results(folder: Path, rows: list[tuple], name: str = "log") -> Path:
    made, truth = write_case(folder / f"{name}.made", FRAMES, rows, TRUTH)
    truth.rename(made / "gt.csv")
    return made.rename(folder / name)


def judged(old: Path, new: Path, logs: list[str], limits: Limits):
    pairs = [Pair(new / log, new / log / "gt.csv") for log in logs]
    return judge(compare(old, new, pairs), limits)


def both(tmp_path: Path, **new: list[tuple]) -> tuple[Path, Path, list[str]]:
    """Two folders of logs, by name what is claimed in the new; in the old all is right."""
    for n, (name, rows) in enumerate(new.items()):
        # Logs of equal tables would be taken for copies of one.
        was, now = (
            [(f, m, r + n / 1000, *rest) for f, m, r, *rest in x] for x in (claims(RIGHT), rows)
        )
        results(tmp_path / "old", was, name)
        results(tmp_path / "new", now, name)
    return tmp_path / "old", tmp_path / "new", list(new)


def test_a_loss_in_one_log_of_many_is_one(tmp_path: Path) -> None:
    """4 of 20 frames of one log of five: .04 over all, which the band lets pass."""
    names = "bcde"
    sides = both(tmp_path, a=claims(RIGHT - {5, 6, 7, 8}), **dict.fromkeys(names, claims(RIGHT)))
    found = judged(*sides, Limits(band=0.1))
    assert "worse: TPR 1.0000 -> 0.8000 (m, strict)" in found.sentence
    assert found.faults == (
        "worse: a: m, paper: TPR was 1.0000, is 0.8000",
        "worse: a: m, strict: TPR was 1.0000, is 0.8000",
    )
    marks = {(row.log, row.protocol): row.mark for row in found.rows}
    assert [key for key, mark in marks.items() if mark] == [("a", "strict"), ("a", "paper")]
    [total] = [row for row in found.rows if (row.log, row.protocol) == ("total", "strict")]
    assert (change_text(total.tpr), change_text(total.fpr)) == ("1.0000 -> 0.9600", "0.0000")
    assert judged(*sides, Limits(band=0.2)).faults == ()


def test_two_frames_are_free(tmp_path: Path) -> None:
    sides = both(tmp_path, a=claims(RIGHT - {5, 6}))
    found = judged(*sides, Limits(band=0.0))
    assert found.faults == ()
    assert found.sentence.startswith("as good: TPR 1.0000 -> 0.9000 (m, strict) in a;")


def test_better_and_unchanged(tmp_path: Path) -> None:
    old, new, logs = both(tmp_path, a=claims(RIGHT - set(range(5, 15))))
    limits = Limits(band=0.1)
    better = judged(new, old, logs, limits).sentence
    assert better.startswith("better: TPR 0.5000 -> 1.0000 (m, strict) in a")
    same = judged(new, new, logs, limits).sentence
    assert same == "unchanged: TPR 0.5000, FPR 0.0000 (m, strict) in a"


def test_the_baseline_is_looked_at_on_request(tmp_path: Path) -> None:
    """smi loses everything, m nothing."""
    old = results(tmp_path / "old", claims(RIGHT) + claims(RIGHT, method="smi"))
    new = results(tmp_path / "new", claims(RIGHT) + claims({5}, method="smi"))
    truth = new / "gt.csv"
    compared = compare(old, new, truth)
    assert {row.method for row in judge(compared, Limits(band=0.02)).rows} == {"m"}
    assert judge(compared, Limits(band=0.02)).faults == ()
    assert judge(compared, Limits(band=0.02, methods=("smi",))).sentence.startswith(
        "worse: TPR 1.0000 -> 0.0500 (smi, strict)"
    )
    # Where nothing else is there it counts.
    old, new = (results(tmp_path / f"{len(r)}", claims(r, method="smi")) for r in (RIGHT, {5}))
    assert judge(compare(old, new, truth), Limits(band=0.02)).faults


def test_limits_by_method_and_for_each(tmp_path: Path) -> None:
    """m: TPR 10 of 20, and 2 false claims of ID.2, which 62 cases could be: 3 IDs x 40 - ..."""
    rows = claims(set(range(5, 15)), {30, 31}) + claims(RIGHT, method="n")
    folder = results(tmp_path, rows)
    scored = compare(folder, folder, folder / "gt.csv").after
    for limits, told in (
        (Limits(least_tpr={EACH: 0.5}), []),
        (Limits(least_tpr={EACH: 0.51}), ["TPR 0.5000 (m, strict) is below 0.51"]),
        (Limits(least_tpr={EACH: 0.51, "m": 0.4}), []),
        (Limits(least_tpr={EACH: 0.51}, methods=("n",)), []),
        (Limits(least_tpr={"m": 0.51}, methods=("n",)), ["TPR 0.5000 (m, strict) is below 0.51"]),
        (Limits(most_fpr={EACH: 0.0}), ["FPR 0.0143 (m, strict) is above 0"]),
    ):
        assert limits.broken(scored) == [f"limit not kept: {line}" for line in told], limits
    done = command("--ground-truth", folder / "gt.csv", folder, "--least-tpr", "0.51", code=4)
    assert "kept: TPR 0.5000 (m, strict) is below 0.51" in done.stderr
    command("--ground-truth", folder / "gt.csv", folder, "-q", "--least-tpr", "n=1")


def test_a_tpr_of_nothing_keeps_no_limit(tmp_path: Path) -> None:
    """No landmark is whole in view."""
    truth = [(f, 1, 2.0, 0.0, 0.6) for f in range(5, 25)]
    folder, gt = write_case(tmp_path / "log", FRAMES, claims({5}), truth)
    scored = compare(folder, folder, gt).after
    told = Limits(least_tpr={"m": 0.0}).broken(scored)
    assert len(told) == 1
    assert "kept: TPR 0/0 (m, strict) is below 0" in told[0]


@pytest.mark.slow
def test_many_logs_show_what_is_worse_and_the_total(tmp_path: Path) -> None:
    logs = {f"log_{i}": claims(RIGHT) for i in range(MOST_ROWS)}
    logs["log_3"], logs["log_5"] = claims({5}), claims(RIGHT - set(range(5, 15)))
    old, new, names = both(tmp_path, **logs)
    found = compare(old, new, [Pair(new / log, new / log / "gt.csv") for log in names])
    lines = comparison(found, judge(found, Limits(band=0.1))).splitlines()
    assert "worse on 2 of 24 logs: log_3, log_5" in lines[0]
    assert [line.split()[0] for line in lines[2:8:2]] == ["log_3", "log_5", "total"]
    assert lines[8].startswith("44 more")


@pytest.mark.parametrize("rate", ["1.1", "nan", "m=", "much"])
def test_a_limit_that_is_no_rate(rate: str) -> None:
    command("--least-tpr", rate, code=2)
