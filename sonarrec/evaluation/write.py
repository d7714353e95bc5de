"""The files of `evaluation/` that a scoring writes."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sonarrec.evaluation.curves import Count
from sonarrec.evaluation.match import PAPER_MIN_VISIBLE
from sonarrec.evaluation.plots import draw_roc
from sonarrec.evaluation.tables import COUNTS, HEADERS, Evaluation, count_cells, counts_by_id
from sonarrec.tables.outputs import (
    check_no_recording,
    check_output,
    check_tables,
    is_filled,
    write_csv,
    write_text,
    writing,
)


def write_evaluation(folder: Path, evaluation: Evaluation) -> tuple[str, ...]:
    """Write all tables and the picture into `folder`, created if needed; returns the file names.

    evaluation.json is written last, so if it exists the others are complete. Raises SonarrecError
    if they cannot be written; UsageError, before the first one, if a file of another kind exists.
    """
    text = json_text(as_json(evaluation))
    written = {f"{name}.csv": header for name, header in HEADERS.items()}
    check_tables(folder, written)
    check_output(folder / "evaluation.json", "JSON", header='{\n  "logs": [')
    if not is_filled(folder / "evaluation.json"):  # else the picture is ours, even unmarked
        check_output(folder / "roc.png", "picture")
    check_no_recording(folder, written)
    with writing(folder):
        (folder / "evaluation.json").unlink(missing_ok=True)
        for name, header in HEADERS.items():
            write_table(folder / f"{name}.csv", header, evaluation.rows(name))
        draw_roc(folder / "roc.png", evaluation.scored)
        write_text(folder / "evaluation.json", text)
    return (*written, "roc.png", "evaluation.json")


def write_table(path: Path, header: tuple[str, ...], rows: Iterable[tuple[Any, ...]]) -> None:
    """A CSV file; NaN is an empty cell."""
    cells = (
        ["" if isinstance(cell, float) and math.isnan(cell) else cell for cell in row]
        for row in rows
    )
    write_csv(path, header, cells)


def json_text(document: dict[str, Any]) -> str:
    """A JSON document as text."""
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


def as_json(evaluation: Evaluation) -> dict[str, Any]:
    """evaluation.json: what was scored and how, counts and figures; 0/0 and infinity are null."""
    counts, summary = evaluation.counts, evaluation.summary
    methods: dict[str, Any] = {}
    per_log: dict[str, Any] = {log: {} for log in counts.logs}
    names = [*map(str, counts.ids), "total"]
    for s in counts.scored:
        named = zip(*counts_by_id(s), strict=True)
        methods.setdefault(s.method, {})[s.protocol] = _named_counts(*named)
        for log, of_log in zip(counts.logs, s.counts_per_log(), strict=True):
            per_log[log].setdefault(s.method, {})[s.protocol] = _named_counts(names, of_log)
    return {
        "logs": list(counts.logs),
        "frames": counts.frames,
        "landmarks": list(counts.ids),
        "positives": counts.positives,
        "ignored": counts.ignored,
        "min_visible": evaluation.min_visible,
        "paper_min_visible": PAPER_MIN_VISIBLE,
        "gate_m": list(counts.gates),
        "unit": summary.units.kind,
        "units": summary.units.count,
        "methods": methods,
        "per_log": per_log,
        "figures": [as_record(asdict(figure)) for figure in summary.figures],
        "differences": [as_record(asdict(difference)) for difference in summary.differences],
        "notes": list(evaluation.notes),
        "unused": list(evaluation.unused),
    }


def _named_counts(names: Sequence[str], counts: Sequence[Count]) -> dict[str, Any]:
    return {
        name: {key: finite_or_none(v) for key, v in zip(COUNTS, count_cells(count), strict=True)}
        for name, count in zip(names, counts, strict=True)
    }


def as_record(fields: dict[str, Any]) -> dict[str, Any]:
    """The fields of a figure or a rate for JSON, null in place of NaN and infinity."""
    return {key.removesuffix("_text"): finite_or_none(value) for key, value in fields.items()}


def finite_or_none(value: Any) -> Any:
    """The value; None in place of NaN and infinity, which JSON does not have."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
