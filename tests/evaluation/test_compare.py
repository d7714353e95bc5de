"""Several logs at once, and two sets of results on one truth."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sonarrec.api.evaluate import compare
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.pairs import Pair, read_pairs
from tests.evaluation.test_evaluation import (
    ESTIMATE_HEADER,
    TRUTH_HEADER,
    counts,
    random_case,
    scored,
    write_case,
    write_csv,
)
from tests.support.claims import evaluate
from tests.support.command import sonarrec
from tests.support.rows import read_rows

FRAMES = range(40)
TRUTH = [(f, 1, 2.0, 0.0, 1.0) for f in range(5, 25)]


def claims(right: set[int], wrong: set[int] = frozenset(), method: str = "m") -> list[tuple]:
    """Claims of ID.1 in place, and of ID.2 far off."""
    return [(f, method, 2.0, 0.0, 1, 0.9, 1) for f in sorted(right)] + [
        (f, method, 3.0, 0.0, 2, 0.8, 1) for f in sorted(wrong)
    ]


command = partial(sonarrec, "evaluate")


@pytest.fixture
def sides(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Old results, new ones and truth: the new miss ID.1 in 10 frames and invent ID.2 no more."""
    old, truth = write_case(tmp_path / "old", FRAMES, claims(set(range(5, 25)), {30, 31}), TRUTH)
    new, _ = write_case(tmp_path / "new", FRAMES, claims(set(range(5, 15))), TRUTH)
    return old, new, truth


def test_what_got_better_and_worse(sides: tuple[Path, Path, Path]) -> None:
    old, new, truth = sides
    done = command("--ground-truth", truth, "--compare", old, new)
    rates = "TPR 1.0000 -> 0.5000, FPR 0.0143 -> 0.0000"
    assert done.output.splitlines()[:5] == [
        f"{new} against {old}: worse: {rates} (m, strict) in out; cases in 1 of the "
        "6 units needed: no test",
        "log  method  protocol  TPR before     now  FPR before     now  FP/100 before   now",
        "out  m       strict        1.0000  0.5000      0.0143  0.0000           5.00  0.00  worse",
        "out  m       paper         1.0000  0.5000      0.0143  0.0000           5.00  0.00  worse",
        "out frames 5-24, ID.1: right in 20 -> 10 of 20 (m, strict)",
    ]
    rows = read_rows(new / "evaluation" / "compare.csv")
    rates = {(r["landmark"], r["rate"]): r for r in rows if r["protocol"] == "paper"}
    assert float(rates["1", "tpr"]["worse_by"]) == 0.5
    assert float(rates["2", "fpr"]["worse_by"]) == pytest.approx(-2 / 40)
    assert not (new / "evaluation" / "confusion.csv").exists()


@pytest.mark.slow
def test_a_verdict_tells_whether_it_may_be_chance(tmp_path: Path) -> None:
    """Of eight passes: by the sign-flip test five that change are p = 2/32, six p = 2/64."""
    starts = range(0, 320, 40)
    truth = [(s + f, 1, 2.0, 0.0, 1.0) for s in starts for f in range(10)]
    whole = {f for f, *_ in truth}
    old, gt = write_case(tmp_path / "old", range(320), claims(whole), truth)

    def told(lost: int) -> str:
        kept = {f for f in whole if f >= 40 * lost}
        new, _ = write_case(tmp_path / f"new{lost}", range(320), claims(kept), truth)
        return compare(old, new, gt).verdict

    rates = "TPR 1.0000 -> 0.3750 (m, strict) in out"
    assert f"worse: {rates}; p = 0.062 over 8 passes" in told(5)
    assert told(6).endswith("; p = 0.031 over 8 passes")
    assert told(0) == "unchanged: TPR 1.0000, FPR 0.0000 (m, strict) in out"


