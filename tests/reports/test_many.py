"""The page on many logs: some have panels, the figures are of all, and it stays small."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.reports.build import report
from sonarrec.reports.logs import MOST_LOGS
from sonarrec.reports.page import ROWS_OPEN
from tests.support.command import sonarrec
from tests.support.made_up import make_logs
from tests.support.pages import tables

MANY = 60
MOST_BYTES = 800_000
"""Of a page without pictures: 8 logs with panels of some 40 kB, tables and curves of 300 kB."""


def section(text: str, name: str) -> str:
    return text[text.index(f'<section id="{name}"') :].partition("</section>")[0]


def panels(text: str) -> int:
    return len(re.findall(r"<h3>log\d+</h3>", section(text, "panels")))


@pytest.mark.slow
def test_some_have_panels_the_figures_are_of_all_and_the_page_is_small(tmp_path: Path) -> None:
    """Without truth as well; then the logs that have no panel are not read."""
    make_logs(made := tmp_path / "made", MANY, 200, 6)
    rows = ["log,frame,landmark,range_m,bearing_deg"]
    for n in range(MANY):
        own = (made / f"kind{n % 6}" / "gt.csv").read_text(encoding="utf-8")
        rows += [f"log{n:04d},{line}" for line in own.splitlines()[1:]]
    (gt := tmp_path / "gt.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    page, bare = tmp_path / "page.html", tmp_path / "bare.html"
    sonarrec("report", made / "out", "--ground-truth", gt, "-o", page)
    text = page.read_text(encoding="utf-8")
    assert panels(text) == MOST_LOGS
    listed = section(text, "logs").partition("<details>")
    rows = [part.count('<tr><th scope="row" class="text">') for part in listed]
    assert rows == [ROWS_OPEN, 0, MANY - ROWS_OPEN]
    count = evaluate_logs(made / "out", gt).counts.count("framework", "strict")
    assert f"framework: {count.fp:,} false claims, {count.fn} missed" in section(text, "mistakes")
    sonarrec("report", made / "out", "-o", bare)
    assert max(file.stat().st_size for file in (page, bare)) < MOST_BYTES


PLACED = "frame,method,object,range_m,bearing_deg,landmark,score,declared"
RIGHT = [f"{n},framework,1,2.0,0,1,.9,1" for n in range(10, 20)]


def plain_logs(root: Path, estimates: dict[str, list[str]], truth: list[str]) -> Path:
    """Logs of 40 frames in folders, by name their estimates.csv, and their truth."""
    for n, (name, lines) in enumerate(estimates.items()):
        tables(root / "out" / name, range(40), lines[0], lines[1:])
        run = f'finished = true\n[input]\nname = "{name}"\nsha256 = "{n:064x}"\n'
        (root / "out" / name / "run.toml").write_text(run)
    lines = ["log,frame,landmark,range_m,bearing_deg", *truth, ""]
    (root / "gt.csv").write_text("\n".join(lines))
    return root / "out"


def test_the_page_of_many_logs_begins_with_a_line_on_all(tmp_path: Path) -> None:
    """Its rates are those of `evaluate`; mistakes are those of the first method alone."""
    absent, single = "30,framework,1,2.0,0,2,.8,1", "31,smi,0,2.0,0,3,.8,1"
    logs = {"a": [PLACED, *RIGHT, absent, single], "b": [PLACED, *RIGHT]}
    out = plain_logs(tmp_path, logs, [f"{log},{n},1,2.0,0" for log in logs for n in range(10, 30)])
    report(out, page := tmp_path / "page.html", ground_truth=tmp_path / "gt.csv")
    text = page.read_text(encoding="utf-8")
    line = text[text.index('class="headline"') :].partition("</p>")[0]
    for fact in ("2 of 2 logs", "TPR 0.500", "1.25 false claims"):  # one in 80 frames
        assert fact in line
    assert "<h3>framework" in section(text, "mistakes")
    assert "<h3>smi" not in section(text, "mistakes")


def test_mistakes_are_told_as_all_logs_are_scored(tmp_path: Path) -> None:
    """The last log lacks positions, so that protocol paper alone is scored; it has no panel, and
    of those that have, a claim of ID.1 three metres off is no mistake in it."""
    far = [f"{n},framework,1,5.0,0,1,.9,1" for n in range(10, 20)]
    absent = "30,framework,1,2.0,0,2,.8,1"
    estimates = {f"log{n:02d}": [PLACED, *far, absent] for n in range(MOST_LOGS)}
    head = "frame,method,landmark,score,declared"
    estimates[f"log{MOST_LOGS:02d}"] = [head, *(f"{n},framework,1,.9,1" for n in range(10, 20))]
    truth = [f"{log},{n},1,2.0,0" for log in estimates for n in range(10, 20)]
    out = plain_logs(tmp_path, estimates, truth)
    found = evaluate_logs(out, tmp_path / "gt.csv").counts
    count = found.count("framework", "paper")
    assert (count.fp, count.fn) == (MOST_LOGS, 0)
    report(out, page := tmp_path / "page.html", ground_truth=tmp_path / "gt.csv")
    text = page.read_text(encoding="utf-8")
    assert panels(text) == MOST_LOGS
    told = section(text, "mistakes")
    assert f"framework: {MOST_LOGS} false claims, 0 missed" in told
    assert told.count("ID.2 declared (0.80) while") == 1
    assert f"<summary>{MOST_LOGS} logs</summary>" in told
    assert "ID.1" not in told.partition("smi: ")[0]
