"""No command writes over what it reads, nor over a file that is not of its own kind."""

from __future__ import annotations

import csv
import os
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result

from sonarrec.cli import main
from sonarrec.tables.outputs import escape_mathtext, with_mark, write_csv, write_text
from tests.support import command
from tests.support.batch import until
from tests.support.command import SAMPLE, sample_log
from tests.support.rows import read_rows
from tests.support.slow import but_first


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log, its truth and its results, and a landmark set."""
    folder = tmp_path_factory.mktemp("made")
    sample_log(folder / "log", 12)
    rows = (SAMPLE / "gt.csv").read_text().splitlines()
    kept = [rows[0], *(row for row in rows[1:] if int(row.split(",")[0]) < 12)]
    (folder / "gt.csv").write_text("\n".join(kept) + "\n")
    for name in ("pan.mcap", "pan.sonar.toml"):
        shutil.copy(SAMPLE.parent / name, folder)
    command.sonarrec("run", "-q", folder / "log", "-o", folder / "sonarrec_out")
    return folder


@pytest.fixture
def work(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(made, tmp_path / "work")
    shutil.copytree(made / TABLES, tmp_path / "work/before/log")
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def sonarrec(line: str) -> Result:
    return CliRunner().invoke(main, line.split())


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """As on a disk that is full once a file has this many bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


TABLES = "sonarrec_out/log"
EVALUATE = f"evaluate {TABLES} --ground-truth gt.csv"
COMPARE = f"--compare before/log {TABLES} --ground-truth gt.csv"
REFUSED = [
    f"report {TABLES} -o gt.csv",
    f"report {TABLES} --log log -o other.html",
    f"report {TABLES} -o other.html",
    f"overlay log {TABLES} -o link.mcap",
    f"overlay log {TABLES} -o other.mp4",
    f"overlay log {TABLES} -o log",
    "calibrate pan.mcap --ground-truth gt.csv -o pan.mcap",
    "calibrate log --ground-truth gt.csv -o log/sonar.toml",
    f"truth propose {TABLES} -o gt.csv",
    "truth convert coco.json -o gt.csv",
    "info log --preview log/000003.png",
    "info log --write-sonar log/sonar.toml",
    "landmarks -o others/000000.png",
    "simulate --frames 2 --scene basin -o mine.mcap",
    f"{EVALUATE} -o others",
    f"{EVALUATE} -o log",
    f"{EVALUATE} -o mine_1",  # where one file is not ours
    f"{EVALUATE} -o mine_2",
    f"evaluate {COMPARE} -o mine_3",
    f"map {TABLES} -o mine_4",
    f"map {TABLES} -o log",
    "run log -o .",
    "run log -o log",
    f"overlay log {TABLES} -o log/x.mp4",
    "run pan.mcap -o others",
    "landmarks -o log/lm.png",
    "simulate --frames 2 --scene basin -o log/x.mcap",
    "info pan.mcap --preview log/p.png",
    f"overlay pan.mcap {TABLES} -o log/x.mcap",
    "run log -o dives",
    "run pan.mcap -o dives",
]


@pytest.mark.parametrize("line", REFUSED)
def test_nothing_else_is_written_over(work: Path, line: str) -> None:
    os.link("pan.mcap", "link.mcap")
    for folder in ("others/pan", "dives/pan", *(f"mine_{n}" for n in (1, 2, 3, 4))):
        (work / folder).mkdir(parents=True)
    for picture in ("others/000000.png", "mine_2/roc.png"):
        cv2.imwrite(picture, np.zeros((8, 8), np.uint8))
    for name, text in (
        ("coco.json", '{"images": [], "categories": [], "annotations": []}'),
        ("others/passes.csv", "name,weight\n"),
        ("others/changes.csv", "name,weight\n"),
        ("others/pan/frames.csv", "frame,timestamp_ns\n0,0\n"),
        ("other.html", "<!doctype html><title>Mine</title>"),
        ("other.mp4", "\0\0\0\x18ftypmp42 and more"),
        ("mine.gt.csv", "frame,landmark\n"),
        ("mine.json", '{"mine": 1}'),
        ("mine_1/evaluation.json", '{"features": []}'),
        ("mine_3/compare.csv", '{"features": []}'),
        ("mine_4/map.geojson", '{"type": "FeatureCollection", "features": []}'),
    ):
        (work / name).write_text(text)
    shutil.copytree("log", "dives/log")
    shutil.copy("pan.mcap", "dives/pan")
    before = contents(work)
    done = sonarrec(line)
    assert done.exit_code in (1, 2), done.output
    assert isinstance(done.exception, SystemExit), done.exception
    [told] = done.stderr.splitlines()
    reasons = "exist|reads it|become a part|not written here|holds frames.csv|log itself|may be a"
    assert re.search(r"mine_\d/\S+: exists" if "mine_" in line else reasons, told)
    assert contents(work) == before


