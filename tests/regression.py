"""`make regression`: the sample logs, run and scored by the real commands, against the record.

`python -m tests.regression --record` writes sample_data/regression.csv anew. Beside the rates it
is checked that the folder and the MCAP of one log give the same estimates, byte for byte, and
that a second run does.
"""

from __future__ import annotations

import csv
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / "sample_data"
RECORD = SAMPLES / "regression.csv"
BUILD = ROOT / "build" / "regression"
COLUMNS = ("log", "protocol", "method", "landmark", "rate", "value", "band")

# What a band absorbs: other builds of OpenCV and numpy round differently in the last bit, which
# moves particles and, through them, a frame or two at the ends of a pass. So a band is two frames
# of those that the rate is over, and no less than this: .03 of the 60 to 150 positives of a sample
# log, .01 of its 300 negatives. One object lost for a fifth of a pass is more.
BANDS = {"tpr": 0.03, "fpr": 0.01}


def sample_logs() -> list[tuple[str, Path, Path]]:
    """(name, log, gt.csv) of every sample log: folders and MCAP files."""
    folders = [(p.parent, p) for p in SAMPLES.glob("*/gt.csv")]
    files = [(p, p.with_suffix(".gt.csv")) for p in SAMPLES.rglob("*.mcap")]
    logs = [
        (log.relative_to(SAMPLES).as_posix(), log, truth)
        for log, truth in sorted(folders + files)
        if log.is_file() or any(log.glob("*.png"))
    ]
    if not logs:
        raise SystemExit(f"{SAMPLES}: no sample log here")
    return logs


def sonarrec(*arguments: str | Path) -> None:
    """One real command; its messages are shown where it fails."""
    words = [sys.executable, "-m", "sonarrec", *map(str, arguments)]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        raise SystemExit(f"{' '.join(words[1:])}\nexit {done.returncode}\n{done.stderr}")


def measure() -> tuple[dict[tuple[str, ...], tuple[float, float]], list[str]]:
    """(value, band) by (log, protocol, method, landmark, rate); what is not byte for byte."""
    shutil.rmtree(BUILD, ignore_errors=True)
    rates: dict[tuple[str, ...], tuple[float, float]] = {}
    results: dict[str, Path] = {}
    unequal = []
    for name, log, truth in sample_logs():
        out = BUILD / name.replace("/", "_")
        sonarrec("run", log, "--out", out, "-q")
        [results[name]] = [p.parent for p in out.glob("*/estimates.csv")]
        sonarrec("evaluate", "--ground-truth", truth, results[name], "-q")
        with (results[name] / "evaluation" / "confusion.csv").open(encoding="utf-8") as file:
            for row in csv.DictReader(file):
                for rate, (part, rest) in {"tpr": ("tp", "fn"), "fpr": ("fp", "tn")}.items():
                    if row[rate]:
                        key = (name, row["protocol"], row["method"], row["landmark"], rate)
                        band = max(BANDS[rate], 2 / (int(row[part]) + int(row[rest])))
                        rates[key] = (float(row[rate]), band)

    def compare(first: Path, second: Path, what: str) -> None:
        for table in ("frames.csv", "estimates.csv"):
            if (first / table).read_bytes() != (second / table).read_bytes():
                unequal.append(f"{table} differs: {what}")

    for name, folder in results.items():
        twin = results.get(name.removesuffix(".mcap"))
        if twin and twin != folder:
            compare(twin, folder, f"{name} and {name.removesuffix('.mcap')}, one log in two forms")
    name, log, _ = sample_logs()[0]
    sonarrec("run", log, "--out", BUILD / "again", "-q")
    [again] = [p.parent for p in (BUILD / "again").glob("*/estimates.csv")]
    compare(results[name], again, f"{name}, run twice")
    return rates, unequal


def record(rates: dict[tuple[str, ...], tuple[float, float]]) -> None:
    """Write the record."""
    with RECORD.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for key, (value, band) in rates.items():
            table.writerow([*key, f"{value:.4f}", f"{band:.4f}"])


def moved(
    rates: dict[tuple[str, ...], tuple[float, float]], recorded: list[dict[str, str]]
) -> list[str]:
    """One line per rate that left its band, is gone or is new."""
    lines = []
    known = set()
    for row in recorded:
        key = tuple(row[c] for c in COLUMNS[:5])
        known.add(key)
        what = " ".join(key[:-1]) + f" {key[-1].upper()}"
        value, band = float(row["value"]), float(row["band"])
        if key not in rates:
            lines.append(f"{what}: was {value:.4f}, is no longer measured")
        elif abs(rates[key][0] - value) > band + 1e-4:  # the record has four digits
            lines.append(f"{what}: was {value:.4f}, is {rates[key][0]:.4f}, band +-{band:g}")
    lines += [
        f"{' '.join(key[:-1])} {key[-1].upper()}: is {value:.4f}, not in the record"
        for key, (value, _) in rates.items()
        if key not in known
    ]
    return lines


def main(arguments: list[str]) -> int:
    """Exit code 0 where every number is in its band, 1 where one is not."""
    if arguments not in ([], ["--record"]):
        print("usage: python -m tests.regression [--record]", file=sys.stderr)
        return 2
    rates, unequal = measure()
    if arguments:
        record(rates)
        lines = unequal
    else:
        with RECORD.open(newline="", encoding="utf-8") as file:
            lines = moved(rates, list(csv.DictReader(file))) + unequal
    for line in lines:
        print(f"regression: {line}", file=sys.stderr)
    if not lines:
        print(f"regression: {len(rates)} rates {'recorded' if arguments else 'in their bands'}")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
