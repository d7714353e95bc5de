"""What continuous integration says at its end: which tests were skipped, and why."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

RUN = Path(__file__).resolve().parents[1] / ".ci" / "run"
SKIPPED = "SKIPPED [24] tests/support/browser.py:44: no chromium and chromedriver on the PATH"
TOOLS = ("bash", "env", "dirname", "mkdir", "rm", "tee", "grep")


def run(folder: Path, make: str, stubs: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """.ci/run where only a few tools exist, and `make` is a script."""
    (folder / ".ci").mkdir()
    shutil.copy(RUN, folder / ".ci" / "run")
    tools = folder / "bin"
    tools.mkdir()
    for name in TOOLS:
        found = shutil.which(name)
        assert found is not None
        (tools / name).symlink_to(found)
    for name, script in ({"make": make} | stubs).items():
        (tools / name).write_text(f"#!{shutil.which('bash')}\n{script}\n")
        (tools / name).chmod(0o755)
    return subprocess.run(
        [folder / ".ci" / "run"],
        env=os.environ | {"PATH": str(tools)},
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.mark.parametrize(
    ("stubs", "reason"),
    [
        ({"id": "echo 1000"}, "not root"),
        ({"id": "echo 0"}, "no apt-get"),
        ({"id": "echo 0", "apt-get": "exit 100"}, "apt-get could not install them"),
    ],
)
def test_without_a_browser_the_last_lines_say_so(
    tmp_path: Path, stubs: dict[str, str], reason: str
) -> None:
    found = run(tmp_path, f'[ "$1" != test ] || echo "{SKIPPED}"', stubs)
    assert found.returncode == 0, found.stderr
    assert found.stdout.splitlines()[-2:] == [
        SKIPPED,
        f"The report was not opened in a browser: no chromium and chromedriver ({reason}).",
    ]


def test_with_a_browser_nothing_is_installed(tmp_path: Path) -> None:
    stubs = {"chromium": "", "chromedriver": "", "apt-get": "exit 100", "id": "echo 0"}
    found = run(tmp_path, 'echo "made $1"', stubs)
    assert found.returncode == 0
    assert [line for line in found.stdout.splitlines() if line] == [
        "made lint",
        "made test",
        "made test-slow",
        "made regression",
        "No test was skipped.",
    ]


@pytest.mark.parametrize("failing", ["test", "test-slow"])
def test_failing_tests_fail_it(tmp_path: Path, failing: str) -> None:
    """What was skipped is told all the same."""
    make = f'[ "$1" != {failing} ] || {{ echo "{SKIPPED}"; exit 1; }}'
    found = run(tmp_path, make, {"id": "echo 9"})
    assert found.returncode == 1
    assert SKIPPED in found.stdout.splitlines()[-2]
