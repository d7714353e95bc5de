"""What `make bench` measures and no quick machine is needed for: memory."""

from __future__ import annotations

import re
import shutil
import sys
from dataclasses import replace
from importlib import resources
from pathlib import Path

import pytest

from sonarrec.simulation.simulate import write_recording
from tests.studies.bench import PARTS, wide
from tests.support.batch import peak_mb

FRAMES, LONG = 16, 64
# MB. Limits; most of it is taken before the 40th frame.
PEAKS = {"default": 150, "offline": 200}
SOUGHT = 160  # where landmarks have another size, and rings of many radii are sought at the end


@pytest.mark.slow
def test_a_run_at_130_deg_stays_within_its_memory(tmp_path: Path) -> None:
    log = tmp_path / "wide"
    write_recording(replace(wide(), frames=FRAMES), log)
    pictures = sorted(log.glob("*.png"))
    for n in range(FRAMES, LONG):
        shutil.copy(pictures[n % FRAMES], log / f"{n:06d}.png")
    out = str(tmp_path / "out")
    command = [sys.executable, "-m", "sonarrec", "run", str(log), "-q", "--overwrite", "-o", out]
    for preset, most in PEAKS.items():
        assert 60 < peak_mb([*command, "--preset", preset]) < most, preset
    basin = resources.files("sonarrec").joinpath("landmark_sets", "basin.toml").read_text("utf-8")
    own = re.sub("radius_m = .*", "radius_m = 0.26", basin)
    (tmp_path / "own.toml").write_text(own, encoding="utf-8")
    assert 60 < peak_mb([*command, "--landmarks", str(tmp_path / "own.toml")]) < SOUGHT


def test_what_is_timed_is_there() -> None:
    missing = [
        (owner, name)
        for _, functions in PARTS.values()
        for owner, name in functions
        if not hasattr(owner, name)
    ]
    assert not missing
