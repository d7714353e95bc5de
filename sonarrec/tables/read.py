"""Reads and checks CSV tables, as a whole or in parts; an error names file, line and column."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import count, islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from pandas.api.types import is_integer_dtype, is_numeric_dtype, union_categoricals

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import SonarrecError, plain_number, printable
from sonarrec.tables import not_text, refuse_pipe

Kind = Literal[
    "whole",
    "landmark",
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
"""What the cells of a column must be. A share may be blank, a label is any text."""
Table = dict[str, Any]
"""Column name to (rows,) array.

int64; float64, NaN where blank; bool; texts as pandas categories; of a label whole numbers as they
are, else an int64 number per distinct one, -1 where blank."""

NONE = -(2**62)
"""The number that stands for the word none."""
ID_IN_LABELS = r"(?:id|landmark)[\s._-]*"
"""What may stand before the number in a label that names an ID."""
LARGEST = 10**9
"""Larger positions (pixels, m, deg) are invalid; their squares could not be used."""
POSITION_KINDS: dict[str, Kind] = dict.fromkeys(
    ("x_px", "y_px", "range_m", "bearing_deg"), "blank or place"
)
MOST_SHOWN = 300
"""Characters of a header, or of what pandas says, in a message."""
_OPTIONS: dict[str, Any] = {
    "skipinitialspace": True,
    "index_col": False,
    "keep_default_na": False,  # NA and null are names
    "na_values": ["", "nan"],
    "low_memory": False,
    "compression": None,
}
_SIMILARITY = 0.7  # of difflib's ratio: visibility is near visible, comment is near none
_ELSEWHERE = {
    **dict.fromkeys(("u", "cx", "col", "column", "center_x", "centre_x"), "x_px"),
    **dict.fromkeys(("v", "cy", "row", "center_y", "centre_y"), "y_px"),
    **dict.fromkeys(("r", "distance", "dist", "slant_range"), "range_m"),
    **dict.fromkeys(("angle", "azimuth", "theta"), "bearing_deg"),
    **dict.fromkeys(("id", "label", "class", "marker", "tag", "name"), "landmark"),
    **dict.fromkeys(("image", "index", "frame_number", "frame_id"), "frame"),
}
"""Names of columns that other programs use."""
_ROWS_AT_ONCE = 2**16
"""A table as a whole is read in parts of so many rows: data frames take several times its size."""
_WITH_OFFSET = r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d.*(?:Z|[+-]\d\d(?::?\d\d)?)"


@dataclass(frozen=True, slots=True)
class _Bounds:
    """Of the numbers of a kind, inclusive."""

    words: str
    """What a cell must be."""
    least: float = -np.finfo(float).max
    most: float = np.finfo(float).max
    integer: bool = False


_FINITE = _Bounds("a finite number")
_POSITION = _Bounds("a finite number", -LARGEST, LARGEST)
_BOUNDS: dict[Kind, _Bounds] = {
    "whole": _Bounds("a whole number", integer=True),
    "landmark": _Bounds("an ID such as 3 or ID.3, or none", integer=True),
    "number": _FINITE,
    "blank or number": _FINITE,
    "time": _Bounds("a finite number, or a time with its UTC offset such as 2024-05-01T12:00:00Z"),
    "place": _POSITION,
    "blank or place": _POSITION,
    "share": _Bounds("0 to 1", 0, 1),
    "flag": _Bounds("0 or 1", 0, 1, integer=True),
}
ROUNDED_NS = 10**12
"""1000 s: no log has such steps, and 1.79517E+18 has no digits for less."""
_TEXTS: tuple[Kind, ...] = ("text", "blank or text")
_MAY_BE_BLANK: tuple[Kind, ...] = ("blank or number", "blank or place", "share")


def read_table(
    path: Path,
    kinds: Mapping[str, Kind],
    required: tuple[str, ...],
    expected: str,
    others: list[str] | None = None,
) -> Table:
    """Read the columns named in `kinds`, if they exist; others are ignored.

    required: columns that must exist. expected: a header for error messages. others: is filled with
    the names of the columns that are ignored.
    Raises SonarrecError if the file, its header or a cell cannot be used.
    """
    parts = [
        table for _, table in read_tables(path, kinds, required, expected, _ROWS_AT_ONCE, others)
    ]
    if len(parts) == 1:
        return parts[0]
    return {name: _joined([part.pop(name) for part in parts]) for name in [*parts[0]]}


def _joined(parts: Sequence[Any]) -> Any:
    """The parts of a column as one."""
    if isinstance(parts[0], pd.Categorical):
        return union_categoricals(parts, sort_categories=True)
    return np.concatenate(parts)


def read_tables(
    path: Path,
    kinds: Mapping[str, Kind],
    required: tuple[str, ...],
    expected: str,
    rows: int | None = None,
    others: list[str] | None = None,
) -> Iterator[tuple[int, Table]]:
    """As `read_table` in parts of at most `rows` rows: (index of the first row, table)."""
    texts = {name: str for name, kind in kinds.items() if kind in _TEXTS}
    labels: dict[Any, int] = {}
    first = 0
    for part in _parts(path, expected, texts, rows):
        _check_header(path, [*part.columns], kinds, required, expected)
        if others is not None:
            others[:] = [str(name) for name in part.columns if name not in kinds]
        yield (
            first,
            {
                name: _checked(path, first, part[name], kinds[name], labels)
                for name in kinds
                if name in part
            },
        )
        first += len(part)


def data_frame(path: Path, expected: str) -> pd.DataFrame:
    """All columns as pandas reads them. Raises SonarrecError if the file is not a table."""
    return pd.concat(_parts(path, expected, {}, None))


def mistaken_columns(
    others: Iterable[str], known: Sequence[str], wanted: Container[str]
) -> list[tuple[str, str]]:
    """(name, the known one that it is nearest to) of columns that are ignored, if that is one of
    the wanted, such as x for x_px. The name with "" if it is near none."""
    near = [(name, _nearest(name, known)) for name in others if name not in known]
    return [(name, nearest) for name, nearest in near if not nearest or nearest in wanted]


def _nearest(name: str, known: Sequence[str]) -> str:
    """The known name of a column that another name may stand for; empty: none."""
    plain = name.strip().lower()
    if (usual := _ELSEWHERE.get(plain)) in known:
        return str(usual)
    prefixed = [n for n in known if plain and (n.startswith(plain) or plain.startswith(n))]
    return next(iter(prefixed or get_close_matches(plain, known, 1, _SIMILARITY)), "")


def read_header(path: Path, expected: str) -> list[str]:
    """The names of all columns. Raises SonarrecError if the file is not a table."""
    return [str(name) for name in next(_parts(path, expected, {}, 1)).columns]


def _parts(
    path: Path, expected: str, dtype: Mapping[str, type], rows: int | None
) -> Iterator[pd.DataFrame]:
    """The file in data frames of at most `rows` rows. Raises SonarrecError if it is no table."""
    refuse_pipe(path)
    if path.is_file():
        with path.open("rb") as file:
            if what := not_text(file.read(32), "a CSV table"):
                raise SonarrecError(f"{path}: {what}")
    options: Any = {"dtype": dtype, "chunksize": rows or 2**62, **_OPTIONS}
    parts = _in_one_line(path, expected, lambda: pd.read_csv(path, **options))
    with parts:
        while (part := _in_one_line(path, expected, lambda: next(parts, None))) is not None:
            yield part.dropna(how="all")  # Excel leaves lines of commas alone


def _in_one_line(path: Path, expected: str, read: Callable[[], Any]) -> Any:
    """The result of `read`. Raises SonarrecError, in one line, where pandas finds no table."""
    how = ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            return read()
    except FileNotFoundError:
        raise SonarrecError(f"{path}: no such file") from None
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    except pd.errors.EmptyDataError:
        why = "it is empty"
    except UnicodeDecodeError:
        why = "not in UTF-8; save it as that"
    except (pd.errors.ParserWarning, ValueError) as error:  # as pandas' ParserError is
        why = "rows are longer than the header"
        if not (longer := isinstance(error, pd.errors.ParserWarning)):
            why = " ".join(str(error).split())[:MOST_SHOWN]  # it has the line
        if longer or "Expected" in why:
            with suppress(OSError), path.open(encoding="utf-8", errors="replace") as file:
                how = _other_separator(file.readline(MOST_SHOWN)) or (
                    "; a comma separates cells, so write decimals with a point, and texts with a "
                    "comma in quotes"
                )
    raise SonarrecError(
        f"{path}: not a readable CSV table ({why}); expected a header such as {expected}{how}"
    )


def _other_separator(header: str) -> str:
    """What to do about a header whose cells are not separated by commas; empty: they are."""
    if not any(mark in header for mark in (";", "\t", "\\t", "|")):
        return ""
    return "; separate the cells by commas, and write decimals with a point"


def _check_header(
    path: Path, names: Sequence[str], kinds: Mapping[str, Kind], required: Sequence[str], like: str
) -> None:
    """Raise SonarrecError if a column is missing, or there twice."""
    for name in kinds:
        if f"{name}.1" in names:  # as pandas calls the second one
            raise SonarrecError(f"{path}: two columns are called {name}; rename or delete one")
    if missing := [name for name in required if name not in names]:
        renamed = {name: _nearest(name, missing) for name in map(str, names) if name not in kinds}
        meant = ", ".join(f"{name} to {near}" for name, near in renamed.items() if near)
        like += f"; rename {meant}" if meant else ""
        header = printable(",".join(map(str, names)))
        like += _other_separator(header)
        shown = header if len(header) <= MOST_SHOWN else f"{header[:MOST_SHOWN]}..."
        raise SonarrecError(
            f"{path}: wrong columns, no {', '.join(missing)}; found {shown}; expected a header "
            f"such as {like}"
        )


def _checked(path: Path, first: int, column: Any, kind: Kind, labels: dict[Any, int]) -> Any:
    """A column as an array of its kind; see Table.

    first: index of its first row in the file. labels: those found so far; new ones are added.
    Raises SonarrecError for the first invalid cell.
    """
    blank = column.isna().to_numpy()
    if kind == "label":
        return _numbered(column, labels)
    if kind in _TEXTS:
        values, bad, must = column.astype("category").array, blank & (kind == "text"), "a name"
    else:
        bounds = _BOUNDS[kind]
        values = _nanoseconds(column) if kind == "time" else _numbers(column)
        if kind == "landmark" and not is_numeric_dtype(column):
            text = column.astype(str).str.strip()
            number = text.str.replace(rf"^{ID_IN_LABELS}(?=\d)", "", case=False, regex=True)
            values = np.where(text == "none", NONE, _numbers(number))
        in_ns = kind == "whole" and str(column.name).endswith("_ns")
        is_rounded = np.all(values > ROUNDED_NS) and not np.any(values % ROUNDED_NS)
        if in_ns and len(values) and is_rounded and column.dtype.kind == "f":  # as in 1.7E+18
            raise SonarrecError(
                f"{path}: {column.name} is rounded to {ROUNDED_NS // 10**9} s or more in every row "
                f"({column.iloc[0]}), as spreadsheets do; export it again as text, or use frame"
            )
        bad, must = ~((values >= bounds.least) & (values <= bounds.most)), bounds.words
        if bounds.integer and values.dtype.kind == "f":
            bad |= (values != np.floor(values)) | (np.abs(values) >= 2.0**63)
        if kind in _MAY_BE_BLANK:
            bad &= ~blank
    if bad.any():
        row = int(np.argmax(bad))
        value = "an empty cell or nan" if blank[row] else repr(str(column.iloc[row])[:40])
        if kind in ("place", "blank or place") and np.isfinite(values[row]):
            must += " from -1e9 to 1e9"
        line = line_number(path, first + row)
        how = "" if blank[row] or "number" not in must else plain_number(column.iloc[row])
        if in_ns and not blank[row]:
            must += " of ns (1 s is 1000000000)"
            ns, how = _nanoseconds(column.iloc[[row]])[0], ""
            if values[row] % 1 > 0:
                how = "; multiply all by 1e9 if they are in seconds"
            elif not np.isfinite(values[row]) and ":" in str(column.iloc[row]):
                how = "; write the ns since 1970, which need the UTC offset of a time"
                how = f"; write {ns:.0f}, the ns since 1970" if np.isfinite(ns) else how
        raise SonarrecError(f"{path} line {line}: {column.name} must be {must}, not {value}{how}")
    if kind in _TEXTS:
        return values
    if kind == "flag":
        return values.astype(bool)
    return values.astype(np.int64) if _BOUNDS[kind].integer else values.astype(float)


def _numbers(column: Any) -> Any:
    """A column's numbers, int64 where all are whole; NaN for other cells."""
    if is_integer_dtype(column) and column.dtype != np.uint64:
        return column.to_numpy(dtype=np.int64)
    # As texts, for numbers of hundreds of digits are too large for any type.
    column = column if is_numeric_dtype(column) else column.astype(str)
    return pd.to_numeric(column, errors="coerce").to_numpy(dtype=float)


