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
from tests.support.command import sonarrec

PAGE = Path(__file__).parents[2] / "sonarrec" / "help" / "check.md"


@pytest.mark.slow
def test_the_steps_compare(tmp_path: Path) -> None:
    [workflow] = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (job,) = YAML(typ="safe").load(workflow)["jobs"].values()
    steps = [step["run"] for step in job["steps"] if "run" in step]
    assert [step.split()[:2] for step in steps] == [["pip", "install"], ["sonarrec", "check"]]
    (kept,) = [s["with"] for s in job["steps"] if "upload-artifact" in s.get("uses", "")]
    log(tmp_path, frames=16)
    (tmp_path / FILE).write_text('[[log]]\npath = "faint"\n')
    sonarrec("check", tmp_path / FILE, "--update")
    paths = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    bash = ["bash", "-e", "-c", steps[1]]
    done = subprocess.run(bash, cwd=tmp_path, env=os.environ | {"PATH": paths}, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(b"unchanged: TPR ")
    assert (tmp_path / kept["path"] / "faint" / "estimates.csv").is_file()
