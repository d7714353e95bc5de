"""`sonarrec status`: the progress of a run over many logs."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from time import time
from typing import TYPE_CHECKING

import click

from sonarrec.cli import options
from sonarrec.cli.endings import say
from sonarrec.cli.groups import command
from sonarrec.errors import UsageError, number_of

if TYPE_CHECKING:
    from sonarrec.runs.task import Status

STATES: tuple[Status, ...] = ("done", "partial", "failed", "running", "waiting")


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
    from sonarrec.runs.logs_table import read_logs

    with ExitStack() as stack:
        path = RemoteFiles(stack, cache).file(inside(out, "logs.csv"))
        assert path is not None
        if not path.is_file():
            raise UsageError(f"{path}: no such file; `sonarrec run -o {out}` writes it")
        rows = read_logs(path)
        # Not negative: the file may be of another machine, whose clock is ahead.
        age_s = max(time() - path.stat().st_mtime, 0.0)
    many = Counter(row.status for row in rows)
    counts = {state: many[state] for state in STATES if many[state]}
    ended = [row for row in rows if row.status in ("done", "partial") and row.seconds]
    seconds = sum(row.seconds for row in ended)
    rate = sum(row.frames for row in ended) / seconds if seconds else None
    frames, unusable, declared = (
        sum(getattr(row, key) for row in rows) for key in ("frames", "unusable", "declared")
    )
    if as_json:
        document = {
            "counts": counts,
            "frames": frames,
            "unusable": unusable,
            "declared": declared,
            "frames_per_second": rate,
            "age_s": age_s,
            "logs": [asdict(row) for row in rows],
        }
        click.echo(json.dumps(document, indent=2))
        return
    told = ", ".join(f"{count} {state}" for state, count in counts.items())
    say(f"{number_of(len(rows), 'log')}: {told}")
    say(
        f"{number_of(frames, 'frame')}, {unusable} unusable, "
        f"{number_of(declared, 'pass', 'es')} declared"
        + (f"; {number_of(round(rate), 'frame')}/s a process" if rate else "")
    )
    for row in rows:
        if row.message:  # failed, partial or stopped
            say(f"{row.status}: {row.log}: {row.message}")
    if counts.get("running"):
        say(f"as of {age_s:.0f} s ago")
