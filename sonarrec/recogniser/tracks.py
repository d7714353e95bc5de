"""One table of all tracks, in whose columns each stage keeps what it knows of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, IntArray, Table


class Tracks(Table):
    """The tracks of one log, a row each, by rising number.

    Stages declare columns, and write to them; rows begin and end here alone, in all columns at
    once. `tracks[rows]` copies some rows.

    number: (n,) int, stable over frames; none is used twice. remembered: (n,) bool, whether the
    track has left the view and may return.
    """

    def __init__(self) -> None:
        self.columns = {}
        self._new: dict[str, Any] = {}
        self._last = 0
        self.declare(number=0, remembered=False)

    def declare(self, **new: Any) -> None:
        """Add columns. new: what each has in a row that begins: values of any shape, (n, ...) in
        the table, or a class, of which every row gets an object of its own."""
        for name, value in new.items():
            assert name not in self.columns, name
            self._new[name] = np.asarray(value)[None]
            self.columns[name] = self._new[name][:0]

    def __setitem__(self, name: str, values: npt.ArrayLike) -> None:
        self.columns[name][:] = values

    @property
    def in_view(self) -> IntArray:
        """Indices of the tracks in view: those that are not only remembered."""
        return np.flatnonzero(~self.columns["remembered"])

    def keep(self, rows: BoolArray) -> None:
        """End the tracks that are not in a mask (n,)."""
        if not rows.all():
            self.columns = {name: column[rows] for name, column in self.columns.items()}

    def begin(self, count: int) -> IntArray:
        """Begin so many tracks, with new numbers. Returns their rows."""
        rows = len(self) + np.arange(count)
        for name, column in self.columns.items():
            new = np.repeat(self._new[name], count, axis=0)
            if callable(new_object := self._new[name][0]):
                new[:] = [new_object() for _ in rows]
            self.columns[name] = np.concatenate([column, new])
        self["number"][rows] = self._last + 1 + np.arange(count)
        self._last += count
        return rows