@pytest.mark.parametrize(
    "line",
    but_first(
        [
            f"{EVALUATE} -q",
            f"report {TABLES} -o r.html -q",
            f"overlay log {TABLES} -o o.mcap -q",
            "calibrate log --ground-truth gt.csv -o model.toml -q",
            f"evaluate {COMPARE} -q",
            f"map {TABLES} --origin 54,10,0 -q",
            "run log -q --overwrite",
        ],
        3,
    ),
)
@pytest.mark.usefixtures("work")
def test_what_a_command_wrote_it_writes_again(line: str) -> None:
    for _ in range(2):
        done = sonarrec(line)
        assert done.exit_code in (0, 3), done.output
        assert "not overwritten" not in done.stderr


@pytest.mark.parametrize(
    ("line", "full", "lost"),
    but_first(
        [
            (f"report {TABLES} -o o", "o", "-"),
            (f"map {TABLES} -o o", "o/map.csv", "-"),
            (f"evaluate {COMPARE} -o o", "o/compare.csv", "-"),
            # Where it stands the others are of one call.
            (f"{EVALUATE} -o o", "o/confusion.csv", "o/evaluation.json"),
            (f"overlay log {TABLES} -o o.mcap", "o.mcap", "-"),
            (f"overlay log {TABLES} -o o.mp4", "o.mp4", "-"),
        ],
        2,
    ),
)
def test_a_full_disk_leaves_what_was_there(work: Path, line: str, full: str, lost: str) -> None:
    assert sonarrec(line).exit_code in (0, 3)
    before = contents(work)
    with files_of_at_most(130):
        done = sonarrec(line)
    assert done.exit_code == 1
    [told] = done.stderr.splitlines()
    assert told.startswith(f"sonarrec: {full}: ")
    assert "written (File too large)" in told or "is the disk full?" in told
    assert contents(work) == {p: b for p, b in before.items() if p != work / lost}


@pytest.mark.parametrize("cell", ["a\r\nb", "a\nb", 'a"b', "a,b", " a ", "d\udce9j"])
def test_every_cell_is_read_back_by_another_reader(cell: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_csv(path, ["n", cell], [[1, cell], [cell, 2]])
    with path.open(newline="", encoding="utf-8", errors="surrogateescape") as file:
        assert [*csv.reader(file)] == [["n", cell], ["1", cell], [cell, "2"]]
    assert path.read_bytes().endswith(b",2\n")


def test_what_is_replaced_keeps_its_links_and_rights(tmp_path: Path) -> None:
    link, path = tmp_path / "link", tmp_path / "there" / "page"
    path.parent.mkdir()
    link.symlink_to(path)
    write_text(link, "first")
    path.chmod(0o600)
    write_text(link, "second")
    assert link.is_symlink()
    assert contents(path.parent) == {path: b"second"}
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_marked_png_is_the_same_picture() -> None:
    picture = np.random.default_rng(0).integers(0, 255, (20, 30, 3)).astype(np.uint8)
    data = with_mark(cv2.imencode(".png", picture)[1].tobytes())
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read, picture)


def test_a_read_only_folder_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("ro").mkdir()
    monkeypatch.setattr(os, "access", lambda *_: False)
    done = sonarrec("landmarks basin -o ro/x.png")
    assert (done.exit_code, "ro may not be written to" in done.stderr) == (1, True)


@pytest.mark.usefixtures("work")
def test_a_picture_beside_other_pictures_is_no_part_of_a_recording() -> None:
    for name in ("figure1.png", "figure2.png", "photo.png"):
        cv2.imwrite(name, np.zeros((8, 8), np.uint8))
    for _ in range(2):
        assert sonarrec("landmarks -q -o lm.png").exit_code == 0
    cv2.imwrite("figure3.png", np.zeros((8, 8), np.uint8))
    assert sonarrec("landmarks -o lm.png").exit_code == 2  # it may be a recording


@pytest.mark.parametrize("out", but_first(["new", "x.mcap", "new/x.mcap", "there"], 2))
def test_a_simulation_on_a_full_disk_leaves_nothing(work: Path, out: str) -> None:
    (work / "there").mkdir()
    before, folders = contents(work), {p for p in work.rglob("*") if p.is_dir()}
    with files_of_at_most(3000):
        done = sonarrec(f"simulate --frames 3 -q -o {out}")
    assert (done.exit_code, len(done.stderr.splitlines())) == (1, 1)
    assert contents(work) == before
    assert {p for p in work.rglob("*") if p.is_dir()} == folders
    assert sonarrec(f"simulate --frames 3 -q -o {out}").exit_code == 0