def test_results_without_a_method_in_common_are_refused(tmp_path: Path) -> None:
    old, truth = write_case(tmp_path / "old", FRAMES, claims({5, 6}), TRUTH)
    new, _ = write_case(tmp_path / "new", FRAMES, claims({5}, method="n"), TRUTH)
    done = command("--ground-truth", truth, "--compare", old, new, code=1)
    assert f"{old} has m; {new} has n" in done.stderr


def test_only_common_frames_are_compared(tmp_path: Path) -> None:
    """Leaving out the frames that were hard makes nothing better."""
    old, truth = write_case(tmp_path / "old", FRAMES, claims(set(range(5, 15))), TRUTH)
    new, _ = write_case(tmp_path / "new", range(15), claims(set(range(5, 15))), TRUTH)
    done = command("--ground-truth", truth, "--compare", old, new, code=3)
    assert "25 frames in" in done.stderr
    assert ": unchanged: TPR 1.0000" in done.stdout


RUN = """finished = true
[program]
version = "1"
methods = ["m"]
[input]
name = "pan"
path = "somewhere/pan.mcap"
bytes = 7
sha256 = "{digest}"
topic = "{topic}"
[config]
preset = "default"
seed = 0
[config.features]
declare = 0.75
[landmarks]
name = "basin"
radius_m = 0.15
ring = [0.8, 1.0]
symbol = [0.0, 0.6]
[[landmarks.landmark]]
id = 1
sectors = [1, 0, 0, 0]
[[landmarks.landmark]]
id = 2
sectors = [1, 0, 1, 0]
"""


def made(folder: Path, digest: str = "0" * 64, topic: str = "/sonar") -> None:
    (folder / "run.toml").write_text(RUN.format(digest=digest, topic=topic))


@pytest.mark.parametrize(("key", "value"), [("digest", "1" * 64), ("topic", "/other")])
def test_results_of_different_logs_are_refused(
    sides: tuple[Path, Path, Path], key: str, value: str
) -> None:
    old, new, truth = sides
    made(old)
    made(new, **{key: value})
    done = command("--ground-truth", truth, "--compare", old, new, code=1)
    (line,) = done.stderr.splitlines()
    assert f"{old} and {new}: results" in line
    assert done.stdout == ""
    assert not (new / "evaluation").exists()


def test_without_a_sha256_frames_go_together_by_number_and_it_is_said(
    sides: tuple[Path, Path, Path],
) -> None:
    old, new, truth = sides
    made(new)
    arguments = ["--ground-truth", truth, "--compare", old, new]
    said = command(*arguments, code=1).stderr  # the built-in set has four IDs
    assert "IDs 1, 2, 3, 4 and 1, 2;" in said
    assert f"note: {old}: run.toml" in command(*arguments, "--landmarks", "basin").stdout


def several(folder: Path, digests: dict[str, str], right: dict[str, set[int]]) -> Path:
    """Results of several logs under their names, of the recordings with these digests."""
    for name, digest in digests.items():
        out, _ = write_case(folder / f"{name}.case", FRAMES, claims(right[name]), [])
        made(out, digest=digest)
        (folder / "results").mkdir(exist_ok=True)
        out.rename(folder / "results" / name)
    return folder / "results"


def compared(folder: Path) -> set[str]:
    return {row["log"] for row in read_rows(folder / "evaluation" / "compare.csv")}


def test_several_logs_each_with_a_truth_of_its_own(tmp_path: Path) -> None:
    """Logs go together by name; one that only one side has is told."""
    digests = {"x": "a" * 64, "y": "b" * 64}
    old = several(tmp_path / "old", digests, {"x": {5, 6}, "y": {5, 6}})
    new = several(tmp_path / "new", digests, {"x": {5}, "y": {5, 6, 7}})
    for name in ("x", "y"):
        write_csv(tmp_path / f"{name}.csv", TRUTH_HEADER, TRUTH)
    rows = [(f"old/results/{name}", f"{name}.csv") for name in ("x", "y")]
    pairs = tmp_path / "pairs.csv"
    write_csv(pairs, ("results", "ground_truth"), rows)
    done = command("--pairs", pairs, "--compare", old, new)
    assert "y frames 5-24, ID.1: right in 2 -> 3 of 20" in done.stdout
    assert "x frames 5-24, ID.1: right in 2 -> 1 of 20" in done.stdout
    assert compared(new) == {"", "x", "y"}
    write_csv(pairs, ("results", "ground_truth"), rows[:1])
    assert "new/results/y" in command("--pairs", pairs, "--compare", old, new, code=3).stderr
    (new / "y").rename(new / "z")
    told = command("--pairs", pairs, "--compare", old, new, code=3).stderr
    assert f"y: is in {old} only" in told
    assert f"z: is in {new} only" in told


