"""Reads and checks tables, as a whole or in parts; an error names file, line and column."""

from __future__ import annotations

import csv
import io
import itertools
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, TextIO

import numpy as np
import pandas as pd
from pandas.api.types import union_categoricals

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import SonarrecError, printable

Kind = Literal[
    "whole",
    "whole or none",
    "number",
    "time",
    "place",
    "blank or number",
    "blank or place",
    "share",
    "flag",
    "text",
    "blank or text",
    "label",
]
Table = dict[str, Any]
"""Column name to (rows,) array.

int64, float64 (three kinds), float64 with NaN (three kinds), bool, str categories (two kinds); of a
label, which may be any text, whole numbers as they are, else an int64 number per distinct one, -1
where blank."""

POSITION_KINDS: dict[str, Kind] = {
    "x_px": "blank or place",
    "y_px": "blank or place",
    "range_m": "blank or place",
    "bearing_deg": "blank or place",
}
NONE = -(2**62)
"""The number that stands for the word none."""
LARGEST = 10**9
"""Larger positions (pixels, m, deg) are invalid; their squares could not be used."""
MOST_SHOWN = 300
"""Characters of a header in a message."""
_OPTIONS: dict[str, Any] = {
    "encoding": "utf-8-sig",
    "skipinitialspace": True,
    "index_col": False,
    "keep_default_na": False,
    "na_values": ["", "nan"],
    "low_memory": False,
}
_RAGGED = (pd.errors.ParserError, pd.errors.ParserWarning)
_AT_ONCE = 256
"""Lines handed to pandas at a time."""
_ROWS_AT_ONCE = 2**16
"""A table as a whole is read in parts of so many rows: data frames take several times its size."""
_BLANK = ", \t\r\n"
"""A line of these alone is no row: spreadsheets end a table with lines such as ",,,"."""
_PLACES: tuple[Kind, ...] = ("place", "blank or place")
_TEXTS: tuple[Kind, ...] = ("text", "blank or text")
_WITH_OFFSET = r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d.*(?:Z|[+-]\d\d(?::?\d\d)?)"
_WORDS = {
    "whole": "a whole number",
    "whole or none": "a whole number, or none",
    "time": "a finite number, or a time with its UTC offset such as 2024-05-01T12:00:00Z",
    "share": "0 to 1",
    "flag": "0 or 1",
    "text": "a name",
}
"""What a cell must be; of other kinds a finite number."""


def read_table(
    path: Path, kinds: Mapping[str, Kind], required: tuple[str, ...], expected: str
) -> Table:
    """Read the columns named in `kinds`, if they exist; others are ignored.

    required: columns that must exist. expected: a header for error messages.
    Raises SonarrecError if the file, its header or a cell cannot be used.
    """
    parts = [table for _, table in read_tables(path, kinds, required, expected, _ROWS_AT_ONCE)]
    if len(parts) == 1:
        return parts[0]
    return {name: _joined([part.pop(name) for part in parts]) for name in [*parts[0]]}


def _joined(parts: Sequence[Any]) -> Any:
    """The parts of a column as one."""
    if isinstance(parts[0], pd.Categorical):
        return union_categoricals(parts, sort_categories=True)
    return np.concatenate(parts)


def read_header(path: Path, expected: str) -> list[str]:
    """The names of all columns. Raises SonarrecError if the file is not a table."""
    return [name.strip() for name in _names(path, expected)]


def _names(path: Path, expected: str) -> list[str]:
    """The names of all columns, as they are written. Raises SonarrecError as `read_tables` does."""
    if path.exists() and not path.is_file():
        raise SonarrecError(f"{path}: not a file that can be read as a table")
    with suppress(OSError), path.open("rb") as file:  # reported when it is read
        if file.read(4).startswith((b"PK\x03\x04", b"\x1f\x8b")):  # .xlsx and .ods; gzip
            raise SonarrecError(
                f"{path}: a workbook or an archive, not a CSV table; export or unpack it as CSV"
            )

    def read() -> list[str]:
        with _opened(path) as file:
            lines = (line for _, line in _lines(file))
            for cells in csv.reader(lines, skipinitialspace=True):
                return cells
        raise pd.errors.EmptyDataError

    names: list[str] = _parse(path, expected, read)
    for mark, name in ((";", ";"), ("\t", "tabs")):  # as spreadsheets save them
        if len(names) == 1 and mark in names[0]:
            raise SonarrecError(
                f"{path}: columns are separated by {name} and not by , as expected; a header is "
                f"{expected}"
            )
    return names


