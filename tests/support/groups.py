"""Groups of stage 2, made up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sonarrec.records import Groups


def groups(
    *numbers: int,
    positions: Sequence[Sequence[float]] | None = None,
    remembered: Sequence[int] = (),
    sight_deg: Sequence[float] | None = None,
) -> Groups:
    """Groups in view, by default at (0, 0) and with a line of sight that has not rotated."""
    n = len(numbers)
    return Groups(
        numbers=np.array(numbers, np.int64),
        positions=np.array([(0, 0)] * n if positions is None else positions, float).reshape(n, 2),
        spread=np.zeros((n, 2)),
        existence=np.full(n, 0.9),
        sight_deg=np.array([0.0] * n if sight_deg is None else sight_deg),
        in_view=np.ones(n, bool),
        remembered=np.array(remembered, np.int64),
    )
