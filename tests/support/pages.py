"""What tests of pages share: a page's elements and tables, and tables written by hand."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from collections.abc import Iterable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from sonarrec.evaluation.rows import ScoringOptions
from sonarrec.reports.logs import LogToShow, ReportedLog, read_logs
from sonarrec.sonar.stated import Sonar
from sonarrec.truth.table import read_truth

DECLARED = "frame,method,object,landmark,score,declared"
PLACED = "frame,method,object,range_m,bearing_deg,p_1,p_2,p_3,p_4,p_none,landmark,score,declared"


class Page(HTMLParser):
    """Every element of a page with its attributes, and every table as rows of cells: by its
    caption, and by the label of the box around it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.tables: dict[str, list[list[str]]] = {}
        self.named: dict[str, list[list[str]]] = {}
        self.text = ""
        self._rows: list[list[str]] = []
        self._caption: str | None = None
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag == "table":
            self._rows = []
            self.named[str(self.elements[-2][1].get("aria-label"))] = self._rows
        elif tag == "caption":
            self._caption = ""
        elif tag == "tr":
            self._rows.append([])
        elif tag in ("td", "th"):
            self._rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        if tag == "caption" and self._caption is not None:
            self.tables[self._caption] = self._rows
            self._caption = None
        elif tag == "table":
            self._rows = []

    def handle_data(self, data: str) -> None:
        self.text += data
        if self._caption is not None:
            self._caption += data
        elif self._rows and self._rows[-1]:
            self._rows[-1][-1] += data.strip()


def tables(folder: Path, frames: Iterable[object], head: str, rows: Iterable[str]) -> None:
    """Results of another program. frames: numbers, or (number, time in ns); rows: of estimates."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [",".join(map(str, f)) if isinstance(f, tuple) else str(f) for f in frames]
    columns = "frame,timestamp_ns" if "," in lines[0] else "frame"
    (folder / "frames.csv").write_text("\n".join([columns, *lines, ""]))
    (folder / "estimates.csv").write_text("\n".join([head, *rows, ""]))


def held_frames(path: Path) -> list[dict[str, Any]]:
    """What the page holds to be shown on a click, per log."""
    (text,) = re.findall(
        r'<script type="application/json" id="frames">(.*?)</script>', path.read_text()
    )
    found: list[dict[str, Any]] = json.loads(text)
    return found


def reported(folder: Path, truth: Path | None = None) -> ReportedLog:
    [log], _ = read_logs(
        [LogToShow(folder, read_truth(truth or folder / "gt.csv"))], ScoringOptions(sonar=Sonar())
    )
    return log


def without_log(results: Path, to: Path) -> None:
    """Results as they are on another machine."""
    shutil.copytree(results, to)
    run = (to / "run.toml").read_text(encoding="utf-8")
    run = re.sub(r"^(path|place) = .*", r'\1 = "gone"', run, flags=re.MULTILINE)
    (to / "run.toml").write_text(run, encoding="utf-8")


def random_results(folder: Path) -> Path:
    """Random results of two methods and random truth, with positions."""
    rng, frames = np.random.default_rng(5), 120
    places = rng.uniform((1.5, -10), (3.5, 10), (5, 2))
    rows, truth = [], []
    for n in range(frames):
        for range_m, bearing in places[rng.random(5) < 0.5]:
            near = (range_m + rng.normal(0, 0.05), bearing + rng.normal(0, 1))
            truth.append(f"{n},{rng.integers(1, 5)},{range_m},{bearing},{rng.choice([0.5, 1])}")
            for method in ("smi", "framework"):
                s = round(rng.random(), 2)
                rows.append(
                    f"{n},{method},{rng.integers(100, 104)},{near[0]},{near[1]},.1,.2,.3,.2,.2,"
                    f"{rng.integers(1, 5)},{s},{int(s > 0.4)}"
                )
    tables(folder, ((n, n * 250_000_000) for n in range(frames)), PLACED, rows)
    lines = ["frame,landmark,range_m,bearing_deg,visible", *dict.fromkeys(truth), ""]
    (folder / "gt.csv").write_text("\n".join(lines))
    return folder


def as_written(folder: Path) -> None:
    """Let run.toml state the tables of a results folder as they are now."""
    run = tomllib.loads((folder / "run.toml").read_text(encoding="utf-8"))
    run["input"] |= {"estimates": 0, "sightings": 0}
    run["input"].pop("tables_sha256", None)
    (folder / "run.toml").write_text(tomli_w.dumps(run), encoding="utf-8", newline="\n")
