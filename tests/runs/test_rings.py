"""A run whose landmark set states a wrong ring or radius says so, by its own discs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from sonarrec.landmarks import load_landmarks
from tests.support.command import SAMPLE, sonarrec
from tests.support.slow import but_first


@pytest.mark.parametrize(
    ("changed", "told"),
    but_first(
        [
            ({}, ""),
            ({"radius_m": 0.14}, "radius_m may be about 0.14"),
            ({"radius_m": 0.16}, "radius_m may be about 0.15"),
            ({"ring": (0.72, 1.0)}, "the ring begin at about 0.7"),
        ],
        quick=2,
    ),
)
def test_a_wrong_ring_or_radius_is_told(changed: dict[str, Any], told: str, tmp_path: Path) -> None:
    """Before, no note was: some of these cost .2 to .8 of TPR elsewhere."""
    file = tmp_path / "set.toml"
    file.write_text(tomli_w.dumps(replace(load_landmarks("basin"), **changed).as_table()))
    done = sonarrec("run", SAMPLE, "--frames", ":60", "--landmarks", file, "-o", tmp_path / "out")
    notes = [line for line in done.stderr.splitlines() if "the rings of its discs" in line]
    assert len(notes) == bool(told)
    assert not told or (told in notes[0] and "--try-radii" in notes[0])


@pytest.mark.slow
def test_objects_that_are_no_landmarks_are_not_doubted(tmp_path: Path) -> None:
    log = SAMPLE.parents[2] / "shared" / "data" / "river" / "pike1.avi"
    if not log.exists():
        pytest.skip(f"test recording not found: {log}")
    for preset in ("default", "paper"):
        done = sonarrec("run", log, "-o", tmp_path, "--preset", preset, "--overwrite")
        assert "the rings of" not in done.stderr
