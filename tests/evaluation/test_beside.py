"""Truth found beside the log, and truth that cannot be the log's."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import pytest

from tests.evaluation.test_evaluation import RUN_TOML, counts, scored, write_case, write_csv
from tests.support.claims import evaluate
from tests.support.command import sonarrec
from tests.support.rows import read_rows

FRAMES = range(12)
HEADER = ("frame", "landmark", "range_m", "bearing_deg")
command = partial(sonarrec, "evaluate")


def result(folder: Path, log: Path, digest: str, claimed: range, more: str = "") -> Path:
    """Results of a log of 12 frames that claim ID.1 in some."""
    claims = [(f, "m", 2.0, 0.0, 1, 0.9, 1) for f in claimed]
    out, _ = write_case(folder, FRAMES, claims, [])
    size = log.stat().st_size if log.is_file() else 0
    size = size or sum(f.stat().st_size for f in log.glob("*.png"))
    (out / "run.toml").write_text(
        f'finished = true\n[program]\nmethods = ["m"]\n[input]\nname = "{log.stem}"\n'
        f'path = "{log}"\nbytes = {size}\nsha256 = "{digest}"\n{more}'
    )
    return out.rename(folder / log.stem)


def truth(path: Path, frames: range) -> None:
    write_csv(path, HEADER, [(f, 1, 2.0, 0.0) for f in frames])


def logs_in_figures(logs: Path) -> set[str]:
    return {row["log"] for row in read_rows(logs / "out" / "evaluation" / "figures.csv")}


def found_and_missed(logs: Path) -> list[tuple[int, int]]:
    """TP and FN of ID.1 in each log."""
    found = evaluate(logs / "out")
    per_log = [scored(found, "strict").count(0, n) for n in range(len(found.folders))]
    return [(c.tp, c.fn) for c in per_log]


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """Two files and a folder of images, as far as looking for them goes; results of each."""
    place = tmp_path / "logs"
    (place / "pings").mkdir(parents=True)
    for name in ("a.mp4", "b.mp4", "pings/0.png"):
        (place / name).write_bytes(name.encode())
    for n, name in enumerate(("a.mp4", "b.mp4", "pings")):
        result(tmp_path / "out", place / name, f"{n}" * 64, range(n + 1))
    return tmp_path


def test_one_truth_beside_several_logs_may_be_anothers(logs: Path) -> None:
    truth(logs / "logs" / "gt.csv", range(4))
    assert "next to 2 logs" in command(logs / "out" / "b", code=3).stderr
    (logs / "logs" / "gt.csv").rename(logs / "logs" / "b.gt.csv")
    assert command(logs / "out" / "b").stderr == ""


def test_each_log_has_its_own(logs: Path) -> None:
    truth(logs / "logs" / "a.gt.csv", range(4))
    truth(logs / "logs" / "gt.csv", range(8))
    truth(logs / "logs" / "pings" / "gt.csv", range(12))
    done = command(logs / "out")
    assert f"the first {logs}/logs/a.gt.csv" in done.stdout
    assert found_and_missed(logs) == [(1, 3), (2, 6), (3, 9)]
    assert logs_in_figures(logs) == {"", "a", "b", "pings"}


def test_truths_in_one_folder(logs: Path) -> None:
    """As a browser downloads what its pages save; the truth next to a log is not used then."""
    labelled = logs / "labelled"
    labelled.mkdir()
    truth(logs / "logs" / "b.gt.csv", range(8))
    for name, frames in (("a", 4), ("pings", 12)):
        truth(labelled / f"{name}.gt.csv", range(frames))
    done = command(logs / "out", "--ground-truth", labelled, code=3)
    assert f"no b.gt.csv in {labelled}" in done.stderr
    assert logs_in_figures(logs) == {"", "a", "pings"}
    old = shutil.copytree(logs / "out", logs / "old")
    compared = command("--compare", old, logs / "out", "--ground-truth", labelled, code=3)
    assert "no b.gt.csv" in compared.stderr


def test_a_log_without_truth_is_left_out_and_said(logs: Path) -> None:
    truth(logs / "logs" / "a.gt.csv", range(4))
    done = command(logs / "out", code=3)
    assert "b.gt.csv, nor" in done.stderr
    assert f"beside {logs}/logs/pings" in done.stderr
    assert evaluate(logs / "out").counts.logs == ("a",)


def test_without_any_truth_one_line_says_where_it_was_looked_for(logs: Path) -> None:
    done = command(logs / "out", code=2)
    (line,) = done.stderr.splitlines()
    assert "a.gt.csv, nor" in line
    assert "without one); give --ground-truth, or --pairs" in line
    assert done.stdout == ""
    (logs / "out" / "a" / "run.toml").unlink()
    assert "run.toml" in command(logs / "out" / "a", code=2).stderr
    (logs / "logs" / "b.mp4").unlink()
    assert "no such file" in command(logs / "out" / "b", code=2).stderr


def test_the_log_is_found_from_any_folder_and_where_it_moved_with_its_results(
    logs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth(logs / "logs" / "a.gt.csv", range(4))
    run = logs / "out" / "a" / "run.toml"
    text = run.read_text().replace(f'path = "{logs / "logs" / "a.mp4"}"', 'path = "logs/a.mp4"')
    run.write_text(text + 'place = "../../logs/a.mp4"\n')
    (logs / "elsewhere").mkdir()
    monkeypatch.chdir(logs / "elsewhere")
    done = command("../out/a")
    assert f"ground truth next to its log, {logs / 'logs' / 'a.gt.csv'}" in done.stdout
    for name in ("out", "logs"):
        (logs / name).rename(logs / "elsewhere" / name)
    assert "next to its log, logs/a.gt.csv" in command("out/a").stdout
    (logs / "elsewhere" / "logs" / "a.mp4").unlink()
    said = command("out/a", code=2).stderr
    assert said.startswith("sonarrec: out/a")


def test_the_truth_of_another_log_in_its_place_is_not_taken(logs: Path) -> None:
    truth(logs / "logs" / "a.gt.csv", range(4))
    (logs / "logs" / "a.mp4").write_bytes(b"another recording")
    said = command(logs / "out" / "a", code=2).stderr
    assert "run (it had 5 bytes" in said


def test_one_truth_beside_several_logs_must_tell_them_apart(logs: Path) -> None:
    truth(logs / "logs" / "gt.csv", range(8))
    shutil.rmtree(logs / "out" / "pings")
    assert "lies beside 2 logs (a, b)" in command(logs / "out", code=1).stderr
    rows = [("a", 0, 1, 2.0, 0.0), ("b", 0, 1, 2.0, 0.0), ("b", 1, 1, 2.0, 0.0)]
    write_csv(logs / "logs" / "gt.csv", ("log", *HEADER), rows)
    assert found_and_missed(logs) == [(1, 0), (2, 0)]


def test_copies_of_one_recording_count_once(logs: Path) -> None:
    """Also those with other settings; figures, intervals and passes are those of the first."""
    truth(logs / "gt.csv", range(4))
    few = logs / "few"
    few.mkdir()
    alone = (logs / "out" / "a").rename(few / "a")
    shutil.copytree(alone, few / "copy")
    (few / "link").symlink_to(alone)
    result(logs / "else", logs / "logs" / "a.mp4", "0" * 64, range(3)).rename(few / "other")
    done = command("--ground-truth", logs / "gt.csv", few, code=3)
    for name in ("copy", "link"):
        assert f"{few / name}: the same" in done.stdout
    assert f"{few / 'other'}: the same" in done.stderr
    assert "not scored" in done.stderr
    one, all_ = evaluate(alone, logs / "gt.csv"), evaluate(few, logs / "gt.csv")
    assert counts(scored(one, "strict")) == counts(scored(all_, "strict"))
    assert one.counts.units.number == all_.counts.units.number
    # A table of pairs that names it four times.
    rows = [("few/a", "gt.csv")] * 3 + [("few/link", "gt.csv")]
    write_csv(logs / "pairs.csv", ("results", "ground_truth"), rows)
    done = command("--pairs", logs / "pairs.csv")
    assert done.stdout.count("counts once") == 2  # no line is told twice
    told = json.loads((logs / "evaluation" / "evaluation.json").read_text())
    assert told["frames"] == len(FRAMES)


@pytest.mark.parametrize("unit", [100.0, 0.001])
def test_positions_outside_the_image_are_refused(tmp_path: Path, unit: float) -> None:
    """Centimetres, or kilometres."""
    rows = [(f, 1, 2.0 * unit, 1.0, 1.0) for f in FRAMES]
    results, gt = write_case(tmp_path, FRAMES, [(0, "m", 2.0, 0.0, 1, 0.9, 1)], rows)
    (results / "run.toml").write_text(RUN_TOML)
    (line,) = command("--ground-truth", gt, results, code=1).stderr.splitlines()
    assert "out (1.25 to 3.75 m" in line
    assert f"such as {2 * unit:.4g} m, 1 deg" in line


@pytest.mark.parametrize("text", ["0,x,2,0", "0,9,2,0"])
def test_a_truth_that_cannot_be_read_leaves_its_log_out(logs: Path, text: str) -> None:
    """A cell that is no number, and an ID that the landmark set does not have."""
    for name in ("a.gt.csv", "pings/gt.csv"):
        truth(logs / "logs" / name, range(4))
    own = logs / "logs" / "b.gt.csv"
    own.write_text(",".join(HEADER) + f"\n{text}\n")
    old = shutil.copytree(logs / "out", logs / "old")
    for words in ([logs / "out"], ["--compare", old, logs / "out"]):
        done = command(*words, code=3)
        (line,) = done.stderr.splitlines()
        assert line.startswith(f"sonarrec: {own} line 2: landmark ")
        assert line.endswith(f"; b is not {'compared' if words[1:] else 'scored'}")
    told = json.loads((logs / "out" / "evaluation" / "evaluation.json").read_text())
    assert told["logs"] == ["a", "pings"]
    for name in ("a.gt.csv", "pings/gt.csv"):
        shutil.copy(own, logs / "logs" / name)
    done = command(logs / "out", code=1)
    assert done.stderr.startswith(f"sonarrec: {logs / 'logs' / 'a.gt.csv'} line 2: landmark ")
    assert done.stderr.count("\n") == 1
