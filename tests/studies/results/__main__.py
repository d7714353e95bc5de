"""`make results`: makes the digests anew, and puts RESULTS.md together."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from tests.studies.results.record import digests

FOLDER = Path(__file__).parent
NOW = FOLDER / "now.toml"
PAGE = FOLDER.parent / "RESULTS.md"
ORDER = (*("paper", "scenes", "scenes_fresh", "transfer", "worlds", "scale", "bench"),)
"""Files of this folder, as they follow each other on the page."""
HEAD = """# Measured results

`make results` puts this page together from the files in `tests/studies/results`, each written by
the command that its section names (`--record NAME`). TPR / FPR are over all IDs at the operating
point. `smi` is the paper's single-frame method; `hough` is a plain `cv2.HoughCircles` loop with a
majority vote (`tests/studies/baseline.py`); `paper`, `default` and `offline` are the framework with
these presets. Simulated figures come from seeds on which nothing was learned or chosen.

A row marked † was measured when the program gave other results on the sample logs than now.
"""


def page(now: Mapping[str, str]) -> str:
    """RESULTS.md, from all files of this folder and today's digests."""
    return "\n".join([HEAD, *(_section(name, read(name), now) for name in ORDER)])


def read(name: str) -> dict[str, Any]:
    """What is on record of a study."""
    return tomllib.loads((FOLDER / f"{name}.toml").read_text(encoding="utf-8"))


def _section(name: str, study: Mapping[str, Any], now: Mapping[str, str]) -> str:
    stale = [of for of, digest in study["digest"].items() if now[of] != digest]
    since = f"; since then other results: {', '.join(stale)}" if stale else ""
    source = f"`{study['command']}`, commit {study['commit']}{since}."
    lines = [f"## {study['title']}", "", source, *study["words"].strip().splitlines()]
    mark = "† " if stale else ""
    shown = study["table"][: study.get("on_page")]
    if len(shown) < len(study["table"]):
        lines.append(f"More tables: `tests/studies/results/{name}.toml`.")
    for table in shown:
        lines += ["", *([table["caption"], ""] if table["caption"] else [])]
        columns, *rows = csv.reader(table["csv"].strip().splitlines())
        lines += [_row(columns), "|---" * len(columns) + "|"]
        lines += [_row([mark + row[0], *row[1:]]) for row in rows]
    return "\n".join([*lines, ""])


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Make the digests anew and write the page."""
    now = digests()
    NOW.write_text(tomli_w.dumps(now), encoding="utf-8")
    PAGE.write_text(page(now), encoding="utf-8")


if __name__ == "__main__":
    main()
