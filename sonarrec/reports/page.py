"""Collects the content of each section of the page and fills the template; values are escaped."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from heapq import nlargest
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from sonarrec.drawing.pen import landmark_colours
from sonarrec.errors import number_of
from sonarrec.evaluation import screen
from sonarrec.evaluation.count import Counts
from sonarrec.evaluation.figures import BY_NAME, over_units, units_text
from sonarrec.evaluation.plots import COLOURS
from sonarrec.evaluation.write import Evaluation
from sonarrec.nouns import VERSION, date_text, is_date, time_text
from sonarrec.reports import charts
from sonarrec.reports.frames import Picture, ShownLog
from sonarrec.reports.logs import ReportedLog, Track, judged_sightings, tracks, true_landmark
from sonarrec.reports.mistakes import Episode, in_words
from sonarrec.reports.svg import STYLES, darkened, frames_a_bar, glyph
from sonarrec.results.sightings import PASS_GAP, Sighting

MOST_TRACKS = 12
MOST_SILENT = 40
MOST_SIGHTINGS = 40
MOST_MISTAKES = 20
MOST_RATES = 40  # logs with a row of rates
MOST_LINES = 20  # notes, and lines on what could not be used


View = dict[str, Any]  # values of the template that belong together, by name


def render(
    logs: Sequence[ReportedLog],
    evaluation: Evaluation | None,
    wrong: Mapping[str, Sequence[Episode]],
    truth: Path | None,
    pictures: Sequence[Picture],
    shown: Sequence[ShownLog],
    unused: Sequence[str],
    logs_in_all: int,
) -> str:
    """The whole page as HTML.

    logs: those with panels. evaluation: of all logs; it and truth are None without ground truth.
    wrong: the mistakes of each method. pictures, shown: of the recordings. unused: a
    line for each part of the input that could not be used. logs_in_all: also those without panels.
    """
    landmarks = logs[0].results.landmarks
    most_tracks = MOST_TRACKS if len(logs) == 1 else max(1, 2 * MOST_TRACKS // len(logs))
    methods = evaluation.counts.methods if evaluation else logs[0].results.methods
    scores = None
    if evaluation is not None:
        scores = _scores(logs, evaluation, wrong)
    # That of `sonarrec map` lies in the folder of one log's results, or in that of all.
    homes = {log.run.path.parents[len(logs) > 1] for log in logs}
    drawn, map_picture = min(homes) / "map" / "map.png", None
    if len(homes) == 1 and drawn.is_file():
        map_picture = "data:image/png;base64," + base64.b64encode(drawn.read_bytes()).decode()
    colours = landmark_colours(landmarks.ids).values()
    names = ", ".join(log.results.name for log in logs[:3]) + (", ..." if logs[3:] else "")
    frames = json.dumps([asdict(log) for log in shown], separators=(",", ":"), allow_nan=False)
    script = (files("sonarrec.reports") / "report.js").read_text(encoding="utf-8")
    environment = Environment(
        loader=PackageLoader("sonarrec.reports", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html").render(
        number=lambda value, digits: f"{value:,.{digits}f}",
        time_of_day=time_text,
        version=VERSION,
        title=f"{logs_in_all} logs" if logs_in_all > len(logs) else names,
        contents=_contents(
            scores is not None,
            bool(scores and scores["others"]),
            several=logs_in_all > 1,
            mapped=map_picture is not None,
        ),
        pass_gap=PASS_GAP,
        landmarks=landmarks,
        methods=methods,
        measured=_measured,
        light_colours=[darkened(colour) for colour in colours],
        dark_colours=["#{:02x}{:02x}{:02x}".format(*colour) for colour in colours],
        glyphs=[glyph(landmarks, k) for k in range(len(landmarks.ids))],
        method_colours=[COLOURS[n % len(COLOURS)] for n in range(len(methods))],
        line_styles=STYLES,
        logs=[_log_view(log, most_tracks) for log in logs],
        tracker=logs[0].tracker,
        truth=None if truth is None else truth.name,
        evaluation=evaluation,
        scores=scores,
        unused=_first(unused),
        logs_in_all=logs_in_all,
        counts=evaluation and evaluation.counts,
        surest=[p for p in pictures if p.request.group == "surest"],
        rarest=[p for p in pictures if p.request.group == "rarest"],
        mistake_pictures=[p for p in pictures if p.request.group == "mistake"],
        held={log.name: n for n, log in enumerate(shown)},
        shown=shown,
        shown_json=frames.replace("<", "\\u003c"),  # safe inside a script element
        script=script,  # the page allows it by its hash
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        map_picture=map_picture,
    )


def _contents(scored: bool, figures: bool, several: bool, mapped: bool) -> dict[str, str]:
    """The sections by name, in the page's order, and their headings."""
    seen = {"seen": "What was seen, when and with what score"}
    rates = {"rates": "Rates at the operating point"} if scored else {}
    return {
        # The page of one log begins with what was seen, that of several with the rates.
        **(rates | seen if several else seen | rates),
        "sightings": "Sightings",
        **({"tables": "The paper's tables"} if scored else {}),
        **({"figures": "Figures and tests"} if figures else {}),
        **({"curves": "Curves", "mistakes": "Mistakes, the worst first"} if scored else {}),
        "tracks": "Probability over time, per track",
        **({"map": "Map"} if mapped else {}),
        "settings": "Settings",
    }


