"""Reads results folders: ours, or those of other programs with the same tables.

`read_log` reads a log whole, for scoring; `read_estimates` frame by frame, in memory that does not
grow with the log; `read_results` as pandas tables, for users.
"""

from __future__ import annotations

import hashlib
import math
import re
import stat
import sys
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import (
    Diagnostics,
    MissingError,
    SonarrecError,
    command_line,
    number_of,
    printable,
    similar_name,
)
from sonarrec.landmarks import DrawnSet, LandmarkSet
from sonarrec.results.columns import (
    CORNERS,
    ESTIMATES_HEADER,
    FRAME_COLUMNS,
    FRAMES_HEADER,
    belief_names,
    chosen,
    estimate_columns,
    in_order,
    kinds,
    leading,
    needed,
)
from sonarrec.results.folders import log_of, parent_of, part_of
from sonarrec.results.identity import why_outdated
from sonarrec.results.run_file import RunFile, csv_rows, cut_short, read_run, tables_changed
from sonarrec.sonar.frame import Estimate, Fan
from sonarrec.sonar.geometry import pixel_from_polar, plane_position, polar_from_pixel
from sonarrec.sonar.stated import Sonar
from sonarrec.stretches import stretches_of
from sonarrec.tables import PART, natural_order
from sonarrec.tables.outputs import free_name
from sonarrec.tables.read import (
    POSITION_KINDS,
    Table,
    data_frame,
    line_number,
    position_pair,
    read_table,
    read_tables,
)

_READ = re.compile("[0-9]{36}")  # the column `read`
ROWS = 2_000
"""Of estimates.csv, read at a time."""
SIGMAS = ("range_sigma_m", "bearing_sigma_deg", "orientation_sigma_deg")
Recording = tuple[str | None, Hashable]
"""What identifies a recording: its SHA-256, None if not known, and a further key."""


@dataclass(frozen=True, slots=True)
class LogResults:
    """The results of all methods on one log: F frames, N estimates, K IDs."""

    name: str
    landmarks: LandmarkSet
    fan: Fan | None
    """Converts fan pixels to metres; None if the geometry is not known."""
    frame: IntArray
    """(F,) numbers of the frames processed, rising."""
    timestamp_ns: IntArray | None
    """(F,) or None."""
    stretch: IntArray
    """(F,) numbers of their stretches."""
    methods: tuple[str, ...]
    """Their names. The arrays below have one element per estimate."""
    method: IntArray
    """Index into methods."""
    frame_index: IntArray
    """Into frame."""
    landmark_index: IntArray
    """Into landmarks.ids."""
    score: FloatArray
    """0 to 1."""
    declared: BoolArray
    position: FloatArray | None
    """(N, 2) metres in the fan plane, or None if not known."""
    orientation: FloatArray
    """(N,) deg, NaN if not known."""
    object: IntArray
    """(N,) a number per candidate or track, -1 if not known."""
    probability: npt.NDArray[np.float32] | None
    """(N, K + 1), one per ID in the set's order, then none of these; None if the columns are
    missing."""
    strays: int
    """Estimates left out because they lie on frames that frames.csv does not list."""
    run: RunFile
    """run.toml."""


def find_logs(results: Path) -> list[Path]:
    """The results folders of single logs: `results` itself, or those in it, in natural order.

    The part of a stopped run counts where there are no finished results. Raises MissingError if
    there are none.
    """
    if (results / "frames.csv").is_file():
        return [results]
    # It may be the log: then its results are where `run` puts them.
    home = Path("sonarrec_out", results.stem)
    is_log = (home / "frames.csv").is_file()
    of_log = f"; if it is a log, its results are in {home}" if is_log else ""
    if not results.is_dir():
        part = part_of(results)
        has_frames = (part / "frames.csv").is_file()
        hint = f"; a run that did not finish left {part}" if has_frames else ""
        if results.is_file():
            raise MissingError(
                f"{results}: a file, not a folder of results, as `sonarrec run LOG` writes one; a "
                "ground truth is given with --ground-truth"
            )
        hint += similar_name(results) if not of_log else ""
        raise MissingError(
            f"{results}: no such results folder; `sonarrec run LOG` writes one{hint}{of_log}"
        )
    logs = {path.name: path for path in results.iterdir() if _holds_frames(path)}
    names = (n for n in logs if not (n.endswith(PART) and n.removesuffix(PART) in logs))
    if not (folders := sorted((logs[name] for name in names), key=natural_order)):
        raise MissingError(
            f"{results}: no results here (no frames.csv, nor a folder that holds one); "
            f"give the folder that `sonarrec run LOG` wrote{of_log}"
        )
    return folders


