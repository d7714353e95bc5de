"""Two recordings in one file of a sonar: nothing is lost unsaid, and the times' fall is told."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from sonarrec.readers import open_log
from tests.support.logs import frames
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
    assert note.startswith(f"{path}: times go back by {'1' if count == 12 else '0'}.")
    assert f"at frame {count} (were two recordings joined, or was the clock set?)" in note
