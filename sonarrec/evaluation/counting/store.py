"""A store of arrays: in memory while they are small, else in a temporary file.

So memory does not grow with the number of logs, and every figure stays exact.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator
from tempfile import SpooledTemporaryFile
from typing import Any

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import FloatArray, IntArray

IN_MEMORY = 32_000_000
"""Bytes; more go to a temporary file, which is deleted with the store."""
AT_ONCE = 250_000
"""Rows that are sorted at a time."""
STEPS = 1 << 16
"""Bins of the histogram that `values_at_ranks` uses."""

Blocks = Callable[[], Iterable[FloatArray]]
"""Gives (n,) arrays, the same ones on each call."""


class Store:
    """Arrays by key and part (the number of a log)."""

    def __init__(self) -> None:
        self._file: SpooledTemporaryFile[bytes] = SpooledTemporaryFile(IN_MEMORY)  # noqa: SIM115
        self._end = 0
        self._blocks: dict[Hashable, list[tuple[int, int, Any, tuple[int, ...]]]] = defaultdict(
            list
        )

    def put(self, key: Hashable, part: int, array: npt.NDArray[Any]) -> None:
        """Keep an array."""
        self._file.seek(self._end)
        self._file.write(np.ascontiguousarray(array).tobytes())
        self._blocks[key].append((part, self._end, array.dtype, array.shape))
        self._end += array.nbytes

    def get(self, key: Hashable) -> Iterator[tuple[int, npt.NDArray[Any]]]:
        """(part, array) of a key, in the order of `put`, one in memory at a time."""
        for part, at, dtype, shape in self._blocks.get(key, ()):
            self._file.seek(at)
            data = self._file.read(int(np.prod(shape)) * dtype.itemsize)
            yield part, np.frombuffer(data, dtype).reshape(shape)


def sum_by_value(chunks: Iterable[tuple[FloatArray, IntArray]]) -> tuple[FloatArray, IntArray]:
    """(n,) distinct values, rising, and (n, C) the sums of the numbers of each.

    chunks: (m,) values and (m, C) whole numbers, of any total length.
    """
    chunks_left: list[tuple[FloatArray, IntArray]] = []
    rows = least = 0
    for values, numbers in chunks:
        if len(values):
            chunks_left.append((values, numbers.astype(np.int32)))
            rows += len(values)
        if rows - least > AT_ONCE:
            chunks_left = [_merge(chunks_left)]
            rows = least = len(chunks_left[0][0])
    return _merge(chunks_left) if chunks_left else (np.empty(0), np.empty((0, 1), dtype=np.int32))


def _merge(chunks_left: list[tuple[FloatArray, IntArray]]) -> tuple[FloatArray, IntArray]:
    values = np.concatenate([v for v, _ in chunks_left])
    numbers = np.concatenate([n for _, n in chunks_left])
    order = np.argsort(values, kind="stable")
    values = values[order]
    start = np.flatnonzero(np.append(True, values[1:] != values[:-1]))
    return values[start], np.add.reduceat(numbers[order], start, axis=0, dtype=np.int32)


def values_at_ranks(blocks: Blocks, ranks: IntArray) -> FloatArray:
    """(r,) the values of these ranks, counted from 0, as sorting all values would give.

    Three passes: the range of values, a histogram, then the values in the bins of the ranks.
    """
    low, high = np.inf, -np.inf
    for block in blocks():
        finite = block[np.isfinite(block)]
        low = min(low, finite.min(initial=np.inf))
        high = max(high, finite.max(initial=-np.inf))
    width = high - low if high > low else 1.0

    def step(values: FloatArray) -> IntArray:
        # Rises with the value; the last bin is for infinity.
        steps = np.full(len(values), STEPS - 1)
        finite = np.isfinite(values)
        steps[finite] = (values[finite] - low) / width * (STEPS - 2)
        return steps

    count = np.zeros(STEPS, dtype=np.int64)
    for block in blocks():
        count += np.bincount(step(block), minlength=STEPS)
    end = np.cumsum(count)
    wanted_bins = np.zeros(STEPS, dtype=bool)
    wanted_bins[np.searchsorted(end, ranks, side="right")] = True

    def in_wanted_bins(block: FloatArray) -> tuple[FloatArray, IntArray]:
        inside = block[wanted_bins[step(block)]]
        return inside, np.ones((len(inside), 1), dtype=np.int32)

    values, many = sum_by_value(map(in_wanted_bins, blocks()))
    before = np.cumsum(np.where(wanted_bins, 0, count))  # values left out below each bin
    place = ranks - before[np.searchsorted(end, ranks, side="right")]
    return np.asarray(values[np.searchsorted(np.cumsum(many[:, 0]), place, side="right")])
