"""estimates.parquet in place of estimates.csv: the same columns, smaller and faster to read.

It needs pyarrow (pip install 'sonarrec[parquet]'), which is imported only when it is used.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from sonarrec.errors import SonarrecError
from sonarrec.tables.outputs import replaced

PARQUET = ".parquet"
ROWS = 50_000
"""Rows of a row group: some MB in memory, independent of the log's length."""
_WHOLE = ("frame", "timestamp_ns", "object", "landmark", "declared")


def check_parquet() -> None:
    """Raises SonarrecError if pyarrow is missing."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise SonarrecError(
            "Parquet tables need pyarrow; install it with: pip install 'sonarrec[parquet]'"
        ) from None


def convert(table: Path, parquet: Path) -> None:
    """Convert a finished estimates.csv to Parquet, and delete it.

    A run writes CSV first because an unfinished Parquet file cannot be read. The numbers are those
    read from the CSV. Raises OSError if the disk is full.
    """
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

    parts = pd.read_csv(table, chunksize=ROWS, dtype={"method": str}, low_memory=False)
    first = next(parts)
    kinds = {name: pa.int64() for name in _WHOLE} | {"method": pa.string()}
    schema = pa.schema([(name, kinds.get(name, pa.float64())) for name in first.columns])
    with replaced(parquet) as new:
        with pq.ParquetWriter(new, schema) as writer:
            for part in chain([first], parts):
                writer.write_table(pa.Table.from_pandas(part, schema, preserve_index=False))
        with new.open("r+b") as file:  # Windows cannot sync a file that is opened read-only
            os.fsync(file.fileno())
    table.unlink()


def read_names(path: Path) -> list[str]:
    """The names of the columns. Raises SonarrecError if it cannot be read as Parquet."""
    return list(map(str, _opened(path).schema_arrow.names))


def read_parts(path: Path, columns: Sequence[str] | None, rows: int | None) -> Iterator[Any]:
    """Data frames of at most `rows` rows; None: one of all rows.

    columns: those that are read as numbers or text; None: all, whatever they hold.
    What pandas noted beside the columns is passed over, such as which of them was its index.
    Raises SonarrecError if the file cannot be read as Parquet, or if one of `columns` holds lists
    or bytes.
    """
    file = _opened(path)
    import pyarrow as pa

    for name in columns or ():
        kind = file.schema_arrow.field(name).type
        if pa.types.is_nested(kind) or "binary" in str(kind):
            raise SonarrecError(f"{path}: column {name} holds {kind}, not numbers or text")
    try:
        if rows is None or not file.metadata.num_rows:
            yield file.read(columns).to_pandas(ignore_metadata=True)
        else:
            for batch in file.iter_batches(rows, columns=columns):
                yield batch.to_pandas(ignore_metadata=True)
    except (OSError, pa.ArrowException) as error:
        raise _unreadable(path, error) from None


def _opened(path: Path) -> Any:
    """A pyarrow.parquet.ParquetFile. Raises SonarrecError if it cannot be read as Parquet."""
    check_parquet()
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.ParquetFile(path)
    except FileNotFoundError:
        raise SonarrecError(f"{path}: no such file") from None
    except (OSError, pa.ArrowException) as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: Exception) -> SonarrecError:
    why = " ".join(str(error).split())[:200]
    return SonarrecError(f"{path}: not a readable Parquet table ({why})")
