"""`make scale`: a thousand logs in one call, stopped and killed; long logs.

Logs are hard links to a few simulated recordings of 60 frames. Of a thousand, five are broken each
in another way, one hangs and one kills its process (`tests/support/batch.py`). Prints what
tests/studies/RESULTS.md has, and fails where something was lost.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

from sonarrec.simulation.scene import load_scene
from sonarrec.simulation.simulate import write_recording
from tests.studies.results.record import options, save, show
from tests.support.batch import SAMPLE, command, environment, peak_mb, rows, tables

FRAMES = 60
MOST_CALIBRATED = 10_000
"""Frames of the longest log that is learned from: it takes 6 ms a frame."""
SEEDS = range(8000, 8004)


def recordings(folder: Path) -> list[Path]:
    """Simulated recordings, one file each; their sonar.toml serves all logs of the folder."""
    made = [folder / f"made{seed}.mcap" for seed in SEEDS]
    for seed, path in zip(SEEDS, made, strict=True):
        write_recording(replace(load_scene("sample_pan"), seed=seed, frames=FRAMES), path)
    shutil.copy(made[0].with_suffix(".sonar.toml"), folder / "sonar.toml")
    return made


def logs(folder: Path, source: list[Path], count: int) -> list[Path]:
    """So many logs, hard links in turn."""
    folder.mkdir(parents=True)
    shutil.copy(source[0].parent / "sonar.toml", folder)
    paths = [folder / f"log{i:04d}.mcap" for i in range(count)]
    for i, path in enumerate(paths):
        os.link(source[i % len(source)], path)
    return paths


def broken(paths: list[Path]) -> list[str]:
    """Break five logs, each in another way; let one hang and one kill its process. Their names."""
    chosen = paths[len(paths) // 14 :: len(paths) // 7][:7]
    whole = chosen[0].read_bytes()
    torn, foreign = whole[:8] + bytes(len(whole) - 8), (SAMPLE / "000000.png").read_bytes()
    for path, content in zip(chosen[:4], (b"", whole[:200], torn, foreign), strict=True):
        path.unlink()
        path.write_bytes(content)
    chosen[4].unlink()
    chosen[4].symlink_to("nowhere.mcap")
    for k, name in ((5, "hangs"), (6, "dies")):
        chosen[k] = chosen[k].rename(chosen[k].with_name(f"{name}.mcap"))
    return [path.stem for path in chosen]


def call(out: Path, folder: Path, *words: str | int | Path, stop_after: int = 0) -> float:
    """Seconds of a call over all logs of a folder; killed with -9 once so many are done."""
    begun = time.monotonic()
    running = subprocess.Popen(
        command("run", f"{folder}/*.mcap", *words, "-o", out, "-q"),
        env=environment(folder.parent),
        stderr=subprocess.DEVNULL,
    )
    while stop_after and running.poll() is None:
        if len([*out.glob("*/run.toml")]) >= stop_after:
            running.send_signal(signal.SIGKILL)
        time.sleep(0.1)
    running.wait()
    return time.monotonic() - begun


def same(one: Path, other: Path) -> int:
    """How many logs have the same bytes in both; exits where one differs."""
    names = [path.parent.name for path in one.glob("*/run.toml")]
    for name in names:
        if tables(one / name) != tables(other / name):
            sys.exit(f"{name}: other bytes in {one} and {other}")
    return len(names)


def thousand(home: Path, source: list[Path], count: int) -> None:
    folder, out = home / "thousand", home / "all"
    names = broken(logs(folder, source, count))
    took = call(out, folder, "-j", 2, "--timeout", 20)
    states = Counter(row["status"] for row in rows(out).values())
    failed = [name for name, row in rows(out).items() if row["status"] == "failed"]
    print(f"{count} logs of {FRAMES} frames, 2 jobs: {took:.0f} s; {dict(states)}")
    if set(failed) != set(names):
        sys.exit(f"failed: {failed}; expected {names}")
    for name in failed:
        print(f"  {rows(out)[name]['message']}")

    halted = home / "halted"
    call(halted, folder, "-j", 2, "--timeout", 20, stop_after=count // 2)
    ready = {p: p.stat().st_mtime_ns for p in halted.glob("*/run.toml") if ".part" not in str(p)}
    call(halted, folder, "-j", 2, "--timeout", 20)
    twice = [p for p, when in ready.items() if p.stat().st_mtime_ns != when]
    print(
        f"killed after {len(ready)} logs, called again: {len(twice)} done twice; "
        f"{same(out, halted)} of the same bytes as undisturbed"
    )
    if twice:
        sys.exit(f"done twice: {twice}")


def long(home: Path, largest: int) -> None:
    """Logs of 1,000 frames and more through the commands; the sample again and again."""
    images = sorted(SAMPLE.glob("*.png"))
    head, *truth = (SAMPLE / "gt.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    shown = [tuple(line.split(",", 1)) for line in truth]
    count, lines = 1000, []
    while count <= largest:
        log, results = home / f"frames{count}", home / "long" / f"frames{count}"
        log.mkdir()
        shutil.copy(SAMPLE / "sonar.toml", log)
        for i in range(count):
            (log / f"{i:06d}.png").symlink_to(images[i % len(images)])
        gt = home / f"gt{count}.csv"
        with gt.open("w", encoding="utf-8") as file:
            file.write(head)
            for first in range(0, count, len(images)):
                rows = ((first + int(frame), rest) for frame, rest in shown)
                file.writelines(f"{frame},{rest}" for frame, rest in rows if frame < count)
        for words in (
            ["run", log, "-o", results.parent],
            ["evaluate", "--ground-truth", gt, results],
            ["map", results, "-o", home / "map"],
            ["report", "--ground-truth", gt, results],
            ["truth", "propose", results, "-o", home / f"proposed{count}.csv"],
            ["truth", "check", gt, log],
            ["calibrate", log, "--ground-truth", gt, "-o", home / f"model{count}.toml"],
        ):
            if count <= MOST_CALIBRATED or words[0] != "calibrate":
                begun = time.monotonic()
                peak = peak_mb(command(*words))
                took = f"{time.monotonic() - begun:.1f}"
                name = " ".join(map(str, words[: 2 if words[0] == "truth" else 1]))
                lines.append({"command": name, "frames": count, "MB": f"{peak:.0f}", "s": took})
        count *= 10
    show("One log, the sample again and again: peak memory and time", lines)


def main() -> None:
    parser = options("scale", __doc__)
    parser.add_argument("--logs", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--part", choices=["thousand", "long"])
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        (home / "made").mkdir()
        source = recordings(home / "made")
        if asked.part in (None, "thousand"):
            thousand(home, source, asked.logs)
        if asked.part in (None, "long"):
            long(home, asked.frames)
    save(asked.record)


if __name__ == "__main__":
    main()