def _first(lines: Sequence[str]) -> list[str]:
    """The first MOST_LINES lines, and how many more there are."""
    more = [number_of(len(lines) - MOST_LINES, "more such line")] * (len(lines) > MOST_LINES)
    return [*lines[:MOST_LINES], *more]


def _scores(
    logs: Sequence[ReportedLog], evaluation: Evaluation, wrong: Mapping[str, Sequence[Episode]]
) -> View:
    """What is known with ground truth.

    rates, rates_per_log, others (figures), differences: from `screen`. units: such as "12 passes".
    over: the part of captions on intervals. tested: labels of the figures in differences. starred:
    whether a table has a 0/0. curves: per protocol.
    """
    counts, summary = evaluation.counts, evaluation.summary
    methods, protocols = counts.methods, screen.protocols(counts)
    per_log = screen.rates_per_log(counts)
    if len(per_log) > MOST_RATES:
        most_mistakes = sorted(per_log, key=lambda row: -sum(r.missed + r.false for r in row[1]))
        per_log = most_mistakes[:MOST_RATES]
    others = [name for name in BY_NAME if name not in screen.HEADLINE]
    tables = [screen.paper_table(s, thousands=",") for s in counts.scored]
    return {
        "protocols": protocols,
        "rates": screen.rates(counts, summary),
        "rates_per_log": per_log,
        "units": units_text(summary.units),
        "over": over_units(summary),
        "others": screen.figures(summary, protocols[0], methods, others),
        "tested": [metric.label for metric in screen.TESTED],
        "differences": screen.differences(summary, protocols[0]),
        "notes": _first(evaluation.notes),
        "tables": tables,
        "starred": any("*" in cell for table in tables for _, row in table.rows for cell in row),
        "curves": [
            (p, charts.roc([s for s in counts.scored if s.protocol == p])) for p in protocols
        ],
        "mistakes": _mistakes(logs, counts, wrong),
    }


