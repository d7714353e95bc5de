"""Pages in a real browser: headless Chromium."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

FLAGS = """headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking
disable-component-update disable-sync hide-scrollbars"""
FAULTS = """
const shown = e => e.checkVisibility() && !e.closest('.scroll');
return {
  broken: [...document.images]
    .filter(i => i.hasAttribute('src') && !(i.complete && i.naturalWidth)).length,
  pictures: document.images.length,
  wide: document.documentElement.scrollWidth - window.innerWidth,
  outside: [...document.body.querySelectorAll('*')]
    .filter(e => shown(e) && !e.closest('svg'))
    .filter(e => e.getBoundingClientRect().right > window.innerWidth + 1)
    .map(e => e.outerHTML.slice(0, 80)),
};"""
# Of every element that holds text itself: its colour and that of the page behind it, as sRGB.
COLOURS = """
const canvas = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
const rgb = c => { canvas.fillStyle = c; canvas.fillRect(0, 0, 1, 1);
                   return [...canvas.getImageData(0, 0, 1, 1).data]; };
const page = rgb(getComputedStyle(document.body).backgroundColor);
const text = new Set([...document.body.querySelectorAll('*')]
  .filter(e => e.checkVisibility())
  .filter(e => [...e.childNodes].some(n => n.nodeType === 3 && n.data.trim()))
  .map(e => getComputedStyle(e).color));
const drawn = new Set([...document.querySelectorAll('.sheet path, .disc path')].map(e => {
  const style = getComputedStyle(e); return style.fill === 'none' ? style.stroke : style.fill; }));
return [page, [...text].map(rgb), [...drawn].map(rgb)];"""


@contextmanager
def chromium(profile: Path) -> Iterator[Any]:
    """Headless Chromium, driven by its own driver; nothing is downloaded to have them."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("no chromium and chromedriver on the PATH")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in (*FLAGS.split(), f"user-data-dir={profile}"):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with webdriver.Chrome(options=options, service=Service(driver)) as chrome:
        yield chrome


def look(browser: Any, page: Path, width: int, scheme: str) -> dict[str, Any]:
    """What is wrong with a page on a screen; `console` is what the browser complains of."""
    screen = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    browser.get_log("browser")
    browser.get(page.as_uri())
    # What is folded away has to fit as well.
    browser.execute_script("document.querySelectorAll('details').forEach(d => d.open = true)")
    return {**browser.execute_script(FAULTS), "console": browser.get_log("browser")}


def contrast(a: list[int], b: list[int]) -> float:
    """WCAG 2 contrast ratio of two sRGB colours, 1 to 21."""
    linear = [
        np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        for c in (np.array(a[:3]) / 255, np.array(b[:3]) / 255)
    ]
    high, low = sorted((float(c @ (0.2126, 0.7152, 0.0722)) for c in linear), reverse=True)
    return (high + 0.05) / (low + 0.05)