def _nanoseconds(column: Any) -> FloatArray:
    """Numbers as they are, times in ISO 8601 as ns since 1970; NaN for other cells.

    A time without its UTC offset may be that of any zone.
    """
    text = column.astype(str)
    stated = text.where(text.str.fullmatch(_WITH_OFFSET))
    times = pd.to_datetime(stated, format="ISO8601", utc=True, errors="coerce")
    # By seconds, for times beyond the year 2262 are more ns than 64 bits hold.
    start, second = pd.Timestamp(0, tz="UTC").as_unit("s"), pd.Timedelta(seconds=1).as_unit("s")
    ns = (times - start) / second * 1e9
    return np.asarray(ns.fillna(pd.to_numeric(text, errors="coerce")), dtype=float)


def _numbered(column: Any, labels: dict[Any, int]) -> IntArray:
    """Labels as numbers; see Table."""
    numbers = _numbers(column.fillna(-1) if is_numeric_dtype(column) else column)
    if (np.floor(numbers) == numbers).all():
        return np.asarray(numbers.astype(np.int64))
    codes, names = pd.factorize(column)
    known = [labels.setdefault(name, len(labels)) for name in names]
    return np.asarray(np.array([*known, -1], dtype=np.int64)[codes])


def line_number(path: Path, row: int) -> int:
    """1-based line of a CSV file at which a table's 0-based row ends."""
    return next(islice(line_numbers(path), row, None))


def line_numbers(path: Path) -> Iterator[int]:
    """The 1-based lines of a CSV file at which its rows end; after the last row it counts on.

    Blank lines, also of commas alone, are not rows, and a quoted cell may span several lines.
    """
    line = 0
    with suppress(csv.Error), path.open(encoding="utf-8", errors="replace", newline="") as file:
        rows = csv.reader(file, skipinitialspace=True)
        filled = (rows.line_num for cells in rows if "".join(cells).strip())
        for line in islice(filled, 1, None):
            yield line
    yield from count(line + 1)


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
