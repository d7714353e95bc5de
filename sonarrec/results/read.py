"""Reads results folders for scoring: ours, or those of other programs with the same tables."""

from __future__ import annotations

import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import MissingError, SonarrecError, printable
from sonarrec.geometry import plane_position
from sonarrec.landmarks import DrawnSet, LandmarkSet
from sonarrec.nouns import PART, Fan
from sonarrec.results.columns import (
    ESTIMATES_HEADER,
    FRAME_COLUMNS,
    FRAMES_HEADER,
    belief_names,
    estimate_columns,
    in_order,
    kinds,
    needed,
)
from sonarrec.results.folders import aside_of, log_of, part_of
from sonarrec.results.run_file import RunFile, cut_short, read_run, rows_lost
from sonarrec.sonar import Sonar
from sonarrec.tables.order import natural_order
from sonarrec.tables.read import Table, cut, line_number, position_pair, read_table, read_tables


@dataclass(frozen=True, slots=True)
class LogResults:
    """The results of all methods on one log: F frames, N estimates, K IDs.

    frame: (F,) numbers of the frames processed, rising. timestamp_ns: (F,) or None.
    methods: names. The arrays below have one element per estimate. method: index into methods.
    frame_index: into frame. landmark_index: into landmarks.ids. score: 0 to 1. declared: bool.
    position: (N, 2) metres in the fan plane, or None if not known.
    orientation: (N,) deg, NaN if not known. object: (N,) a number per candidate or track, -1 if
    not known. probability: (N, K + 1), one per ID in the set's order, then none of these; None if
    the columns are missing.
    fan: converts fan pixels to metres; None if the geometry is not known.
    strays: estimates left out because they lie on frames that frames.csv does not list.
    finished: False if run.toml says that the run was cut short. run: run.toml.
    """

    name: str
    landmarks: LandmarkSet
    fan: Fan | None
    frame: IntArray
    timestamp_ns: IntArray | None
    methods: tuple[str, ...]
    method: IntArray
    frame_index: IntArray
    landmark_index: IntArray
    score: FloatArray
    declared: BoolArray
    position: FloatArray | None
    orientation: FloatArray
    object: IntArray
    probability: npt.NDArray[np.float32] | None
    strays: int
    finished: bool
    run: RunFile


def find_logs(results: Path) -> list[Path]:
    """The results folders of single logs: `results` itself, or those in it, in natural order.

    Raises SonarrecError if there are none.
    """
    if (results / "frames.csv").is_file():
        return [results]
    if not results.is_dir():
        part = part_of(results)
        has_frames = (part / "frames.csv").is_file()
        hint = f"; a run that did not finish left {part}" if has_frames else ""
        raise MissingError(
            f"{results}: no such results folder; `sonarrec run LOG` writes one{hint}"
        )
    logs = {p for p in results.iterdir() if _holds_frames(p)}
    # If a results folder is a link, the part of a stopped run lies beside its target.
    linked = {part_of(p) for p in results.iterdir() if p.is_symlink() and p not in logs}
    logs |= {part for part in linked if (part / "frames.csv").is_file()}
    finished = {part_of(log) for log in logs}  # parts beside finished results are not needed
    # A run that was killed, or failed, while it replaced results leaves them here and there.
    named = logs | {log.with_name(log.name.removesuffix(PART)) for log in logs}
    replaced = {aside_of(log) for log in named}
    folders = sorted(logs - finished - replaced, key=natural_order)
    if not folders:
        raise SonarrecError(
            f"{results}: no results here (no frames.csv, nor a folder that holds one); "
            "give the folder that `sonarrec run` wrote"
        )
    return folders


def _holds_frames(folder: Path) -> bool:
    """Whether it is a folder with frames.csv, or one that only another user may read.

    That is told where its tables are read: a log must not be missing from the figures unnoticed.
    """
    try:
        return stat.S_ISREG((folder / "frames.csv").stat().st_mode)
    except PermissionError:
        return folder.name[0] != "." and folder.name != "lost+found"
    except OSError:
        return False


def not_whole(log: LogResults, action: str) -> list[str]:
    """A line for each part of the results that cannot be used.

    action: what a command does with the rest, such as "scored".
    """
    lines = [] if log.finished else [cut_short(log.name, len(log.frame), action)]
    lost = rows_lost(log.run.path.parent, log.run.input) if log.finished else []
    lines += [f"{log.name}: {line}; only these are {action}" for line in lost]
    if log.strays:
        lines.append(
            f"{log.name}: {log.strays} estimates lie on frames that frames.csv does not list; "
            f"they are not {action}"
        )
    return lines