def read_tables(
    path: Path,
    kinds: Mapping[str, Kind],
    required: tuple[str, ...],
    expected: str,
    rows: int | None = None,
) -> Iterator[tuple[int, Table]]:
    """As `read_table` in parts of at most `rows` rows: (index of the first row, table).

    The rows before an invalid cell are given before SonarrecError is raised.
    """
    names = _names(path, expected)
    header = {name.strip(): name for name in names}
    for name in kinds:
        if sum(other.strip() == name for other in names) > 1:
            raise SonarrecError(f"{path}: two columns are called {name}; rename or delete one")
    missing = [name for name in required if name not in header]
    if missing:
        _parse(path, expected, lambda: [*_csv_parts(path, {}, None)])  # if it is one at all
        found = printable(",".join(header))
        found = found if len(found) <= MOST_SHOWN else f"{found[:MOST_SHOWN]}..."
        raise SonarrecError(
            f"{path}: wrong columns, no {', '.join(missing)}; found {found}; expected a header "
            f"such as {expected}"
        )
    used = {name: header[name] for name in kinds if name in header}
    text = [c for n, c in used.items() if kinds[n] in _TEXTS]
    # Not as "category", which turns the name 007 into a number. Not with `usecols`, which accepts
    # rows that are longer than the header.
    parts = _csv_parts(path, dict.fromkeys(text, object), rows)
    labels: dict[Any, int] = {}
    first = 0
    while (part := _parse(path, expected, lambda: next(parts, None))) is not None:
        columns = {
            name: part[column].astype("category") if column in text else part[column]
            for name, column in used.items()
        }
        table, fault = _table(path, first, columns, kinds, labels)
        yield first, table
        if fault is not None:
            raise fault
        first += len(part)


def _csv_parts(path: Path, dtype: Mapping[str, type], rows: int | None) -> Iterator[Any]:
    """Data frames of at most `rows` rows; None: one of all rows."""
    with _opened(path) as file:
        text: Any = _Text(line for _, line in _lines(file))
        if rows is None:
            yield pd.read_csv(text, dtype=dtype, **_OPTIONS)
        else:
            yield from pd.read_csv(text, dtype=dtype, chunksize=rows, **_OPTIONS)


def _opened(path: Path, errors: str = "strict") -> TextIO:
    return path.open(encoding="utf-8-sig", errors=errors, newline="")


def _lines(file: TextIO) -> Iterator[tuple[int, str]]:
    """The lines of a CSV file that are not blank, by their 1-based number."""
    return ((number, line) for number, line in enumerate(file, 1) if line.strip(_BLANK))


class _Text(io.TextIOBase):
    """Lines as an open file, for pandas."""

    def __init__(self, lines: Iterator[str]) -> None:
        self._lines = lines

    def read(self, _size: int | None = -1, /) -> str:
        """Some whole lines; "" at the end."""
        return "".join(itertools.islice(self._lines, _AT_ONCE))


