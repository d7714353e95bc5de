"""Pairs the old and the new results of each log, and finds the truth of each pair."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.evaluation.log_pair import LogPair
from sonarrec.evaluation.logs import first_ids
from sonarrec.evaluation.match import ScoringOptions
from sonarrec.evaluation.pairs import (
    FindBeside,
    Pair,
    find_truths_beside,
    truth_by_folder,
    truth_note,
)
from sonarrec.results.folders import estimates_of, log_of
from sonarrec.results.read import find_logs, read_frames, read_log
from sonarrec.results.run_file import RunFile, read_run
from sonarrec.results.same_log import Recording, check_one_log, counted_once, recording
from sonarrec.tables.read import read_header
from sonarrec.truth.table import HEADER

Folders = tuple[Path, Path]
"""The old and the new results folder of one log."""


@dataclass(frozen=True, slots=True)
class Pairing:
    """The logs to compare, in order, and the messages about them."""

    pairs: list[LogPair]
    notes: list[str]
    unused: list[str]


def pair_logs(
    old: Path,
    new: Path,
    ground_truth: Path | Sequence[Pair] | None,
    options: ScoringOptions,
    find_beside: FindBeside | None,
) -> Pairing:
    """The logs to compare; the arguments are those of `compare.compare`.

    Raises SonarrecError if there is none.
    """
    candidates, unused = _pair_up(old, new)
    pairs: list[Folders] = []
    recordings: list[Recording] = []
    notes: list[str] = []
    faults: list[SonarrecError] = []
    for folders in candidates:
        try:
            remarks = _check_comparable(folders, options.landmarks)
            recordings.append(_recording(folders[1], options.landmarks))
        except SonarrecError as fault:  # the other logs can be compared
            faults.append(fault)
            unused.append(f"{fault}; {log_of(folders[1])} is not compared")
        else:
            pairs.append(folders)
            notes += remarks
    if not pairs:
        raise faults[0]

    def frames(i: int) -> IntArray:
        try:
            return np.asarray(read_frames(pairs[i][1])["frame"])
        except SonarrecError:  # reported when the log is counted
            return np.empty(0, dtype=np.int64)

    told = Diagnostics()
    kept = counted_once([after for _, after in pairs], recordings, frames, "compared", told)
    counted = [pairs[i] for i in kept]
    truths, truth_notes, without = _truths(counted, len(faults), ground_truth, find_beside)
    ids = first_ids((after for _, after in counted), options.landmarks)
    logs = [
        LogPair(*folders, truth.ground_truth, truth.log or log_of(folders[1]), options, ids)
        for folders, truth in zip(counted, truths, strict=True)
        if truth is not None
    ]
    return Pairing(logs, [*notes, *told.notes, *truth_notes], [*unused, *told.problems, *without])


def _run(folder: Path) -> RunFile:
    return read_run(folder / "run.toml")


def _recording_of(folder: Path) -> tuple[str, str | None] | None:
    """SHA-256 and topic as of `Input.recording`; None also if run.toml cannot be read.

    That is reported later.
    """
    with suppress(SonarrecError):
        return _run(folder).input.recording
    return None


def _recording(folder: Path, landmarks: str | None) -> Recording:
    run = _run(folder)
    if run.input.recording:
        return run.input.recording
    return recording(folder, run, len(read_log(folder, landmarks).frame_index))


def _check_comparable(pair: Folders, landmarks: str | None) -> list[str]:
    """Notes on two results folders. Raises SonarrecError if they cannot be compared."""
    old, new = pair
    for folder in pair:
        if not (table := estimates_of(folder)).is_file():
            raise SonarrecError(f"{table}: no such file")
    a, b = map(_run, pair)
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


def _pair_up(old: Path, new: Path) -> tuple[list[Folders], list[str]]:
    """The old and the new folder of each log, and a line for each folder without a partner.

    Folders are paired by name, else by SHA-256. Two folders of one log each are paired anyway.
    """
    before, after = find_logs(old), find_logs(new)
    if len(before) == len(after) == 1:
        return [(before[0], after[0])], []
    of_name: dict[str, list[Path]] = {}
    of_digest: dict[tuple[str, str | None], list[Path]] = {}
    for folder in before:
        of_name.setdefault(log_of(folder), []).append(folder)
        if (digest := _recording_of(folder)) is not None:
            of_digest.setdefault(digest, []).append(folder)
    pairs = []
    for folder in after:
        digest = _recording_of(folder)
        same = [] if digest is None else of_digest.get(digest, [])
        # Links that lead to folders of one name are paired by the names of the links.
        named = sorted(of_name.get(log_of(folder), []), key=lambda f: f.name != folder.name)
        chosen = next((f for f in named if f in same), None)
        chosen = chosen or next(iter([*same, *named]), None)
        if chosen is not None:
            pairs.append((chosen, folder))
    if not pairs:
        raise SonarrecError(f"{old} and {new} have no log in common, by name or by SHA-256")
    used = {folder for pair in pairs for folder in pair}
    alone = [
        f"{log_of(folder)}: is in {side} only; not compared"
        for side, folders in ((old, before), (new, after))
        for folder in folders
        if folder not in used
    ]
    return pairs, alone


def _truths(
    pairs: Sequence[Folders],
    left_out: int,
    ground_truth: Path | Sequence[Pair] | None,
    find_beside: FindBeside | None,
) -> tuple[list[Pair | None], list[str], list[str]]:
    """The truth of each pair, None if it has none; a line for each truth that was searched for
    and found; a line for each pair without a truth.

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
        return [Pair(folder, ground_truth) for folder in folders], [], []
    where: list[str] = []
    truths: list[Pair | None]
    if ground_truth is None:
        found, without = find_truths_beside(folders, find_beside)
        where = [truth_note(pair) for pair in found]
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
    return truths, where, without
