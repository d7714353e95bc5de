"""The report's page in a real browser: what it looks like, and what a click does."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from selenium.webdriver import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select

from tests.support.browser import COLOURS, contrast, look

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("name", "width", "scheme"),
    [("full", 1280, "light"), ("full", 400, "dark"), ("bare", 400, "light")],
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


SHOWN = """
const of = id => document.getElementById('viewer-' + id), viewer = of('title').closest('aside');
const marks = {};
for (const m of viewer.querySelectorAll('ellipse'))
  (marks[m.getAttribute('class')] ||= []).push(m.getBoundingClientRect().toJSON());
const image = of('image');
return {
  open: !viewer.hidden && viewer.checkVisibility(),
  title: of('title').textContent, note: of('note').textContent, method: of('method').value,
  labels: [...viewer.querySelectorAll('text')].map(t => t.textContent),
  alt: image.alt, loaded: image.complete && image.naturalWidth > 0,
  box: image.getBoundingClientRect().toJSON(), marks,
};"""


def shown(browser: Any) -> Any:
    """What the viewer shows: its texts, its image, and the marks on it by their kind."""
    return browser.execute_script(SHOWN)


def middles(boxes: list[dict[str, float]]) -> np.ndarray:
    return np.array([[b["x"] + b["width"] / 2, b["y"] + b["height"] / 2] for b in boxes])


def find(browser: Any, selector: str) -> Any:
    return browser.find_elements("css selector", selector)


def click(browser: Any, element: Any, share: float = 0.5) -> None:
    """At a share of an element's width, from its left."""
    browser.execute_script("arguments[0].scrollIntoView({block: 'start'})", element)
    beside = round((share - 0.5) * element.size["width"])
    ActionChains(browser).move_to_element_with_offset(element, beside, 0).click().perform()


def test_a_click_on_a_bar_shows_its_frame(browser: Any, pages: dict[str, Path]) -> None:
    look(browser, pages["full"], 400, "light")
    assert not shown(browser)["open"]
    for method in ("framework", "smi"):
        lane = find(browser, f"#seen .lane[data-method='{method}']:not(.truth)")[0]
        click(browser, lane, 5.1 / 32)  # of 32 s
        found = shown(browser)
        assert (found["open"], found["loaded"], found["method"]) == (True, True, method)
        number, at = re.findall(r"Frame (\d+), (.*) s", found["title"])[0]
        assert float(at) == pytest.approx(5.1, abs=0.3)
        assert int(number) == 4 * float(at)
        asked = re.findall(r"The nearest in this page to (.*) s\.", found["note"])
        assert float(asked[0]) == pytest.approx(5.1, abs=0.2)
        assert any(re.fullmatch(r"ID.1 +\d.\d\d", label) for label in found["labels"])
        assert found["alt"].startswith(f"Sonar image, frame {number}: {method} declares ID.1 (")
        # Marks lie on the image, and the truth about what is declared.
        for mark in (m for kind in found["marks"].values() for m in kind):
            assert mark["right"] > found["box"]["left"]
            assert mark["left"] < found["box"]["right"]
        truth, declared = (middles(found["marks"][kind]) for kind in ("truth", "declared"))
        assert np.linalg.norm(truth[:, None] - declared, axis=2).min() < 4
        # A line on the charts tells which moment it is.
        line = find(browser, "#seen .lane.main .now")[0].rect["x"]
        expected = lane.rect["x"] + lane.rect["width"] * float(at) / 32
        assert line == pytest.approx(expected, abs=2)
    assert browser.get_log("browser") == []


def test_a_click_on_a_number_shows_that_frame(browser: Any, pages: dict[str, Path]) -> None:
    look(browser, pages["full"], 1280, "light")
    rows = find(browser, "#mistakes tbody tr")
    assert len(rows) >= 4
    for row in rows:
        number = row.find_element("css selector", "button.frame")
        click(browser, number)
        found = shown(browser)
        assert found["title"].startswith(f"Frame {number.text},")
        assert (found["method"], found["note"]) == (number.get_attribute("data-method"), "")
        told = re.search(r"(ID.\d) declared (\(.*?\))", row.text)
        if told:  # a false claim: the very number is on the frame
            assert f"{told[1]}  {told[2][1:-1]}" in found["labels"]
    assert browser.get_log("browser") == []


def test_from_frame_to_frame(browser: Any, pages: dict[str, Path]) -> None:
    look(browser, pages["full"], 1280, "light")
    back, on = (find(browser, f"#viewer-{name}")[0] for name in ("back", "on"))
    right = ActionChains(browser).send_keys(Keys.ARROW_RIGHT).perform
    steps = (find(browser, "#sightings td button.frame")[0].click, back.click, on.click, right)
    for step, number in zip(steps, (1, 0, 1, 2), strict=True):
        step()
        assert shown(browser)["title"].startswith(f"Frame {number},")
        assert back.is_enabled() == (number > 0)
    before = shown(browser)
    Select(find(browser, "#viewer-method")[0]).select_by_value("smi")
    after = shown(browser)
    assert (after["method"], after["title"]) == ("smi", before["title"])
    assert after["labels"] != before["labels"]
    ActionChains(browser).send_keys(Keys.ESCAPE).perform()
    assert not shown(browser)["open"]
    assert not find(browser, ".now")
    assert browser.get_log("browser") == []


def test_without_scripts_the_page_reads(browser: Any, pages: dict[str, Path]) -> None:
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        browser.get(pages["full"].as_uri())
        assert not any(e.is_displayed() for e in find(browser, "#viewer, .live"))
        assert not any(number.is_enabled() for number in find(browser, "button.frame"))
        assert find(browser, "#sightings td button.frame")[0].text == "1"
        assert all(p.rect["height"] > 100 for p in find(browser, ".gallery img"))
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
