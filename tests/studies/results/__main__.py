"""`make results`: makes the digests again, and fills RESULTS.md and the README's table."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from tests.studies.results.readme import README, filled
from tests.studies.results.record import digests, read, stale

FOLDER = Path(__file__).parent
NOW = FOLDER / "now.toml"
PAGE = FOLDER.parent / "RESULTS.md"
ORDER = (*("paper", "scenes", "scenes_fresh", "worlds", "scale", "bench"),)
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


def _section(name: str, study: Mapping[str, Any], now: Mapping[str, str]) -> str:
    other = stale(study, now)
    since = f"; since then other results: {', '.join(other)}" if other else ""
    source = f"`{study['command']}`, commit {study['commit']}{since}."
    lines = [f"## {study['title']}", "", source, *study["words"].strip().splitlines()]
    mark = "† " if other else ""
    shown, most = study["table"][: study.get("on_page")], study.get("rows_on_page")
    if len(shown) < len(study["table"]) or most is not None:
        lines.append(f"The rest: `tests/studies/results/{name}.toml`.")
    for table in shown:
        lines += ["", *([table["caption"], ""] if table["caption"] else [])]
        columns, *rows = csv.reader(table["csv"].strip().splitlines())
        lines += [_row(columns), "|---" * len(columns) + "|"]
        lines += [_row([mark + row[0], *row[1:]]) for row in rows[:most]]
    return "\n".join([*lines, ""])


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Make the digests again and write both pages."""
    now = digests()
    NOW.write_text(tomli_w.dumps(now), encoding="utf-8")
    PAGE.write_text(page(now), encoding="utf-8")
    README.write_text(filled(README.read_text(encoding="utf-8"), now), encoding="utf-8")


if __name__ == "__main__":
    main()
