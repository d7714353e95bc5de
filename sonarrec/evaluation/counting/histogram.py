"""Values and how often each occurs: of scores, which have six digits, and of errors."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sonarrec.arrays import FloatArray, IntArray

Table = tuple[FloatArray, IntArray]
"""(n,) distinct values, rising, and (n, C) the sums of what belongs to each."""


def sum_by_value(chunks: Iterable[tuple[FloatArray, IntArray]]) -> Table:
    """The distinct values of chunks of (m,) values and (m, C) whole numbers, with their sums."""
    values, numbers = [], []
    for value, number in chunks:
        if len(value):
            values.append(value)
            numbers.append(number)
    if not values:
        return np.empty(0), np.empty((0, 1), dtype=np.int64)
    value, of_value = np.unique(np.concatenate(values), return_inverse=True)
    number = np.concatenate(numbers)
    sums = [np.bincount(of_value, column, minlength=len(value)) for column in number.T]
    return value, np.stack(sums, axis=1).astype(np.int64)


def values_at_ranks(table: Table, ranks: IntArray) -> FloatArray:
    """(r,) the values of these ranks, counted from 0, as sorting all values would give.

    table: counts (n, 1).
    """
    value, count = table
    return np.asarray(value[np.searchsorted(np.cumsum(count[:, 0]), ranks, side="right")])