def test_a_log_that_cannot_be_compared_is_left_out_of_several(tmp_path: Path) -> None:
    """Of another recording, or without a frame in common; it still counts as one of several."""
    digests, right = {name: name * 64 for name in "xyz"}, {"x": {5}, "y": {5, 6}, "z": {7}}
    old = several(tmp_path / "old", digests, right)
    new = several(tmp_path / "new", digests | {"y": "d" * 64}, right)
    (new / "z" / "frames.csv").write_text("frame\n99\n")
    (new / "z" / "estimates.csv").write_text(",".join(ESTIMATE_HEADER) + "\n")
    rows = [(name, *row) for name in right for row in TRUTH]
    write_csv(tmp_path / "gt.csv", ("log", *TRUTH_HEADER), rows)
    sides = ["--compare", old, new, "--ground-truth"]
    done = command(*sides, tmp_path / "gt.csv", code=3)
    first, second = done.stderr.splitlines()
    assert f"{old / 'y'} and {new / 'y'}: results" in first
    assert first.endswith("; y is not compared")
    assert f"sonarrec: {old / 'z'} and {new / 'z'}" in second
    assert compared(new) == {""}
    write_csv(tmp_path / "one.csv", TRUTH_HEADER, TRUTH)
    assert "holds 3 logs (x, y" in command(*sides, tmp_path / "one.csv", code=1).stderr


def test_other_new_results_of_a_recording_are_not_compared(tmp_path: Path) -> None:
    a, names = "a" * 64, ("x", "y")
    old = several(tmp_path / "old", dict.fromkeys(names, a), {"x": {5}, "y": {6}})
    new = several(tmp_path / "new", dict.fromkeys(names, a), {"x": {5}, "y": {6}})
    rows = [(name, *row) for name in names for row in TRUTH]
    write_csv(tmp_path / "gt.csv", ("log", *TRUTH_HEADER), rows)
    done = command("--compare", old, new, "--ground-truth", tmp_path / "gt.csv", code=3)
    (other,) = done.stderr.splitlines()
    assert other.endswith("not compared")


def test_pairs_that_name_no_truth_at_all(tmp_path: Path) -> None:
    """In a short line, however many logs there are."""
    digests = {name: name * 64 for name in "abc"}
    out = several(tmp_path / "out", digests, {name: {5} for name in digests})
    new = several(tmp_path / "new", digests, {name: {5} for name in digests})
    pairs = tmp_path / "pairs.csv"
    write_csv(pairs, ("results", "ground_truth"), [])
    for words in ([], ["--compare", out, new]):
        assert f"sonarrec: {pairs}" in command("--pairs", pairs, *words, code=1).stderr
    write_csv(pairs, ("results", "ground_truth"), [("elsewhere", "gt.csv")])
    told = command("--pairs", pairs, "--compare", out, new, code=1).stderr
    assert f"sonarrec: {new / 'c'}: " in told


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--pairs", "p.csv", "--ground-truth", "p.csv"], "--pairs"),
        (["--compare", "a", "b", "c"], "--compare names both results"),
        (["--compare", "a", "b", "--details"], "--compare names both results"),
    ],
)
def test_options_that_do_not_go_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.csv").write_text("results,ground_truth\n")
    assert says in command(*arguments, code=2).stderr


