"""`sonarrec status`: the progress of a run over many logs."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from time import time
from typing import TYPE_CHECKING, Any

import click

from sonarrec.cli import options
from sonarrec.cli.endings import say
from sonarrec.cli.groups import command
from sonarrec.errors import UsageError, number_of

if TYPE_CHECKING:
    from sonarrec.runs.logs_table import Row


@command(short_help="Show the progress of a run over many logs, and what failed.")
@click.argument("out", type=options.FOLDER_OR_URL, default=Path("sonarrec_out"))
@options.json()
@options.cache
def status(out: Path | str, as_json: bool, cache: options.GetCache) -> None:
    """Print how many logs of OUT (default: sonarrec_out) are done, and which failed and why.

    It reads OUT/logs.csv, which `sonarrec run` updates while it runs. So it can be called from
    another terminal, or from another machine that has access to the folder. A run whose OUT is on a
    server uploads the file at its end.

    \b
    Examples:
      sonarrec status
      sonarrec status results --json
    """
    from sonarrec.remote.run import RemoteFiles, inside

    with ExitStack() as stack:
        path = RemoteFiles(stack, cache).file(inside(out, "logs.csv"))
        assert path is not None
        _tell(path, out, as_json)


def _tell(path: Path, out: Path | str, as_json: bool) -> None:
    from sonarrec.runs.logs_table import read_logs

    if not path.is_file():
        raise UsageError(f"{path}: no such file; `sonarrec run -o {out}` writes it")
    rows = read_logs(path)
    figures = _figures(path, rows)
    if as_json:
        document = figures | {"logs": [asdict(row) for row in rows]}
        click.echo(json.dumps(document, indent=2))
        return
    counts = ", ".join(f"{n} {status}" for status, n in figures["counts"].items())
    say(f"{number_of(len(rows), 'log')}: {counts}")
    rate = figures["frames_per_second"]
    say(
        f"{number_of(figures['frames'], 'frame')}, {figures['unusable']} unusable, "
        f"{number_of(figures['declared'], 'pass', 'es')} declared"
        + (f"; {number_of(round(rate), 'frame')}/s a process" if rate else "")
    )
    for row in rows:
        if row.message:  # failed, partial or stopped
            say(f"{row.status}: {row.log}: {row.message}")
    if figures["counts"].get("running"):
        say(f"as of {figures['age_s']:.0f} s ago")


def _figures(path: Path, rows: list[Row]) -> dict[str, Any]:
    counts = Counter(row.status for row in rows)
    ended = [row for row in rows if row.status in ("done", "partial") and row.seconds]
    seconds = sum(row.seconds for row in ended)
    return {
        "counts": {
            status: counts[status]
            for status in ("done", "partial", "failed", "running", "waiting")
            if counts[status]
        },
        "frames": sum(row.frames for row in rows),
        "unusable": sum(row.unusable for row in rows),
        "declared": sum(row.declared for row in rows),
        "frames_per_second": sum(row.frames for row in ended) / seconds if seconds else None,
        # Not negative: the file may be of another machine, whose clock is ahead.
        "age_s": max(time() - path.stat().st_mtime, 0.0),
    }
