"""The sightings of a run as a table for the terminal, or as JSON."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sonarrec.times import date_text, is_date

if TYPE_CHECKING:
    from sonarrec.results.sightings import Sighting
    from sonarrec.runs.one import Summary


def table(summary: Summary, folder: str) -> list[str]:
    """Lines to print: the longest passes of each method, and how many more sightings.csv has.

    folder: of that file.
    """
    lines: list[str] = []
    for method, count in summary.passes.items():
        lines += [f"{method}:"] if len(summary.passes) > 1 else []
        sightings = [s for s in summary.sightings if s.method == method]
        if not sightings:
            lines.append("no landmark declared")
            continue
        dated = is_date(sightings[0].start_ns)
        wide = max(len(_end(s)) for s in sightings) if dated else None
        times = f"{'from UTC':<22}  {'to UTC':<{wide}}" if wide else f"{'from s':>9} {'to s':>9}"
        lines.append(
            f"landmark  track  frames       {times}  declared  best score  range m  bearing deg"
        )
        lines += [_row(s, wide) for s in sightings]
        if count > len(sightings):
            where = f"{folder}/sightings.csv"
            lines.append(f"these are the longest; {count - len(sightings)} more in {where}")
    return lines


def _row(s: Sighting, end_width: int | None) -> str:
    """A row. end_width: of the column of end dates; None if times are not dates."""
    track = "-" if s.track is None else s.track
    times = f"{s.start_ns / 1e9:>9.2f} {s.end_ns / 1e9:>9.2f}"
    if end_width is not None:
        times = f"{date_text(s.start_ns, 2):<22}  {_end(s):<{end_width}}"
    return (
        f"{s.landmark:>8}  {track:>5}  {f'{s.first_frame}-{s.last_frame}':<11}  {times}"
        f"  {s.frames_declared:>8}  {s.best_score:>10.3f}  {_number(s.range_m, 2):>7}"
        f"  {_number(s.bearing_deg, 1):>11}"
    )


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _end(s: Sighting) -> str:
    """The end of a pass, with the date if it differs from that of the start."""
    start, end = date_text(s.start_ns, 2), date_text(s.end_ns, 2)
    return end[11:] if end[:10] == start[:10] else end


def as_json(summary: Summary, folder: str, sightings: Path) -> dict[str, Any]:
    """The JSON object of a log, with all sightings of all methods.

    folder: where its results are. sightings: their sightings.csv.
    """
    from sonarrec.results.sightings import sightings_in

    return {
        "folder": folder,
        "up_to_date": summary.up_to_date,
        "frames": summary.frames,
        "candidates": summary.candidates,
        "sightings": [_plain(s) for s in sightings_in(sightings)],
        "problems": summary.problems,
        "notes": summary.notes,
    }


def _plain(sighting: Sighting) -> dict[str, Any]:
    """The fields, null for values that are not known."""
    return {
        name: None if isinstance(value, float) and math.isnan(value) else value
        for name, value in asdict(sighting).items()
    }
