"""The page on which a person checks ground truth: what is in it, and what it does in a browser."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonarrec.geometry import (
    polar_from_pixel,
)
from sonarrec.results.read import read_log
from sonarrec.truth.match import share_in_image
from tests.support.browser import look
from tests.support.command import SAMPLE, sonarrec
from tests.support.rows import read_rows

ENTER = "\ue007"
GT = SAMPLE.with_name("pan.gt.csv")
HEADER = "frame,timestamp_ns,method,object,x_px,y_px,landmark,score,declared,p_1,p_2,p_3,p_4,p_none"


def data_of(page: Path) -> dict[str, Any]:
    """What the page's script reads."""
    text = re.search(r'<script type="application/json" id="data">(.*)</script>', page.read_text())
    assert text is not None
    found: dict[str, Any] = json.loads(text[1])
    return found


def truth_rows() -> dict[int, dict[int, tuple[float, float]]]:
    """The sample's truth: by ID and frame, the pixel."""
    found: dict[int, dict[int, tuple[float, float]]] = {}
    for row in read_rows(GT):
        place = float(row["x_px"]), float(row["y_px"])
        found.setdefault(int(row["landmark"]), {})[int(row["frame"])] = place
    return found


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log called dive, without truth, and its results."""
    folder = tmp_path_factory.mktemp("ran")
    shutil.copytree(SAMPLE, folder / "dive", ignore=shutil.ignore_patterns("gt.csv"))
    sonarrec("run", folder / "dive", "--out", folder / "out", "-q")
    return folder


Track = tuple[int, dict[int, tuple[float, float]], float]
"""The ID it declares, the pixel in each frame, and its belief."""


def with_tracks(ran: Path, folder: Path, tracks: Sequence[Track]) -> Path:
    """The log with results that hold these tracks alone, in a new folder."""
    shutil.copytree(ran, folder)
    lines = [HEADER]
    for number, (landmark, places, belief) in enumerate(tracks, 1):
        beliefs = [belief if k == landmark else 0 for k in range(1, 5)] + [1 - belief]
        lines += [
            ",".join(map(str, (frame, 0, "framework", number, x, y, landmark, belief, 1, *beliefs)))
            for frame, (x, y) in places.items()
        ]
    results = folder / "out" / "dive"
    lines[1:] = sorted(lines[1:], key=lambda line: int(line.partition(",")[0]))
    (results / "estimates.csv").write_text("\n".join(lines) + "\n")
    run = (results / "run.toml").read_text()
    (results / "run.toml").write_text(re.sub(r"(?m)^estimates = .*", "estimates = 1", run))
    return folder


def swapped() -> list[Track]:
    """Tracks of one that took another disc for its own at frame 40, lay 10 px off in frame 100, and
    called a stone ID.2; ID.1 is missing in frames 40 to 52."""
    one, three = (truth_rows()[k] for k in (1, 3))
    first = {n: one[n] for n in range(40)} | {n: three[n] for n in range(40, 112)}
    second = {n: one[n] for n in range(77, 128)}
    second[100] = (second[100][0] - 10, second[100][1])
    stone = dict.fromkeys(range(60, 80), (95.0, 60.0))
    return [
        (1, first, 0.97),
        (3, {n: three[n] for n in range(17, 40)}, 0.98),
        (1, second, 0.99),
        (2, stone, 0.91),
    ]


def review(folder: Path, *more: str | Path, code: int = 0, log: str = "dive") -> Path:
    """The page of a log."""
    page = folder / "review.html"
    results = ("--results", folder / "out", "-o", page)
    sonarrec("truth", "review", folder / log, *results, *more, code=code)
    return page


# What is in the page


def test_passes_the_uncertain_ones_first(ran: Path, tmp_path: Path) -> None:
    page = review(with_tracks(ran, tmp_path / "w", swapped()))
    found = data_of(page)
    assert page.stat().st_size < 25e6
    spans = [
        (p["landmark"], p["rows"][0]["frame"], p["rows"][-1]["frame"]) for p in found["passes"]
    ]
    assert spans == [(2, 60, 79), (1, 0, 111), (3, 17, 39), (1, 77, 127)]
    assert [p["belief"] for p in found["passes"]] == [0.91, 0.97, 0.98, 0.99]
    assert {p["state"] for p in found["passes"]} == {"open"}
    assert sorted(map(int, found["images"])) == list(range(128))


# In a browser


class Page:
    """A page in the browser, used as a person uses it."""

    def __init__(self, browser: Any, page: Path, downloads: Path, width: int = 1400) -> None:
        self.browser, self.page, self.downloads = browser, page, downloads
        where = {"behavior": "allow", "downloadPath": str(downloads)}
        browser.execute_cdp_cmd("Browser.setDownloadBehavior", where)
        self.faults = look(browser, page, width, "dark")

    def press(self, *keys: str) -> None:
        from selenium.webdriver import ActionChains

        ActionChains(self.browser).send_keys(*keys).perform()

    def text(self, part: str) -> str:
        return str(self.browser.find_element("id", part).get_attribute("textContent"))

    @property
    def passes(self) -> list[list[Any]]:
        """ID, first and last frame, state of each."""
        of = "[p.landmark, p.rows[0].frame, p.rows.at(-1).frame, p.state]"
        found: list[list[Any]] = self.browser.execute_script(f"return passes.map(p => {of})")
        return found

    def choose(self, landmark: int, first: int) -> None:
        """Click the pass in the list."""
        ids = "passes.find(p => p.landmark === arguments[0] && p.rows[0].frame === arguments[1]).id"
        made = self.browser.execute_script(f"return {ids}", landmark, first)
        self.browser.find_element("css selector", f'#list [data-pass="{made}"]').click()

    def go(self, frame: int) -> None:
        """By the arrows."""
        from selenium.webdriver.common.keys import Keys

        now = int(self.browser.execute_script("return now"))
        self.press(*[Keys.ARROW_RIGHT if frame > now else Keys.ARROW_LEFT] * abs(frame - now))
        assert self.text("title") == f"Frame {frame}"

    def pointer(self, x: float, y: float, *, drag: tuple[float, float] = (0, 0)) -> float:
        """Press at a pixel of the fan, and drag by so many; returns screen pixels a pixel."""
        from selenium.webdriver import ActionChains

        svg = self.browser.find_element("id", "marks")
        box = self.browser.execute_script(
            "const b = arguments[0].getBoundingClientRect(); return [b.width, b.height]", svg
        )
        scale = float(box[0]) / int(self.browser.execute_script("return fan.columns"))
        at = round((x + 0.5) * scale - box[0] / 2), round((y + 0.5) * scale - box[1] / 2)
        act = ActionChains(self.browser).move_to_element_with_offset(svg, *at).click_and_hold()
        if any(drag):
            act = act.move_by_offset(*(round(v * scale) for v in drag))
        act.release().perform()
        return scale

    def save(self) -> Path:
        """What is downloaded."""
        file = self.downloads / "gt.csv"
        file.unlink(missing_ok=True)
        self.press("s")
        for _ in range(200):
            if file.exists():
                return file
            time.sleep(0.02)
        raise AssertionError(self.text("say"))


@pytest.mark.slow
def test_a_person_corrects_a_proposal(browser: Any, ran: Path, tmp_path: Path) -> None:
    """Each kind of decision once; the file holds them, and scores as truth made by hand."""
    folder = with_tracks(ran, tmp_path / "w", swapped())
    one = truth_rows()[1]
    page = Page(browser, review(folder), tmp_path)
    assert page.faults["console"] == []
    page.press("r")  # the stone, which is first
    assert page.text("pass").startswith("ID.1, frames 0 to 111, open")
    page.go(40)
    page.press("f", "3")  # from here on it is ID.3
    page.choose(1, 0)
    page.press("a")
    page.choose(3, 17)
    page.press("a")
    page.press("a")  # of what is open then, the last
    page.choose(1, 77)
    page.go(100)
    scale = page.pointer(one[100][0] - 10, one[100][1], drag=(10, 0))
    page.choose(1, 0)
    page.press("n", "1")
    page.go(40)
    page.pointer(*one[40])
    page.go(52)
    page.pointer(*one[52])
    page.press(*[ENTER, "r", "u"])  # reject what was drawn, and not
    expected = [[2, 60, 79, "rejected"], [1, 0, 39, "accepted"], [3, 40, 111, "accepted"]]
    expected += [[3, 17, 39, "accepted"], [1, 77, 127, "accepted"], [1, 40, 52, "accepted"]]
    assert page.passes == expected
    browser.refresh()
    assert page.passes == expected
    rows = read_rows(page.save())
    assert "No pass is open" in page.text("say")
    made = {
        (int(r["frame"]), int(r["landmark"])): (float(r["x_px"]), float(r["y_px"])) for r in rows
    }
    assert len(made) == len(rows)
    assert made.keys() == {(n, k) for k, of in truth_rows().items() for n in of}
    assert {row["source"] for row in rows} == {""}
    for (frame, landmark), place in made.items():
        off = np.subtract(place, truth_rows()[landmark][frame])
        drawn = landmark == 1 and 40 <= frame <= 52
        near = 2 / scale if drawn or frame == 100 else 0.006
        assert np.abs(off).max() < near + 1.5 * drawn, (frame, landmark, off)
    fan = read_log(folder / "out" / "dive").fan
    assert fan is not None
    by_program = share_in_image(fan, *polar_from_pixel(fan, *np.array([*made.values()]).T), 0.15)
    visible = np.array([float(row["visible"]) for row in rows])
    assert np.abs(visible - by_program).max() < 0.03
    saved = page.downloads / "gt.csv"
    sonarrec("truth", "check", saved, folder / "dive")
    results = ran / "out" / "dive"
    printed = [
        sonarrec("evaluate", "--ground-truth", truth, results, code=0).stdout
        for truth in (saved, GT)
    ]
    assert printed[0].replace(str(saved), str(GT)) == printed[1]
