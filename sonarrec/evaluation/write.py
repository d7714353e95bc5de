"""The files of `evaluation/` that a scoring writes."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sonarrec.evaluation.counting.curves import Count, macro_curve
from sonarrec.evaluation.counting.pooled import Pooled, PooledScored
from sonarrec.evaluation.counting.reliability import BINS
from sonarrec.evaluation.matching.joined import PAPER_MIN_VISIBLE
from sonarrec.evaluation.plots import draw_det, draw_reliability, draw_roc, draw_roc_by_id
from sonarrec.evaluation.summary import Summary
from sonarrec.tables.outputs import (
    check_no_recording,
    check_output,
    check_tables,
    is_filled,
    is_output,
    write_csv,
    write_text,
    writing,
)

COUNTS = ("tpr", "fpr", "tp", "tn", "fp", "fn", "total", "tpr_once")
CONFUSION = ("protocol", "method", "landmark", *COUNTS)
PAPER_KEY = "paper_min_visible"
"""In evaluation.json of the versions whose protocol paper counts every frame."""
ROC = ("protocol", "method", "landmark", "threshold", "tpr", "fpr", "tp", "tn", "fp", "fn")
FIGURES = ("protocol", "method", "landmark", "figure", "value", "low", "high", "units", "note")
TESTS = (
    *("protocol", "a", "b", "landmark", "figure", "value_a", "value_b", "difference"),
    *("low", "high", "p", "units", "note"),
)
PASSES = (
    *("log", "landmark", "first_frame", "last_frame", "protocol", "method", "frames", "right"),
    *("frames_to_id", "id_switches", "track_switches"),
)
RELIABILITY = ("method", "landmark", "bin_low", "bin_high", "count", "mean_probability", "right")


def write_evaluation(
    folder: Path, evaluation: Pooled, summary: Summary, det: bool = False
) -> tuple[str, ...]:
    """Write all tables and pictures into `folder`, created if needed; returns the file names.

    evaluation.json is written last, so if it exists the others are complete. Pictures that only an
    earlier scoring drew are deleted. Raises SonarrecError if they cannot be written; UsageError,
    before the first one, if a file of another kind exists.
    """
    text = json_text(as_json(evaluation, summary))
    written = tables(evaluation, summary)
    pictures = ["roc.png", "roc_by_id.png"]
    pictures += ["det.png"] if det else []
    pictures += ["reliability.png"] if summary.reliability else []
    check_tables(folder, {name: header for name, (header, _) in written.items()})
    check_output(folder / "evaluation.json", "JSON", header='{\n  "logs": [')
    if not is_filled(
        folder / "evaluation.json"
    ):  # if it exists, the pictures are ours, even without a mark
        for name in pictures:
            check_output(folder / name, "picture")
    check_no_recording(folder, written)
    with writing(folder):
        (folder / "evaluation.json").unlink(missing_ok=True)
        for name in {"det.png", "reliability.png"}.difference(pictures):
            if is_output(folder / name, "picture"):  # of an earlier scoring
                (folder / name).unlink()
        for name, (header, rows) in written.items():
            write_table(folder / name, header, rows)
        draw_roc(folder / "roc.png", evaluation.scored)
        draw_roc_by_id(folder / "roc_by_id.png", evaluation.scored)
        if det:
            draw_det(folder / "det.png", evaluation.scored)
        if summary.reliability:
            draw_reliability(folder / "reliability.png", summary.reliability)
        write_text(folder / "evaluation.json", text)
    return (*written, *pictures, "evaluation.json")


def tables(
    evaluation: Pooled, summary: Summary
) -> dict[str, tuple[tuple[str, ...], Iterable[tuple[Any, ...]]]]:
    """Columns and rows of each CSV file, by its name."""
    return {
        "confusion.csv": (CONFUSION, _confusion(evaluation)),
        "per_log.csv": (("log", *CONFUSION), _per_log(evaluation)),
        "roc.csv": (ROC, _roc(evaluation)),
        "figures.csv": (FIGURES, _figures(summary)),
        "tests.csv": (TESTS, _tests(summary)),
        "passes.csv": (PASSES, _passes(evaluation)),
        "reliability.csv": (RELIABILITY, _reliability(summary)),
    }


def write_table(path: Path, header: tuple[str, ...], rows: Iterable[tuple[Any, ...]]) -> None:
    """A CSV file; NaN is an empty cell."""
    cells = (
        ["" if isinstance(cell, float) and math.isnan(cell) else cell for cell in row]
        for row in rows
    )
    write_csv(path, header, cells)


def _cells(scored: PooledScored) -> list[tuple[str, Count]]:
    named = [(str(i), scored.count(k)) for k, i in enumerate(scored.ids)]
    return [*named, ("total", scored.count())]


def _counts(c: Count) -> tuple[float, ...]:
    return c.tpr, c.fpr, c.tp, c.tn, c.fp, c.fn, c.total, c.tpr_once


def _confusion(evaluation: Pooled) -> Iterable[tuple[Any, ...]]:
    for s in evaluation.scored:
        for name, count in _cells(s):
            yield s.protocol, s.method, name, *_counts(count)


def _per_log(evaluation: Pooled) -> Iterable[tuple[Any, ...]]:
    names = [*map(str, evaluation.ids), "total"]
    split = [(s, s.counts_per_log()) for s in evaluation.scored]
    for i, log in enumerate(evaluation.logs):
        for s, counts in split:
            for name, count in zip(names, counts[i], strict=True):
                yield log, s.protocol, s.method, name, *_counts(count)


def _roc(evaluation: Pooled) -> Iterable[tuple[Any, ...]]:
    """The corners of every curve, thresholds falling from inf; macro curves have no threshold."""
    for s in evaluation.scored:
        which: list[tuple[str, int | None]] = [(str(i), k) for k, i in enumerate(s.ids)]
        for name, k in [*which, ("total", None)]:
            curve = s.curve(k)
            at = curve.turns()
            rates = curve.threshold, curve.tpr, curve.fpr
            columns = *rates, curve.tp, curve.tn, curve.fp, curve.fn
            for row in zip(*(column[at].tolist() for column in columns), strict=True):
                yield s.protocol, s.method, name, *row
        fpr, tpr = macro_curve(s.curve(k) for k in range(len(s.ids)))
        for x, y in zip(fpr.tolist(), tpr.tolist(), strict=True):
            yield s.protocol, s.method, "macro", "", y, x, "", "", "", ""


def _figures(summary: Summary) -> Iterable[tuple[Any, ...]]:
    for f in summary.figures:
        yield f.protocol, f.method, f.landmark_text, f.name, f.value, f.low, f.high, f.units, f.note


def _tests(summary: Summary) -> Iterable[tuple[Any, ...]]:
    for d in summary.differences:
        yield (
            *(d.protocol, d.a, d.b, d.landmark_text, d.name, d.value_a, d.value_b, d.value),
            *(d.low, d.high, d.p, d.units, d.note),
        )


def _passes(evaluation: Pooled) -> Iterable[tuple[Any, ...]]:
    passes = evaluation.passes
    changed = {s.method: s for s in evaluation.switches}
    for outcome in evaluation.outcomes:
        switches = changed.get(outcome.method)
        for i in range(len(passes.first_frame)):
            yield (
                evaluation.logs[passes.log_index[i]],
                evaluation.ids[passes.landmark_index[i]],
                int(passes.first_frame[i]),
                int(passes.last_frame[i]),
                outcome.protocol,
                outcome.method,
                int(outcome.frames[i]),
                int(outcome.right[i]),
                float(outcome.wait[i]),
                "" if switches is None else int(switches.ids[i]),
                "" if switches is None or switches.tracks is None else int(switches.tracks[i]),
            )


def _reliability(summary: Summary) -> Iterable[tuple[Any, ...]]:
    for r in summary.reliability:
        for b in range(BINS):
            yield (
                *(r.method, r.landmark_text, b / BINS, (b + 1) / BINS),
                *(int(r.count[b]), float(r.mean[b]), float(r.right[b])),
            )


def json_text(document: dict[str, Any]) -> str:
    """A JSON document as text."""
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


def as_json(evaluation: Pooled, summary: Summary) -> dict[str, Any]:
    """evaluation.json: what was scored and how, counts and figures; 0/0 and infinity are null."""
    methods: dict[str, Any] = {}
    per_log: dict[str, Any] = {log: {} for log in evaluation.logs}
    names = [*map(str, evaluation.ids), "total"]
    for s in evaluation.scored:
        methods.setdefault(s.method, {})[s.protocol] = _named_counts(*zip(*_cells(s), strict=True))
        for log, counts in zip(evaluation.logs, s.counts_per_log(), strict=True):
            per_log[log].setdefault(s.method, {})[s.protocol] = _named_counts(names, counts)
    return {
        "logs": list(evaluation.logs),
        "frames": evaluation.frames,
        "landmarks": list(evaluation.ids),
        "positives": int(evaluation.positives.sum()),
        "ignored": evaluation.ignored,
        "min_visible": evaluation.min_visible,
        PAPER_KEY: PAPER_MIN_VISIBLE,
        "gate_m": list(evaluation.gates),
        "unit": summary.units.kind,
        "units": summary.units.count,
        "methods": methods,
        "per_log": per_log,
        "figures": [as_record(asdict(figure)) for figure in summary.figures],
        "differences": [as_record(asdict(difference)) for difference in summary.differences],
        "notes": [*evaluation.notes, *summary.notes],
        "unused": list(evaluation.unused),
    }


def _named_counts(names: Sequence[str], counts: Sequence[Count]) -> dict[str, Any]:
    return {
        name: {key: finite_or_none(v) for key, v in zip(COUNTS, _counts(count), strict=True)}
        for name, count in zip(names, counts, strict=True)
    }


def as_record(fields: dict[str, Any]) -> dict[str, Any]:
    """The fields of a figure or a rate for JSON, null in place of NaN and infinity."""
    return {key.removesuffix("_text"): finite_or_none(value) for key, value in fields.items()}


def finite_or_none(value: Any) -> Any:
    """The value; None in place of NaN and infinity, which JSON does not have."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
