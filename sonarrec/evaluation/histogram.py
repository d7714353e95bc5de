"""Values and how often each occurs: of scores, which have six digits, and of errors."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

import numpy as np

from sonarrec.arrays import FloatArray, IntArray

Key = tuple[str | int, ...]
Table = tuple[FloatArray, IntArray]
"""(n,) distinct values, rising, and (n, C) the sums of what belongs to each."""
Rows = tuple[FloatArray, IntArray, IntArray]
"""(n,) values, (n,) the unit of each, and (n, C) the sums of what belongs to it there."""

MOST_ROWS = 4_000_000
"""With more of them values by unit are rounded; see Values."""
STEPS = {"position": 1e-5, "orientation": 0.01}
"""m and deg to which errors are then rounded down: an edge of a histogram stays in its step."""
SCORES = np.unique(np.round([0, *1 / (1 + np.exp(-np.linspace(-14, 14, 1868))), 1], 6))
"""Those to which scores are then rounded down, so that no FPR of a curve rises: dense near 0 and 1,
where curves are steep."""


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


def sum_by_unit(value: FloatArray, unit: IntArray, number: IntArray) -> Rows:
    """One row for each value in each unit, in order. value, unit: (n,); number: (n, C)."""
    order = np.lexsort((value, unit))
    value, unit = value[order], unit[order]
    new = np.ones(len(value), dtype=bool)
    new[1:] = (np.diff(value) != 0) | (np.diff(unit) != 0)
    start = np.flatnonzero(new)
    if not len(start):
        return value, unit.astype(np.int32), np.empty((0, number.shape[1]), dtype=np.int32)
    sums = np.add.reduceat(number[order], start, axis=0, dtype=np.int32)
    return value[start], unit[start].astype(np.int32), sums


class Values:
    """The scores of claims and the errors of all logs, by key: ("claims", ...) or an error's name.

    Each log's are added by unit. With more than MOST_ROWS they stay exact in all, but by unit are
    rounded, so that memory does not grow with the number of claims.
    """

    def __init__(self) -> None:
        self._rows: dict[Key, list[Rows]] = defaultdict(list)
        self._rounded: dict[Key, list[Rows]] = defaultdict(list)
        self._exact: dict[Key, Table] = {}  # of those that are rounded
        self._tables: dict[Key, Table] = {}  # of all
        self._count = 0

    def add(self, key: Key, rows: Rows) -> None:
        """Add those of one log."""
        self._rows[key].append(rows)
        self._tables.pop(key, None)
        self._count += len(rows[0])
        if self._count > MOST_ROWS:
            for of in list(self._rows):
                self._round(of)
            self._count = 0

    def _round(self, key: Key) -> None:
        self._exact[key] = self.table(key)
        for value, unit, number in self._rows.pop(key):
            if step := STEPS.get(str(key[0])):
                coarse = np.floor(value / step) * step
            else:
                coarse = SCORES[np.searchsorted(SCORES, value, side="right") - 1]
            self._rounded[key].append(sum_by_unit(coarse, unit, number))

    def rows(self, key: Key) -> list[Rows]:
        """By unit, one for each log that has the key."""
        return [*self._rounded.get(key, ()), *self._rows.get(key, ())]

    def table(self, key: Key) -> Table:
        """In all."""
        if key not in self._tables:
            exact = [self._exact[key]] if key in self._exact else []
            fresh = ((value, number) for value, _, number in self._rows.get(key, ()))
            self._tables[key] = sum_by_value([*exact, *fresh])
        return self._tables[key]
