"""Many logs scored one at a time: the same figures as all at once, and memory that stays flat."""

from __future__ import annotations

import os
import shutil
import tracemalloc
from pathlib import Path

import pytest

from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.pairs import Pair, read_pairs
from sonarrec.evaluation.write import write_evaluation
from tests.evaluation.test_evaluation import write_case
from tests.support.claims import all_scored
from tests.support.command import sonarrec
from tests.support.made_up import make_logs
from tests.support.rows import read_rows
from tests.support.slow import but_first

BROKEN = {
    "estimates.csv": ("frame,method\n0,smi\n", "estimates.csv: wrong columns, no "),
    "frames.csv": ("frame\n", "frames.csv: no frame was processed"),
    "run.toml": ("[sonar\n", "run.toml: not a readable TOML file"),
}


@pytest.mark.parametrize(
    ("name", "side"),
    but_first([*((n, "") for n in BROKEN), *((n, s) for n in BROKEN for s in ("out", "new"))]),
)
def test_a_log_that_cannot_be_read_is_left_out(tmp_path: Path, name: str, side: str) -> None:
    """The first of three, of either side where two are compared: tables are as without it. If none
    can be read it is one line. One fault is found in another process."""
    pairs = make_logs(tmp_path / "made", 3, 50, 2)
    old, new = (pairs.with_name(name) for name in ("out", "new"))
    shutil.copytree(old, new, symlinks=True)
    words = ["evaluate", "--pairs", pairs, "-q"]
    words += ["--compare", old, new] if side else []
    text, told = BROKEN[name]

    def spoil(n: int) -> str:
        folder = pairs.with_name(side or "out") / f"log000{n}"
        (folder / name).unlink()
        (folder / name).write_text(text, encoding="utf-8")
        return f"sonarrec: {folder}{os.sep}{told}"

    line, done = spoil(0), sonarrec(*words, "-o", tmp_path / "found", code=3)
    (error,) = [one for one in done.stderr.splitlines() if ": note: " not in one]
    assert error.startswith(line)
    assert error.endswith(f"; log0000 is not {'compared' if side else 'scored'}")
    head, _, *others = pairs.read_text(encoding="utf-8").splitlines(keepends=True)
    pairs.write_text("".join([head, *others]), encoding="utf-8")
    for folder in (old, new):
        shutil.rmtree(folder / "log0000")
    sonarrec(*words, "-o", tmp_path / "without")
    tables = ("compare.csv",) if side else ("confusion.csv", "roc.csv", "figures.csv")
    for table in tables:
        found, without = (tmp_path / where / table for where in ("found", "without"))
        assert found.read_bytes() == without.read_bytes()
    line, _ = spoil(1), spoil(2)
    done = sonarrec(*words, "-o", tmp_path / "none", code=1)
    assert done.output.startswith(line)
    assert done.output.count("\n") == 1
    assert not (tmp_path / "none").exists()


def test_a_log_without_any_estimate_counts_as_nothing_claimed(tmp_path: Path) -> None:
    """Of another program, whose run.toml names no method."""
    truth = [(f, 1, 2.0, 0.0, 1.0) for f in range(5, 25)]
    pairs = []
    for name, last in (("a", 20), ("b", 0)):
        claims = [(f, "m", 2.0, 0.0, 1, 0.9, 1) for f in range(5, last)]
        pairs.append(Pair(*write_case(tmp_path / name, range(40), claims, truth), name))
    found = evaluate_logs(pairs)
    assert all_scored(found.counts)[0].count().fn == 5 + 20
    write_evaluation(tmp_path / "e", found)
    assert {row["log"] for row in read_rows(tmp_path / "e" / "passes.csv")} == {"a", "b"}


@pytest.mark.slow
def test_ids_in_another_order_are_put_in_that_of_the_first(tmp_path: Path) -> None:
    pairs = make_logs(tmp_path / "made", 3, 200)
    for n, order in enumerate(((1, 2, 3, 4), (4, 2, 1, 3), (2, 1, 3, 4))):
        sectors = {1: [1, 0, 0, 0], 2: [1, 0, 1, 0], 3: [1, 1, 0, 0], 4: [1, 1, 1, 0]}
        of = (f"[[landmarks.landmark]]\nid = {i}\nsectors = {sectors[i]}\n" for i in order)
        run = tmp_path / "made" / "out" / f"log{n:04d}" / "run.toml"
        ring = 'name = "x"\nradius_m = 0.15\nring = [0.8, 1.0]\nsymbol = [0.0, 0.62]\n'
        run.write_text(run.read_text() + "[landmarks]\n" + ring + "".join(of))
    rows = read_pairs(pairs)
    found = evaluate_logs(rows)
    assert found.counts.ids == (1, 2, 3, 4)
    for n, row in enumerate(rows):
        alone = evaluate_logs([row])
        order = [alone.counts.ids.index(i) for i in (1, 2, 3, 4)]
        for one, of_all in zip(all_scored(alone.counts), all_scored(found.counts), strict=True):
            for k, own in enumerate(order):
                assert of_all.count(k, n)[:4] == one.count(own)[:4]


@pytest.mark.slow
def test_memory_does_not_grow_with_the_logs(tmp_path: Path) -> None:
    """Two logs and eleven. What may grow is what a log leaves behind for good: its name, counts and
    passes (a few kB), and its row in the sums by unit (20 tables of 600 numbers a row, some 50 kB,
    .5 MB in all). What was read of a log is 4,000 estimates of 17 numbers, .5 MB: were it kept,
    nine more would be 4.5 MB."""
    pairs = read_pairs(make_logs(tmp_path / "made", 11, 1000, 2))
    peaks_mb = []
    for n in (2, 11):
        tracemalloc.start()
        evaluate_logs(pairs[:n])
        peaks_mb.append(tracemalloc.get_traced_memory()[1] / 1e6)
        tracemalloc.stop()
    assert peaks_mb[1] - peaks_mb[0] < 1
