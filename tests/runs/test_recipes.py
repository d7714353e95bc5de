"""The Slurm array of help/run.md, run as it stands there; srun runs its words here."""

from __future__ import annotations

import os
import re
import stat
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.support.batch import rows
from tests.support.logs import cdr_image, frames, mcap_file
from tests.test_docs import PAGES, code_lines

pytestmark = pytest.mark.slow

BIN = Path(sys.executable).parent
LOGS = ("a", "b", "c", "d")


def recipe(beginning: str) -> str:
    """The block of the page that has a line beginning so, as it would be in a file."""
    text = "\n".join(code_lines(PAGES["run"]))
    (found,) = [b for b in re.split(r"\n\n+", text) if re.search(f"(?m)^{beginning}", b)]
    return found + "\n"


@pytest.fixture
def shared(tmp_path: Path) -> Path:
    """A folder that all machines see, with four logs in two folders and the program's .venv."""
    place = tmp_path / "shared"
    for n, name in enumerate(LOGS):
        log = place / "dives" / str(n % 2) / f"{name}.mcap"
        images = frames(3, seed=n)
        mcap_file(log, [("/s", k * 10**8, cdr_image(image)) for k, image in enumerate(images)])
    (place / ".venv").mkdir()
    (place / ".venv" / "bin").symlink_to(BIN)
    (tmp_path / "bin").mkdir()
    srun = tmp_path / "bin" / "srun"
    srun.write_text('#!/bin/sh\nexec "$@"\n')
    srun.chmod(srun.stat().st_mode | stat.S_IXUSR)
    return place


def printed(words: Sequence[str], cwd: Path, **environment: object) -> str:
    """What a recipe prints; it has to end well."""
    path = os.pathsep.join(
        [*(f"{at}/bin" for at in (cwd, cwd.parent)), str(BIN), os.environ["PATH"]]
    )
    env = os.environ | {"PATH": path} | {name: str(v) for name, v in environment.items()}
    done = subprocess.run(words, cwd=cwd, env=env, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


def assert_once(shares: Sequence[str], out: Path) -> None:
    """Every log is done, by one of the shares, of which none had nothing to do."""
    done = [re.findall(r"(?m)^(?:.*results/)?(\w)(?: +3 |: 3 frames)", text) for text in shares]
    assert Counter(name for share in done for name in share) == Counter(LOGS)
    assert all(done)
    assert {name: row["status"] for name, row in rows(out).items()} == dict.fromkeys(LOGS, "done")


def test_a_slurm_array(shared: Path) -> None:
    script = shared / "job.sh"
    script.write_text(recipe("#SBATCH"))
    given = {"SLURM_ARRAY_TASK_COUNT": 2, "SLURM_CPUS_PER_TASK": 1, "SCRATCH": shared}

    def task(number: int) -> str:
        return printed(["sh", str(script)], shared, SLURM_ARRAY_TASK_ID=number, **given)

    assert_once([task(number) for number in (1, 2)], shared / "results")
    assert "2 up" in task(1)
