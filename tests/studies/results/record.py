"""Shows the tables of a study, and puts them on record: `show`, `judge`, `save`; `digests`: of what
the program gives on the sample logs."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import textwrap
import tomllib
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import pandas as pd
import tomli_w

from tests.support.rows import read_rows

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[2]
SAMPLES = ROOT / "sample_data"
LOGS = "pan", "polar"
PRESETS = "default", "offline", "paper"
PROTOCOLS = {"paper": "protocol_paper", "strict": "protocol_strict"}
GOALS = "Goals"
_shown: list[tuple[str, list[dict[str, object]]]] = []  # in this process, which is one study


def show(caption: str, lines: Sequence[Mapping[str, object]], *, keep: bool = True) -> None:
    """Print a table, a mapping of column to cell for each line. keep: it goes on record."""
    print(f"\n{caption}\n")
    print(textwrap.indent(pd.DataFrame(lines).to_string(index=False), "  "), flush=True)
    if keep and lines:
        _shown.append((caption, [dict(line) for line in lines]))


def judge(
    what: str, value: float, bound: float, *, form: str = ".4g", at_least: bool = False
) -> None:
    """Print a figure beside its goal, and keep it: at most the bound, or at least."""
    met = value >= bound if at_least else value <= bound
    measured, goal = format(value, form), f"{'>=' if at_least else '<='} {bound:g}"
    print(f"  {what:<46} {measured:>9}  goal {goal}: {'met' if met else 'NOT met'}", flush=True)
    if not any(caption == GOALS for caption, _ in _shown):
        _shown.append((GOALS, []))
    row = {"what": what, "measured": measured, "goal": goal, "met": "yes" if met else "no"}
    next(lines for caption, lines in _shown if caption == GOALS).append(row)


def seeds(text: str) -> range:
    """`3000:3004` as the range of 3000 to 3003; `3000` as that one seed."""
    first, _, end = text.partition(":")
    return range(int(first), int(end) if end else int(first) + 1)


def options(
    name: str, about: str | None, of_seeds: range | None = None, frames: int | None = None
) -> argparse.ArgumentParser:
    """What studies are asked: `--out`, `--record` for `save`, and seeds and frames, by default."""
    parser = argparse.ArgumentParser(prog=f"python -m tests.studies.{name}", description=about)
    if of_seeds is not None:
        parser.add_argument("--seeds", type=seeds, default=of_seeds, help="first:end, end left out")
    if frames is not None:
        parser.add_argument("--frames", type=int, default=frames, help="of each recording")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / name.partition(".")[0])
    parser.add_argument("--record", metavar="NAME", help="file in tests/studies/results to write")
    return parser


def save(name: str | None) -> None:
    """Put what was shown, and the commit, into this folder's `name`.toml; None: do not.

    Its title, command and words are written by hand, and so are the names in `digest`: on what
    the figures depend. Make such a file for a new study.
    """
    if name is None:
        return
    study, now = read(name), digests()
    ask = ["git", "rev-parse", "--short=8", "HEAD"]
    study["commit"] = subprocess.check_output(ask, cwd=ROOT, text=True).strip()
    study["digest"] = {of: now[of] for of in study["digest"]}
    study["table"] = [
        {"caption": caption, "csv": pd.DataFrame(lines).to_csv(index=False, lineterminator="\n")}
        for caption, lines in _shown
    ]
    text = tomli_w.dumps(study, multiline_strings=True)
    (FOLDER / f"{name}.toml").write_text(text, encoding="utf-8")


def read(name: str) -> dict[str, Any]:
    """What is on record of a study."""
    return tomllib.loads((FOLDER / f"{name}.toml").read_text(encoding="utf-8"))


def stale(study: Mapping[str, Any], now: Mapping[str, str]) -> list[str]:
    """Names of the digests on which a study depends, and which are not as of `now`."""
    return [of for of, digest in study["digest"].items() if now[of] != digest]


def digests() -> dict[str, str]:
    """The estimates of each preset, by its name, and the rates of each protocol.

    Rates are those of the results on record, so that they tell of the counting alone. Estimates are
    of the machine's builds of numpy and OpenCV: others round differently in the last bit.
    """
    found: dict[str, str] = {}
    rates: dict[str, str] = dict.fromkeys(PROTOCOLS.values(), "")
    with tempfile.TemporaryDirectory() as folder:
        for preset in PRESETS:
            out = Path(folder, preset)
            for log in LOGS:
                _sonarrec("run", SAMPLES / log, "--preset", preset, "-q", "-o", out)
            tables = [(out / log / "estimates.csv").read_bytes() for log in LOGS]
            found[preset] = sha256(b"".join(tables)).hexdigest()[:12]
        for log in LOGS:
            results = Path(folder, "on_record", log)
            shutil.copytree(SAMPLES / "regression" / log, results)
            _sonarrec("evaluate", results, "--ground-truth", SAMPLES / log / "gt.csv")
            rows = read_rows(results / "evaluation" / "confusion.csv")
            for row in sorted(rows, key=lambda row: row["method"] != "smi"):
                cells = (row[c] for c in ("method", "landmark", "tpr", "fpr"))
                rates[PROTOCOLS[row["protocol"]]] += f"{log} {' '.join(cells)}\n"
    return found | {name: sha256(text.encode()).hexdigest()[:12] for name, text in rates.items()}


def _sonarrec(*arguments: str | Path) -> None:
    words = [sys.executable, "-m", "sonarrec", *map(str, arguments)]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
