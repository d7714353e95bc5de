"""Two recordings in one file of a sonar: nothing is lost unsaid, and the times' fall is told."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from sonarrec.readers import open_log
from tests.support.logs import PERIOD_NS, cdr_image, frames, mcap_file
from tests.support.sonar_files import aris_file, gemini_log, gemini_record, oculus_ping

IMAGES = [np.ascontiguousarray(image) for image in frames(12, 64, 48)]


@pytest.mark.parametrize(
    ("name", "count"),
    # Of the last one times fall by less than a second.
    [(name, 12) for name in ("log.raw", "log.aris", "stored.glf", "packed.glf", "one.glf")]
    + [("log.aris", 7)],
)
def test_times_that_go_back_are_told(tmp_path: Path, name: str, count: int) -> None:
    path, numbered = tmp_path / name, list(enumerate(IMAGES[:count]))
    if name == "log.raw":
        path.write_bytes(b"".join(oculus_ping(k, image) for k, image in numbered))
    elif name == "log.aris":
        aris_file(path, IMAGES[:count])
    else:
        records = [gemini_record(k, image) for k, image in numbered]
        method = zipfile.ZIP_STORED if name == "stored.glf" else zipfile.ZIP_DEFLATED
        gemini_log(path, records * (2 if name == "one.glf" else 1), method)
    if name != "one.glf":
        path.write_bytes(2 * path.read_bytes())
    with open_log(path, sonar={"tilt_deg": 20.0}) as log:
        assert len(list(log)) == 2 * count
        assert not log.diagnostics.problems
        (note,) = (note for note in log.diagnostics.notes if "times go back" in note)
    assert note.startswith(f"{path}: times go")
    assert f"frame {count} (were" in note


@pytest.mark.parametrize("unset", [1, 3])
def test_a_clock_that_was_set_after_the_first_frames_is_told(unset: int, tmp_path: Path) -> None:
    set_ns = 1_717_000_000 * 10**9
    times = [k * PERIOD_NS + (k >= unset) * set_ns for k in range(8)]
    stored = [("/s", time, cdr_image(i)) for time, i in zip(times, frames(8), strict=True)]
    with open_log(mcap_file(tmp_path / "log.mcap", stored)) as log:
        assert [frame.timestamp_ns for frame in log] == times
        assert any(f"at frame {unset}" in note for note in log.diagnostics.notes)


@pytest.mark.parametrize(("divisor", "unit"), [(1, ""), (1_000, "us"), (10**6, "ms")])
def test_a_rate_that_no_sonar_has_is_told_with_the_unit_that_fits(
    divisor: int, unit: str, tmp_path: Path
) -> None:
    stored = [("/s", k * PERIOD_NS // divisor, cdr_image(i)) for k, i in enumerate(frames(8))]
    with open_log(mcap_file(tmp_path / "log.mcap", stored)) as log:
        list(log)
        told = [note for note in log.diagnostics.notes if "a second" in note]
    assert [f"in {unit} it has 4" in note for note in told] == [True] * bool(unit)