def _holds_frames(folder: Path) -> bool:
    """Whether it is a folder with frames.csv, or one that only another user may read.

    Reading its tables then fails with a message: no log may be missing from the figures unnoticed.
    """
    if folder.name.startswith(".") and folder.name.endswith(".old"):
        return False  # a run that was killed while it replaced results left it
    try:
        return stat.S_ISREG((folder / "frames.csv").stat().st_mode)
    except PermissionError:
        return folder.name[0] != "." and folder.name != "lost+found"
    except OSError:
        return False


def why_incomplete(log: LogResults, action: str) -> list[str]:
    """A line for each part of the results that cannot be used.

    action: what a command does with the rest, such as "scored".
    """
    if log.run.finished:
        changed = tables_changed(log.run.path.parent, log.run.input)
        lines = [f"{log.name}: {line}; only what it holds now is {action}" for line in changed]
    else:
        lines = [cut_short(log.name, len(log.frame), action)]
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
        stretch=stretches_of({name: column[order] for name, column in frames.items()}),
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
        run=run,
    )


def rows_of(log: LogResults, kept: BoolArray) -> LogResults:
    """The results with these estimates only. kept: (N,)."""
    names = ["method", "frame_index", "landmark_index", "score", "declared", "orientation"]
    names += ["object", *(n for n in ("position", "probability") if getattr(log, n) is not None)]
    return replace(log, **{name: getattr(log, name)[kept] for name in names})


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

    Raises SonarrecError, with the line, for an invalid cell.
    """
    columns = estimate_columns(landmarks.ids, isinstance(landmarks, DrawnSet))
    if rows is None:  # a text in every row, which only pictures show: too large to hold
        columns = tuple(c for c in columns if c.name != "read")
    ids = np.asarray(landmarks.ids)
    header = needed(columns), ESTIMATES_HEADER
    for first, table in read_tables(path, kinds(columns), *header, rows):
        known = np.isin(table["landmark"], ids)
        if not known.all():
            row = int(np.argmin(known))
            raise SonarrecError(
                f"{path} line {line_number(path, first + row)}: "
                f"landmark {table['landmark'][row]} is not in the set {landmarks.name!r} "
                f"({', '.join(map(str, ids))}); name the set used with --landmarks"
            )
        yield first, table


def choose_method(path: Path, choice: str | None) -> str:
    """The method to show: the one wanted, else the leading one.

    A table without rows counts as having every method. Raises UsageError if the method is missing,
    SonarrecError if the table cannot be read.
    """
    usual, names = choice or leading(()), set[str]()
    header = needed(estimate_columns(())), ESTIMATES_HEADER
    for _, table in read_tables(path, {"method": "text"}, *header, ROWS):
        names |= {str(name) for name in table["method"].unique()}
        if usual in names:
            return usual  # usually in the first rows
    if not names:
        return usual
    return chosen(names, [choice], path)[0] if choice is not None else leading(names)


def read_estimates(
    path: Path, method: str, landmarks: LandmarkSet, fan: Fan
) -> Iterator[tuple[int, tuple[Estimate, ...]]]:
    """(frame, its estimates by the method) for every frame that has any, in order.

    Values that other programs leave out are filled in: pixels from range and bearing or the other
    way round, probabilities from the score, the object by -1.
    Raises SonarrecError, with the line, for an invalid cell and for frames out of order.
    """
    yield from _by_frame(path, landmarks, fan, lambda table: table["method"] == method, True)


def declared_by_frame(
    folder: Path, landmarks: str | None, sonar: Sonar | None
) -> Iterator[tuple[int, int, int, tuple[Estimate, ...]]]:
    """(frame, its time in ns, its stretch, declared estimates of all methods), by rising frame."""
    run, frames = read_run(folder / "run.toml"), read_frames(folder)
    order = np.argsort(frames["frame"], kind="stable")
    frames = {name: column[order] for name, column in frames.items()}
    times = frames.get("timestamp_ns", np.zeros_like(order))
    rows = zip(frames["frame"].tolist(), times.tolist(), stretches_of(frames).tolist(), strict=True)
    path, geometry = folder / "estimates.csv", (run.landmark_set(landmarks), run.fan(sonar))
    declared = _by_frame(path, *geometry, lambda table: table["declared"], False)
    current, estimates = next(declared, (-1, ()))
    for frame, time, stretch in rows:
        while current < frame:  # it is not listed
            current, estimates = next(declared, (sys.maxsize, ()))
        yield frame, time, stretch, estimates if current == frame else ()


def _by_frame(
    path: Path,
    landmarks: LandmarkSet,
    fan: Fan | None,
    wanted: Callable[[Table], BoolArray],
    placed: bool,
) -> Iterator[tuple[int, tuple[Estimate, ...]]]:
    """(frame, its estimates) of the rows wanted. placed: each must have a position."""
    last, estimates = -1, list[Estimate]()
    for first, table in estimate_tables(path, landmarks, ROWS):
        rows = np.flatnonzero(np.asarray(wanted(table)))
        for row, frame, estimate in _estimates_in(table, rows, landmarks, fan):
            fault = ""
            if placed and math.isnan(estimate.x_px):
                fault = "no position: neither x_px,y_px nor range_m,bearing_deg"
            elif frame < last:
                fault = f"frame {frame} after frame {last}; sort the table by frame"
            if fault:
                raise SonarrecError(f"{path} line {line_number(path, first + row)}: {fault}")
            if frame > last and estimates:
                yield last, tuple(estimates)
                estimates = []
            last = frame
            estimates.append(estimate)
    if estimates:
        yield last, tuple(estimates)


def _estimates_in(
    table: Table, rows: IntArray, landmarks: LandmarkSet, fan: Fan | None
) -> Iterator[tuple[int, int, Estimate]]:
    """(row, frame, estimate) of some rows of a table; missing values are computed or NaN."""
    count, methods = len(table["frame"]), np.asarray(table["method"])
    blank = np.full(count, np.nan)
    # Where probabilities are missing they are the score and its complement.
    score, columns = table["score"], belief_names(landmarks.ids)
    beliefs = np.zeros((count, len(columns)))
    beliefs[np.arange(count), landmarks.indices(table["landmark"])] = score
    beliefs[:, -1] = 1 - score
    if all(name in table for name in columns):
        in_table = np.column_stack([table[name] for name in columns])
        complete = np.isfinite(in_table).all(axis=1)
        beliefs[complete] = in_table[complete]
    # Other programs may have a column of this name.
    symbols = [text if _READ.fullmatch(str(text)) else "" for text in table.get("read", blank)]
    corners = np.stack([table.get(name, blank) for name in CORNERS], axis=1).reshape(-1, 4, 2)
    complete_corners = np.isfinite(corners).all(axis=(1, 2))
    of_estimates = {
        **positions(table, fan),
        **{name: table.get(name, blank) for name in ("orientation_deg", *SIGMAS)},
        "existence": np.nan_to_num(table.get("existence", blank), nan=1.0),
        "object": table.get("object", np.full(count, -1)),
        "landmark": table["landmark"],
        "score": score,
        "declared": table["declared"],
    }
    numbers: dict[str, list[Any]] = {name: v[rows].tolist() for name, v in of_estimates.items()}
    for k, n in enumerate(rows.tolist()):
        estimate = Estimate(
            method=str(methods[n]),
            probabilities=beliefs[n],
            corners=corners[n] if complete_corners[n] else None,
            read=symbols[n],
            **{name: values[k] for name, values in numbers.items()},
        )
        yield n, int(table["frame"][n]), estimate


def positions(table: Table, fan: Fan | None) -> dict[str, FloatArray]:
    """x_px, y_px, range_m and bearing_deg, (rows,) each; NaN if not known.

    If the table has only one of the two pairs, the fan gives the other.
    """
    blank = np.full(len(table["frame"]), np.nan)
    stated = {name: table.get(name, blank) for name in POSITION_KINDS}
    if fan is None:
        return stated
    x_px, y_px, range_m, bearing_deg = (stated[name] for name in POSITION_KINDS)
    in_pixels = np.isfinite(x_px) & np.isfinite(y_px)
    in_polar = np.isfinite(range_m) & np.isfinite(bearing_deg)
    column, row = pixel_from_polar(fan, range_m, bearing_deg)
    slant, bearing = polar_from_pixel(fan, x_px, y_px)
    return {
        "x_px": np.where(in_pixels, x_px, column),
        "y_px": np.where(in_pixels, y_px, row),
        "range_m": np.where(in_polar, range_m, slant),
        "bearing_deg": np.where(in_polar, bearing_deg, bearing),
    }


class CountedOnce:
    """Keeps the first results of each recording; copies would count as independent logs.

    Results of different frames of one recording all count.

    action: what a command does with the results, such as "scored". diagnostics: receives a
    line for each copy.
    """

    def __init__(self, action: str, diagnostics: Diagnostics) -> None:
        self._action, self._diagnostics = action, diagnostics
        self._counted: dict[Recording, list[Path]] = defaultdict(list)

    def add(self, folder: Path, log: Recording) -> bool:
        """Whether these results count. log: from `recording`."""
        first = next((other for other in self._counted[log] if _share_frames(other, folder)), None)
        if first is None:
            self._counted[log].append(folder)
            return True
        line = f"{folder}: the same log as {first}, which counts once"
        if _digest(folder) == _digest(first):
            self._diagnostics.note(line)
        else:
            self._diagnostics.problem(f"{line}; these other results of it are not {self._action}")
        return False


def _share_frames(folder: Path, other: Path) -> bool:
    """Whether two results have a frame in common; not if they cannot be read."""
    with suppress(SonarrecError):
        return bool(np.intersect1d(*(read_frames(f)["frame"] for f in (folder, other))).size)
    return False


def recording(folder: Path, run: RunFile) -> Recording:
    """What identifies a recording: SHA-256 and topic; without them the tables' contents."""
    if run.input.recording:
        return run.input.recording
    # Tables without estimates may be equal by chance; then run.toml or the folder decides.
    is_distinct = run.table or csv_rows(folder / "estimates.csv")
    path = None if is_distinct else folder.resolve()
    return None, (_digest(folder), str(run.table), path)


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in (folder / "frames.csv", folder / "estimates.csv"):
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def check_same_log(log: Any, folder: Path, run: RunFile) -> None:
    """Raise SonarrecError if the results in `folder` are of another log. log: a `readers.log.Log`.

    Compared by size and SHA-256 or, if run.toml lacks them, by the number of frames.
    """
    made_from = run.input
    if made_from.sha256 is not None:
        if not made_from.is_of(*log.digest_source()):
            earlier = f", or {why}" if (why := why_outdated(run.table)) else ""
            raise SonarrecError(
                f"{folder}: results of another log, {made_from.path or made_from.name}, or of "
                f"{log.path} before its files changed{earlier}; give the log they were made from, "
                f"or {command_line('run', log.path, '-o', free_name(parent_of(folder)))}"
            )
    elif log.frame_count is not None:
        last = read_frames(folder)["frame"].max(initial=-1)
        if last < log.frame_count:
            return
        raise SonarrecError(
            f"{folder / 'frames.csv'}: results of another log: frame {last} is listed, but "
            f"{log.path} has only {number_of(log.frame_count, 'frame')}"
        )


