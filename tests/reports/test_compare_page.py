"""The page of two results: its numbers against the comparison's, and what it needs from outside."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sonarrec.evaluation.compare import compare
from tests.evaluation.test_evaluation import write_case
from tests.support.command import sonarrec
from tests.support.pages import Page

FRAMES = range(400)
PASSES = 8


@pytest.fixture
def sides(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Eight passes of ID.1, 20 frames each: the new results lose the first half of six of them,
    gain one that the old ones never claimed, and invent ID.2 in frame 45 no more."""
    truth = [(50 * n + i, 1, 2.0, 0.0, 1.0) for n in range(PASSES) for i in range(20)]
    right = [(f, "m", 2.0, 0.0, 1, 0.9, 1) for f, *_ in truth]
    old = [c for c in right if c[0] // 50 != 7] + [(45, "m", 3.0, 0.0, 2, 0.8, 1)]
    new = [c for c in right if c[0] // 50 >= 6 or c[0] % 50 >= 10]
    a, gt = write_case(tmp_path / "old", FRAMES, old, truth)
    b, _ = write_case(tmp_path / "new", FRAMES, new, truth)
    return a, b, gt


def test_the_page_tells_what_the_comparison_found(sides: tuple[Path, Path, Path]) -> None:
    old, new, gt = sides
    done = sonarrec("report", "--compare", old, new, "--ground-truth", gt)
    path = new / "compare.html"
    assert done.stdout.startswith(f"{path}: ")
    page = Page(path)
    found = compare(old, new, gt)
    tests = {
        d.name: d for d in found.differences if (d.protocol, d.landmark_text) == ("strict", "total")
    }
    assert f"{new} is worse than {old}" in page.text
    assert (
        "TPR 0.8750 -> 0.6250, FPR 0.0007 -> 0.0000 (m, strict); 1 of 8 passes gained" in page.text
    )
    rows = {row[0]: row for row in page.tables["m, protocol strict"][1:]}
    assert rows["TPR"][1:3] == ["0.875", "0.625"]  # 140 and 100 of 160 frames
    assert rows["TPR"][4] == f"{tests['tpr'].p:.2g}"
    assert f"{tests['tpr'].low:+.3f} to {tests['tpr'].high:+.3f}" in rows["TPR"][3]
    assert rows["FPR"][1:3] == ["0.0007", "0.0000"]  # 1 of 1440 frames and absent IDs
    per_id = {row[0]: row for row in page.tables["m, protocol strict, per ID"][1:]}
    assert per_id["ID.1 TPR"][1:3] == ["0.875", "0.625"]
    assert "ID.3 TPR" not in per_id
    # What got worse, then what got better: passes, then frames.
    text = path.read_text(encoding="utf-8")
    worse, better = text[text.index('id="worse"') :].split('<section id="better">')
    assert [worse.count(x) for x in ("<td>20</td><td>20</td>", "TP</td>")] == [6, 6]
    assert "350 to 369" in better
    assert re.search(r">45</th>.*ID\.2.*FP</td>.*TN</td>", better)


def test_further_results_have_a_page_each(sides: tuple[Path, Path, Path]) -> None:
    old, new, gt = sides
    done = sonarrec("report", "--compare", old, new, old, "--ground-truth", gt)
    assert [line.partition(":")[0] for line in done.stdout.splitlines()] == [
        str(new / "compare.html"), str(old / "compare.html"),
    ]  # fmt: skip
    assert f"{old} is as good as {old}" in Page(old / "compare.html").text


def test_the_page_needs_nothing_else(sides: tuple[Path, Path, Path]) -> None:
    old, new, gt = sides
    sonarrec("report", "--compare", old, new, "--ground-truth", gt, "-q")
    page = Page(new / "compare.html")
    assert not any(tag in ("script", "link", "img", "iframe") for tag, _ in page.elements)
    assert "http" not in page.text
    policies = [a["content"] for t, a in page.elements if t == "meta" and "http-equiv" in a]
    assert policies == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--compare", "a", "b", "c", "-o", "x.html"], "--out names one page"),
        (["a", "b"], "several RESULTS need --compare"),
        (["--compare", "a", "b", "--log", "c"], "leave out --log"),
        (["--compare", "a", "b", "--pairs", "p.csv", "--ground-truth", "p.csv"], "--pairs"),
    ],
)
def test_options_that_do_not_go_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.csv").write_text("results,ground_truth\n")
    assert says in sonarrec("report", *arguments, code=2).stderr
