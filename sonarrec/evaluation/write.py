"""The result of `evaluate`, its tables, and the files of `evaluation/`."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from sonarrec.errors import number_of
from sonarrec.evaluation.count import Counts, Scored
from sonarrec.evaluation.curves import Count
from sonarrec.evaluation.figures import Summary
from sonarrec.evaluation.match import PAPER_MIN_VISIBLE
from sonarrec.evaluation.mistakes import Mistake
from sonarrec.tables.outputs import (
    check_no_recording,
    check_output,
    check_tables,
    is_filled,
    write_csv,
    write_text,
    writing,
)

COUNTS = ("tpr", "fpr", "tp", "tn", "fp", "fn", "total", "tpr_once")
HEADERS = {
    "confusion": ("protocol", "method", "landmark", *COUNTS),
    "roc": ("protocol", "method", "landmark", "threshold", "tpr", "fpr", "tp", "tn", "fp", "fn"),
    "figures": (
        *("protocol", "method", "landmark", "figure", "value", "low", "high", "units", "note"),
        "log",
    ),
    "passes": (
        *("log", "landmark", "first_frame", "last_frame", "protocol", "method", "frames", "right"),
    ),
    "mistakes": Mistake._fields,
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

    @property
    def scored(self) -> tuple[Scored, ...]:
        """Counts and curves of every method under every protocol."""
        return self.counts.scored

    @property
    def confusion(self) -> pd.DataFrame:
        """Rates and counts, per ID and in total."""
        return self._table("confusion")

    @property
    def figures(self) -> pd.DataFrame:
        """All figures with their 95 % intervals; of several logs also the rates of each."""
        return self._table("figures")

    @property
    def tests(self) -> pd.DataFrame:
        """The differences of each two methods, with intervals and p-values."""
        rows = [d._asdict() | {"difference": d.value} for d in self.summary.differences]
        return pd.DataFrame(rows).rename(columns={"name": "figure"})

    @property
    def roc(self) -> pd.DataFrame:
        """The corners of every curve."""
        return self._table("roc")

    @property
    def passes(self) -> pd.DataFrame:
        """How each method did in each pass of a landmark."""
        return self._table("passes")

    @property
    def mistakes(self) -> pd.DataFrame:
        """What each method got wrong over neighbouring frames, the longest first."""
        return self._table("mistakes")

    def _table(self, name: str) -> pd.DataFrame:
        return pd.DataFrame(_ROWS[name](self), columns=list(HEADERS[name]))

    @property
    def table(self) -> pd.DataFrame:
        """A row per method: TPR and FPR under each protocol over all IDs."""
        of_method: dict[str, dict[str, float]] = {}
        for s in self.scored:
            count, row = s.count(), of_method.setdefault(s.method, {})
            row |= {f"{s.protocol} TPR": count.tpr, f"{s.protocol} FPR": count.fpr}
        return pd.DataFrame.from_dict(of_method, orient="index").rename_axis("method")

    def __repr__(self) -> str:
        of = f"{number_of(len(self.folders), 'log')}, {number_of(self.counts.frames, 'frame')}"
        leading = [s for s in self.scored if s.method == self.scored[0].method][-1]
        return f"<Evaluation of {of}: {repr(leading)[1:]}"


def _confusion(evaluation: Evaluation) -> Iterable[tuple[Any, ...]]:
    for s in evaluation.scored:
        for name, count in s.named_counts().items():
            yield s.protocol, s.method, name, *(getattr(count, column) for column in COUNTS)


def _roc(evaluation: Evaluation) -> Iterable[tuple[Any, ...]]:
    """The corners of every curve, thresholds falling from inf."""
    for s in evaluation.scored:
        for name, k in [*((str(i), k) for k, i in enumerate(s.ids)), ("total", None)]:
            curve = s.curve(k)
            at = curve.turns()
            rates = curve.threshold, curve.tpr, curve.fpr
            columns = *rates, curve.tp, curve.tn, curve.fp, curve.fn
            for row in zip(*(column[at].tolist() for column in columns), strict=True):
                yield s.protocol, s.method, name, *row


def _figures(evaluation: Evaluation) -> Iterable[tuple[Any, ...]]:
    """The figures of all logs, whose `log` is empty; then TPR and FPR of each of several."""
    for f in evaluation.summary.figures:
        yield *f, ""
    logs = evaluation.counts.logs
    for s in evaluation.scored if len(logs) > 1 else ():
        for n, log in enumerate(logs):
            for name, count in s.named_counts(n).items():
                for figure in ("tpr", "fpr"):
                    value = getattr(count, figure)
                    yield s.protocol, s.method, name, figure, value, "", "", "", "", log


def _passes(evaluation: Evaluation) -> Iterable[tuple[Any, ...]]:
    counts = evaluation.counts
    for s in counts.scored:
        both = counts.passes.tolist(), counts.outcomes(s.protocol, s.method).tolist()
        for (log, k, first, last, _), outcome in zip(*both, strict=True):
            yield counts.logs[log], counts.ids[k], first, last, s.protocol, s.method, *outcome


def _mistakes(evaluation: Evaluation) -> Iterable[tuple[Any, ...]]:
    return evaluation.counts.mistakes


_ROWS = {
    **{"confusion": _confusion, "roc": _roc, "figures": _figures},
    **{"passes": _passes, "mistakes": _mistakes},
}


def write_evaluation(folder: Path, evaluation: Evaluation) -> tuple[str, ...]:
    """Write all tables and the picture into `folder`, created if needed; returns the file names.

    evaluation.json is written last, so if it exists the others are complete. Raises SonarrecError
    if they cannot be written; UsageError, before the first one, if a file of another kind exists.
    """
    from sonarrec.evaluation.plots import draw_roc  # brings matplotlib

    text = json_text(evaluation)
    written = {f"{name}.csv": header for name, header in HEADERS.items()}
    check_tables(folder, written)
    check_output(folder / "evaluation.json", "JSON", header='{\n  "logs": [')
    if not is_filled(folder / "evaluation.json"):  # else the picture is ours, even unmarked
        check_output(folder / "roc.png", "picture")
    check_no_recording(folder, written)
    with writing(folder):
        (folder / "evaluation.json").unlink(missing_ok=True)
        for name, header in HEADERS.items():
            write_table(folder / f"{name}.csv", header, _ROWS[name](evaluation))
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


def json_text(evaluation: Evaluation) -> str:
    """evaluation.json: what was scored and how, counts and figures.

    NaN and infinity, which JSON does not have, are null.
    """
    counts, summary = evaluation.counts, evaluation.summary
    methods: dict[str, Any] = {}
    per_log: dict[str, Any] = {log: {} for log in counts.logs}
    for s in counts.scored:
        methods.setdefault(s.method, {})[s.protocol] = _named(s.named_counts())
        for n, log in enumerate(counts.logs):
            per_log[log].setdefault(s.method, {})[s.protocol] = _named(s.named_counts(n))
    document = {
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
        "figures": [figure._asdict() for figure in summary.figures],
        "differences": [difference._asdict() for difference in summary.differences],
        "notes": list(evaluation.notes),
        "unused": list(evaluation.unused),
    }
    return json.dumps(_finite(document), indent=2, allow_nan=False) + "\n"


def _named(counts: dict[str, Count]) -> dict[str, Any]:
    return {name: {key: getattr(c, key) for key in COUNTS} for name, c in counts.items()}


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
