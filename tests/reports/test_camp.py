"""The report, evaluate and overlay of many logs: real ones with faults, and made-up ones."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.reports.build import report
from sonarrec.reports.logs import MOST_LOGS
from sonarrec.reports.page import ROWS_OPEN
from tests.support.browser import look
from tests.support.camp import BROKEN, OTHER_SET, WITHOUT_TRUTH, WORST, make_camp
from tests.support.command import sonarrec
from tests.support.made_up import make_logs
from tests.support.pages import Page, tables
from tests.support.rows import read_rows

MANY = 60
MOST_BYTES = 800_000
"""Of a page without pictures: 8 logs with panels of some 40 kB, tables and curves of 300 kB."""


def results_of(folder: Path, count: int, frames: int, *, trouble: bool, code: int = 0) -> Path:
    make_camp(folder / "camp", count, frames, trouble)
    out = folder / "out"
    sonarrec("run", folder / "camp", "--recursive", "-q", "-j", 1, "-o", out, code=code)
    return out


def test_one_of_two_lacks_truth(tmp_path: Path) -> None:
    """The other one is scored, and the page says so. One truth beside both that names none of
    them is told, too."""
    out = results_of(tmp_path, 2, 6, trouble=False)
    truth = tmp_path / "camp" / "dive02" / "gt.csv"
    text = truth.read_text()
    truth.unlink()
    told = sonarrec("report", out, code=3)
    assert "dive02: no ground" in told.stderr
    page = Page(out / "report.html")
    for fact in ("1 of them scored against gt.csv", "1 of 2 logs", "1 without ground truth"):
        assert fact in page.text
    scored, other, note = page.named["All logs"][2:]
    assert scored[0] == "dive01"
    found = evaluate_logs(out / "dive01").counts
    one, smi = (found.count(method, "strict") for method in ("framework", "smi"))
    rates, others = ([f"{c.tpr:.4f}", f"{c.fpr:.4f}"] for c in (one, smi))
    per_100 = f"{100 * one.fp / 6:.2f}"
    assert scored[1:] == ["done", "6", *rates, str(one.fn), str(one.fp), per_100, *others]
    assert one.tpr > 0.5
    assert other == ["dive02", "done", "6", *["-"] * 7]
    assert note == ["no ground truth"]
    (tmp_path / "camp" / "dive01" / "gt.csv").unlink()
    for name in ("dive01", "dive02"):
        (tmp_path / "camp" / f"{name}.gt.csv").symlink_to("gt.csv")
    (tmp_path / "camp" / "gt.csv").write_text(text)
    told = sonarrec("report", out, code=3)
    assert "log column" in told.stderr
    assert "nothing is scored" in told.stderr
    assert "ground truth" in Page(out / "report.html").text


@pytest.fixture(scope="module")
def camp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of twenty logs and their report."""
    out = results_of(tmp_path_factory.mktemp("twenty"), 20, 12, trouble=True, code=3)
    told = sonarrec("report", out, code=3).stderr.splitlines()
    assert len(told) == 2
    assert f"{WITHOUT_TRUTH}: no ground" in told[0]
    assert f"{OTHER_SET}: landmark IDs 11, 12, 13, 14" in told[1]
    return out


@pytest.mark.slow
def test_twenty_logs_are_listed_the_worst_first(camp: Path) -> None:
    page = Page(camp / "report.html")
    assert "20 recorded sonar" in page.text
    rows = page.named["All logs"][2:]
    assert [row[:2] for row in rows if len(row) > 1][:2] == [[BROKEN, "failed"], [WORST, "done"]]
    assert "unreadable image" in rows[1][0]
    unscored = ["done", "12", *["-"] * 7]
    assert rows[-4::2] == [[OTHER_SET, *unscored], [WITHOUT_TRUTH, *unscored]]
    assert rows[-3::2] == [["another landmark set"], ["no ground truth"]]
    assert len({row[0] for row in rows if len(row) > 1}) == 20
    good = [float(row[3]) - float(row[4]) for row in rows if row[3:] and row[3] != "-"]
    assert good == sorted(good)
    assert len(good) == 17
    text = (camp / "report.html").read_text()
    shown = re.findall(r'<details class="log"( open)?>\s*<summary><h3>(.*?)</h3>', text)
    assert len(shown) == MOST_LOGS
    assert [name for is_open, name in shown if is_open] == [WORST]