def begun_simulation(work: Path) -> subprocess.Popen[bytes]:
    """A long one, that has begun to write.

    Not as it begins: compiled code of numpy and msgspec, which imports modules and checks the
    scene, drops exceptions that are raised meanwhile, and with them the signal."""
    words = [sys.executable, "-m", "sonarrec", "simulate", "--frames", "100000", "-o", "x.mcap"]
    process = subprocess.Popen(words, cwd=work, stderr=subprocess.DEVNULL)
    until(lambda: any(p.stat().st_size > 10**6 for p in work.glob(".*.new/x.mcap")))
    return process


@pytest.mark.slow
def test_a_simulation_that_is_terminated_leaves_nothing(work: Path) -> None:
    process = begun_simulation(work)
    process.terminate()
    assert process.wait(30) == 143
    assert not [path for path in work.iterdir() if path.name.startswith((".", "x"))]


@pytest.mark.slow
def test_what_a_killed_simulation_left_is_removed_by_the_next(work: Path) -> None:
    process = begun_simulation(work)
    process.kill()
    process.wait()
    (left,) = work.glob(".*.new")
    of_a_running_process = left.with_name(left.name.replace(str(process.pid), str(os.getpid())))
    of_a_running_process.mkdir()
    assert sonarrec("simulate --frames 3 -q -o x.mcap").exit_code == 0
    assert [*work.glob(".*.new")] == [of_a_running_process]


@pytest.mark.parametrize(
    ("line", "link"),
    but_first(
        [
            (EVALUATE, f"{TABLES}/evaluation"),
            (EVALUATE, f"{TABLES}/evaluation/roc.png"),
            (f"report {TABLES}", f"{TABLES}/report.html"),
            ("run log --overwrite", "sonarrec_out/.log.old"),
            (EVALUATE, f"{TABLES}/evaluation/confusion.csv"),
            (f"evaluate {COMPARE}", f"{TABLES}/evaluation"),
            (f"map {TABLES}", f"{TABLES}/map"),
            (f"map {TABLES}", f"{TABLES}/map/map.csv"),
            ("run log --overwrite", "sonarrec_out/log.part"),
        ],
        4,
    ),
)
def test_no_link_in_a_results_folder_is_followed(work: Path, line: str, link: str) -> None:
    place = work / link
    precious = work / "precious"
    precious.mkdir()
    for table in ("frames.csv", "sightings.csv"):
        (precious / table).write_text("mine")
    place.parent.mkdir(exist_ok=True)
    place.symlink_to(precious / "frames.csv" if place.suffix in (".csv", ".png") else precious)
    before = contents(precious)
    done = sonarrec(line)
    assert done.exit_code == 2, done.output
    assert "a link" in done.stderr
    assert contents(precious) == before
    named = sonarrec(f"{line} -o {place}") if place.parent.name == "log" else None
    if named is not None and place.suffix == "":  # what the user names is followed
        assert named.exit_code in (0, 3), named.output
        assert len(contents(precious)) > 2


def test_logs_csv_is_never_a_link(work: Path) -> None:
    table = work / "sonarrec_out" / "logs.csv"
    table.rename(work / "mine.csv")
    table.symlink_to(work / "mine.csv")
    before = (work / "mine.csv").read_bytes()
    done = sonarrec("run log --overwrite")
    assert "a link" in done.stderr
    assert (work / "mine.csv").read_bytes() == before


@pytest.mark.usefixtures("work")
def test_names_that_spreadsheets_would_compute() -> None:
    names = ("=1+1", "+cmd", "@cmd", "a\rb", "plain")
    for name in names:
        sample_log(Path(name), 2)
    for _ in range(2):  # again, with the rows of before
        done = command.sonarrec("run", *names, "-o", "out", "-j", "1", "-q")
        assert not done.stderr
    rows = read_rows(Path("out/logs.csv"))
    assert len(rows) == len(names)
    assert {row["status"] for row in rows} == {"done"}
    assert not [cell for row in rows for cell in row.values() if cell[:1] in ("=", "+", "@")]


def test_names_are_no_formulas_in_pictures() -> None:
    assert escape_mathtext("a$b$c") == r"a\$b\$c"
    assert escape_mathtext("_hidden") == " _hidden"  # matplotlib leaves it out of legends
    assert escape_mathtext("mine_1") == "mine_1"
