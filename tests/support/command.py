"""The program as a command."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

from click.testing import CliRunner, Result

from sonarrec.cli import main

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "pan"


def sample_log(folder: Path, count: int) -> Path:
    """The first frames of the sample log, and its geometry, in a folder that is made."""
    folder.mkdir(parents=True)
    for name in (*(f"{n:06d}.png" for n in range(count)), "sonar.toml"):
        shutil.copy(SAMPLE / name, folder)
    return folder


def sonarrec(*arguments: str | Path, code: int = 0, **options: str) -> Result:
    """One command; a traceback or another exit code than `code` fails the test.

    options: of CliRunner.invoke, such as `input`.
    """
    result = CliRunner().invoke(main, [str(a) for a in arguments], **options)  # type: ignore[arg-type]
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result


def on_a_terminal(*words: str, cwd: Path, **environment: str) -> bytes:
    """What a command shows on a terminal, which this makes one of."""
    import termios  # not on every system

    ours, theirs = os.openpty()
    termios.tcsetwinsize(theirs, (40, 120))
    subprocess.run(
        [sys.executable, "-m", "sonarrec", *words],
        cwd=cwd,
        env=os.environ | {"TERM": "xterm", "PAGER": "cat"} | environment,
        stdin=subprocess.DEVNULL,
        stdout=theirs,
        stderr=theirs,
        timeout=60,
    )
    os.set_blocking(ours, False)
    shown = b""
    with contextlib.suppress(BlockingIOError):
        while block := os.read(ours, 4096):
            shown += block
    for end in (ours, theirs):
        os.close(end)
    return shown
