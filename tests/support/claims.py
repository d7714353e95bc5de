"""Results and truth made of arrays, for tests of scoring without files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.evaluation.count import Counts, count_log
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.figures import summarise
from sonarrec.evaluation.match import Matched, ScoringOptions
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
    return Matched(
        name="log",
        ids=IDS,
        methods=methods,
        frame=np.arange(frames),
        stretch=np.zeros(frames, int) if stretch is None else np.array(stretch),
        truth_frame_index=t[:, 0].astype(int),
        truth_landmark_index=t[:, 1].astype(int) - 1,
        truth_position=t[:, 2:4],
        truth_positive=np.array([row[4] for row in truth], dtype=bool),
        truth_half_in_view=np.array([row[4] for row in truth], dtype=bool),
        gate_m=GATE_M,
        method_index=c[:, 0].astype(int),
        claim_frame_index=c[:, 1].astype(int),
        claim_landmark_index=c[:, 2].astype(int) - 1,
        claim_position=c[:, 3:5],
        score=c[:, 5],
        declared=c[:, 6].astype(bool),
        probability=np.array(told, dtype=np.float32).reshape(-1, len(IDS) + 1),
        placed=True,
        truth_orientation=np.array([row[5] if len(row) > 5 else np.nan for row in truth]),
        claim_orientation=np.zeros(len(c)),
        turn_deg=np.array([360.0, 180.0, 360.0, 360.0]),
    )


def counts(*logs: Matched) -> Counts:
    """The counts of logs."""
    found = Counts()
    for log in logs:
        found.add(count_log(log))
    return found.finish([Path(f"log{n}") for n in range(len(logs))])


def evaluated(*logs: Matched) -> Evaluation:
    """Their figures as well."""
    found = counts(*logs)
    return Evaluation(found, summarise(found), 0.9, (), (), ())


def evaluate(results: str | Path, truth: str | Path | None = None, **options: Any) -> Evaluation:
    """The scores of files. options: of ScoringOptions."""
    return evaluate_logs(results, truth, ScoringOptions(**options))
