"""A person labels a campaign on its pages: what is saved against the simulator's truth."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonarrec.results.read import read_log
from sonarrec.truth.match import match_truth
from sonarrec.truth.table import read_truth
from tests.support.browser import look
from tests.support.command import SAMPLE, sonarrec
from tests.support.review_page import SHIFT, Page
from tests.support.rows import read_rows

pytestmark = pytest.mark.slow
WIDE = """
name = "wide"
seed = 4
frames = 40
[sonar]
layout = "polar"
field_of_view_deg = 90.0
[motion]
pan_min_deg = -20.0
pan_max_deg = 20.0
pan_start_deg = -20.0
pan_deg_s = 4.0
[[landmark]]
id = 2
ground_m = 1.9
azimuth_deg = -14.0
[[landmark]]
id = 4
ground_m = 2.3
azimuth_deg = 15.0
[[object]]
kind = "stone"
ground_m = 2.0
azimuth_deg = 1.0
"""
EMPTY = """
name = "empty"
seed = 5
frames = 24
[[object]]
kind = "stone"
ground_m = 2.0
azimuth_deg = 1.0
"""


@pytest.fixture(scope="module")
def camp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders logs and truths (of the simulator), and the results in out."""
    folder = tmp_path_factory.mktemp("camp")
    (folder / "truths").mkdir()
    for name in ("pan", "polar"):
        shutil.copytree(SAMPLE.with_name(name), folder / "logs" / name)
    for name, scene in (("wide", WIDE), ("empty", EMPTY)):
        (folder / f"{name}.toml").write_text(scene)
        out = folder / "logs" / name
        sonarrec("simulate", "--scene", folder / f"{name}.toml", "-o", out, "-q")
    for log in (folder / "logs").iterdir():
        (log / "gt.csv").rename(folder / "truths" / f"{log.name}.gt.csv")
    sonarrec("run", folder / "logs", "--recursive", "-o", folder / "out", "-q")
    return folder


@pytest.fixture
def page(browser: Any, camp: Path, tmp_path: Path) -> Page:
    """That of the log pan."""
    made = tmp_path / "pan.html"
    sonarrec("truth", "review", camp / "logs" / "pan", "--results", camp / "out", "-o", made)
    return Page(browser, made, tmp_path)


def pixels(results: Path, truth: Path) -> dict[tuple[int, int], tuple[float, float]]:
    """Where a truth has its landmarks, by ID and frame."""
    log = read_log(results)
    assert log.fan is not None
    matched = match_truth(read_truth(truth), log)
    places = matched.pixels(log.fan)
    assert places is not None
    ids = np.array(log.landmarks.ids)[matched.landmark_index]
    frames = log.frame[matched.frame_index]
    keys = zip(ids.tolist(), frames.tolist(), strict=True)
    return dict(zip(keys, map(tuple, places.tolist()), strict=True))


def test_a_campaign_is_labelled(browser: Any, camp: Path, tmp_path: Path) -> None:
    """What the recogniser declares is accepted on every page, from each to the next by a key."""
    pages, labelled = tmp_path / "pages", tmp_path / "labelled"
    sonarrec("truth", "review", camp / "logs", "--results", camp / "out", "-o", pages)
    labelled.mkdir()
    look(browser, pages / "index.html", 1280, "dark")
    browser.execute_script("localStorage.clear()")
    page = Page(browser, pages / "empty.html", tmp_path)
    names = ["empty", "pan", "polar", "wide"]
    for name in names:
        assert browser.find_element("css selector", "h1").text == name
        while any(state == "open" for *_, state in page.passes):
            page.press("a")
        saved, passes = page.save(), page.passes
        assert saved.name == f"{name}.gt.csv"
        browser.refresh()
        assert page.passes == passes
        shutil.copy(saved, labelled)
        page.press("l")
    # The start page, on which the last one ends, knows of all.
    assert browser.current_url.endswith("index.html")
    cells = [cell.text for cell in browser.find_elements("css selector", ".open")]
    assert cells == ["0"] * 4
    for name in names[1:]:
        truth = pixels(camp / "out" / name, camp / "truths" / f"{name}.gt.csv")
        made = pixels(camp / "out" / name, labelled / f"{name}.gt.csv")
        off = [np.subtract(made[key], truth[key]) for key in made.keys() & truth.keys()]
        assert len(off) > 0.6 * len(truth)
        assert np.quantile(np.hypot(*np.transpose(off)), 0.95) < 4
    # Both commands find what was saved, in one folder.
    assert sonarrec("truth", "check", labelled, camp / "logs").stdout.count("rows, ") == 4
    sonarrec("evaluate", camp / "out", "--ground-truth", labelled, "-q")


