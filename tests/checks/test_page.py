"""`sonarrec help check` as written: its file for GitHub Actions."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from tests.checks.test_check import FILE, log

PAGE = Path(__file__).parents[2] / "sonarrec" / "help" / "check.md"


def workflow() -> str:
    found = re.search(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return found[1]


def bash(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    paths = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": paths}
    return subprocess.run(
        ["bash", "-e", "-c", command], cwd=folder, env=environment, capture_output=True, text=True
    )


@pytest.mark.slow
def test_the_steps_compare(tmp_path: Path) -> None:
    log(tmp_path, frames=16)
    (tmp_path / FILE).write_text('[[log]]\npath = "faint"\n')
    (job,) = YAML(typ="safe").load(workflow())["jobs"].values()
    steps = [step["run"] for step in job["steps"] if "run" in step]
    assert [step.split()[:2] for step in steps] == [["pip", "install"], ["sonarrec", "check"]]
    (kept,) = [s["with"] for s in job["steps"] if "upload-artifact" in s.get("uses", "")]

    assert bash("sonarrec check --update", tmp_path).returncode == 0
    done = bash(steps[1], tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("unchanged: TPR ")
    assert (tmp_path / kept["path"] / "faint" / "estimates.csv").is_file()

    (tmp_path / FILE).write_text('set = ["features.declare=0.999"]\n[[log]]\npath = "faint"\n')
    worse = bash(steps[1], tmp_path)
    assert worse.returncode == 4
    assert worse.stdout.startswith("worse: TPR ")