def read_log(folder: Path, landmarks: str | None = None, sonar: Sonar | None = None) -> LogResults:
    """Read one log's frames.csv, estimates.csv and, if there is one, run.toml.

    landmarks, sonar: take precedence over run.toml. Raises SonarrecError on any fault.
    """
    run = read_run(folder / "run.toml")
    landmark_set = run.landmark_set(landmarks)
    fan = run.fan(sonar)

    path, frames = folder / "frames.csv", read_frames(folder)
    order = np.argsort(frames["frame"], kind="stable")
    frame = frames["frame"][order]
    repeated = np.flatnonzero(np.diff(frame) == 0)
    if repeated.size:
        line = line_number(path, int(order[repeated[0] + 1]))
        raise SonarrecError(f"{path} line {line}: frame {frame[repeated[0]]} is listed twice")
    if not frame.size:
        raise SonarrecError(f"{path}: no frame was processed")

    path = folder / "estimates.csv"
    [(_, table)] = estimate_tables(path, landmark_set)
    pair = position_pair(path, table)
    position = None if pair is None else plane_position(pair, fan)
    listed = np.isin(table["frame"], frame)
    names = [printable(str(name)) for name in table["method"].categories]
    methods = in_order((*(run.methods or ()), *names))  # also those without any estimate
    renumber = np.array([methods.index(m) for m in names], dtype=np.int64)
    columns, probability = belief_names(landmark_set.ids), None
    if all(name in table for name in columns):
        probability = np.empty((int(listed.sum()), len(columns)), dtype=np.float32)
        for k, name in enumerate(columns):
            probability[:, k] = table.pop(name)[listed]  # so that they are held once
    return LogResults(
        name=log_of(folder),
        landmarks=landmark_set,
        fan=fan,
        frame=frame,
        timestamp_ns=frames["timestamp_ns"][order] if "timestamp_ns" in frames else None,
        methods=methods,
        method=renumber[table["method"].codes[listed]],
        frame_index=np.searchsorted(frame, table["frame"][listed]),
        landmark_index=landmark_set.indices(table["landmark"][listed]),
        score=table["score"][listed],
        declared=table["declared"][listed],
        position=None if position is None else position[listed],
        orientation=table.get("orientation_deg", np.full(len(listed), np.nan))[listed],
        object=table["object"][listed] if "object" in table else np.full(listed.sum(), -1),
        probability=probability,
        strays=int(np.count_nonzero(~listed)),
        finished=run.finished,
        run=run,
    )


def rows_of(log: LogResults, kept: BoolArray) -> LogResults:
    """The results with these estimates only. kept: (N,)."""
    names = ("method", "frame_index", "landmark_index", "score", "declared", "orientation")
    columns = {name: getattr(log, name)[kept] for name in (*names, "object")}
    return replace(
        log,
        position=None if log.position is None else log.position[kept],
        probability=None if log.probability is None else log.probability[kept],
        **columns,
    )


def of_methods(log: LogResults, wanted: Sequence[str]) -> LogResults:
    """The results of the wanted methods; of all if none is wanted, or if there is none of them."""
    methods = [method for method in wanted if method in log.methods]
    if not methods:
        return log
    number = np.array([methods.index(m) if m in methods else -1 for m in log.methods])
    kept = rows_of(log, number[log.method] >= 0)
    return replace(kept, methods=tuple(methods), method=number[kept.method])


def read_frames(folder: Path) -> Table:
    """The columns of frames.csv that are needed, in the order of the file."""
    path = folder / "frames.csv"
    return read_table(path, kinds(FRAME_COLUMNS), needed(FRAME_COLUMNS), FRAMES_HEADER)


def estimate_tables(
    path: Path, landmarks: LandmarkSet, rows: int | None = None
) -> Iterator[tuple[int, Table]]:
    """estimates.csv in parts of at most `rows` rows, or whole: (index of the first row, columns).

    Raises SonarrecError, with the line, for an invalid cell; the rows before it are given first.
    """
    columns = estimate_columns(landmarks.ids, isinstance(landmarks, DrawnSet))
    ids = np.asarray(landmarks.ids)
    header = needed(columns), ESTIMATES_HEADER
    for first, table in read_tables(path, kinds(columns), *header, rows):
        known = np.isin(table["landmark"], ids)
        if not known.all():
            row = int(np.argmin(known))
            yield first, cut(table, row)
            raise SonarrecError(
                f"{path} line {line_number(path, first + row)}: "
                f"landmark {table['landmark'][row]} is not in the set {landmarks.name!r} "
                f"({', '.join(map(str, ids))}); name the set used with --landmarks"
            )
        yield first, table


@dataclass(frozen=True, slots=True, repr=False)
class Tables:
    """The tables of one log's results, with the rows and columns of the files.

    frames: frames.csv, a row per frame. estimates: estimates.csv, a row per frame, method and
    object; positions in pixels, m and deg. sightings: sightings.csv, None if there is none.
    """

    frames: pd.DataFrame
    estimates: pd.DataFrame
    sightings: pd.DataFrame | None

    def __repr__(self) -> str:
        return f"<{len(self.frames)} frames, {len(self.estimates)} estimates>"


def read_results(folder: str | Path) -> Tables:
    """The tables of one log's results. folder: written by `sonarrec run` for that log.

    Raises SonarrecError if frames.csv or estimates.csv cannot be read.
    """
    folder = Path(folder)
    sightings = folder / "sightings.csv"
    return Tables(
        frames=_table(folder / "frames.csv", FRAMES_HEADER),
        estimates=_table(folder / "estimates.csv", ESTIMATES_HEADER),
        sightings=_table(sightings, "method,landmark,track") if sightings.is_file() else None,
    )


def _table(path: Path, expected: str) -> pd.DataFrame:
    """One table. expected: a header for the error message."""
    try:
        return pd.read_csv(path, encoding="utf-8-sig", skipinitialspace=True)
    except FileNotFoundError:
        raise SonarrecError(f"{path}: no such file; give the folder of one log's results") from None
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise SonarrecError(
            f"{path}: not a readable CSV table ({str(error).strip()}); "
            f"expected a header such as {expected}"
        ) from None
