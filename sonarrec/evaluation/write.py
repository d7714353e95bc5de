"""The result of `evaluate`: its tables, and the files of `evaluation/`."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from sonarrec.arrays import stacked
from sonarrec.errors import number_of
from sonarrec.evaluation.counts import Counts
from sonarrec.evaluation.figures import Difference, Figure, Summary
from sonarrec.evaluation.mistakes import Mistake
from sonarrec.evaluation.plots import draw_roc
from sonarrec.evaluation.rows import PAPER_MIN_VISIBLE
from sonarrec.tables.outputs import (
    as_cell,
    check_folder,
    check_output,
    check_tables,
    is_filled,
    write_csv,
    write_text,
    writing,
)

COUNTED = ["tpr", "fpr", "tp", "tn", "fp", "fn", "total", "tpr_once", "false_per_100"]
LABELS = ["protocol", "method", "landmark"]
HEADERS = {
    "confusion": [*LABELS, *COUNTED],
    "roc": [*LABELS, "threshold", "tpr", "fpr", "tp", "tn", "fp", "fn"],
    "figures": [*LABELS, "figure", "value", "low", "high", "units", "note", "log"],
    "passes": [
        *("log", "landmark", "first_frame", "last_frame", "protocol", "method", "frames", "right")
    ],
    "mistakes": [*Mistake._fields],
}
"""Columns of each table, which is also a CSV file of that name."""


@dataclass(frozen=True, slots=True, repr=False)
class Evaluation:
    """The result of `evaluate`. Its tables have the columns of the files of their names."""

    counts: Counts
    summary: Summary
    min_visible: float
    folders: tuple[Path, ...]
    """Results folder of each log, as given."""
    truths: tuple[Path, ...]
    """The truth of each log."""
    notes: tuple[str, ...]
    """What is remarkable, a line each."""
    unused: tuple[str, ...]
    """Input that could not be used or is in doubt, a line each."""
    left_out: int | None = None
    """Frames that are not labelled, if only labelled ones count; else None."""

    @property
    def confusion(self) -> pd.DataFrame:
        """Rates and counts, per ID and in total."""
        rows = [
            (protocol, method, landmark, *(getattr(count, name) for name in COUNTED))
            for (method, protocol, log, landmark), count in self.counts.confusion.items()
            if not log
        ]
        return pd.DataFrame(rows, columns=HEADERS["confusion"])

    @property
    def roc(self) -> pd.DataFrame:
        """The corners of every curve, thresholds falling from inf."""
        curves = [
            self.counts.corners(method, protocol, landmark).with_columns(
                method=method, protocol=protocol, landmark=landmark
            )
            for method in self.counts.methods
            for protocol in self.counts.protocols
            for landmark in self.counts.landmarks
        ]
        return pd.DataFrame(stacked(curves).select(HEADERS["roc"]).columns)

    @property
    def figures(self) -> pd.DataFrame:
        """All figures with their 95 % intervals; of several logs also the rates of each."""
        table = pd.DataFrame(self.summary.figures, columns=Figure._fields).assign(log="")
        if len(self.counts.logs) > 1:
            each = [
                (protocol, method, landmark, name, getattr(count, name), "", "", log)
                for (method, protocol, log, landmark), count in self.counts.confusion.items()
                for name in ("tpr", "fpr")
                if log
            ]
            known = [*LABELS, "figure", "value", "units", "note", "log"]
            of_logs = pd.DataFrame(each, columns=known)
            table = pd.concat([table.astype({"units": object}), of_logs])
        return table[HEADERS["figures"]].reset_index(drop=True)

    @property
    def tests(self) -> pd.DataFrame:
        """The differences of each two methods, with intervals and p-values."""
        table = pd.DataFrame(self.summary.differences, columns=Difference._fields)
        return table.assign(difference=table.value_b - table.value_a)

    @property
    def passes(self) -> pd.DataFrame:
        """How each method did in each pass of a landmark."""
        return pd.DataFrame(self.counts.passes.select(HEADERS["passes"]).columns)

    @property
    def mistakes(self) -> pd.DataFrame:
        """What each method got wrong over neighbouring frames, the longest first."""
        table = pd.DataFrame(self.counts.mistakes, columns=HEADERS["mistakes"])
        return table.assign(other=pd.Series([m.other for m in self.counts.mistakes], dtype=object))

    @property
    def table(self) -> pd.DataFrame:
        """A row per method: TPR, FPR and false claims in 100 frames under each protocol over all
        IDs."""
        methods = pd.Index(self.counts.methods, name="method")
        columns = {
            f"{protocol} {label}": [
                getattr(self.counts.count(method, protocol), rate) for method in methods
            ]
            for protocol in self.counts.protocols
            for rate, label in (("tpr", "TPR"), ("fpr", "FPR"), ("false_per_100", "false per 100"))
        }
        return pd.DataFrame(columns, index=methods)

    def __repr__(self) -> str:
        logs, frames = len(self.folders), self.counts.frames
        method, protocol = self.counts.methods[0], self.counts.protocols[-1]
        count = self.counts.count(method, protocol)
        return (
            f"<Evaluation of {number_of(logs, 'log')}, {number_of(frames, 'frame')}: {method}, "
            f"{protocol}: TPR {count.tpr:.4f}, FPR {count.fpr:.4f}, "
            f"{count.false_per_100:.2f} false claims per 100 frames>"
        )


def write_evaluation(folder: Path, evaluation: Evaluation) -> tuple[str, ...]:
    """Write all tables and the picture into `folder`, created if needed; returns the file names.

    evaluation.json is written last, so if it exists the others are complete. Raises SonarrecError
    if they cannot be written; UsageError, before the first one, if a file of another kind exists.
    """
    text = json_text(evaluation)
    written = {f"{name}.csv": header for name, header in HEADERS.items()}
    check_folder(folder, (*written, "roc.png", "evaluation.json"))
    check_tables(folder, written)
    check_output(folder / "evaluation.json", "JSON", header='{\n  "logs": [')
    if not is_filled(folder / "evaluation.json"):  # else the picture is ours, even unmarked
        check_output(folder / "roc.png", "picture")
    with writing(folder):
        (folder / "evaluation.json").unlink(missing_ok=True)
        for name in HEADERS:
            write_table(folder / f"{name}.csv", getattr(evaluation, name))
        draw_roc(folder / "roc.png", evaluation.counts)
        write_text(folder / "evaluation.json", text)
    return (*written, "roc.png", "evaluation.json")


def write_table(path: Path, table: pd.DataFrame) -> None:
    """A CSV file; NaN is an empty cell."""
    if "log" in table:
        table = table.assign(log=[as_cell(str(name)) for name in table["log"]])
    columns = [
        ["" if isinstance(cell, float) and math.isnan(cell) else cell for cell in table[name]]
        for name in table
    ]
    write_csv(path, list(table), zip(*columns, strict=True))


def json_text(evaluation: Evaluation) -> str:
    """evaluation.json: what was scored and how, counts and figures.

    NaN and infinity, which JSON does not have, are null.
    """
    counts, summary = evaluation.counts, evaluation.summary
    methods: dict[str, Any] = {}
    per_log: dict[str, Any] = {log: {} for log in counts.logs}
    for (method, protocol, log, landmark), count in counts.confusion.items():
        by_method = per_log[log] if log else methods
        row = {name: getattr(count, name) for name in COUNTED}
        by_method.setdefault(method, {}).setdefault(protocol, {})[landmark] = row
    document = {
        "logs": list(counts.logs),
        "frames": counts.frames,
        "labelled_only": evaluation.left_out is not None,
        "frames_left_out": evaluation.left_out or 0,
        "landmarks": list(counts.ids),
        "positives": counts.positives,
        "ignored": counts.ignored,
        "min_visible": evaluation.min_visible,
        "paper_min_visible": PAPER_MIN_VISIBLE,
        "gate_m": list(counts.gates),
        "unit": counts.units.kind,
        "units": counts.units.number,
        "methods": methods,
        "per_log": per_log,
        "figures": [_named(figure) for figure in summary.figures],
        "differences": [_named(difference) for difference in summary.differences],
        "notes": list(evaluation.notes),
        "unused": list(evaluation.unused),
    }
    return json.dumps(_finite(document), indent=2, allow_nan=False) + "\n"


def _named(row: Figure | Difference) -> dict[str, Any]:
    return {"name" if key == "figure" else key: cell for key, cell in row._asdict().items()}


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
