"""Collects the content of each section of the page and fills the template; values are escaped."""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Container, Iterator, Mapping, Sequence
from heapq import nlargest
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec import __version__
from sonarrec.drawing.pen import landmark_colours
from sonarrec.errors import number_of, printable
from sonarrec.evaluation.counts import Counts
from sonarrec.evaluation.figures import METRICS, units_text
from sonarrec.evaluation.plots import COLOURS
from sonarrec.evaluation.write import Evaluation
from sonarrec.passes import PASS_GAP
from sonarrec.reports import charts, screen
from sonarrec.reports.frames import Picture, Shown
from sonarrec.reports.glyphs import glyph
from sonarrec.reports.logs import (
    ReportedLog,
    Track,
    judged_sightings,
    tracks,
    true_landmark,
)
from sonarrec.reports.overview import LogRow, SharedMistake, headline
from sonarrec.reports.template import fill
from sonarrec.results.run_file import RunFile, flat
from sonarrec.results.sightings import Sighting
from sonarrec.sonar.frame import date_text, is_date, time_text
from sonarrec.sonar.geometry import floor_depth

MOST_TRACKS = 12
MOST_SIGHTINGS = 40
MOST_MISTAKES = 20
MOST_ROWS = 200  # of the table of all logs
ROWS_OPEN = 25  # of them; the others are folded
MOST_LINES = 20  # notes, and lines on what could not be used


TRACKS = "Probability over time, per track"
View = dict[str, Any]  # values of the template that belong together, by name


