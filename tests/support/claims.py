"""Results and truth made of arrays, for tests of scoring without files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.evaluation.counting.scoring import PROTOCOLS, score
from sonarrec.evaluation.evaluate import Evaluation, evaluate_whole
from sonarrec.evaluation.matching.joined import Joined
from sonarrec.evaluation.matching.options import ScoringOptions

IDS = (1, 2, 3, 4)
GATE_M = 0.15


def joined(
    frames: int,
    truth: Sequence[tuple],
    claims: Sequence[tuple],
    *,
    methods: tuple[str, ...] = ("a", "b"),
    logs: Sequence[int] | None = None,
    seconds: float = 0.25,
) -> Joined:
    """truth: (frame, ID, x, y, positive) and, if wanted, orientation, which is 0 for all claims.
    claims: (method, frame, ID, x, y, score, declared), then, if wanted, object and the
    probabilities of the IDs and of none. Frames and methods by index; logs: the log of every
    frame, rising."""
    log = np.zeros(frames, dtype=int) if logs is None else np.asarray(logs)
    t = np.array([row[:4] for row in truth], dtype=float).reshape(-1, 4)
    c = np.array([row[:7] for row in claims], dtype=float).reshape(-1, 7)
    told = [row[8:] or (np.nan,) * (len(IDS) + 1) for row in claims]
    start = np.searchsorted(log, np.arange(log.max() + 1))
    return Joined(
        logs=tuple(f"log{i}" for i in range(log.max() + 1)),
        ids=IDS,
        methods=methods,
        log_index=log,
        frame=np.arange(frames) - start[log],
        seconds=np.full(frames, seconds),
        truth_frame_index=t[:, 0].astype(int),
        truth_landmark_index=t[:, 1].astype(int) - 1,
        truth_position=t[:, 2:4],
        truth_positive=np.array([row[4] for row in truth], dtype=bool),
        truth_half_in_view=np.array([row[4] for row in truth], dtype=bool),
        gate=np.full(len(t), GATE_M),
        method_index=c[:, 0].astype(int),
        claim_frame_index=c[:, 1].astype(int),
        claim_landmark_index=c[:, 2].astype(int) - 1,
        claim_position=c[:, 3:5],
        score=c[:, 5],
        declared=c[:, 6].astype(bool),
        claim_object=np.array([row[7] if len(row) > 7 else -1 for row in claims], dtype=int),
        probability=np.array(told, dtype=np.float32).reshape(-1, len(IDS) + 1),
        placed=True,
        rounded=False,
        truth_orientation=np.array([row[5] if len(row) > 5 else np.nan for row in truth]),
        claim_orientation=np.zeros(len(c)),
        turn_deg=np.array([360.0, 180.0, 360.0, 360.0]),
    )


def evaluated(case: Joined) -> Evaluation:
    """Every method under both protocols."""
    scored = tuple(score(case, m, p) for m in range(len(case.methods)) for p in PROTOCOLS)
    return Evaluation(case, (), scored, 0.9, (), ())


def evaluate(results: str | Path, truth: str | Path | None = None, **options: Any) -> Evaluation:
    """The scores of files with all frames and claims. options: of ScoringOptions."""
    return evaluate_whole(results, truth, ScoringOptions(**options))