def _parse(path: Path, expected: str, read: Callable[[], Any]) -> Any:
    """The result of `read`. Raises SonarrecError if the file is not a table."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            return read()
    except FileNotFoundError:
        raise SonarrecError(f"{path}: no such file") from None
    except pd.errors.EmptyDataError:
        raise SonarrecError(f"{path}: empty; expected a header such as {expected}") from None
    except (OSError, UnicodeDecodeError, csv.Error, *_RAGGED) as error:
        ragged = isinstance(error, _RAGGED)
        why = (_longer_row(path) if ragged else None) or str(error).strip()
        if "EOF inside string" in why:
            why = 'a quotation mark (") is never closed'
        if isinstance(error, UnicodeDecodeError):
            why = "not in UTF-8; save it as that"
        raise SonarrecError(
            f"{path}: not a readable CSV table ({why}); expected a header such as {expected}"
        ) from None


def _longer_row(path: Path) -> str | None:
    """A message on the first row that is longer than the header; None if there is none."""
    columns = 0
    with suppress(csv.Error, SonarrecError):
        for line, cells in _rows(path):
            columns = columns or len(cells)  # of the header
            if len(cells) > columns:
                return f"line {line}: {len(cells)} cells, the header has {columns}"
    return None


def _table(
    path: Path,
    first: int,
    columns: Mapping[str, Any],
    kinds: Mapping[str, Kind],
    labels: dict[Any, int],
) -> tuple[Table, SonarrecError | None]:
    """The rows before the first invalid cell, and the error for that cell.

    first: index of the first row in the file. labels: those found so far; new ones are added.
    """
    values = {name: _values(column, kinds[name], labels) for name, column in columns.items()}
    first_bad = {name: int(np.argmax(bad)) for name, (_, bad) in values.items() if bad.any()}
    end, fault = None, None
    if first_bad:
        name = min(first_bad, key=lambda name: first_bad[name])
        end = first_bad[name]
        wrong = _wrong_cell(columns[name].iloc[end], values[name][0][end], kinds[name])
        fault = SonarrecError(f"{path} line {line_number(path, first + end)}: {name} {wrong}")
    types = {"whole": np.int64, "whole or none": np.int64, "flag": np.bool_, "label": np.int64}
    table = {
        name: array[:end]
        if kinds[name] in _TEXTS
        else np.asarray(array[:end], dtype=types.get(kinds[name], np.float64))
        for name, (array, _) in values.items()
    }
    return table, fault


def _wrong_cell(cell: object, value: Any, kind: Kind) -> str:
    """What an invalid cell must be, and what it is. value: the cell as a number, else NaN."""
    found = "an empty cell or nan" if pd.isna(cell) else repr(str(cell)[:40])
    size, bounds = np.abs(value), ""
    if kind.startswith("whole") and size >= 2.0**63:
        bounds = " below 2^63"
    elif kind in _PLACES and np.isfinite(size):
        bounds = " from -1e9 to 1e9"
    return f"must be {_WORDS.get(kind, 'a finite number')}{bounds}, not {found}"


def cut(table: Table, rows: int) -> Table:
    """The first `rows` rows of a table."""
    return {name: column[:rows] for name, column in table.items()}


def line_number(path: Path, row: int) -> int:
    """1-based line of a CSV file at which a table's 0-based row begins."""
    return next(itertools.islice(line_numbers(path), row, None))