@pytest.mark.slow
def test_equal_mistakes_are_one_line_and_frames_can_be_known(camp: Path) -> None:
    page = Page(camp / "report.html")
    found = evaluate_logs(camp).counts
    at_start = {m.log for m in found.mistakes if m.at_start}
    assert len(at_start) > 10
    rows = page.named["Mistakes of framework"][1:]
    (unknowable,) = (row for row in rows if "first frame" in row[2])
    assert unknowable[0].startswith(f"{len(at_start)} logs")
    assert unknowable[3] == "frame 0"
    assert len({row[2] for row in rows}) == len(rows)
    mistakes = page.text[page.text.index("Mistakes, the longest first\n") :]
    pictured = re.findall(r"(dive\d\d), frame\s+(\d+):\s+(.*)", mistakes.partition("smi: ")[0])
    assert any(log == WORST and what.startswith("ID.3 in view") for log, _, what in pictured)
    assert all(number != "0" for _, number, _ in pictured)
    total = found.count("framework", "strict")
    assert re.search(rf"framework: {total.fp} false claims?, {total.fn} missed", page.text)


@pytest.mark.slow
def test_evaluate_and_overlay_of_twenty(camp: Path, tmp_path: Path) -> None:
    done = sonarrec("evaluate", camp, "-o", tmp_path / "e", code=3)
    assert len(done.stderr.splitlines()) == 2
    assert f"note: 1 log failed: {BROKEN} (logs.csv says" in done.stdout
    rows = read_rows(tmp_path / "e" / "mistakes.csv")
    assert len({row["log"] for row in rows}) == 17
    worst = [row for row in rows if (row["method"], row["at_start"]) == ("framework", "0")]
    shots = tmp_path / "shots"
    drawn = sonarrec("overlay", camp, "-o", shots, "--mistakes", 3, code=3).stdout
    expected = {f"{row['log']}/{int(row['worst_frame']):06d}.png" for row in worst[:3]}
    assert {str(p.relative_to(shots)) for p in shots.rglob("*.png")} == expected
    assert drawn.count(": ID.") == min(3, len(worst))
    refused = sonarrec("overlay", camp, "-o", tmp_path / "x.mp4", code=2).stderr
    assert "19 logs" in refused


@pytest.mark.slow
@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (420, "dark")])
def test_twenty_logs_in_a_browser(browser: Any, camp: Path, width: int, scheme: str) -> None:
    found = look(browser, camp / "report.html", width, scheme)
    assert (found["console"], found["broken"], found["outside"]) == ([], 0, [])
    assert found["wide"] <= 0
    browser.get((camp / "report.html").as_uri())
    height = browser.execute_script("return document.documentElement.scrollHeight")
    assert height < 16 * 900
    second = browser.find_elements("css selector", "#logs a")[1]
    panel = browser.find_elements("css selector", "details.log")[1]
    assert panel.get_attribute("open") is None
    second.click()
    assert panel.get_attribute("open") is not None
    assert panel.find_element("css selector", "h3").text == second.text


@pytest.mark.slow
def test_log_names_one_without_a_panel(camp: Path, tmp_path: Path) -> None:
    rows = [row[0] for row in Page(camp / "report.html").named["All logs"] if len(row) > 3]
    page = tmp_path / "x.html"
    alone = sonarrec("report", camp, "--log", camp.parent / "camp" / rows[-3], "-o", page, code=3)
    assert " 0 pictures" in alone.stdout
    told = sonarrec("report", camp, "--log", camp / "dive02", "--log", tmp_path, "-o", page, code=2)
    assert "these logs" in told.stderr


@pytest.mark.slow
def test_a_results_folder_that_cannot_be_read_costs_itself(camp: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(camp, out, ignore=shutil.ignore_patterns("report.html"))
    (out / "dive20" / "estimates.csv").write_text("frame,method\n0,smi\n")
    truth = tmp_path / "gt.csv"
    lines = ["log,frame,landmark,x_px,y_px"]
    for n in (1, 2, 4, 20):
        own = camp.parent / "camp" / f"dive{n:02d}" / "gt.csv"
        lines += [f"dive{n:02d},{','.join(list(r.values())[:4])}" for r in read_rows(own)]
    truth.write_text("\n".join(lines) + "\n")
    page = tmp_path / "x.html"
    told = sonarrec("report", out, "--ground-truth", truth, "-o", page, code=3).stderr
    assert "estimates.csv: wrong" in told
    rows = Page(page).named["All logs"]
    assert ["dive20", "done"] in [row[:2] for row in rows]


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
