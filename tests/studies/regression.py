"""`make regression`: the sample logs, run anew, against the results on record.

What is compared, and how, is `sonarrec evaluate --compare --fail-on-regression`; a rate may be
worse by BAND, and by two frames. Beside that the folder and the MCAP of one log must give the
same estimates, byte for byte, and a second run the same tables.

`python -m tests.studies.regression --record` puts the new results on record, in
sample_data/regression.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "sample_data"
RECORD = SAMPLES / "regression"
BUILD = ROOT / "build" / "regression"
TABLES = ("frames.csv", "estimates.csv")

# Other builds of OpenCV and numpy round differently in the last bit, which moves particles and,
# through them, a frame or two at the ends of a pass. One object lost for a fifth of a pass is more.
BAND = "0.01"


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


def sonarrec(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """One real command."""
    words = [sys.executable, "-m", "sonarrec", *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, cwd=ROOT)


def run(log: Path, out: Path) -> Path:
    """The folder of the results of one log, processed now."""
    done = sonarrec("run", log, "--out", out, "-q", "--overwrite")
    if done.returncode:
        raise SystemExit(f"sonarrec run {log}\nexit {done.returncode}\n{done.stderr}")
    [table] = out.glob("*/estimates.csv")
    return table.parent


def unequal(a: Path, b: Path, what: str, tables: tuple[str, ...] = TABLES) -> list[str]:
    """One line per table that is not the same, byte for byte."""
    return [
        f"{table} differs: {what}"
        for table in tables
        if (a / table).read_bytes() != (b / table).read_bytes()
    ]


def against_record(name: str, results: Path, truth: Path) -> list[str]:
    """Print what changed; one line per rate that is worse."""
    old = RECORD / name.removesuffix(".mcap")
    arguments = ("--ground-truth", truth, "--compare", old, results, "--fail-on-regression", BAND)
    done = sonarrec("evaluate", *arguments)
    print(f"{name}\n{done.stdout}")
    if done.returncode == 0:
        return []
    return [f"{name}: {line.removeprefix('sonarrec: ')}" for line in done.stderr.splitlines()]


def main(arguments: list[str]) -> int:
    """Exit code 0 where nothing is worse and all that must be is equal, else 1."""
    if arguments not in ([], ["--record"]):
        print("usage: python -m tests.studies.regression [--record]", file=sys.stderr)
        return 2
    shutil.rmtree(BUILD, ignore_errors=True)
    logs = sample_logs()
    results = {name: run(log, BUILD / name.replace("/", "_")) for name, log, _ in logs}
    name, log, _ = logs[0]
    lines = unequal(results[name], run(log, BUILD / "again"), f"{name}, run twice")
    for name, _, truth in logs:
        twin = name.removesuffix(".mcap")
        if twin != name and twin in results:
            what = f"{name} and {twin}, one log in two forms"
            # frames.csv has the clocks of the recording, too, which a folder of images lacks.
            lines += unequal(results[twin], results[name], what, ("estimates.csv",))
        if not arguments:
            lines += against_record(name, results[name], truth)
        else:
            (RECORD / twin).mkdir(parents=True, exist_ok=True)
            for table in TABLES:
                shutil.copyfile(results[name] / table, RECORD / twin / table)
    for line in lines:
        print(f"regression: {line}", file=sys.stderr)
    if not lines:
        print(f"regression: {len(logs)} logs {'recorded' if arguments else 'no worse'}")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