def line_numbers(path: Path) -> Iterator[int]:
    """The 1-based lines of a CSV file at which its rows begin; after the last row it counts on.

    Blank lines are not rows, and a quoted cell may span several lines.
    """
    line = 0
    with suppress(csv.Error, SonarrecError):  # a cell or line that is too long
        for n, (line, _) in enumerate(_rows(path)):
            if n:  # not the header
                yield line
    yield from itertools.count(line + 1)


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The header and the rows of a CSV file: (1-based line at which it begins, cells).

    Raises csv.Error and SonarrecError at a cell or line that is too long.
    """
    numbers: list[int] = []  # of the lines of one row
    with _opened(path, errors="replace") as file:

        def lines() -> Iterator[str]:
            for number, line in _lines(file):
                numbers.append(number)
                yield line

        for cells in csv.reader(lines(), skipinitialspace=True):
            yield numbers[0], cells
            numbers.clear()


def _values(column: Any, kind: Kind, labels: dict[Any, int]) -> tuple[Any, BoolArray]:
    """(the values of a column, which of its cells are invalid)."""
    blank = column.isna().to_numpy()
    none = np.zeros(len(column), dtype=bool)
    if kind in _TEXTS:
        return column.array, blank if kind == "text" else none
    if kind == "label":
        return _numbered(column, blank, labels), none
    if column.dtype.kind == "b" and kind == "flag":
        return column.to_numpy(), none
    if column.dtype.kind in "iu" and column.dtype != np.uint64:
        values = column.to_numpy(dtype=np.int64)
    elif column.dtype.kind in "mM" or (column.dtype.kind == "O" and kind == "time"):
        values = _nanoseconds(column) if kind == "time" else np.full(len(column), np.nan)
    else:
        try:
            values = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float)
        except OverflowError:  # a number of hundreds of digits
            values = pd.to_numeric(column.astype(str), errors="coerce").to_numpy(dtype=float)
    bad = ~np.isfinite(values)
    if kind in ("blank or number", "blank or place", "share"):
        bad &= ~blank
    if kind in _PLACES:
        bad |= np.abs(values) > LARGEST
    if kind == "share":
        bad |= (values < 0) | (values > 1)
    elif kind.startswith("whole") and values.dtype.kind == "f":
        # Larger floats would overflow without an error.
        bad |= (values != np.floor(values)) | (np.abs(values) >= 2.0**63)
        if kind == "whole or none":
            is_none = (column == "none").to_numpy(dtype=bool, na_value=False)
            values, bad = np.where(is_none, NONE, values), bad & ~is_none
    elif kind == "flag":
        bad |= (values != 0) & (values != 1)
    return values, bad


def _nanoseconds(column: Any) -> FloatArray:
    """Numbers as they are, times in ISO 8601 as ns since 1970; NaN for other cells.

    A time without its UTC offset may be that of any zone.
    """
    text = column.astype(str)
    offset_stated = text.where(text.str.fullmatch(_WITH_OFFSET))
    times = pd.to_datetime(offset_stated, format="ISO8601", utc=True, errors="coerce")
    # By seconds, for times beyond the year 2262 are more ns than 64 bits hold.
    start, second = pd.Timestamp(0, tz="UTC").as_unit("s"), pd.Timedelta(seconds=1).as_unit("s")
    ns = (times - start) / second * 1e9
    return np.asarray(ns.fillna(pd.to_numeric(text, errors="coerce")), dtype=float)


def _numbered(column: Any, blank: BoolArray, labels: dict[Any, int]) -> IntArray:
    """Labels as numbers; see Table."""
    if column.dtype.kind == "i":
        return np.asarray(column.to_numpy(dtype=np.int64))
    if column.dtype.kind == "f":
        values = np.where(blank, -1.0, column.to_numpy(dtype=float))
        if ((values == np.floor(values)) & (np.abs(values) < 2.0**63)).all():
            return values.astype(np.int64)
    codes, names = pd.factorize(column)
    numbers = [labels.setdefault(name, len(labels)) for name in names]
    return np.asarray(np.array([*numbers, -1], dtype=np.int64)[codes])


def position_pair(path: Path, table: Table) -> tuple[str, FloatArray, FloatArray] | None:
    """("polar", range m, bearing deg) or ("pixel", column, row), each (rows,); None if neither.

    Range and bearing are preferred, since they need no geometry. A pair with an empty column counts
    as missing. Raises SonarrecError if only some cells of a pair are empty, and if there is half a
    pair alone.
    """
    half = None
    for kind, pair in (("polar", ("range_m", "bearing_deg")), ("pixel", ("x_px", "y_px"))):
        if any(name not in table for name in pair):
            continue
        first, second = (table[name] for name in pair)
        blank = np.isnan(first) | np.isnan(second)
        if not blank.any():
            return kind, first, second
        line = line_number(path, int(np.argmax(blank)))
        fault = f"{path} line {line}: {' or '.join(pair)} is empty"
        if not blank.all():
            raise SonarrecError(fault)
        if not (np.isnan(first) & np.isnan(second)).all():
            half = fault
    if half is not None:
        raise SonarrecError(half)
    return None
