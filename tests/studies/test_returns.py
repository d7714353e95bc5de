"""What `make returns` counts, on a case small enough to count by hand."""

from __future__ import annotations

import numpy as np

from tests.studies.returns import Returns, counted


def test_exits_and_returns_counted_by_hand() -> None:
    #            comes  whole  edge  away  away  edge  back  edge  back  away
    visible = [0.3, 1.0, 0.4, 0.0, 0.0, 0.5, 1.0, 0.6, 1.0, 0.0]
    claimed = [1, 1, 0, 1, 0, 1, 1, 1, 0, 1]
    # Another ID, which never is whole in view: nothing of it can leave.
    never = [0.5, 0.5, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0]
    table = np.column_stack([visible, never])
    declared = np.column_stack([claimed, np.ones(10)]) > 0
    assert counted(table, declared) == Returns(
        exits=2, returns=1, away=3, claims=2, back=2, right=1
    )


def test_sums_are_by_field() -> None:
    assert Returns(1, 2, 3, 4, 5, 6) + Returns(1, 1, 1, 1, 1, 1) == Returns(2, 3, 4, 5, 6, 7)
