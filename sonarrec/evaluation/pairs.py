"""Finds the truth of results: from a table of pairs, or beside the log."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from sonarrec.errors import (
    MissingError,
    SonarrecError,
    UsageError,
    is_url,
    name_from_text,
    number_of,
)
from sonarrec.readers.open import Source, find_log, log_name
from sonarrec.results.read import find_logs
from sonarrec.results.run_file import Input, read_run
from sonarrec.tables.read import line_numbers, read_header, read_table
from sonarrec.truth.table import HEADER, TRUTH_FILE


@dataclass(frozen=True, slots=True)
class Pair:
    """The results folder of one log and the truth that goes with it."""

    results: Path
    ground_truth: Path
    log: str | None = None
    """Name of the log, also for the log column of the truth; None: the name of the folder."""
    row: str | None = None
    """The table and the line that it was read from."""


def read_pairs(path: Path) -> list[Pair]:
    """Read a table of pairs with the columns results, ground_truth and, optionally, log.

    Paths are relative to the folder of the table. Raises SonarrecError if it cannot be used.
    """
    columns = ("results", "ground_truth")
    table = read_table(path, dict.fromkeys((*columns, "log"), "text"), columns, ",".join(columns))
    logs = [str(log) for log in table["log"]] if "log" in table else [None] * len(table["results"])
    if not logs:
        raise SonarrecError(f"{path}: it has no row; give one for each log ({','.join(columns)})")
    rows = [f"{path} line {line}" for line, _ in zip(line_numbers(path), logs, strict=False)]
    return [
        Pair(path.parent / str(results), path.parent / str(truth), log, row)
        for results, truth, log, row in zip(*(table[c] for c in columns), logs, rows, strict=True)
    ]


def usable_pairs(pairs: Iterable[Pair]) -> tuple[list[Pair], list[str]]:
    """The pairs that exist and have results of one log, and a line for each other pair.

    Raises SonarrecError if there is no such pair.
    """
    usable, faults = [], []
    for pair in pairs:
        try:
            folders = find_logs(pair.results)
            if folders != [pair.results]:
                raise SonarrecError(
                    f"{pair.results}: holds {len(folders)} logs; give each log its own row"
                )
            if not pair.ground_truth.exists():
                raise SonarrecError(f"{pair.ground_truth}: no such file")
        except SonarrecError as fault:
            faults.append(fault if pair.row is None else type(fault)(f"{pair.row}: {fault}"))
        else:
            usable.append(pair)
    if not usable:
        raise faults[0] if faults else SonarrecError("no pair of results and ground truth to score")
    return usable, [f"{fault}; not scored" for fault in faults]


def find_truths_beside(folders: Iterable[Path]) -> tuple[list[Pair], list[str]]:
    """Each results folder with the truth beside its log, and a line for each without truth.

    run.toml says where the log is.
    Raises UsageError if there is no truth at all, SonarrecError if no run.toml can be read or if
    several logs share a truth without a log column.
    """
    pairs, without, unread = [], [], []
    sharing: dict[Path, dict[Hashable, Path]] = defaultdict(dict)
    for folder in folders:
        try:
            run = read_run(folder / "run.toml")
        except SonarrecError as error:
            unread.append(error)
            continue
        try:
            truth = _truth_beside(folder, run.input)
        except SonarrecError as error:
            without.append(str(error))
            continue
        pairs.append(Pair(folder, truth))
        sharing[truth.resolve()][run.input.sha256, run.input.topic] = folder
    for truth, logs in sharing.items():
        if len(logs) > 1 and "log" not in read_header(truth, HEADER):
            names = ", ".join(folder.name for folder in logs.values())
            raise SonarrecError(
                f"{truth}: lies beside {len(logs)} logs ({names}), so it needs a log column that "
                "names their results folders; or give each log its own NAME.gt.csv"
            )
    if unread and not (pairs or without):
        raise unread[0]
    if not pairs:
        others = (
            f" (and {number_of(len(without) - 1, 'more log')} without one)" if without[1:] else ""
        )
        raise UsageError(f"{without[0]}{others}; give --ground-truth, or --pairs")
    return pairs, [f"{line}; not scored" for line in (*map(str, unread), *without)]


def truth_note(pair: Pair) -> str:
    """A message on a truth from `find_truths_beside`."""
    return f"{pair.results}: ground truth {pair.ground_truth}, beside its log"


def _truth_beside(folder: Path, source: Input) -> Path:
    """NAME.gt.csv, else gt.csv, beside the log that results were made from.

    For a folder, of images or a bag, those in it, else NAME.gt.csv beside it. Raises SonarrecError
    if there is none, or if the log was replaced by another one.
    """
    if source.path is None:
        raise SonarrecError(f"{folder}: no ground truth: run.toml does not say where the log is")
    try:
        if is_url(source.path):
            raise SonarrecError(f"its log is on a server, {source.path}")
        found = _log_at(source.path, folder, source.place)
    except SonarrecError as error:
        raise SonarrecError(f"{folder}: no ground truth: {error}") from None
    log, name = str(found.path), f"{log_name(found.place)}.{TRUTH_FILE}"
    searched = f"{name}, nor {TRUTH_FILE} beside {log}"
    if found.place.is_dir():
        searched = f"{TRUTH_FILE} in {found.place}, nor {name} in or beside it"
    truth, size = found.beside(TRUTH_FILE), _size(found)
    if truth is None:
        raise SonarrecError(f"{folder}: no ground truth: no {searched}")
    if source.bytes not in (None, size):
        raise SonarrecError(
            f"{folder}: no ground truth: {log} has changed since the run (it had "
            f"{source.bytes} bytes and has {size}), so {truth} may not be its truth"
        )
    return truth


def _log_at(path: str, folder: Path, place: str | None) -> Source:
    """The log at the path in run.toml, else at the place relative to the results folder.

    In both, bytes that are not UTF-8 are escaped. Raises MissingError if there is no log.
    """
    places = [path, name_from_text(path)]
    if place is not None:  # the path is relative to the folder that `run` was called in
        places.append(str((folder.resolve() / name_from_text(place)).resolve()))
    for candidate in places:
        with suppress(MissingError):
            return find_log(candidate)
    return find_log(path)


def _size(log: Source) -> int:
    """Bytes, counted as in run.toml (`readers.log.digest_of`)."""
    total = 0
    for file in log.files:
        with suppress(OSError):  # the run reported it
            total += file.stat().st_size
    return total


def truth_by_folder(pairs: Sequence[Pair]) -> Callable[..., Pair | None]:
    """A function that gives the first pair for some folders: by path, else by name.

    It uses an index, since there may be a thousand pairs for a thousand logs.
    """
    places: dict[Path, int] = {}
    names: dict[str, int] = {}
    for i, pair in enumerate(pairs):
        place = pair.results.resolve()
        places.setdefault(place, i)
        names.setdefault(pair.log or place.name, i)

    def pair_of(*folders: Path) -> Pair | None:
        resolved = [folder.resolve() for folder in folders]
        matches = [places[place] for place in resolved if place in places]
        matches = matches or [names[place.name] for place in resolved if place.name in names]
        return pairs[min(matches)] if matches else None

    return pair_of