def test_ends_of_a_pass(browser: Any, page: Page, camp: Path) -> None:
    """By keys and by a drag on the bar: cut, and carried on by the motion; undone."""
    truth = pixels(camp / "out" / "pan", camp / "truths" / "pan.gt.csv")
    whole = page.passes
    landmark, first, last, _ = whole[0]
    page.choose(landmark, first)
    page.go(first + 9)
    page.press("b")
    assert page.passes[0][:3] == [landmark, first + 9, last]
    page.go(first + 25)
    page.press("e")
    assert page.passes[0][1:3] == [first + 9, first + 25]
    lane, lanes = browser.execute_script(
        "const [of, count] = lanesOf(); return [of.get(passes[0].id), count]"
    )
    page.strip(first + 26, first + 14, lane=(1.6 + lane + 0.35) / (1.6 + lanes))
    assert page.passes[0][1:3] == [first + 9, first + 14]
    page.press(SHIFT, "b")
    page.press(SHIFT, "e")
    begun = page.passes[0][1]
    made = browser.execute_script(
        "return current().rows.filter(r => r.made && r.visible > 0.9).map(r => [r.frame, r.x, r.y])"
    )
    assert len(made) > 15
    assert begun <= first + 1
    for frame, x, y in made:
        assert np.hypot(*np.subtract((x, y), truth[landmark, frame])) < 4, frame
    page.press("u", "u", "u", "u", "u")
    assert page.passes == whole
    # Without motion it stays in its pixel, as far as it is told, and the page says so.
    browser.execute_script("data.poses = {}")
    page.press(SHIFT, "e")
    assert page.passes == whole
    page.choose(landmark, first)
    end = page.passes[0][2]
    page.strip(end + 3)
    page.press("e")
    assert page.passes[0][2] == end + 3
    assert "not known" in page.text("say")


def decided(page: Page) -> Counter[tuple[Any, ...]]:
    return Counter((*span, state) for _, *span, state in page.passes if state != "open")


def test_rejections_and_pieces_come_back(browser: Any, camp: Path, tmp_path: Path) -> None:
    """A page made anew knows what was rejected, and a pass with a gap as one."""
    log = shutil.copytree(camp / "logs" / "pan", tmp_path / "pan")
    out, made = camp / "out", tmp_path / "pan.html"
    where = ("--results", out / "pan", "-o", made)
    sonarrec("truth", "review", log, *where)
    page = Page(browser, made, tmp_path)
    page.press("r", "a")
    landmark, first, *_ = next(one for one in page.passes if one[3] == "accepted")
    page.choose(landmark, first)
    page.go(first + 12)
    for _ in range(14):
        page.press("x", "\ue014")
    before = decided(page)
    saved = page.save()
    rejected = [row for row in read_rows(saved) if row["landmark"] == "none"]
    assert rejected
    shutil.copy(saved, tmp_path / "pan.gt.csv")  # beside the log
    sonarrec("truth", "review", log, *where)
    again = Page(browser, made, tmp_path)
    assert decided(again) == before
    assert len(again.passes) == len(page.passes)


def test_a_whole_pass_is_shifted(browser: Any, page: Page) -> None:
    """By as much on the floor in each frame, though the sonar pans."""
    places = "return current().rows.map(r => floorFromPixel(fan, r.x, r.y))"
    rows = browser.execute_script("return current().rows")
    before = np.array(browser.execute_script(places), dtype=float)
    now = int(browser.execute_script("return now"))
    [at] = [row for row in rows if row["frame"] == now]
    page.press("m")
    page.pointer(at["x"], at["y"], drag=(9, -6))
    by = np.array(browser.execute_script(places), dtype=float) - before
    size = np.linalg.norm(by, axis=1)
    assert size.min() > 0.05
    assert np.ptp(size) < 0.01
    yaws = "return current().rows.map(r => data.poses[r.frame]).map(p => Math.atan2(p[1], p[0]))"
    pan = np.array(browser.execute_script(yaws), dtype=float)
    rotated = np.unwrap(np.arctan2(by[:, 1], by[:, 0])) - pan
    assert np.ptp(pan) > 0.1
    assert np.ptp(rotated) < 0.02
    page.press("u")
    assert browser.execute_script(places) == before.tolist()


def test_the_start_page_reads_saved_tables(browser: Any, camp: Path, tmp_path: Path) -> None:
    """Where the browser shares no storage between pages: it says so, and takes the tables."""
    pages = tmp_path / "pages"
    sonarrec("truth", "review", camp / "logs", "--results", camp / "out", "-o", pages)
    look(browser, pages / "index.html", 1280, "dark")
    browser.execute_script("localStorage.clear()")
    found = look(browser, pages / "index.html", 390, "dark")
    assert found["console"] == []
    assert found["wide"] <= 0
    assert "choose the saved tables" in browser.find_element("id", "where").text
    saved = tmp_path / "pan.gt.csv"
    saved.write_text(
        "frame,landmark,x_px,y_px,visible,track,source\n"
        "1,1,50,60,1,1,\n2,1,50,60,1,1,\n1,none,9,60,1,2,\n1,3,70,60,1,3,tracked\n"
    )
    other = tmp_path / "other.gt.csv"
    other.write_text("frame,landmark\n")
    browser.find_element("id", "files").send_keys(f"{saved}\n{other}")
    row = browser.find_element("css selector", "[data-log='1']")
    cells = [cell.text for cell in row.find_elements("css selector", "th, td")]
    assert (cells[0], cells[2:5]) == ("pan", ["3", "2", "1"])
    assert "4 rows" in cells[-1]
    assert "other.gt.csv" in browser.find_element("id", "where").text


def test_two_tabs(browser: Any, page: Page) -> None:
    first = browser.current_window_handle
    browser.switch_to.new_window("tab")
    second = browser.current_window_handle
    try:
        browser.get(page.page.as_uri())
        told = "document.getElementById('twin').checkVisibility()"
        assert browser.execute_script(f"return new Promise(r => setTimeout(() => r({told}), 300))")
        browser.switch_to.window(first)
        page.press("a")
        browser.switch_to.window(second)
        before = page.passes
        page.press("r")  # not before it is loaded again
        assert page.passes == before
        browser.find_element("css selector", "[data-act=again]").click()
        assert [one[3] for one in page.passes].count("accepted") == 1
    finally:
        browser.close()
        browser.switch_to.window(first)
