"""Pairs the old and the new results of each log, finds the truth of each pair, and counts it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.evaluation.changes import ByMethod, changed_frames
from sonarrec.evaluation.count import LogCounts, count_log
from sonarrec.evaluation.logs import TruthCheck, UnreadableLog, check_fit, truth_table
from sonarrec.evaluation.match import ScoringOptions, match
from sonarrec.evaluation.pairs import (
    Pair,
    find_truths_beside,
    truth_by_folder,
    truth_note,
)
from sonarrec.results.folders import is_file, log_of
from sonarrec.results.read import (
    CountedOnce,
    LogResults,
    Recording,
    check_one_log,
    find_logs,
    not_whole,
    read_log,
    recording,
    rows_of,
)
from sonarrec.results.run_file import read_run
from sonarrec.tables.read import read_header
from sonarrec.truth.match import match_truth
from sonarrec.truth.table import HEADER

Folders = tuple[Path, Path]
"""The old and the new results folder of one log."""


@dataclass(frozen=True, slots=True)
class LogPair:
    """The old and the new results of one log, to be read and counted."""

    old: Path
    new: Path
    """Results folders."""
    ground_truth: Path
    name: str
    """Name of the log, in messages and in the log column of the truth."""

    @property
    def folders(self) -> Folders:
        return self.old, self.new


def pair_logs(
    old: Path,
    new: Path,
    ground_truth: Path | Sequence[Pair] | None,
    options: ScoringOptions,
    told: Diagnostics,
) -> list[LogPair]:
    """The logs to compare, in order; the arguments are those of `compare.compare`.

    Raises SonarrecError if there is none.
    """
    candidates = _pair_up(old, new, told)
    pairs: list[Folders] = []
    recordings: list[Recording] = []
    faults: list[SonarrecError] = []
    for folders in candidates:
        try:
            remarks = _check_comparable(folders, options.landmarks)
            recordings.append(recording(folders[1], read_run(folders[1] / "run.toml")))
        except SonarrecError as fault:  # the other logs can be compared
            faults.append(fault)
            told.problem(f"{fault}; {log_of(folders[1])} is not compared")
        else:
            pairs.append(folders)
            told.note(*remarks)
    if not pairs:
        raise faults[0]

    once = CountedOnce("compared", told)
    counted = [pair for pair, of in zip(pairs, recordings, strict=True) if once.add(pair[1], of)]
    truths = _truths(counted, len(faults), ground_truth, told)
    return [
        LogPair(*folders, truth.ground_truth, truth.log or log_of(folders[1]))
        for folders, truth in zip(counted, truths, strict=True)
        if truth is not None
    ]


def _check_comparable(pair: Folders, landmarks: str | None) -> list[str]:
    """Notes on two results folders. Raises SonarrecError if they cannot be compared."""
    old, new = pair
    for folder in pair:
        if not is_file(table := folder / "estimates.csv"):
            raise SonarrecError(f"{table}: no such file")
    a, b = (read_run(folder / "run.toml") for folder in pair)
    note = check_one_log(old, a, new, b)
    ids = [run.landmark_set(landmarks).ids for run in (a, b)]
    if ids[0] != ids[1]:
        both = " and ".join(", ".join(map(str, side)) for side in ids)
        raise SonarrecError(
            f"{old} and {new}: run with the landmark IDs {both}; only results with the same IDs "
            "in the same order can be compared; give --landmarks to use one set for both"
        )
    unknown = (folder for folder, run in zip(pair, (a, b), strict=True) if not run.table)
    return [
        *([note] if note else []),
        *(f"{folder}: no run.toml, so its settings are not known" for folder in unknown),
    ]


def _pair_up(old: Path, new: Path, told: Diagnostics) -> list[Folders]:
    """The old and the new folder of each log; each folder without a partner is told.

    Folders are paired by name, else by SHA-256. Two folders of one log each are paired anyway.
    """
    before, after = find_logs(old), find_logs(new)
    if len(before) == len(after) == 1:
        return [(before[0], after[0])]

    def digest(folder: Path) -> tuple[str, str | None] | None:
        with suppress(SonarrecError):  # reported later
            return read_run(folder / "run.toml").input.recording
        return None

    of_name: dict[str, list[Path]] = defaultdict(list)
    of_digest: dict[tuple[str, str | None], list[Path]] = defaultdict(list)
    for folder in before:
        of_name[log_of(folder)].append(folder)
        if (known := digest(folder)) is not None:
            of_digest[known].append(folder)
    pairs = []
    for folder in after:
        known = digest(folder)
        same = [] if known is None else of_digest[known]
        # Links that lead to folders of one name are paired by the names of the links.
        named = sorted(of_name[log_of(folder)], key=lambda f: f.name != folder.name)
        candidates = [*(f for f in named if f in same), *same, *named]
        if candidates:
            pairs.append((candidates[0], folder))
    if not pairs:
        raise SonarrecError(f"{old} and {new} have no log in common, by name or by SHA-256")
    used = {folder for pair in pairs for folder in pair}
    for side, folders in ((old, before), (new, after)):
        alone = (log_of(folder) for folder in folders if folder not in used)
        told.problem(*(f"{log}: is in {side} only; not compared" for log in alone))
    return pairs


def _truths(
    pairs: Sequence[Folders],
    left_out: int,
    ground_truth: Path | Sequence[Pair] | None,
    told: Diagnostics,
) -> list[Pair | None]:
    """The truth of each pair, None if it has none; what was searched for is told.

    left_out: how many other logs were given that cannot be compared.
    """
    folders = [new for _, new in pairs]
    if isinstance(ground_truth, Path):
        logs = len(pairs) + left_out
        if logs > 1 and "log" not in read_header(ground_truth, HEADER):
            raise SonarrecError(
                f"{ground_truth}: {logs} logs are to be compared, so the truth needs a log "
                "column that names their folders; or give the folders of one log"
            )
        return [Pair(folder, ground_truth) for folder in folders]
    truths: list[Pair | None]
    if ground_truth is None:
        found, without = find_truths_beside(folders)
        told.note(*map(truth_note, found))
        of_folder = {pair.results: pair for pair in found}
        truths = [of_folder.get(folder) for folder in folders]
    else:
        truth_of = truth_by_folder(ground_truth)
        truths = [truth_of(new, old) for old, new in pairs]
        without = [
            f"{folder}: the pairs name no truth for it; not compared"
            for folder, truth in zip(folders, truths, strict=True)
            if truth is None
        ]
    if not any(truths):
        others = f" (nor for {number_of(len(without) - 1, 'more log')})" if without[1:] else ""
        raise SonarrecError(f"{without[0]}{others}")
    told.problem(*without)
    return truths


@dataclass(slots=True)
class CountedPair:
    """The counts of one LogPair."""

    check: TruthCheck
    unused: list[str]
    """A line for each part of the results that is not compared."""
    counts: tuple[LogCounts, LogCounts] | None = None
    """Of the old and the new results; None where the truth does not fit the log, or once they are
    added to those of others."""
    changes: ByMethod = field(default_factory=dict)
    """Frames and IDs that are counted differently."""


def count_pair(
    pair: LogPair, options: ScoringOptions, ids: tuple[int, ...]
) -> CountedPair | UnreadableLog:
    """Read the old and the new results of one log, cut them to their common frames, count them.

    ids: as of `match`.
    """
    unused: list[str] = []
    try:
        table = truth_table(pair.ground_truth)
        old, new = (read_log(f, options.landmarks, options.sonar) for f in pair.folders)
        common = np.intersect1d(old.frame, new.frame)
        if not len(common):
            raise SonarrecError(f"{pair.old} and {pair.new} have no frame in common")
        for folder, log in ((pair.old, old), (pair.new, new)):
            if alone := len(log.frame) - len(common):
                frames = number_of(alone, "frame")
                unused.append(f"{log.name}: {frames} in {folder} only; not compared")
            unused += not_whole(log, "scored")
        old, new = (_only(replace(log, name=pair.name), common) for log in (old, new))
        truth = match_truth(table, new, options.tolerance_s)
        counted = CountedPair(check_fit(table, new, truth), unused)
        if counted.check.fault is not None:
            return counted
        # Each side is scored as `evaluate` scores it: pixels lie where its own geometry puts them.
        old_truth = match_truth(table, replace(new, fan=old.fan or new.fan), options.tolerance_s)
    except SonarrecError as fault:  # the other logs can be compared
        return UnreadableLog(pair.name, fault)
    before = match(old, old_truth, options.min_visible, ids, within_m=options.within_m)
    after = match(new, truth, options.min_visible, ids, within_m=options.within_m)
    counted.counts = count_log(before, rates_only=True), count_log(after, rates_only=True)
    counted.changes = changed_frames(before, after)
    return counted


def _only(log: LogResults, frames: IntArray) -> LogResults:
    """The results on the frames of these numbers."""
    listed = np.isin(log.frame, frames)
    kept = rows_of(log, listed[log.frame_index])
    return replace(
        kept,
        frame=log.frame[listed],
        timestamp_ns=None if log.timestamp_ns is None else log.timestamp_ns[listed],
        frame_index=(np.cumsum(listed) - 1)[kept.frame_index],
    )