def _log_view(log: ReportedLog, most_tracks: int) -> View:
    """One log's part of the page.

    axis: of the whole log's time. measured: heads of columns with a value in any sighting. dated:
    whether the log's times are dates. silent: tracks that were never declared, on that axis.
    """
    sightings = judged_sightings(log)
    found_tracks = tracks(log, most_tracks, MOST_SILENT)
    stamps = log.results.timestamp_ns
    rows = charts.timeline(log)
    ids_drawn = {k for k, _ in rows}
    valued = {head for s in sightings for head, value, _ in _measured(s.sighting) if value}
    return {
        "log": log,
        "facts": list(_facts(log)),
        "problems": list(log.run.input.problems),
        "timeline": rows,
        "frames_a_bar": frames_a_bar(len(log.time)),
        "axis": charts.time_axis(log)[0],
        "unseen": [i for k, i in enumerate(log.results.landmarks.ids) if k not in ids_drawn],
        "sightings": sorted(
            nlargest(MOST_SIGHTINGS, sightings, key=lambda s: s.sighting.frames_declared),
            key=lambda s: (s.sighting.first_frame, s.sighting.last_frame),
        ),
        "sightings_left": len(sightings[MOST_SIGHTINGS:]),
        "measured": [head for head, *_ in MEASURED if head in valued],
        "dated": stamps is not None and is_date(int(stamps[0])),
        "tracks": [_track_view(log, track) for track in found_tracks.declared],
        "tracks_in_all": found_tracks.declared_in_all,
        "silent": charts.silent_lanes(log, found_tracks.silent),
        "silent_in_all": found_tracks.silent_in_all,
        "settings": list(settings_tables(log.run.table)),
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
    results, run = log.results, log.run
    yield "frames", f"{len(results.frame):,}"
    if log.clock == "s" and len(log.time) > 1:
        axis, period = charts.time_axis(log)
        yield "length", f"{axis.high - axis.low:,.1f} s at {1 / period:.3g} Hz"
    if results.timestamp_ns is not None and is_date(int(results.timestamp_ns[0])):
        yield "start", f"{date_text(int(results.timestamp_ns[0]))} UTC"
    if results.fan is not None:
        yield "range window", f"{results.fan.range_min_m:g} to {results.fan.range_max_m:g} m"
        yield "tilt", f"{results.fan.tilt_deg:g} deg"
    yield "landmark set", f"{results.landmarks.name}, radius {results.landmarks.radius_m:g} m"
    presets = [str(config["preset"]) for config in run.configs if "preset" in config]
    if presets:
        yield "preset" + "s" * (len(presets) > 1), ", ".join(presets)


def _track_view(log: ReportedLog, track: Track) -> View:
    """One track: its facts, the strip of truth and a panel per method."""
    results = log.results
    ids = results.landmarks.ids
    declared = results.landmark_index[track.estimates[results.declared[track.estimates]]]
    frames = number_of(len(track.estimates), "frame")
    counts = np.bincount(declared, minlength=len(ids)).tolist()
    claims = [f"ID.{i} in {n} of {frames}" for i, n in zip(ids, counts, strict=True) if n]
    first, last = int(track.frame_index[0]), int(track.frame_index[-1])
    return {
        "track": track,
        "claims": ", ".join(claims),
        "frames": _span(int(results.frame[first]), int(results.frame[last])),
        "times": f"{log.time[first]:.1f} to {log.time[last]:.1f} s" if log.clock == "s" else "",
        "axis": charts.track_axis(log, track),
        "truth": true_landmark(log, track),
        "strip": charts.truth_strip(log, track),
        "panels": charts.track_panels(log, track),
    }


def _mistakes(
    logs: Sequence[ReportedLog], counts: Counts, wrong: Mapping[str, Sequence[Episode]]
) -> list[View]:
    """Each method's episodes, the worst first."""
    matched = {log.results.name: log.matched for log in logs}
    mistakes = []
    for method in sorted(counts.methods, key=lambda m: m != logs[0].tracker):
        count = counts.scored_by(method, screen.protocols(counts)[0]).count()
        episodes = wrong.get(method, [])  # the method may be in other logs only
        shown = [
            {
                "episode": episode,
                "sentence": in_words(episode, log),
                "frames": _span(episode.first, episode.last),
            }
            for episode in episodes[:MOST_MISTAKES]
            if (log := matched[episode.log]) is not None
        ]
        left = len(episodes) - len(shown)
        mistakes.append({"method": method, "count": count, "shown": shown, "left": left})
    return mistakes


def _span(first: int, last: int) -> str:
    return f"{first}" if first == last else f"{first} to {last}"


def settings_tables(
    table: Mapping[str, Any], name: str = "run"
) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """run.toml as (table name, its keys and values); nested tables follow."""
    plain = {key: value for key, value in table.items() if not _is_nested(value)}
    if plain:
        yield name, [(key, _plain(value)) for key, value in plain.items()]
    for key, value in table.items():
        if _is_nested(value):
            label = key if name == "run" else f"{name}.{key}"
            for n, part in enumerate(value if isinstance(value, list) else [value]):
                yield from settings_tables(
                    part, f"{label}[{n}]" if isinstance(value, list) else label
                )


def _is_nested(value: Any) -> bool:
    """Whether a TOML value is a table, or several that hold tables."""
    if isinstance(value, list):
        return any(isinstance(part, dict) and any(map(_is_nested, part.values())) for part in value)
    return isinstance(value, dict)


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_plain(v)}" for key, v in value.items())
    if isinstance(value, list):
        between = "; " if any(isinstance(v, dict) for v in value) else ", "
        return between.join(map(_plain, value)) or "none"
    return str(value).lower() if isinstance(value, bool) else str(value)
