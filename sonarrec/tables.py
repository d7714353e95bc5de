"""CSV tables, read whole and checked column by column; a fault names file, line and column."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from sonarrec.records import FloatArray, SonarrecError

Kind = Literal["whole", "number", "blank or number", "share", "flag", "text", "label"]
Table = dict[str, Any]
"""Column name to (rows,) array.

int64, float64, float64 with NaN (two kinds), bool, str categories; of a label,
which may be any text, whole numbers as they are, else an int64 number per distinct one, -1 where
blank."""

POSITION_KINDS: dict[str, Kind] = {
    "x_px": "blank or number",
    "y_px": "blank or number",
    "range_m": "blank or number",
    "bearing_deg": "blank or number",
}
MOST_COLUMNS = 1_000
LONGEST_LINE = 64_000
_WORDS = {
    "whole": "a whole number",
    "number": "a finite number",
    "blank or number": "a finite number",
    "share": "0 to 1",
    "flag": "0 or 1",
    "text": "a name",
}


def read_table(
    path: Path, kinds: Mapping[str, Kind], required: tuple[str, ...], expected: str
) -> Table:
    """Read the columns named in `kinds`; others are left alone, absent ones left out.

    `expected` is the header shown where one of the `required` columns is missing.
    Raises SonarrecError where the file, its header or a cell cannot be used.
    """
    _check_shape(path)
    options: dict[str, Any] = {
        "encoding": "utf-8-sig",
        "skipinitialspace": True,
        "index_col": False,
        "keep_default_na": False,
        "na_values": ["", "nan"],
        "low_memory": False,
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            header = {str(c).strip(): c for c in pd.read_csv(path, nrows=0, **options).columns}
            missing = [name for name in required if name not in header]
            if missing:
                raise SonarrecError(
                    f"{path}: wrong columns, no {', '.join(missing)}; found "
                    f"{','.join(header)}; expected a header such as {expected}"
                )
            used = {name: header[name] for name in kinds if name in header}
            text = {c: "category" for n, c in used.items() if kinds[n] == "text"}
            # Not with `usecols`, which passes over rows that are longer than the header.
            frame = pd.read_csv(path, dtype=text, **options)
    except FileNotFoundError:
        raise SonarrecError(f"{path}: no such file") from None
    except pd.errors.EmptyDataError:
        raise SonarrecError(f"{path}: empty; expected a header such as {expected}") from None
    except (OSError, UnicodeDecodeError, pd.errors.ParserError, pd.errors.ParserWarning) as error:
        raise SonarrecError(
            f"{path}: not a readable CSV table ({str(error).strip()}); "
            f"expected a header such as {expected}"
        ) from None
    return {name: _column(path, name, frame[column], kinds[name]) for name, column in used.items()}


def _check_shape(path: Path) -> None:
    """Refuses what is no table before it is taken for one: a device has no end, and of very many
    columns each costs time."""
    try:
        if path.exists() and not path.is_file():
            raise SonarrecError(f"{path}: not a file that can be read as a table")
        with path.open("rb") as file:
            header = file.read(LONGEST_LINE).lstrip().partition(b"\n")[0]
            blocks = iter(lambda: file.read(LONGEST_LINE), b"")
            long = any(
                len(x) == LONGEST_LINE and not _ends_line(x)
                for x in itertools.chain([header], blocks)
            )
    except FileNotFoundError:
        return  # told by who reads it
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    if long or header.count(b",") >= MOST_COLUMNS:
        raise SonarrecError(
            f"{path}: more than {MOST_COLUMNS} columns, or a line of more than {LONGEST_LINE} "
            "bytes; no table of this program is like that"
        )


def _ends_line(block: bytes) -> bool:
    return b"\n" in block or b"\r" in block


def line_number(path: Path, row: int) -> int:
    """1-based line in the file of a table's 0-based row (blank lines hold no row)."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        filled = (number for number, text in enumerate(file, 1) if text.strip())
        return next(itertools.islice(filled, row + 1, None), row + 2)


def _column(path: Path, name: str, column: Any, kind: Kind) -> Any:
    """The column as an array of its kind; SonarrecError at the first cell that is not."""
    if kind == "label":
        if column.dtype.kind == "i":
            return column.to_numpy(dtype=np.int64)
        return pd.factorize(column)[0]
    if kind == "text":
        bad = column.isna().to_numpy()
        values = column.cat
    else:
        if column.dtype.kind == "b" and kind == "flag":
            return column.to_numpy()
        if column.dtype.kind in "iu" and column.dtype != np.uint64:
            values = column.to_numpy(dtype=np.int64)
        else:
            try:
                values = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float)
            except OverflowError:  # of hundreds of digits
                values = pd.to_numeric(column.astype(str), errors="coerce").to_numpy(dtype=float)
        bad = ~np.isfinite(values)
        if kind in ("blank or number", "share"):
            bad &= ~column.isna().to_numpy()
            if kind == "share":
                bad |= (values < 0) | (values > 1)
        elif kind == "whole":
            # Beyond 2**63 a float would wrap round in silence.
            bad |= (values != np.floor(values)) | (np.abs(values) >= 2.0**63)
        elif kind == "flag":
            bad |= (values != 0) & (values != 1)
    if bad.any():
        row = int(np.argmax(bad))
        cell = column.iloc[row]
        found = "an empty cell or nan" if pd.isna(cell) else repr(str(cell)[:40])
        bound = " below 2^63" if kind == "whole" and np.abs(values[row]) >= 2.0**63 else ""
        raise SonarrecError(
            f"{path} line {line_number(path, row)}: {name} must be {_WORDS[kind]}{bound}, "
            f"not {found}"
        )
    if kind == "text":
        return column.array
    types = {"whole": np.int64, "flag": np.bool_}
    return np.asarray(values, dtype=types.get(kind, np.float64))


def position_pair(path: Path, table: Table) -> tuple[str, FloatArray, FloatArray] | None:
    """("polar", range m, bearing deg) or ("pixel", column, row), each (rows,); None without either.

    Range and bearing go first: they need no geometry. Columns left blank throughout count as
    absent; a blank among filled ones raises SonarrecError.
    """
    for kind, pair in (("polar", ("range_m", "bearing_deg")), ("pixel", ("x_px", "y_px"))):
        if any(name not in table for name in pair):
            continue
        first, second = (table[name] for name in pair)
        blank = np.isnan(first) | np.isnan(second)
        if blank.size and blank.all():
            continue
        if blank.any():
            line = line_number(path, int(np.argmax(blank)))
            raise SonarrecError(f"{path} line {line}: {' or '.join(pair)} is empty")
        return kind, first, second
    return None