def render(
    logs: Sequence[ReportedLog],
    evaluation: Evaluation | None,
    wrong: Mapping[str, Sequence[SharedMistake]],
    truth: Path | None,
    pictures: Sequence[Picture],
    shown: Sequence[Shown],
    unused: Sequence[str],
    rows: Sequence[LogRow],
) -> str:
    """The whole page as HTML.

    logs: those with panels. evaluation: of all logs; None without ground truth. truth: that of all
    logs, if one file was given. wrong: the mistakes of each method. pictures, shown: of the
    recordings. unused: a line for each part of the input that could not be used. rows: of all logs.
    """
    landmarks = logs[0].results.landmarks
    most_tracks = MOST_TRACKS if len(logs) == 1 else max(1, 2 * MOST_TRACKS // len(logs))
    methods = evaluation.counts.methods if evaluation else logs[0].results.methods
    held = {log["name"]: n for n, log in enumerate(shown)}
    scores = None if evaluation is None else _scores(evaluation, wrong, held)
    several = len(rows) > 1
    # That of `sonarrec map` lies in the folder of one log's results, or in that of all.
    homes = {log.results.run.path.parents[len(logs) > 1] for log in logs}
    drawn, map_picture = min(homes) / "map" / "map.png", None
    if len(homes) == 1 and drawn.is_file():
        map_picture = f"data:image/png;base64,{b64encode(drawn.read_bytes()).decode()}"
    names = ", ".join(log.name for log in logs[:3]) + (", ..." if logs[3:] else "")
    colours = landmark_colours(landmarks.ids).values()
    rated = {
        "tables": "The paper's tables",
        **({"figures": "Figures and tests"} if scores and scores["others"] else {}),
        "curves": "Curves",
    }
    mistakes = {"mistakes": "Mistakes, the longest first"}
    contents = {
        # The page of one log begins with what was seen, that of several with all logs.
        **({"logs": "All logs, the worst first" if scores else "All logs"} if several else {}),
        **({} if several else {"seen": "What was seen, when and with what score"}),
        **({"rates": "Rates at the operating point"} if scores else {}),
        **(mistakes if scores and several else {}),
        **({"panels": "Log by log"} if several else {}),
        "sightings": "The surest sightings" if several else "Sightings",
        **(rated if scores else {}),
        **(mistakes if scores and not several else {}),
        **({} if several else {"tracks": TRACKS}),
        **({"map": "Map"} if map_picture else {}),
        "settings": "Settings",
    }
    return fill(
        "report.html",
        ("viewer.js", "report.js"),
        shown,
        number=lambda value, digits: f"{value:,.{digits}f}",
        time_of_day=time_text,
        version=__version__,
        title=f"{len(rows)} logs" if len(rows) > len(logs) else names,
        headline=headline(rows, evaluation) if several else "",
        contents=contents,
        several=several,
        rows=rows[:MOST_ROWS],
        rows_left=len(rows) - len(rows[:MOST_ROWS]),
        rows_open=ROWS_OPEN,
        most_members=ROWS_OPEN,
        scored=len(evaluation.folders) if evaluation else 0,
        panels={log.folder: n for n, log in enumerate(logs)},
        tracks_title=TRACKS,
        pass_gap=PASS_GAP,
        landmarks=landmarks,
        methods=methods,
        measured=_measured,
        light_colours=[charts.darkened(colour) for colour in colours],
        dark_colours=["#{:02x}{:02x}{:02x}".format(*colour) for colour in colours],
        glyphs=[glyph(landmarks, k) for k in range(len(landmarks.ids))],
        method_colours=[COLOURS[n % len(COLOURS)] for n in range(len(methods))],
        line_styles=charts.STYLES,
        logs=[_log_view(log, most_tracks) for log in logs],
        tracker=logs[0].tracker,
        truth=_truth_text(evaluation, truth),
        evaluation=evaluation,
        scores=scores,
        unused=_first(unused),
        logs_in_all=len(rows),
        counts=evaluation and evaluation.counts,
        pictures=pictures,
        held=held,
        shown=shown,
        map_picture=map_picture,
    )


def _first(lines: Sequence[str]) -> list[str]:
    """The first MOST_LINES lines, and how many more there are."""
    more = len(lines) - MOST_LINES
    return [*lines[:MOST_LINES], *([number_of(more, "more such line")] if more > 0 else ())]


def _truth_text(evaluation: Evaluation | None, given: Path | None) -> str:
    """What was scored against."""
    if evaluation is None:
        return ""
    files = {given} if given else {*evaluation.truths}
    return printable(files.pop().name) if len(files) == 1 else "each log's own ground truth"


def _scores(
    evaluation: Evaluation, wrong: Mapping[str, Sequence[SharedMistake]], held: Container[str]
) -> View:
    """What is known with ground truth. held: logs of which frames can be shown.

    rates, others (figures), differences: from `screen`. units: such as "12 passes".
    over: the part of captions on intervals. tested: labels of the figures in differences. starred:
    whether a table has a 0/0. curves: per protocol.
    """
    counts, summary = evaluation.counts, evaluation.summary
    methods, protocols = counts.methods, screen.protocols(counts)
    others = [name for name in METRICS if name not in screen.HEADLINE]
    tables = [
        (m, p, screen.paper_table(counts, m, p, ",")) for m in methods for p in counts.protocols
    ]
    return {
        "protocols": protocols,
        "rates": screen.rates(counts, summary),
        "units": units_text(counts.units),
        "over": screen.over_units(counts.units),
        "others": screen.figures(summary, protocols[0], methods, others),
        "tested": [METRICS[name].label for name in screen.TESTED],
        "differences": screen.differences(summary, protocols[0]),
        "notes": _first(evaluation.notes),
        "tables": tables,
        "starred": any(
            "*" in cell for _, _, table in tables for row in table.values() for cell in row
        ),
        "curves": [(protocol, charts.roc(counts, protocol)) for protocol in protocols],
        "mistakes": list(_mistakes(counts, wrong, held)),
    }


def _log_view(log: ReportedLog, most_tracks: int) -> View:
    """One log's part of the page.

    axis: of the whole log's time. measured: heads of columns with a value in any sighting. dated:
    whether the log's times are dates.
    """
    sightings, timeline = judged_sightings(log), charts.timeline(log)
    declared, stamps = tracks(log), log.results.timestamp_ns
    shown = nlargest(MOST_SIGHTINGS, sightings, key=lambda s: s.sighting.frames_declared)
    shown.sort(key=lambda s: (s.sighting.first_frame, s.sighting.last_frame))
    valued = {head for s in sightings for head, value, _ in _measured(s.sighting) if value}
    drawn = {k for k, _ in timeline}
    in_order = sorted(declared[:most_tracks], key=lambda t: (int(t.frame_index[0]), t.number))
    return {
        "log": log,
        "facts": list(_facts(log)),
        "problems": list(log.results.run.input.problems),
        "timeline": timeline,
        "frames_a_bar": charts.frames_a_bar(len(log.time)),
        "axis": charts.time_axis(log),
        "unseen": [landmark for k, landmark in enumerate(log.ids) if k not in drawn],
        "sightings": shown,
        "sightings_left": len(sightings) - len(shown),
        "measured": [head for head, *_ in MEASURED if head in valued],
        "dated": stamps is not None and is_date(int(stamps[0])),
        "tracks": [_track_view(log, track) for track in in_order],
        "tracks_in_all": len(declared),
        "settings": list(_settings(log.results.run)),
    }


MEASURED = (
    ("range, m", "range_m", 3, "range_sigma_m"),
    ("bearing, deg", "bearing_deg", 1, "bearing_sigma_deg"),
    ("orientation, deg", "orientation_deg", 0, "orientation_sigma_deg"),
    ("x, m", "x_m", 2, None),
    ("y, m", "y_m", 2, None),
)
"""Columns of measurements in the table of sightings: head, field, digits, field of its error."""


def _measured(sighting: Sighting) -> Iterator[tuple[str, str, str]]:
    """(head, value, standard error) of each column of MEASURED, as text, "" if not known."""
    for head, name, digits, error in MEASURED:
        texts = []
        for field in (name, error):
            value = math.nan if field is None else getattr(sighting, field)
            texts.append("" if math.isnan(value) else f"{value:.{digits}f}")
        yield head, texts[0], texts[1]


def _facts(log: ReportedLog) -> Iterator[tuple[str, str]]:
    """(name, value) of facts about the recording."""
    results = log.results
    yield "frames", f"{len(results.frame):,}"
    if log.clock == "s" and len(log.time) > 1:
        yield "length", f"{log.time[-1] - log.time[0]:,.1f} s at {1 / log.period:.3g} Hz"
    if results.timestamp_ns is not None and is_date(int(results.timestamp_ns[0])):
        yield "start", f"{date_text(int(results.timestamp_ns[0]))} UTC"
    if results.fan is not None:
        yield "range window", f"{results.fan.range_min_m:g} to {results.fan.range_max_m:g} m"
        stated = results.run.sonar()
        assumed = " assumed" if stated.tilt_deg is None and stated.height_m is not None else ""
        yield "tilt", f"{results.fan.tilt_deg:g} deg{assumed}"
        assumed = " assumed" if results.fan.height_m is None else ""
        yield "height", f"{floor_depth(results.fan):.3g} m{assumed}"
    yield "landmark set", f"{results.landmarks.name}, radius {results.landmarks.radius_m:g} m"
    presets = [str(config["preset"]) for config in results.run.configs if "preset" in config]
    if presets:
        yield "presets" if len(presets) > 1 else "preset", ", ".join(presets)


def _track_view(log: ReportedLog, track: Track) -> View:
    """One track: its facts, the strip of truth and a panel per method."""
    declared = track.estimates[log.results.declared[track.estimates]]
    counts = np.bincount(log.results.landmark_index[declared], minlength=len(log.ids)).tolist()
    frames = number_of(len(track.estimates), "frame")
    claims = [f"ID.{i} in {n} of {frames}" for i, n in zip(log.ids, counts, strict=True) if n]
    first, last = track.frame_index[[0, -1]].tolist()
    return {
        "track": track,
        "claims": ", ".join(claims),
        "frames": _span(int(log.results.frame[first]), int(log.results.frame[last])),
        "times": f"{log.time[first]:.1f} to {log.time[last]:.1f} s" if log.clock == "s" else "",
        "axis": charts.track_axis(log, track),
        "truth": true_landmark(log, track),
        "strip": charts.truth_strip(log, track),
        "panels": charts.track_panels(log, track),
    }


def _mistakes(
    counts: Counts, wrong: Mapping[str, Sequence[SharedMistake]], held: Container[str]
) -> Iterator[View]:
    """Each method's mistakes, the longest first. held: logs of which frames can be shown."""
    for method, mistakes in wrong.items():
        yield {
            "method": method,
            "count": counts.count(method, screen.protocols(counts)[0]),
            "shown": [(shared, shared.shown(held)) for shared in mistakes[:MOST_MISTAKES]],
            "left": len(mistakes[MOST_MISTAKES:]),
        }


def _span(first: int, last: int) -> str:
    return f"{first}" if first == last else f"{first} to {last}"


def _settings(run: RunFile) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """run.toml as (table name, its keys and values); settings are named as for --set."""
    for name, rows in groupby(flat(run.table), key=lambda row: row[0].rpartition(".")[0]):
        yield name or "run", [(key.rpartition(".")[2], _plain(value)) for key, value in rows]


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_plain(v)}" for key, v in value.items())
    if isinstance(value, list):
        between = "; " if any(isinstance(v, dict) for v in value) else ", "
        return between.join(map(_plain, value)) or "none"
    return str(value).lower() if isinstance(value, bool) else str(value)
