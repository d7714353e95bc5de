"""Results and truth made of arrays, for tests of scoring without files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sonarrec.arrays import Table
from sonarrec.evaluation.counts import TOTAL, Counts, add_up, count_log
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.rows import Matched, ScoringOptions
from sonarrec.evaluation.rows import matched as with_passes
from sonarrec.evaluation.write import Evaluation

IDS = (1, 2, 3, 4)
GATE_M = 0.15


def matched(
    frames: int,
    truth: Sequence[tuple],
    claims: Sequence[tuple],
    *,
    methods: tuple[str, ...] = ("a", "b"),
    stretch: Sequence[int] | None = None,
) -> Matched:
    """truth: (frame, ID, x, y, positive) and, if wanted, orientation, which is 0 for all claims.
    claims: (method, frame, ID, x, y, score, declared), then, if wanted, the probabilities of the
    IDs and of none. Frames and methods by index."""
    t = np.array([row[:4] for row in truth], dtype=float).reshape(-1, 4)
    c = np.array([row[:7] for row in claims], dtype=float).reshape(-1, 7)
    told = [row[7:] or (np.nan,) * (len(IDS) + 1) for row in claims]
    whole = np.array([row[4] for row in truth], dtype=bool)
    truths = Table(
        at=t[:, 0].astype(int),
        landmark=t[:, 1].astype(int),
        x=t[:, 2],
        y=t[:, 3],
        orientation=np.array([row[5] if len(row) > 5 else np.nan for row in truth], dtype=float),
        paper=whole,
        strict=whole,
    )
    made = Table(
        method=c[:, 0].astype(int),
        at=c[:, 1].astype(int),
        landmark=c[:, 2].astype(int),
        x=c[:, 3],
        y=c[:, 4],
        orientation=np.zeros(len(c)),
        score=c[:, 5],
        declared=c[:, 6].astype(bool),
    )
    return with_passes(
        "log",
        IDS,
        methods,
        np.arange(frames),
        np.zeros(frames, int) if stretch is None else np.array(stretch),
        truths,
        made,
        probability=np.array(told, dtype=np.float32).reshape(-1, len(IDS) + 1),
        gate_m=GATE_M,
        period_deg=dict(zip(IDS, (360.0, 180.0, 360.0, 360.0), strict=True)),
        placed=True,
    )


class Scored(NamedTuple):
    """One method under one protocol."""

    protocol: str
    method: str
    counts: Counts

    def count(self, k: int | None = None, log: int | None = None) -> Any:
        """The rates and counts of the k-th ID or over all, in one log or in all."""
        landmark = TOTAL if k is None else str(self.counts.ids[k])
        of_log = "" if log is None else self.counts.logs[log]
        return self.counts.count(self.method, self.protocol, landmark, of_log)

    def curve(self, k: int | None = None) -> Table:
        """The ROC of the k-th ID, or of all."""
        landmark = TOTAL if k is None else str(self.counts.ids[k])
        return self.counts.curve(self.method, self.protocol, landmark)


def all_scored(of: Counts) -> list[Scored]:
    """Every method under every protocol."""
    return [Scored(p, m, of) for m in of.methods for p in of.protocols]


def counts(*logs: Matched) -> Counts:
    """The counts of logs."""
    return add_up([*map(count_log, logs)], [Path(f"log{n}") for n in range(len(logs))])


def evaluate(results: str | Path, truth: str | Path | None = None, **options: Any) -> Evaluation:
    """The scores of files. options: of ScoringOptions."""
    return evaluate_logs(results, truth, ScoringOptions(**options))
