"""The Slurm array of help/run.md, run as it stands there; srun runs its words here."""

from __future__ import annotations

import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.batch import rows
from tests.support.logs import cdr_image, frames, mcap_file
from tests.test_docs import PAGES, code_lines

pytestmark = pytest.mark.slow

BIN = Path(sys.executable).parent
LOGS = ("a", "b", "c", "d")


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


def test_a_slurm_array(shared: Path) -> None:
    """Every log is done, by one of the tasks, of which none had nothing to do."""
    blocks = re.split(r"\n\n+", "\n".join(code_lines(PAGES["run"])))
    [script] = (block for block in blocks if re.search("(?m)^#SBATCH", block))
    (shared / "job.sh").write_text(f"{script}\n")
    given = {"SLURM_ARRAY_TASK_COUNT": "2", "SLURM_CPUS_PER_TASK": "1", "SCRATCH": str(shared)}
    given["PATH"] = os.pathsep.join([f"{shared.parent}/bin", str(BIN), os.environ["PATH"]])

    def task(number: int) -> str:
        env = os.environ | given | {"SLURM_ARRAY_TASK_ID": str(number)}
        return subprocess.run(
            ["sh", "job.sh"], cwd=shared, env=env, capture_output=True, text=True, check=True
        ).stdout

    done = [re.findall(r"(?m)^(?:.*results/)?(\w)(?: +3 |: 3 frames)", task(n)) for n in (1, 2)]
    assert sorted(done[0] + done[1]) == [*LOGS]
    assert all(done)
    status = {name: row["status"] for name, row in rows(shared / "results").items()}
    assert status == dict.fromkeys(LOGS, "done")
    assert "2 up" in task(1)
