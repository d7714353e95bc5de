"""The review page in a browser, used as a person uses it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from selenium.webdriver import ActionChains
from selenium.webdriver.common.keys import Keys

from tests.support.browser import look

SHIFT = "\ue008"


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
