"""The program as a command."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner, Result

from sonarrec.cli import main

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "pan"


def sonarrec(*arguments: str | Path, code: int = 0, **options: str) -> Result:
    """One command; a traceback or another exit code than `code` fails the test.

    options: of CliRunner.invoke, such as `input`.
    """
    result = CliRunner().invoke(main, [str(a) for a in arguments], **options)  # type: ignore[arg-type]
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result
