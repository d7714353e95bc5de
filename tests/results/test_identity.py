"""Results of an earlier program are told from today's, and made anew."""

from __future__ import annotations

import hashlib
import itertools
import os
import shutil
import zlib
from pathlib import Path

import pytest
from click.testing import CliRunner

from sonarrec import __version__
from sonarrec.cli import main
from sonarrec.readers import open_log
from sonarrec.results.identity import RESULTS_VERSION
from sonarrec.results.run_file import read_run
from sonarrec.runs.recorded import outdated
from tests.support.command import SAMPLE, sample_log, sonarrec
from tests.support.logs import frames, image_folder

SAMPLES = SAMPLE.parent
RECORDED = (6, "d6f157943c6362c1d8dde0c5094b92206e512f35682a8a68a8771bc384eaff35")
"""RESULTS_VERSION when the tables on record last changed, and their digest."""


def test_other_tables_on_record_ask_for_another_results_version() -> None:
    digest = hashlib.sha256()
    tables = [f for f in SAMPLES.rglob("*.csv") if f.name in ("frames.csv", "estimates.csv")]
    assert len(tables) >= 6
    for table in sorted(tables):
        digest.update(table.relative_to(SAMPLES).as_posix().encode() + table.read_bytes())
    changed = digest.hexdigest() != RECORDED[1]
    number = RECORDED[0] + 1 if changed and RECORDED[0] == RESULTS_VERSION else RESULTS_VERSION
    assert (RESULTS_VERSION, digest.hexdigest()) == RECORDED, (
        f"the tables on record changed: set RESULTS_VERSION = {number} in "
        f'sonarrec/results/identity.py, and RECORDED = ({number}, "{digest.hexdigest()}") here'
    )


def output(*words: str | Path) -> str:
    """What a command prints, however it ends: eight frames are few."""
    return CliRunner().invoke(main, [*map(str, words)]).output


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """The folder of the results of eight frames."""
    log = sample_log(tmp_path / "pan", 8)
    sonarrec("run", log, "-o", tmp_path / "out", "-q")
    return tmp_path / "out" / "pan"


def test_results_of_another_version_are_told_by_all_that_use_them_and_made_anew(
    results: Path,
) -> None:
    home, file = results.parents[1], results / "run.toml"
    log = home / "pan"
    used = [
        ("evaluate", results, "--ground-truth", SAMPLE / "gt.csv", "-q"),  # which keeps notes
        ("overlay", log, results, "-o", home / "o.mcap"),
        ("report", results),
        ("truth", "review", log, "--results", results, "-o", home / "review.html"),
        ("map", results, "-o", home / "map"),
    ]
    for words in used:
        assert "another version" not in output(*words)
    text = file.read_text()
    file.write_text(text.replace(f"results_version = {RESULTS_VERSION}\n", ""))
    for words in used:
        assert "another version" in output(*words), words
    assert "another version" in sonarrec("run", log, "-o", home / "out").stderr
    assert file.read_text() == text
    assert "up to date" in sonarrec("run", log, "-o", home / "out").stdout


@pytest.mark.parametrize("key", ["model_sha256", "settings_sha256", "seed"])
def test_another_model_and_edited_settings_are_told(results: Path, key: str) -> None:
    file = results / "run.toml"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(f"{key} = 7" if x.startswith(f"{key} =") else x for x in lines))
    (line,) = outdated([results, results])
    assert "1 more" in line


def test_results_of_a_version_in_development_are_outdated(results: Path) -> None:
    assert outdated([results]) == []
    text = (results / "run.toml").read_text()
    (results / "run.toml").write_text(text.replace(f'"{__version__}"', f'"{__version__}.dev0"'))
    assert len(outdated([results])) == 1


def test_results_of_another_program_are_not_outdated(tmp_path: Path) -> None:
    (tmp_path / "run.toml").write_text('[program]\nname = "theirs"\n')
    assert outdated([tmp_path, tmp_path / "without"]) == []


@pytest.mark.parametrize(
    ("name", "old", "new", "told"),
    [
        ("sonar.toml", "", "# checked\n", ""),
        ("sonar.toml", "tilt_deg = 20.0", "tilt_deg = 25.0", "tilt_deg"),
        ("sonar.toml", "height_m = 0.68\n", "", "height_m"),
        ("landmarks.toml", "", "", ""),
        ("landmarks.toml", "radius_m = 0.15", "radius_m = 0.16", "radius_m"),
    ],
)
def test_a_file_beside_the_log_that_changed_since_is_told(
    results: Path, name: str, old: str, new: str, told: str
) -> None:
    file = results.parents[1] / "pan" / name
    if name == "landmarks.toml":
        shutil.copy(SAMPLES.parent / "sonarrec" / "landmark_sets" / "basin.toml", file)
    text = file.read_text()
    file.write_text(text.replace(old, new, 1) if old else new + text)
    assert (text != file.read_text()) == bool(old or new)
    made = (results / "run.toml").stat().st_mtime_ns
    os.utime(file, ns=(made, made))
    assert outdated([results]) == [], "as old as the results: an option may have replaced it"
    os.utime(file, ns=(made, made + 10**9))
    for words in (("map", results), ("evaluate", results, "--ground-truth", SAMPLE / "gt.csv")):
        lines = [line for line in output(*words).splitlines() if "changed after the run" in line]
        assert len(lines) == bool(told)
        assert all(told in line and name in line for line in lines)


def test_a_log_digested_another_way_is_changed(tmp_path: Path) -> None:
    """By its size alone, images with every pixel inverted were up to date."""
    log, file = image_folder(tmp_path / "log", frames(4)), tmp_path / "out" / "log" / "run.toml"
    sonarrec("run", log, "-o", tmp_path / "out")
    made = file.read_text()
    sha256 = read_run(file).input.sha256
    assert sha256 is not None
    file.write_text(made.replace(sha256, sha256[::-1]))
    told = sonarrec("overlay", log, tmp_path / "out", "-o", tmp_path / "o", code=1).stderr
    assert "another log" in told
    assert "replaced" in sonarrec("run", log, "-o", tmp_path / "out").stderr
    assert file.read_text() == made


def test_pixels_of_equal_size_and_crc_32_are_another_log(tmp_path: Path) -> None:
    """The digest of several files was one of their CRC-32, which is easily made equal."""
    log, (a, b) = image_folder(tmp_path / "log", frames(4)), _equal_crc()
    assert zlib.crc32(a) == zlib.crc32(b)
    found = set()
    for added in (a, b):
        whole = (tmp_path / "log" / "frame1.png").read_bytes()
        (log / "frame1.png").write_bytes(whole + added)
        with open_log(log) as opened:
            found.add(opened.digest_source().sha256)
        (log / "frame1.png").write_bytes(whole)
    assert len(found) == 2


def _equal_crc() -> tuple[bytes, bytes]:
    """Two texts of eight bytes with one CRC-32, for whatever is before them: it is linear."""
    seen = dict[int, bytes]()
    for n in itertools.count():
        text = hashlib.sha256(str(n).encode()).digest()[:8]
        if (other := seen.setdefault(zlib.crc32(text), text)) != text:
            return other, text
    raise AssertionError
