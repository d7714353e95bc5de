"""Digests of what the program gives on the sample logs."""

from __future__ import annotations

import csv
import shutil
import subprocess
import sys
import tempfile
from hashlib import sha256
from pathlib import Path

SAMPLES = Path(__file__).resolve().parents[3] / "sample_data"
LOGS = "pan", "polar"
PRESETS = "default", "offline", "paper"
PROTOCOLS = {"paper": "protocol_paper", "strict": "protocol_strict"}


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
            with (results / "evaluation" / "confusion.csv").open(encoding="utf-8") as file:
                for row in sorted(csv.DictReader(file), key=lambda row: row["method"] != "smi"):
                    cells = (row[c] for c in ("method", "landmark", "tpr", "fpr"))
                    rates[PROTOCOLS[row["protocol"]]] += f"{log} {' '.join(cells)}\n"
    return found | {name: sha256(text.encode()).hexdigest()[:12] for name, text in rates.items()}


def _sonarrec(*arguments: str | Path) -> None:
    words = [sys.executable, "-m", "sonarrec", *map(str, arguments)]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
