"""The result of `evaluate`, and its tables."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from sonarrec.errors import number_of
from sonarrec.evaluation.count import Counts, Scored
from sonarrec.evaluation.curves import Count, macro_curve
from sonarrec.evaluation.summary import Summary

COUNTS = ("tpr", "fpr", "tp", "tn", "fp", "fn", "total", "tpr_once")
CONFUSION = ("protocol", "method", "landmark", *COUNTS)
HEADERS = {
    "confusion": CONFUSION,
    "roc": ("protocol", "method", "landmark", "threshold", "tpr", "fpr", "tp", "tn", "fp", "fn"),
    "figures": (
        *(
            "protocol",
            "method",
            "landmark",
            "figure",
            "value",
            "low",
            "high",
            "units",
            "note",
            "log",
        ),
    ),
    "tests": (
        *("protocol", "a", "b", "landmark", "figure", "value_a", "value_b", "difference"),
        *("low", "high", "p", "units", "note"),
    ),
    "passes": (
        *("log", "landmark", "first_frame", "last_frame", "protocol", "method", "frames", "right"),
        *("frames_to_id", "id_switches", "track_switches"),
    ),
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
    notes: tuple[str, ...]
    """What is remarkable, a line each."""
    unused: tuple[str, ...]
    """Input that could not be used, a line each."""

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
        return self._table("tests")

    @property
    def roc(self) -> pd.DataFrame:
        """The corners of every curve."""
        return self._table("roc")

    @property
    def passes(self) -> pd.DataFrame:
        """How each method did in each pass of a landmark."""
        return self._table("passes")

    def _table(self, name: str) -> pd.DataFrame:
        return pd.DataFrame(self.rows(name), columns=list(HEADERS[name]))

    def rows(self, name: str) -> Iterable[tuple[Any, ...]]:
        """The rows of a table, one of HEADERS."""
        return _ROWS[name](self)

    @property
    def table(self) -> pd.DataFrame:
        """A row per method: TPR and FPR under each protocol over all IDs, HOTA and IDF1."""
        of_method: dict[str, dict[str, float]] = {}
        for s in self.scored:
            count, row = s.count(), of_method.setdefault(s.method, {})
            row |= {f"{s.protocol} TPR": count.tpr, f"{s.protocol} FPR": count.fpr}
        for f in self.summary.figures:
            if f.name in ("hota", "idf1"):
                of_method[f.method][f.name.upper()] = f.value
        return pd.DataFrame.from_dict(of_method, orient="index").rename_axis("method")

    def __repr__(self) -> str:
        of = f"{number_of(len(self.folders), 'log')}, {number_of(self.counts.frames, 'frame')}"
        leading = [s for s in self.scored if s.method == self.scored[0].method][-1]
        return f"<Evaluation of {of}: {repr(leading)[1:]}"


def counts_by_id(scored: Scored) -> list[tuple[str, Count]]:
    """The counts of each ID, then of all."""
    named = [(str(i), scored.count(k)) for k, i in enumerate(scored.ids)]
    return [*named, ("total", scored.count())]


def count_cells(c: Count) -> tuple[float, ...]:
    """The cells of COUNTS."""
    return c.tpr, c.fpr, c.tp, c.tn, c.fp, c.fn, c.total, c.tpr_once


def _confusion(evaluation: Evaluation) -> Iterable[tuple[Any, ...]]:
    for s in evaluation.scored:
        for name, count in counts_by_id(s):
            yield s.protocol, s.method, name, *count_cells(count)


def _roc(evaluation: Evaluation) -> Iterable[tuple[Any, ...]]:
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


def _figures(evaluation: Evaluation) -> Iterable[tuple[Any, ...]]:
    """The figures of all logs, whose `log` is empty; then TPR and FPR of each of several."""
    for f in evaluation.summary.figures:
        yield (
            *(f.protocol, f.method, f.landmark_text, f.name, f.value, f.low, f.high, f.units),
            *(f.note, ""),
        )
    logs, names = evaluation.counts.logs, [*map(str, evaluation.counts.ids), "total"]
    for s in evaluation.scored if len(logs) > 1 else ():
        for log, counts in zip(logs, s.counts_per_log(), strict=True):
            for name, count in zip(names, counts, strict=True):
                for figure, value in (("tpr", count.tpr), ("fpr", count.fpr)):
                    yield s.protocol, s.method, name, figure, value, "", "", "", "", log


def _tests(evaluation: Evaluation) -> Iterable[tuple[Any, ...]]:
    for d in evaluation.summary.differences:
        yield (
            *(d.protocol, d.a, d.b, d.landmark_text, d.name, d.value_a, d.value_b, d.value),
            *(d.low, d.high, d.p, d.units, d.note),
        )


def _passes(evaluation: Evaluation) -> Iterable[tuple[Any, ...]]:
    counts, passes = evaluation.counts, evaluation.counts.passes
    logs = [counts.logs[i] for i in passes.log_index]
    ids = [counts.ids[k] for k in passes.landmark_index]
    none = [""] * len(logs)
    for s in counts.scored:
        outcomes, ids_, tracks = counts.outcomes(s.protocol, s.method), none, none
        if counts.placed:
            found = counts.switches(s.method)
            ids_ = found.ids.tolist()
            tracks = none if found.tracks is None else found.tracks.tolist()
        frames = passes.first_frame.tolist(), passes.last_frame.tolist()
        of = outcomes.frames.tolist(), outcomes.right.tolist(), outcomes.wait.tolist()
        for log, landmark, first, last, *row in zip(
            logs, ids, *frames, *of, ids_, tracks, strict=True
        ):
            yield log, landmark, first, last, s.protocol, s.method, *row


_ROWS = {
    "confusion": _confusion,
    "roc": _roc,
    "figures": _figures,
    "tests": _tests,
    "passes": _passes,
}
