"""The tables of one log's results as pandas data frames, for notebooks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from sonarrec.errors import SonarrecError
from sonarrec.files.parquet import PARQUET, read_parts
from sonarrec.results.columns import ESTIMATES_HEADER, FRAMES_HEADER
from sonarrec.results.folders import estimates_of


@dataclass(frozen=True, slots=True)
class Tables:
    """The tables of one log's results, with the rows and columns of the files.

    frames: frames.csv, a row per frame. estimates: estimates.csv, a row per frame, method and
    object; positions in pixels, m and deg. sightings: sightings.csv, None if there is none.
    """

    frames: pd.DataFrame
    estimates: pd.DataFrame
    sightings: pd.DataFrame | None


def read_results(folder: str | Path) -> Tables:
    """The tables of one log's results. folder: written by `sonarrec run` for that log.

    Raises SonarrecError if frames.csv or estimates.csv cannot be read.
    """
    folder = Path(folder)
    sightings = folder / "sightings.csv"
    return Tables(
        frames=_table(folder / "frames.csv", FRAMES_HEADER),
        estimates=_table(estimates_of(folder), ESTIMATES_HEADER),
        sightings=_table(sightings, "method,landmark,track") if sightings.is_file() else None,
    )


def _table(path: Path, expected: str) -> pd.DataFrame:
    """One table, CSV or Parquet. expected: a header for the error message."""
    if path.suffix == PARQUET:
        return next(read_parts(path, None, None))
    try:
        return pd.read_csv(path, encoding="utf-8-sig", skipinitialspace=True)
    except FileNotFoundError:
        raise SonarrecError(f"{path}: no such file; give the folder of one log's results") from None
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise SonarrecError(
            f"{path}: not a readable CSV table ({str(error).strip()}); "
            f"expected a header such as {expected}"
        ) from None
