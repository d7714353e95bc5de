"""The review page in a browser, used as a person uses it."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

from selenium.webdriver import ActionChains
from selenium.webdriver.common.keys import Keys

from tests.support.browser import look

ENTER = "\ue007"
SHIFT = "\ue008"
Truth = dict[int, dict[int, tuple[float, float, float]]]
"""By ID and frame: the pixel, and the share in view."""


class Page:
    """A page in the browser, used as a person uses it."""

    def __init__(
        self, browser: Any, page: Path, downloads: Path, width: int = 1400, *, again: bool = False
    ) -> None:
        """again: with what the browser has kept of earlier pages."""
        self.browser, self.page, self.downloads = browser, page, downloads / "saved"
        where = {"behavior": "allow", "downloadPath": str(self.downloads)}
        browser.execute_cdp_cmd("Browser.setDownloadBehavior", where)
        self.faults = look(browser, page, width, "dark")
        if not again:
            browser.execute_script("localStorage.clear()")
            self.faults = look(browser, page, width, "dark")

    def press(self, *keys: str) -> None:
        act = ActionChains(self.browser)
        if keys[:1] == (SHIFT,):
            act = act.key_down(SHIFT).send_keys(*keys[1:]).key_up(SHIFT)
        else:
            act = act.send_keys(*keys)
        act.perform()

    def text(self, part: str) -> str:
        return str(self.browser.find_element("id", part).get_attribute("textContent"))

    @property
    def passes(self) -> list[list[Any]]:
        """ID, first and last frame, state of each."""
        of = "[p.landmark, p.rows[0].frame, p.rows.at(-1).frame, p.state]"
        return list(self.browser.execute_script(f"return passes.map(p => {of})"))

    def choose(self, landmark: int, first: int) -> None:
        """Click the pass in the list."""
        ids = "passes.find(p => p.landmark === arguments[0] && p.rows[0].frame === arguments[1]).id"
        made = self.browser.execute_script(f"return {ids}", landmark, first)
        self.browser.find_element("css selector", f'#list [data-pass="{made}"]').click()

    def go(self, frame: int) -> None:
        """By the arrows."""
        now = int(self.browser.execute_script("return now"))
        self.press(*[Keys.ARROW_RIGHT if frame > now else Keys.ARROW_LEFT] * abs(frame - now))
        assert self.text("title") == f"Frame {frame}"

    def pointer(self, x: float, y: float, *, drag: tuple[float, float] = (0, 0)) -> float:
        """Press at a pixel of the fan, and drag by so many; returns screen pixels a pixel."""
        svg = self.browser.find_element("id", "marks")
        left, top, width, height, scale = self.screen()
        at = round(left + x * scale - width / 2), round(top + y * scale - height / 2)
        act = ActionChains(self.browser).move_to_element_with_offset(svg, *at).click_and_hold()
        if any(drag):
            act = act.move_by_offset(*(round(v * scale) for v in drag))
        act.release().perform()
        return scale

    def strip(self, frame: int, to: int | None = None, lane: float = 0) -> None:
        """Press on the bar of frames, and drag to another frame. lane: 0 on top, 1 at the foot."""
        bar = self.browser.find_element("id", "strip")
        width, height = bar.size["width"], bar.size["height"]
        first, frames = self.browser.execute_script("return [data.first, data.frames]")

        def off(n: float) -> int:
            return round((n - first) / frames * width - width / 2)

        down = round((lane - 0.5) * height + (4 if lane == 0 else 0))
        at = off(frame + 0.5) if to is None else off(frame)
        act = ActionChains(self.browser).move_to_element_with_offset(bar, at, down)
        act = act.click_and_hold()
        if to is not None:
            act = act.move_by_offset(off(to + 0.5) - off(frame), 0)
        act.release().perform()

    def screen(self) -> tuple[float, ...]:
        """Where in its box the frame's pixel 0, 0 is; the box's sides; screen pixels a pixel."""
        return tuple(
            self.browser.execute_script(
                "const svg = document.getElementById('marks'), box = svg.getBoundingClientRect();"
                "const m = svg.getScreenCTM();"
                "return [m.e - box.left, m.f - box.top, box.width, box.height, m.a]"
            )
        )

    def save(self) -> Path:
        """What is downloaded."""
        self.downloads.mkdir(exist_ok=True)
        for earlier in self.downloads.iterdir():
            earlier.unlink()
        self.press("s")
        for _ in range(200):
            for file in self.downloads.glob("*.gt.csv"):
                if file.stat().st_size:
                    return file
            time.sleep(0.02)
        raise AssertionError(self.text("say"))


class Labeller:
    """A person who knows the truth and decides on every pass, by keys and clicks."""

    def __init__(self, page: Page, truth: Truth) -> None:
        self.page, self.truth = page, truth

    def go(self, frame: int) -> None:
        """By the arrows if few steps do, else by a click on the bar of frames."""
        now = int(self.page.browser.execute_script("return now"))
        if abs(frame - now) > 6:
            self.page.strip(frame)
        self.page.go(frame)

    def work(self) -> None:
        script = "const p = current(); return p && [p.landmark, p.state, p.rows]"
        while True:
            found = self.page.browser.execute_script(script)
            if found is None or found[1] != "open":
                break
            self.decide(found[0], found[2])
        for landmark in self.truth:
            while (frame := self.missing(landmark)) is not None:
                self.draw(landmark, frame)

    def decide(self, landmark: int, rows: list[dict[str, Any]]) -> None:
        votes = Counter(self.nearest(row) for row in rows)
        true, number = votes.most_common(1)[0]
        if true is None or number < len(rows) / 2:
            self.page.press("r")
            return
        seen = self.truth[true]
        for key, end, by in (("b", rows[0]["frame"], -1), ("e", rows[-1]["frame"], 1)):
            if seen.get(end + by, (0, 0, 0))[2] > 0:
                self.page.press(SHIFT, key)
        self.page.press("a" if true == landmark else str(true))

    def nearest(self, row: dict[str, Any]) -> int | None:
        for landmark, seen in self.truth.items():
            x, y, _ = seen.get(row["frame"], (-99, -99, 0))
            if abs(x - row["x"]) + abs(y - row["y"]) < 12:
                return landmark
        return None

    def missing(self, landmark: int) -> int | None:
        """The middle of the frames, to where it leaves the view, in which nothing is accepted."""
        script = """return passes.filter(p => p.landmark === arguments[0] && p.state === 'accepted')
          .flatMap(p => p.rows.map(r => r.frame))"""
        has = set(self.page.browser.execute_script(script, landmark))
        whole = [n for n, of in self.truth[landmark].items() if of[2] >= 0.9]
        left = [n for n in whole if n not in has]
        run = [n for k, n in enumerate(left) if n - left[0] == k]
        return run[len(run) // 2] if run else None

    def draw(self, landmark: int, frame: int) -> None:
        self.go(frame)
        self.page.press("n", str(landmark))
        self.page.pointer(*self.truth[landmark][frame][:2])
        self.page.press(SHIFT, "b")
        self.page.press(SHIFT, "e")
        self.page.press(ENTER)
