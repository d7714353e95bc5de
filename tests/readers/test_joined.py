"""Two recordings in one file of a sonar: nothing is lost unsaid, and the times' fall is told."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from tests.support.logs import PERIOD_NS, cdr_image, frames, mcap_file, read
from tests.support.sonar_files import aris_file, gemini_log, gemini_record, oculus_file

IMAGES = frames(12, 64, 48)


@pytest.mark.parametrize(
    ("name", "count"),
    # Of the last one times fall by less than a second.
    [(name, 12) for name in ("log.raw", "log.aris", "stored.glf", "packed.glf", "one.glf")]
    + [("log.aris", 7)],
)
def test_times_that_go_back_are_told(tmp_path: Path, name: str, count: int) -> None:
    path, images = tmp_path / name, IMAGES[:count]
    if name == "log.raw":
        oculus_file(path, images)
    elif name == "log.aris":
        aris_file(path, images)
    else:
        records = [gemini_record(k, image) for k, image in enumerate(images)]
        method = zipfile.ZIP_STORED if name == "stored.glf" else zipfile.ZIP_DEFLATED
        gemini_log(path, records * (2 if name == "one.glf" else 1), method)
    if name != "one.glf":
        path.write_bytes(2 * path.read_bytes())
    found, problems, notes = read(path, sonar={"tilt_deg": 20.0})
    assert len(found) == 2 * count
    assert not problems
    (note,) = (note for note in notes if "times go back" in note)
    assert f"frame {count} (were" in note


@pytest.mark.parametrize("unset", [1, 3])
def test_a_clock_that_was_set_after_the_first_frames_is_told(unset: int, tmp_path: Path) -> None:
    set_ns = 1_717_000_000 * 10**9
    times = [k * PERIOD_NS + (k >= unset) * set_ns for k in range(8)]
    stored = [("/s", time, cdr_image(i)) for time, i in zip(times, frames(8), strict=True)]
    found = read(mcap_file(tmp_path / "log.mcap", stored))
    assert found.times == times
    assert any(f"at frame {unset}" in note for note in found.notes)


@pytest.mark.parametrize(("divisor", "unit"), [(1, ""), (1_000, "us"), (10**6, "ms")])
def test_a_rate_that_no_sonar_has_is_told_with_the_unit_that_fits(
    divisor: int, unit: str, tmp_path: Path
) -> None:
    stored = [("/s", k * PERIOD_NS // divisor, cdr_image(i)) for k, i in enumerate(frames(8))]
    notes = read(mcap_file(tmp_path / "log.mcap", stored)).notes
    told = [note for note in notes if "a second" in note]
    assert [f"in {unit} it has 4" in note for note in told] == [True] * bool(unit)
