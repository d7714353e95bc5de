"""Finds the truth of results: by a table of pairs, or by the log; and pairs old with new."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from pathlib import Path

from sonarrec.errors import (
    Diagnostics,
    SonarrecError,
    UsageError,
    command_line,
    name_from_text,
    number_of,
)
from sonarrec.readers.open import is_log_file, log_name, misspelt, own_file
from sonarrec.results.read import find_logs
from sonarrec.results.run_file import Input, read_run
from sonarrec.runs.recorded import recorded_at
from sonarrec.tables.read import read_header, read_table
from sonarrec.truth.table import HEADER, TRUTH_FILE


@dataclass(frozen=True, slots=True)
class Pair:
    """The results folder of one log and the truth that goes with it."""

    results: Path
    ground_truth: Path
    log: str | None = None
    """Name of the log, also for the log column of the truth; None: the name of the folder."""


def read_pairs(path: Path) -> list[Pair]:
    """Read a table of pairs with the columns results, ground_truth and, optionally, log.

    Paths are relative to the folder of the table. Raises SonarrecError if it cannot be used.
    """
    columns = ("results", "ground_truth")
    table = read_table(path, dict.fromkeys((*columns, "log"), "text"), columns, ",".join(columns))
    logs = [str(log) for log in table["log"]] if "log" in table else [None] * len(table["results"])
    if not logs:
        raise SonarrecError(f"{path}: it has no row; give one for each log ({','.join(columns)})")
    return [
        Pair(path.parent / str(results), path.parent / str(truth), log)
        for results, truth, log in zip(*(table[c] for c in columns), logs, strict=True)
    ]


def usable_pairs(pairs: Iterable[Pair], diagnostics: Diagnostics) -> list[Pair]:
    """The pairs that exist and have results of one log; every other one is a problem.

    Raises SonarrecError if there is no such pair.
    """
    usable, faults = [], []
    for pair in pairs:
        try:
            if (logs := find_logs(pair.results)) != [pair.results]:
                raise SonarrecError(f"{pair.results}: holds {len(logs)} logs; give each its row")
            if not pair.ground_truth.exists():
                raise SonarrecError(f"{pair.ground_truth}: no such file")
        except SonarrecError as fault:
            faults.append(fault)
        else:
            usable.append(pair)
    if not usable:
        raise faults[0] if faults else SonarrecError("no pair of results and ground truth to score")
    diagnostics.problem(*(f"{fault}; not scored" for fault in faults))
    return usable


def find_truths(
    folders: Iterable[Path], diagnostics: Diagnostics, truths: Path | None = None
) -> list[Pair]:
    """Each results folder with its truth; one without truth is a problem.

    truths: one truth of all, or a folder that holds NAME.gt.csv of each; None: each log's own, for
    run.toml says where the log is.
    Raises UsageError if there is no truth at all, SonarrecError if no run.toml can be read or if
    several logs share a truth without a log column.
    """
    if truths is not None and not truths.is_dir():
        return [Pair(folder, truths) for folder in folders]
    pairs, without, unread = [], [], []
    sharing: dict[Path, dict[Hashable, Path]] = defaultdict(dict)
    for folder in folders:
        try:
            run = read_run(folder / "run.toml")
        except SonarrecError as error:
            unread.append(error)
            continue
        try:
            if truths is None:
                truth = _truth_of_log(folder, run.input, diagnostics)
            else:
                truth = _truth_in(truths, folder, run.input)
        except SonarrecError as error:
            without.append(f"{folder}: no ground truth: {error}")
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
        others = number_of(len(without) - 1, "more log")
        more = f" (and {others} without one)" if without[1:] else ""
        raise UsageError(f"{without[0]}{more}; give --ground-truth, or --pairs")
    diagnostics.problem(*(f"{line}; not scored" for line in (*map(str, unread), *without)))
    if truths is None:
        line, truth = "scored by the ground truth next to", pairs[0].ground_truth
        text = f"{pairs[0].results}: {line} its log, {truth}"
        if pairs[1:]:
            text = f"{len(pairs)} logs, each {line} it, the first {truth}"
        diagnostics.note(text)
    return pairs


def _truth_in(truths: Path, folder: Path, source: Input) -> Path:
    """NAME.gt.csv in a folder of truths; NAME as of the results, else of the log. Raises
    SonarrecError if there is none."""
    names = [folder.resolve().name]
    if source.path is not None:
        names.append(log_name(Path(name_from_text(source.path))))
    files = [truths / f"{name}.{TRUTH_FILE}" for name in names]
    truth = next(filter(Path.is_file, files), None)
    if truth is None:
        raise SonarrecError(f"no {files[0].name} in {truths}")
    return truth


def _truth_of_log(folder: Path, source: Input, diagnostics: Diagnostics) -> Path:
    """NAME.gt.csv, else gt.csv, in the folder of the log that results were made from; for a folder,
    of images or a bag, those in it, else NAME.gt.csv next to it. It is a problem if a gt.csv may be
    that of another log next to it. Raises SonarrecError if there is none."""
    log = recorded_at(folder, source)
    truth = log.companion(TRUTH_FILE)
    if truth is None:
        name = f"{log_name(log.location)}.{TRUTH_FILE}"
        how = misspelt(log.location, TRUTH_FILE)
        how = how or f"; {command_line('truth', 'review', log.path)} makes one"
        raise SonarrecError(f"no {name}, nor {TRUTH_FILE} in or beside {log.path}{how}")
    if newer := misspelt(log.location, TRUTH_FILE, truth):
        diagnostics.problem(f"{truth}: is used{newer}")
    if truth.name == TRUTH_FILE and truth.parent == log.location.parent:
        logs = sum(
            is_log_file(path) and not own_file(path, TRUTH_FILE).is_file()
            for path in truth.parent.iterdir()
        )
        if logs > 1 and "log" not in read_header(truth, HEADER):
            diagnostics.problem(
                f"{truth}: lies next to {logs} logs and has no log column, so it may be another's "
                f"than that of {log.location.name}; if it is its own, call it "
                f"{own_file(log.location, TRUTH_FILE).name}"
            )
    return truth


def pair_up(old: Path, new: Path, diagnostics: Diagnostics) -> list[tuple[Path, Path]]:
    """The old and the new folder of each log, by name; a folder without a partner is a problem.

    Two folders of one log each are paired anyway.
    """
    before, after = find_logs(old), find_logs(new)
    if len(before) == len(after) == 1:
        return [(before[0], after[0])]

    # The name of a link, not of what it leads to: several may lead to folders of one name.
    earlier, later = ({f.absolute().name: f for f in side} for side in (before, after))
    pairs = [(earlier[name], folder) for name, folder in later.items() if name in earlier]
    if not pairs:
        raise SonarrecError(f"{old} and {new} have no log of one name in common")
    for side, named, other in ((old, earlier, later), (new, later, earlier)):
        diagnostics.problem(
            *(f"{n}: is in {side} only; not compared" for n in named if n not in other)
        )
    return pairs
