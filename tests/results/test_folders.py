"""No results are lost, and none pass for what they are not."""

from __future__ import annotations

import csv
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarrec import run
from sonarrec.errors import SonarrecError, UsageError
from sonarrec.results.folders import exchange, folder_names, part_of, restore
from sonarrec.results.read import find_logs
from sonarrec.results.sightings import read_sightings
from sonarrec.results.write import AT_ONCE
from tests.support.batch import SAMPLE, command, made, until
from tests.support.command import sonarrec
from tests.support.locked import locked
from tests.support.logs import cdr_image, mcap_file
from tests.support.logs import frames as images
from tests.support.slow import but_first

FRAMES = 40


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first frames of the sample log."""
    return made(tmp_path_factory.mktemp("logs"), "dive", frames=FRAMES)[0]


def frames(folder: Path) -> list[int]:
    """The frames of both tables, complete ones only; fails where a row is torn."""
    found = {}
    for name in ("frames.csv", "estimates.csv"):
        text = (folder / name).read_text()
        assert text.endswith("\n"), f"{name} is torn"
        rows = list(csv.reader(text.splitlines()))
        assert {len(row) for row in rows} == {len(rows[0])}, f"{name} has rows of unequal length"
        found[name] = [int(row[0]) for row in rows[1:]]
    listed = len(found["frames.csv"])  # estimates are written first, so many frames at once
    assert set(found["estimates.csv"]) <= {*found["frames.csv"], *range(listed, listed + AT_ONCE)}
    return found["frames.csv"]


def finished(folder: Path) -> bool:
    return bool(tomllib.loads((folder / "run.toml").read_text())["finished"])


def short(place: Path, name: str = "short", frames: int = 3) -> Path:
    """A log of few frames."""
    return made(place, name, frames=frames)[0]


paths = st.lists(
    st.lists(st.sampled_from(["a", "b", "day1", "day2"]), min_size=1, max_size=4).map(
        lambda parts: Path("/", *parts)
    ),
    min_size=1,
    max_size=6,
    unique=True,
)


@given(paths)
def test_names_of_different_places_are_different_and_begin_alike(places: list[Path]) -> None:
    names = folder_names([(p.name, p) for p in places])
    assert len(set(names)) == len(places)
    for name, place in zip(names, places, strict=True):
        assert "-".join(place.parts[1:]).endswith(name)
        if sum(p.name == place.name for p in places) == 1:
            assert name == place.name


def test_what_nothing_tells_apart_is_refused() -> None:
    with pytest.raises(UsageError, match="pan"):
        folder_names([("pan", Path("/x/pan")), ("pan", Path("/x/pan.mcap"))])
    with pytest.raises(UsageError, match=r"/x/pan: .* 2 "):
        folder_names([("pan", Path("/x/pan")), ("a", Path("/x/a")), ("pan", Path("/x/pan"))])


def test_the_same_results_are_not_made_again(tmp_path: Path) -> None:
    log, out = short(tmp_path), tmp_path / "out"
    sonarrec("run", "-q", log, "-o", out)
    before = (out / "short" / "frames.csv").stat().st_mtime_ns
    assert "date, 3 frames" in sonarrec("run", log, "-o", out).stdout
    assert (out / "short" / "frames.csv").stat().st_mtime_ns == before
    sonarrec("run", "-q", log, "-o", out, "--overwrite")
    assert (out / "short" / "frames.csv").stat().st_mtime_ns > before


def test_the_other_sonar_of_a_bag_does_not_replace_the_results_of_the_first(tmp_path: Path) -> None:
    stored = [(topic, 0, cdr_image(image)) for image in images(1) for topic in ("/a", "/b")]
    log, out = mcap_file(tmp_path / "dive.mcap", stored), tmp_path / "out"
    sonarrec("run", "-q", log, "--topic", "/a", "-o", out)
    assert "up to date" in sonarrec("run", log, "--topic", "/a", "-o", out).stdout
    told = sonarrec("run", log, "--topic", "/b", "-o", out, code=1).stderr
    assert f"{out / 'dive'}: holds" in told
    sonarrec("run", "-q", log, "--topic", "/b", "-o", out, "--overwrite")


def test_files_of_the_user_stay_also_where_ours_are_made(tmp_path: Path) -> None:
    """In folders named as ours there may be notes, or nothing of ours at all."""
    log, out = short(tmp_path), tmp_path / "out"
    names = ("notes.txt", "evaluation/notes.txt", "map/old/chart.png", "report.html")
    mine = {out / "short" / name for name in names}
    for path in mine:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("mine")
    sonarrec("run", "-q", log, "-o", out)
    (out / "short" / "map" / "map.csv").write_text("ours")
    sonarrec("run", "-q", log, "-o", out, "--overwrite")
    assert all(path.read_text() == "mine" for path in mine)
    there = {path for path in (out / "short").rglob("*") if path.is_file()}
    ours = {"frames.csv", "estimates.csv", "sightings.csv", "run.toml"}
    assert {path.name for path in there - mine} == ours
    assert not list(out.glob(".*"))


@pytest.mark.slow
def test_all_that_is_made_from_results_goes_with_them(log: Path, tmp_path: Path) -> None:
    sonarrec("run", "-q", log, "-o", tmp_path)
    folder, truth = tmp_path / "dive", tmp_path / "gt.csv"
    kept = {path.name for path in folder.iterdir()}
    header, *rows = (SAMPLE / "gt.csv").read_text().splitlines(keepends=True)
    truth.write_text(header + "".join(row for row in rows if int(row.split(",")[0]) < FRAMES))
    sonarrec("evaluate", "--ground-truth", truth, folder)
    sides = ["--compare", shutil.copytree(folder, tmp_path / "before"), folder]
    sonarrec("evaluate", "--ground-truth", truth, *sides, "-o", folder / "evaluation")
    sonarrec("report", "--ground-truth", truth, folder, "-q")
    sonarrec("map", folder, "--origin", "54,10,0", "--min-frames", "3")
    made = {path for path in folder.rglob("*") if path.is_file() and path.name not in kept}
    assert len(made) >= 12
    shutil.copytree(folder, part_of(folder), ignore=lambda _, names: {*names} - kept)
    assert not exchange(folder)
    assert {path.name for path in folder.iterdir()} == kept


def test_a_path_may_be_of_another_log_in_another_folder(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for day, frame_count, code in (("day1", 3, 0), ("day2", 4, 1)):
        short(tmp_path, f"{day}/dive", frame_count)
        monkeypatch.chdir(tmp_path / day)
        told = sonarrec("run", "-q", "dive", "-o", "../out", code=code).stderr
        assert ("another log" in told) == bool(code)
    monkeypatch.chdir(tmp_path)  # the same one, from elsewhere, is known again, and when it grew
    assert "up to date" in sonarrec("run", "day1/dive", "-o", "out").stdout
    shutil.copy(log / "000003.png", "day1/dive")
    assert "changed" in sonarrec("run", "-q", "day1/dive", "-o", tmp_path / "out").stderr
    assert frames(tmp_path / "out" / "dive") == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("number", "code"),
    but_first([(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGKILL, -9)]),
)
def test_a_stopped_run_leaves_its_part_and_the_old_results(
    log: Path, tmp_path: Path, number: int, code: int
) -> None:
    out = tmp_path / "out"
    sonarrec("run", "-q", short(tmp_path, "dive"), "-o", out)
    old = (out / "dive" / "estimates.csv").read_bytes()
    again = command("run", "-q", log, "-o", out, "--overwrite")
    process = subprocess.Popen(again, stderr=subprocess.PIPE, text=True)
    part = part_of(out / "dive")
    table = part / "frames.csv"
    until(lambda: table.is_file() and table.read_bytes().count(b"\n") > 5)
    process.send_signal(number)
    _, told = process.communicate(timeout=300)
    assert process.returncode == code, told
    assert (out / "dive" / "estimates.csv").read_bytes() == old
    assert not finished(part)
    assert 4 < len(frames(part)) < FRAMES
    if code > 0:
        assert f"stopped; the frames so far are in {part}" in told
    sonarrec("run", "-q", log, "-o", out, "--overwrite")  # no lock is left, and no part
    assert frames(out / "dive") == list(range(FRAMES))
    assert not part.exists()


def test_a_link_in_place_of_the_lock_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".pan.lock").symlink_to(tmp_path / "mine")
    sonarrec("run", "-q", SAMPLE, "--frames", ":2", "-o", tmp_path / "out", code=1)
    assert (tmp_path / "mine").read_text() == "mine"


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["default", "offline"])
def test_ctrl_c_at_any_line_leaves_the_first_frames(log: Path, tmp_path: Path, preset: str) -> None:
    modules = ("side_by_side.py", "hindsight.py", "write.py", "one.py")
    lines = 0

    def trace(frame: FrameType, event: str, _: object) -> Callable[..., Any] | None:
        nonlocal lines
        if not frame.f_code.co_filename.endswith(modules):
            return None
        lines += event == "line"
        if lines == at:
            lines += 1
            raise KeyboardInterrupt
        return trace

    def stopped_at(folder: Path) -> None:
        sys.settrace(trace)
        try:
            run(log, out=folder, preset=preset)
        except KeyboardInterrupt:
            pass
        finally:
            sys.settrace(None)

    at = -1
    stopped_at(tmp_path / "whole")
    kept = []
    for at in np.random.default_rng(0).integers(1, lines, 40).tolist():
        lines, out = 0, tmp_path / str(at)
        stopped_at(out)
        if (part_of(out / "dive") / "sightings.csv").is_file():  # made last
            part = part_of(out / "dive")
            kept.append(len(frames(part)))
            assert frames(part) == list(range(kept[-1])), at
            passes = read_sightings(part) if kept[-1] else []
            assert all(one.last_frame < kept[-1] for one in passes)
    assert len(kept) > 20


@pytest.mark.parametrize("size", but_first([15_000, 100, 6_000]))
def test_a_full_disk_is_one_line_and_costs_no_frame(log: Path, tmp_path: Path, size: int) -> None:
    """No file may grow beyond a size, as on a disk that has no more room."""
    out = tmp_path / "out"
    sonarrec("run", "-q", short(tmp_path, "dive"), "-o", out)
    old = (out / "dive" / "estimates.csv").read_bytes()

    full = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (size, size))
    call = command("run", "-q", log, "-o", out, "--overwrite")
    done = subprocess.run(call, capture_output=True, text=True, preexec_fn=full)
    assert done.returncode == 1
    [line] = done.stderr.splitlines()
    assert "cannot write" in line
    assert (out / "dive" / "estimates.csv").read_bytes() == old
    part = part_of(out / "dive")
    if size > 10_000:
        assert f"{part}: " in line
        assert 0 < len(frames(part)) < FRAMES
        assert f"the {len(frames(part))} frames before" in line
        assert not finished(part)


def test_a_file_in_the_place_of_results_is_refused(log: Path, tmp_path: Path) -> None:
    """It was moved to a hidden name unsaid, and no run could replace the results after that."""
    mine = tmp_path / "dive"
    mine.write_text("my notes")
    for words in ((), ("--overwrite",), ("--dry-run",)):
        told = sonarrec("run", log, "--frames", ":1", "-o", tmp_path, *words, code=1)
        assert f"{mine}: a file" in told.output
    assert mine.read_text() == "my notes"
    assert [*tmp_path.iterdir()] == [mine]


@pytest.mark.slow
def test_a_second_run_into_the_same_folder_is_refused(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = subprocess.Popen(command("run", "-q", log, "-o", out))
    until(lambda: (part_of(out / "dive") / "frames.csv").is_file())
    os.kill(first.pid, signal.SIGSTOP)
    try:
        told = sonarrec("run", "-q", log, "-o", out, code=1).stderr
    finally:
        os.kill(first.pid, signal.SIGCONT)
    assert "another run" in told
    assert first.wait() == 0
    assert frames(out / "dive") == list(range(FRAMES))


def test_what_a_run_left_is_not_counted_with_finished_results(tmp_path: Path) -> None:
    """Its part; and what it laid aside, killed before it could put the new ones in their place or
    delete the old ones."""
    for name in ("a", "a.part", "b.part", ".b.old", "c.part", ".c.part.old", "d", ".d.old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "frames.csv").write_text("frame\n")
    assert [p.name for p in find_logs(tmp_path)] == ["a", "b.part", "c.part", "d"]


def test_results_that_may_not_be_read_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    out = run(short(tmp_path, "dive"), tmp_path / "out").folder.parent
    truth = tmp_path / "gt.csv"
    truth.write_text("log,frame,landmark\ndive,1,1\n")
    other = out / "of_another"
    again = shutil.copytree(out, tmp_path / "again")
    with locked(other), locked(again / "of_another"):
        for words in (
            ("evaluate", out, "--ground-truth", truth),
            ("evaluate", "--compare", out, again, "--ground-truth", truth),
            ("report", out, "-o", tmp_path / "report.html"),
            ("map", out, "-o", tmp_path / "map"),
            ("truth", "propose", out, "-o", tmp_path / "proposed.csv"),
        ):
            stderr = sonarrec(*words, code=3).stderr
            assert re.search(r"of_another.*: cannot be read \(Permission denied\)", stderr)
    other.rmdir()
    with locked(out / "lost+found"):  # of a file system
        assert [p.name for p in find_logs(out)] == ["dive"]


def test_an_exchange_that_was_broken_off_is_put_right(tmp_path: Path) -> None:
    folder = tmp_path / "dive"
    for place, text in ((folder, "old"), (part_of(folder), "new")):
        place.mkdir()
        (place / "run.toml").write_text(text)
    folder.rename(tmp_path / ".dive.old")  # the first of its two steps
    restore(folder)
    assert (folder / "run.toml").read_text() == "old"
    assert not exchange(folder)
    assert (folder / "run.toml").read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["dive"]


def test_files_of_the_user_that_cannot_be_moved_are_kept_and_told(tmp_path: Path) -> None:
    """Here as there is one of that name; a mount or a folder of somebody else stays as well."""
    folder = tmp_path / "dive"
    for place in (folder, part_of(folder)):
        (place / "notes").mkdir(parents=True)
        (place / "notes" / place.name).touch()
        (place / "frames.csv").write_text(place.name)
    [note] = exchange(folder)
    assert f"{folder}: other files" in note
    assert (folder / "frames.csv").read_text() == "dive.part"
    with pytest.raises(SonarrecError, match=r"also in .*\.dive\.old.*; move"):
        restore(folder)  # told before the next run begins
    assert [p.name for p in tmp_path.glob(".*/*/*")] == ["dive"]
    (folder / "notes").rename(tmp_path / "elsewhere")
    restore(folder)
    assert (folder / "notes" / "dive").is_file()
    assert not list(tmp_path.glob(".*"))


def test_nothing_is_written_through_a_link_in_the_place_of_the_results(tmp_path: Path) -> None:
    """It led to any folder of who planted it there; OUT itself may be a link."""
    log, out, disk = short(tmp_path), tmp_path / "out", tmp_path / "disk"
    disk.mkdir()
    out.symlink_to(disk)
    assert run(log, out).folder == out / "short"
    assert finished(disk / "short")
    (disk / "short").rename(disk / "elsewhere")
    (disk / "elsewhere" / "run.toml").unlink()
    (out / "short").symlink_to(disk / "elsewhere")
    before = sorted(p.name for p in disk.rglob("*"))
    with pytest.raises(SonarrecError, match="out/short"):
        run(log, out, overwrite=True)
    assert sorted(p.name for p in disk.rglob("*")) == before


def test_pages_of_results_that_were_replaced_are_told_and_of_no_others(tmp_path: Path) -> None:
    log, out = short(tmp_path), tmp_path / "out"
    sonarrec("run", "-q", log, "-o", out)
    (out / "report.html").write_text("a page")
    run = ("run", log, "-o", out)
    assert "report.html" not in sonarrec(*run).output  # up to date
    assert "report.html" in sonarrec(*run, "--overwrite").stderr