def check_one_log(old: Path, before: RunFile, new: Path, after: RunFile) -> str | None:
    """Raise SonarrecError if two results folders are of different logs or topics.

    Returns a note if a run.toml lacks the SHA-256, so that frames are matched by number; else None.
    """
    a, b = before.input.recording, after.input.recording
    if a is None or b is None:
        without = " and ".join(str(f) for f, log in ((old, a), (new, b)) if log is None)
        return f"{without}: run.toml does not identify the log; frames are matched by number"
    later = after.input
    if a[1] != b[1] or not before.input.is_of(later.bytes, later.sha256):
        two = " and ".join(
            f"{run.input.path or run.input.name}{f', topic {topic}' if topic else ''}"
            for run, (_, topic) in ((before, a), (after, b))
        )
        raise SonarrecError(
            f"{old} and {new}: results of different logs ({two}), or of one log whose files changed"
        )
    return None


@dataclass(frozen=True, slots=True, repr=False)
class Tables:
    """The tables of one log's results, with the rows and columns of the files."""

    frames: pd.DataFrame
    """frames.csv, a row per frame."""
    estimates: pd.DataFrame
    """estimates.csv, a row per frame, method and object; positions in pixels, m and deg."""
    sightings: pd.DataFrame | None
    """sightings.csv, None if there is none."""

    def __repr__(self) -> str:
        return f"<{len(self.frames)} frames, {len(self.estimates)} estimates>"


def read_results(folder: str | Path) -> Tables:
    """Read the tables of one log's results.

    Parameters
    ----------
    folder : str or Path
        The folder that `sonarrec run` wrote for the log.

    Returns
    -------
    Tables
        `frames`, `estimates` and `sightings` with the columns and units of the files.

    Raises
    ------
    SonarrecError
        frames.csv or estimates.csv cannot be read.

    Examples
    --------
    >>> tables = sonarrec.read_results("sample_data/regression/pan")
    >>> declared = tables.estimates[tables.estimates.declared == 1]
    >>> last = declared[["frame", "method", "landmark", "range_m"]].round(1).tail(2)
    >>> print(last.to_string(index=False))
     frame    method  landmark  range_m
       127       smi         3      2.0
       127 framework         1      2.0
    """
    folder = Path(folder)
    sightings = folder / "sightings.csv"
    return Tables(
        frames=data_frame(folder / "frames.csv", FRAMES_HEADER),
        estimates=data_frame(folder / "estimates.csv", ESTIMATES_HEADER),
        sightings=data_frame(sightings, "method,landmark,track") if sightings.is_file() else None,
    )
