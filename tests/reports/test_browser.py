"""The report's page in a real browser: what it looks like, and what a click does."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.browser import COLOURS, contrast, look

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("name", "width", "scheme"),
    [
        ("full", 1280, "light"),
        ("full", 400, "dark"),
        ("bare", 1280, "dark"),
        ("bare", 400, "light"),
    ],
)
def test_in_a_browser(
    browser: Any, pages: dict[str, Path], name: str, width: int, scheme: str
) -> None:
    found = look(browser, pages[name], width, scheme)
    assert found["console"] == []
    assert found["broken"] == 0
    assert (found["pictures"] > 6) == (name == "full")
    assert found["wide"] <= 0
    assert found["outside"] == []
    page, text, drawn = browser.execute_script(COLOURS)
    assert (sum(page[:3]) > 600) == (scheme == "light")
    # WCAG 2 AA: 4.5 for text, 3 for what is drawn.
    assert min(contrast(colour, page) for colour in text) >= 4.5
    assert min(contrast(colour, page) for colour in drawn) >= 3


# Clicks


def shown(browser: Any) -> dict[str, Any]:
    """What the viewer shows: its texts, its image, and the marks on it by their kind."""
    found: dict[str, Any] = browser.execute_script(
        """
const viewer = document.getElementById('viewer');
const image = document.getElementById('viewer-image');
const marks = {};
for (const m of viewer.querySelectorAll('ellipse'))
  (marks[m.getAttribute('class')] ||= []).push(m.getBoundingClientRect().toJSON());
return {
  open: !viewer.hidden && viewer.checkVisibility(),
  title: document.getElementById('viewer-title').textContent,
  note: document.getElementById('viewer-note').textContent,
  method: document.getElementById('viewer-method').value,
  labels: [...viewer.querySelectorAll('text')].map(t => t.textContent),
  image: image.src, alt: image.alt, loaded: image.complete && image.naturalWidth > 0,
  box: image.getBoundingClientRect().toJSON(), marks,
};"""
    )
    return found


def nearest(some: list[dict[str, float]], others: list[dict[str, float]]) -> float:
    """Pixels between the centres of the two boxes nearest to each other."""
    a, b = (
        np.array([[m["x"] + m["width"] / 2, m["y"] + m["height"] / 2] for m in boxes])
        for boxes in (some, others)
    )
    return float(np.linalg.norm(a[:, None] - b[None], axis=2).min())


def click_at(browser: Any, chart: Any, share: float) -> None:
    """At a share of a chart's width, from its left."""
    from selenium.webdriver import ActionChains

    browser.execute_script("arguments[0].scrollIntoView({block: 'start'})", chart)
    beside = (share - 0.5) * chart.size["width"]
    ActionChains(browser).move_to_element_with_offset(chart, round(beside), 0).click().perform()


def find(browser: Any, selector: str) -> list[Any]:
    found: list[Any] = browser.find_elements("css selector", selector)
    return found


def test_a_click_on_a_bar_shows_its_frame(browser: Any, pages: dict[str, Path]) -> None:
    look(browser, pages["full"], 400, "light")
    assert not shown(browser)["open"]
    for method in ("framework", "smi"):
        lane = find(browser, f"#seen .lane[data-method='{method}']:not(.truth)")[0]
        click_at(browser, lane, 5.1 / 32)  # of 32 s
        found = shown(browser)
        assert (found["open"], found["loaded"]) == (True, True)
        number, at = re.findall(r"Frame (\d+), (.*) s", found["title"])[0]
        assert float(at) == pytest.approx(5.1, abs=0.3)
        assert int(number) == 4 * float(at)
        assert found["method"] == method
        asked = re.findall(r"The nearest in this page to (.*) s\.", found["note"])
        assert float(asked[0]) == pytest.approx(5.1, abs=0.2)
        assert any(re.fullmatch(r"ID.1 +\d.\d\d", label) for label in found["labels"])
        assert found["alt"].startswith(f"Sonar image, frame {number}: {method} declares ID.1 (")
        # Marks lie on the image, and the truth about what is declared.
        for mark in (m for kind in found["marks"].values() for m in kind):
            assert mark["right"] > found["box"]["left"]
            assert mark["left"] < found["box"]["right"]
        assert nearest(found["marks"]["truth"], found["marks"]["declared"]) < 4
        # A line on the charts tells which moment it is.
        line = find(browser, "#seen .lane.main .now")[0]
        lane_left, lane_width = lane.rect["x"], lane.rect["width"]
        assert line.rect["x"] == pytest.approx(lane_left + lane_width * float(at) / 32, abs=2)
    assert browser.get_log("browser") == []


def test_a_click_on_a_mistake_shows_it(browser: Any, pages: dict[str, Path]) -> None:
    look(browser, pages["full"], 1280, "light")
    rows = find(browser, "#mistakes tbody tr")
    assert len(rows) >= 4
    for row in rows:
        number = row.find_element("css selector", "button.frame")
        browser.execute_script("arguments[0].scrollIntoView({block: 'start'})", number)
        number.click()
        found = shown(browser)
        assert found["title"].startswith(f"Frame {number.text},")
        assert found["method"] == number.get_attribute("data-method")
        assert found["note"] == ""
        told = re.search(r"(ID.\d) declared (\(.*?\))", row.text)
        if told:  # a false claim: the very number is on the frame
            assert f"{told[1]}  {told[2][1:-1]}" in found["labels"]
    picture = find(browser, "#sightings figure button.frame")[0]
    browser.execute_script("arguments[0].scrollIntoView({block: 'start'})", picture)
    picture.click()
    assert shown(browser)["title"].startswith(f"Frame {picture.text},")
    assert browser.get_log("browser") == []


def test_from_frame_to_frame(browser: Any, pages: dict[str, Path]) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.select import Select

    look(browser, pages["full"], 1280, "light")
    find(browser, "#sightings td button.frame")[0].click()
    assert shown(browser)["title"].startswith("Frame 1,")  # a track's first declares nothing
    back, on = (find(browser, f"#viewer-{name}")[0] for name in ("back", "on"))
    back.click()
    assert shown(browser)["title"].startswith("Frame 0,")
    assert not back.is_enabled()
    on.click()
    assert shown(browser)["title"].startswith("Frame 1,")
    ActionChains(browser).send_keys(Keys.ARROW_RIGHT).perform()
    assert shown(browser)["title"].startswith("Frame 2,")
    back.click()
    before = shown(browser)
    assert before["title"].startswith("Frame 1,")
    Select(find(browser, "#viewer-method")[0]).select_by_value("smi")
    after = shown(browser)
    assert after["method"] == "smi"
    assert after["title"] == before["title"]
    assert after["labels"] != before["labels"]
    ActionChains(browser).send_keys(Keys.ESCAPE).perform()
    assert not shown(browser)["open"]
    assert not find(browser, ".now")
    assert browser.get_log("browser") == []


def test_without_scripts_the_page_reads(browser: Any, pages: dict[str, Path]) -> None:
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        browser.get(pages["full"].as_uri())
        assert not find(browser, "#viewer")[0].is_displayed()
        assert not any(e.is_displayed() for e in find(browser, ".live"))
        numbers = find(browser, "button.frame")
        assert not any(number.is_enabled() for number in numbers)
        assert find(browser, "#sightings td button.frame")[0].text == "1"
        assert all(p.rect["height"] > 100 for p in find(browser, ".gallery img"))
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
