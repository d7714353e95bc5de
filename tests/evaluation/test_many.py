"""Many logs scored one at a time: the same figures as all at once, and memory that stays flat."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import shutil
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from sonarrec.cli import main
from sonarrec.evaluation import compare as comparison
from sonarrec.evaluation import histogram, logs, summary
from sonarrec.evaluation.compare import compare
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.histogram import sum_by_value, values_at_ranks
from sonarrec.evaluation.intervals import bootstrap_weights, coin_tosses
from sonarrec.evaluation.pairs import Pair, read_pairs
from sonarrec.evaluation.passes import UnitKind
from sonarrec.evaluation.write import write_evaluation
from sonarrec.runs.two_cores import CAN_FORK
from tests.evaluation.test_evaluation import write_case
from tests.support.made_up import make_logs, make_sides
from tests.support.slow import but_first

FLOATS = st.lists(
    st.lists(st.floats(0, 5, width=16) | st.just(float("inf")), max_size=30), min_size=1, max_size=5
)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve logs, in one of which a method is missing and another program's is there."""
    table = make_logs(tmp_path_factory.mktemp("many") / "made", 12, 250, 4)
    odd = table.parent / "out" / "log0005"
    text = (odd / "estimates.csv").read_text(encoding="utf-8")
    (odd / "estimates.csv").unlink()
    head, *lines = text.splitlines(keepends=True)
    kept = [line.replace(",smi,", ",another,") for line in lines[: len(lines) // 2]]
    (odd / "estimates.csv").write_text(head + "".join(kept), encoding="utf-8")
    run = (odd / "run.toml").read_text(encoding="utf-8")
    (odd / "run.toml").write_text(run.replace('"smi"', '"another"'), encoding="utf-8")
    return table


@pytest.fixture
def few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Intervals and tests from fewer draws, where it is told only whether two ways are the same."""
    for module in (summary, comparison):
        monkeypatch.setattr(module, "bootstrap_weights", partial(bootstrap_weights, draws=100))
        monkeypatch.setattr(module, "coin_tosses", partial(coin_tosses, flips=255))


@pytest.fixture
def copied(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other processes are copies of this one, which need not load all modules anew; what they are
    given, and what they give, is pickled as ever. As users have it is
    `test_the_same_bytes_however_many_processes` and `test_compared_one_at_a_time_as_all_at_once`.
    """
    if CAN_FORK:
        context = multiprocessing.get_context("fork")
        monkeypatch.setattr(multiprocessing, "get_context", lambda _: context)


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def table(text: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(text.decode().splitlines()))


@pytest.mark.slow
@pytest.mark.usefixtures("few_draws")
def test_values_rounded_by_unit_move_intervals_and_tests_alone(
    tmp_path: Path, pairs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = read_pairs(pairs)
    units: dict[UnitKind, int] = {"log": 12, "pass": 12 * 2}
    for unit, many in units.items():
        for name, most in (("exact", histogram.MOST_ROWS), ("rounded", 20_000)):
            monkeypatch.setattr(histogram, "MOST_ROWS", most)
            write_evaluation(tmp_path / unit / name, evaluate_logs(rows, unit=unit), det=True)
        exact, rounded = (files(tmp_path / unit / n) for n in ("exact", "rounded"))
        for name in exact.keys() - {"figures.csv", "tests.csv", "evaluation.json"}:
            assert rounded[name] == exact[name], name
        for name in ("figures.csv", "tests.csv"):
            for a, b in zip(table(exact[name]), table(rounded[name]), strict=True):
                for column, cell in a.items():
                    if column not in ("low", "high", "p"):
                        assert b[column] == cell
                    elif cell not in ("", "inf"):
                        assert float(b[column]) == pytest.approx(float(cell), abs=0.05)
        told = json.loads(exact["evaluation.json"])
        assert list(told["methods"]) == ["smi", "framework", "another"]
        assert told["units"] == many


@pytest.mark.slow
@pytest.mark.usefixtures("few_draws")
def test_the_same_bytes_however_many_processes(tmp_path: Path, pairs: Path) -> None:
    made = {}
    for jobs in ("1", "3"):  # of 12 logs: more than the three have ahead
        out = tmp_path / "evaluation"
        done = CliRunner().invoke(
            main, ["evaluate", "--pairs", str(pairs), "-j", jobs, "-o", str(out), "--details"]
        )
        assert done.exit_code == 0, done.output
        made[jobs] = files(out), done.output
        shutil.rmtree(out)
    assert made["1"] == made["3"]


BROKEN = {
    "estimates.csv": ("frame,method\n0,smi\n", "estimates.csv: wrong columns, no "),
    "frames.csv": ("frame\n", "frames.csv: no frame was processed"),
    "run.toml": ("[sonar\n", "run.toml: not a readable TOML file"),
}


@contextmanager
def broken(folder: Path, name: str) -> Iterator[str]:
    """Breaks a file of some results meanwhile; how the line on it begins."""
    text, told = BROKEN[name]
    kept = (folder / name).rename(folder / "kept")
    (folder / name).write_text(text, encoding="utf-8")
    try:
        yield f"{folder}{os.sep}{told}"
    finally:
        kept.rename(folder / name)


@pytest.fixture(scope="module")
def sides(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Old and new results of three short logs, and a table of pairs."""
    return make_sides(tmp_path_factory.mktemp("sides") / "made", 3, 50, 2)


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table of pairs of four short logs."""
    return make_logs(tmp_path_factory.mktemp("four") / "made", 4, 50, 2)


@pytest.mark.usefixtures("few_draws", "copied")
@pytest.mark.parametrize(
    ("name", "jobs"),
    but_first([("estimates.csv", "1"), ("frames.csv", "1"), ("run.toml", "1"), ("run.toml", "2")]),
)
def test_a_log_that_cannot_be_read_is_left_out(
    tmp_path: Path, four: Path, name: str, jobs: str
) -> None:
    """The first, whose IDs' order the others would follow. Without any other it is one line. By
    what name it cannot be read is settled before it reaches another process: one has it there."""
    head, _, *others = four.read_text(encoding="utf-8").splitlines()
    less = tmp_path / "pairs.csv"
    less.write_text("\n".join([head, *others, ""]), encoding="utf-8")
    done = CliRunner().invoke(main, ["evaluate", "--pairs", str(less), "-j", "1"])
    assert done.exit_code == 0, done.output
    words = ["evaluate", "--pairs", str(four), "-j", jobs, "-o", str(tmp_path / "found")]
    with ExitStack() as broke:
        told = broke.enter_context(broken(four.parent / "out" / "log0000", name))
        done = CliRunner().invoke(main, words)
        assert done.exit_code == 3
        assert done.stderr.startswith(f"sonarrec: {told}")
        assert done.stderr.endswith("; log0000 is not scored\n")
        assert done.stderr.count("\n") == 1
        for table in ("confusion.csv", "roc.csv", "figures.csv", "per_log.csv"):
            without = (tmp_path / "evaluation" / table).read_bytes()
            assert (tmp_path / "found" / table).read_bytes() == without
        shutil.rmtree(tmp_path / "found")
        for n in (1, 2, 3):
            broke.enter_context(broken(four.parent / "out" / f"log000{n}", name))
        done = CliRunner().invoke(main, words)
    assert done.exit_code == 1
    assert done.output.startswith(f"sonarrec: {told}")
    assert done.output.count("\n") == 1
    assert not (tmp_path / "found").exists()


@cache
def without_the_first(old: Path, new: Path, pairs: Path) -> dict[str, bytes]:
    """What --compare writes where the first log is on neither side."""
    out = pairs.parent / "without"
    both = old / "log0000", new / "log0000"
    for folder in both:
        folder.rename(folder.parent.parent / f"{folder.parent.name}0")
    words = ["--pairs", str(pairs), "--compare", str(old), str(new), "-o", str(out)]
    done = CliRunner().invoke(main, ["evaluate", *words])
    for folder in both:
        (folder.parent.parent / f"{folder.parent.name}0").rename(folder)
    assert done.exit_code == 0, done.output
    return files(out)


@pytest.mark.slow
@pytest.mark.usefixtures("few_draws", "copied")
@pytest.mark.parametrize(
    ("name", "side", "jobs"),
    [
        *((name, side, "1") for name in BROKEN for side in ("out", "new")),
        ("run.toml", "new", "2"),
    ],
)
def test_a_log_that_cannot_be_read_is_not_compared(
    tmp_path: Path, sides: tuple[Path, Path, Path], name: str, side: str, jobs: str
) -> None:
    """The first, on either side. Without any other it is one line."""
    old, new, pairs = sides
    words = ["--pairs", str(pairs), "--compare", str(old), str(new)]
    without = without_the_first(old, new, pairs)
    out = tmp_path / "found"
    with ExitStack() as broke:
        told = broke.enter_context(broken(pairs.parent / side / "log0000", name))
        done = CliRunner().invoke(main, ["evaluate", *words, "-o", str(out), "-j", jobs, "-q"])
        assert done.exit_code == 3, done.output
        assert done.stderr.startswith(f"sonarrec: {told}")
        assert done.stderr.endswith("; log0000 is not compared\n")
        assert done.stderr.count("\n") == 1
        for table in ("compare.csv", "changes.csv"):
            assert (out / table).read_bytes() == without[table]
        found, less = (
            json.loads(text)
            for text in ((out / "compare.json").read_bytes(), without["compare.json"])
        )
        assert found | {"unused": []} == less
        page = CliRunner().invoke(main, ["report", *words, "-o", str(out / "compare.html"), "-q"])
        assert (page.exit_code, page.stderr) == (3, done.stderr)
        for n in (1, 2):
            broke.enter_context(broken(pairs.parent / side / f"log000{n}", name))
        done = CliRunner().invoke(main, ["evaluate", *words, "-j", jobs])
    assert done.exit_code == 1
    assert done.output.startswith(f"sonarrec: {told}")
    assert done.output.count("\n") == 1
    assert not (new / "evaluation").exists()


# SHA-256 of what --compare writes and prints, first recorded when it held all logs at once; since
# then of shorter logs, where the code still met what was recorded of the longer ones.
RECORDED = {
    4: {
        "changes.csv": "c1d11868d335fb2a",
        "compare.csv": "7adf97591fa1498e",
        "compare.json": "f3281431e3ac1939",
        "printed": "2a2e2909d9359723",
    },
    12: {
        "changes.csv": "c62e8bb554426a0a",
        "compare.csv": "259edaa2f50df435",
        "compare.json": "6d2fd05a39b824d5",
        "printed": "a27fdeb1e8b903f5",
    },
}


@pytest.mark.slow
@pytest.mark.parametrize(("logs", "jobs"), [(4, "2"), (12, "1")])
def test_compared_one_at_a_time_as_all_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, logs: int, jobs: str
) -> None:
    """By passes and by logs; of one log the new results hold another method."""
    make_sides(tmp_path / "made", logs, 350, 3)
    monkeypatch.chdir(tmp_path)
    odd = Path("made/new/log0002")
    text = (odd / "estimates.csv").read_text()
    (odd / "estimates.csv").unlink()
    (odd / "estimates.csv").write_text(text.replace(",smi,", ",another,"))
    run = (odd / "run.toml").read_text()
    (odd / "run.toml").write_text(run.replace('"smi"', '"another"'))
    sides = ["--pairs", "made/pairs.csv", "--compare", "made/out", "made/new"]
    done = CliRunner().invoke(main, ["evaluate", *sides, "-o", "found", "-j", jobs])
    assert done.exit_code == (3 if logs > 4 else 0), done.output
    page = CliRunner().invoke(main, ["report", *sides, "-o", "found/compare.html"])
    assert page.exit_code == done.exit_code
    made = files(Path("found"))
    assert made.pop("compare.html")  # its content is the report's tests'
    found = {name: sha256(data).hexdigest()[:16] for name, data in made.items()}
    assert found | {"printed": sha256(done.output.encode()).hexdigest()[:16]} == RECORDED[logs]


def peak_mb(call: Callable[[], object]) -> float:
    """Most memory that a call holds at a time."""
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


@pytest.fixture
def few_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Already of a few logs values by unit are coarse."""
    monkeypatch.setattr(histogram, "MOST_ROWS", 5_000)


@pytest.mark.slow
@pytest.mark.usefixtures("few_rows")
def test_memory_of_a_comparison_does_not_grow_with_the_logs(tmp_path: Path) -> None:
    """Two logs and eleven. What was read of a log is twice that of
    `test_memory_does_not_grow_with_the_logs`: were it kept, nine more would be 9 MB."""

    old, new, table = make_sides(tmp_path / "made", 11, 1000, 2)
    pairs = read_pairs(table)

    def peak(logs: int) -> float:
        found = []
        peak = peak_mb(lambda: found.append(compare(old, new, pairs[:logs], jobs=1)))
        assert len(found[0].logs) == logs
        return peak

    assert peak(11) - peak(2) < 1


def test_a_log_without_any_estimate_counts_as_nothing_claimed(tmp_path: Path) -> None:
    """Of another program, whose run.toml names no method."""
    truth = [(f, 1, 2.0, 0.0, 1.0) for f in range(5, 25)]
    pairs = []
    for name, last in (("a", 20), ("b", 0)):
        claims = [(f, "m", 2.0, 0.0, 1, 0.9, 1) for f in range(5, last)]
        pairs.append(Pair(*write_case(tmp_path / name, range(40), claims, truth), name))
    found = evaluate_logs(pairs)
    assert found.scored[0].count().fn == 5 + 20
    write_evaluation(tmp_path / "e", found)
    assert {row["log"] for row in table(files(tmp_path / "e")["passes.csv"])} == {"a", "b"}


def test_few_small_logs_start_no_process(pairs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "ProcessPoolExecutor", None)
    assert len(evaluate_logs(read_pairs(pairs)).folders) == 12


def test_no_more_processes_than_the_cores_it_may_use(
    pairs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "WORTH_BYTES", 1)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {5})
    monkeypatch.setattr(logs, "ProcessPoolExecutor", None)
    assert len(evaluate_logs(read_pairs(pairs)).folders) == 12


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
        for one, of_all in zip(alone.scored, found.scored, strict=True):
            assert of_all.declared[n].tolist() == one.declared[0, order].tolist()


@pytest.mark.slow
@pytest.mark.usefixtures("few_rows")
def test_memory_does_not_grow_with_the_logs(tmp_path: Path) -> None:
    """Two logs and eleven. What may grow is what a log leaves behind for good: its name, counts and
    passes (a few kB), and its row in the sums by unit (20 tables of 600 numbers a row, some 50 kB,
    .5 MB in all). What was read of a log is 4,000 estimates of 17 numbers, .5 MB: were it kept,
    nine more would be 4.5 MB. `make scoring` measures whole commands over a thousand logs."""
    pairs = read_pairs(make_logs(tmp_path / "made", 11, 1000, 2))
    few, many = (peak_mb(lambda n=n: evaluate_logs(pairs[:n], jobs=1)) for n in (2, 11))  # type: ignore[misc]
    assert many - few < 1


@given(FLOATS)
def test_values_by_rank_are_those_of_sorting(values: list[list[float]]) -> None:
    whole = np.sort(np.concatenate([np.array(some, dtype=float) for some in values]))
    if len(whole):
        ranks = np.unique(np.linspace(0, len(whole) - 1, 7).astype(int))
        counted = sum_by_value([(whole, np.ones((len(whole), 1), dtype=int))])
        assert values_at_ranks(counted, ranks).tolist() == whole[ranks].tolist()


@given(FLOATS)
def test_equal_values_are_put_together(values: list[list[float]]) -> None:
    chunks = [(np.array(some, dtype=float), np.ones((len(some), 2), int)) for some in values]
    found, many = sum_by_value(chunks)
    expected, count = np.unique(np.concatenate([c[0] for c in chunks]), return_counts=True)
    assert found.tolist() == expected.tolist()
    assert many[:, 0].tolist() == many[:, -1].tolist() == count.tolist()