def test_pairs_are_pooled(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    alone = []
    for name in ("one", "two"):
        frames, estimates, truth = random_case(rng)
        alone.append(evaluate(*write_case(tmp_path / name, frames, estimates, truth)))
    rows = [(f"{n}/out", f"{n}/gt.csv", n) for n in ("one", "two")]
    write_csv(tmp_path / "pairs.csv", ("results", "ground_truth", "log"), rows)
    pairs = read_pairs(tmp_path / "pairs.csv")
    pooled = evaluate_logs(pairs)
    assert pooled.counts.logs == ("one", "two")
    for protocol in ("paper", "strict"):
        parts = [scored(one, protocol) for one in alone]
        whole = scored(pooled, protocol)
        for i, part in enumerate(parts):
            for k in (None, 0, 1, 2, 3):
                assert counts(whole, k, i) == counts(part, k)
    # The same from the command line; results lie beside the table.
    done = command("--pairs", tmp_path / "pairs.csv", "--details")
    assert "per log" in done.output
    rows = read_rows(tmp_path / "evaluation" / "figures.csv")
    assert {row["log"] for row in rows} == {"", "one", "two"}
    # Without names both are called "out", and told apart by their folders.
    unnamed = evaluate_logs([Pair(p.results, p.ground_truth) for p in pairs])
    assert unnamed.counts.logs == tuple(str(p.results) for p in pairs)


def test_a_row_that_names_no_results_or_truth_is_left_out(tmp_path: Path) -> None:
    """And told; its truth is not read. Results are of one log."""
    for name in ("a", "b"):
        write_case(tmp_path / name, FRAMES, claims({5}), TRUTH)
    (tmp_path / "bad.csv").touch()
    pairs = tmp_path / "pairs.csv"
    rows = [("c/out", "bad.csv"), ("a/out", "a/gt.csv"), ("both", "bad.csv"), ("b/out", "no.csv")]
    write_csv(pairs, ("results", "ground_truth"), rows)
    (tmp_path / "both").mkdir()
    for name in ("a", "b"):
        (tmp_path / "both" / name).symlink_to(tmp_path / name / "out")
    done = command("--pairs", pairs, "-q", code=3)
    told = [line for line in done.stderr.splitlines() if ": note: " not in line]
    for line, left_out in zip(told, ("c/out", "both", "no.csv"), strict=True):
        assert line.startswith(f"sonarrec: {tmp_path / left_out}: ")
        assert line.endswith("; not scored")
    write_csv(pairs, ("results", "ground_truth"), rows[:1])
    done = command("--pairs", pairs, code=2)
    assert done.output.startswith(f"sonarrec: {tmp_path / 'c/out'}: ")
    assert done.output.count("\n") == 1


def test_a_comparison_says_what_a_score_says_of_each_log(tmp_path: Path) -> None:
    """A log that lacked a method, or rows of truth, was counted without a word."""
    both = claims({5, 6}) + claims({5}, method="n")
    for side in ("old", "new"):
        for log in ("a", "b"):
            kept = claims({5}) if (side, log) == ("new", "b") else both
            write_case(tmp_path / side / f"{log}.case", FRAMES, kept, [])
            (tmp_path / side / f"{log}.case" / "out").rename(tmp_path / side / log)
    write_csv(tmp_path / "gt.csv", [*TRUTH_HEADER, "log"], [(*row, "a") for row in TRUTH])
    *_, empty, lacking, units = compare(
        tmp_path / "old", tmp_path / "new", tmp_path / "gt.csv"
    ).notes
    assert empty.startswith("b: no row in the ground truth")
    assert lacking.startswith(f"{tmp_path / 'new'}: b: has no estimates of n")
    assert "2 logs here have 2" in units
    scored_alone = evaluate(tmp_path / "new", tmp_path / "gt.csv").notes
    assert {empty, lacking.partition(": ")[2]} <= {*scored_alone}
