"""Old and new results put together log by log, by what their run.toml say, with their truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.evaluation.matching.pairs import (
    Elsewhere,
    Pair,
    found_beside,
    found_where,
    truth_by_folder,
)
from sonarrec.files.tables import read_header
from sonarrec.records import IntArray, SonarrecError, shown
from sonarrec.results.counted_once import Recording, counted_once, recording
from sonarrec.results.folders import estimates_of
from sonarrec.results.read import find_logs, read_frames, read_log
from sonarrec.results.run_file import RunFile, read_run
from sonarrec.results.same_log import check_one_log
from sonarrec.truth.table import HEADER

Both = tuple[Path, Path]
"""The folders of one log's old and new results."""


@dataclass(frozen=True, slots=True)
class BothSides:
    """One log to be compared."""

    was: Path
    now: Path
    ground_truth: Path
    name: str
    """Of the log, as the log column of the truth has it."""


@dataclass(frozen=True, slots=True)
class Sides:
    """The logs to be compared, in order, and what is said before they are read."""

    logs: list[BothSides]
    notes: list[str]
    unused: list[str]


def both_sides(
    old: Path,
    new: Path,
    ground_truth: Path | Sequence[Pair] | None,
    landmarks: str | None,
    elsewhere: Elsewhere | None,
) -> Sides:
    """What is to be compared; the arguments are those of `compare.compare`.

    Raises SonarrecError where nothing is.
    """
    pairs, unused = _pair_up(old, new)
    together: list[Both] = []
    recordings: list[Recording] = []
    notes: list[str] = []
    faults: list[SonarrecError] = []
    for pair in pairs:
        try:
            told = _checked(pair, landmarks)
            recordings.append(_recording(pair[1], landmarks))
        except SonarrecError as fault:  # the other logs can be compared
            faults.append(fault)
            unused.append(f"{fault}; {_name(pair[1])} is not compared")
        else:
            together.append(pair)
            notes += told
    if not together:
        raise faults[0]
    folders = [now for _, now in together]

    def frames(i: int) -> IntArray:
        try:
            return np.asarray(read_frames(folders[i])["frame"])
        except SonarrecError:  # told where the log is counted
            return np.empty(0, dtype=np.int64)

    once = counted_once(folders, recordings, frames, "compared")
    together = [together[i] for i in once.kept]
    notes += once.notes
    unused += once.unused
    logs, said, without = _with_truth(together, len(faults), ground_truth, elsewhere)
    return Sides(logs, [*notes, *said], [*unused, *without])


def _run(folder: Path) -> RunFile:
    return read_run(folder / "run.toml")


def _sha256(folder: Path) -> tuple[str, str | None] | None:
    """As `Input.recording`; None also where run.toml cannot be read, which is told later."""
    with suppress(SonarrecError):
        return _run(folder).input.recording
    return None


def _name(folder: Path) -> str:
    return shown(folder.resolve().name)


def _recording(folder: Path, landmarks: str | None) -> Recording:
    run = _run(folder)
    if run.input.recording:
        return run.input.recording
    return recording(folder, run, len(read_log(folder, landmarks).frame_index))


def _checked(pair: Both, landmarks: str | None) -> list[str]:
    """What to note of two results to be compared. Raises SonarrecError where they cannot be."""
    was, now = pair
    for folder in pair:
        if not (table := estimates_of(folder)).is_file():
            raise SonarrecError(f"{table}: no such file")
    a, b = map(_run, pair)
    note = check_one_log(was, a, now, b)
    ids = [run.landmark_set(landmarks).ids for run in (a, b)]
    if ids[0] != ids[1]:
        told = " and ".join(", ".join(map(str, side)) for side in ids)
        raise SonarrecError(
            f"{was} and {now}: run with the landmark IDs {told}; to compare them the "
            "same IDs are needed, in the same order, or --landmarks"
        )
    unknown = (folder for folder, run in zip(pair, (a, b), strict=True) if not run.table)
    return [
        *([note] if note else []),
        *(f"{folder}: no run.toml, so its settings are not known" for folder in unknown),
    ]


def _pair_up(old: Path, new: Path) -> tuple[list[Both], list[str]]:
    """Which goes with which: by name, else by SHA-256; two folders of one log each in any case."""
    before, after = find_logs(old), find_logs(new)
    if len(before) == len(after) == 1:
        return [(before[0], after[0])], []
    of_name: dict[str, list[Path]] = {}
    of_digest: dict[tuple[str, str | None], list[Path]] = {}
    for was in before:
        of_name.setdefault(_name(was), []).append(was)
        if (digest := _sha256(was)) is not None:
            of_digest.setdefault(digest, []).append(was)
    pairs = []
    for now in after:
        digest = _sha256(now)
        same = [] if digest is None else of_digest.get(digest, [])
        # Links to folders of one name go together by their own names.
        named = sorted(of_name.get(_name(now), []), key=lambda was: was.name != now.name)
        chosen = next((was for was in named if was in same), None)
        chosen = chosen or next(iter([*same, *named]), None)
        if chosen is not None:
            pairs.append((chosen, now))
    if not pairs:
        raise SonarrecError(f"{old} and {new} have no log in common, by name or by SHA-256")
    used = {folder for pair in pairs for folder in pair}
    alone = [
        f"{_name(folder)}: is in {side} only; not compared"
        for side, folders in ((old, before), (new, after))
        for folder in folders
        if folder not in used
    ]
    return pairs, alone


def _with_truth(
    together: Sequence[Both],
    left_out: int,
    ground_truth: Path | Sequence[Pair] | None,
    elsewhere: Elsewhere | None,
) -> tuple[list[BothSides], list[str], list[str]]:
    """The logs that have a truth; a line for each whose truth was found, and for each that has
    none. left_out: logs beside these, that cannot be compared."""
    if isinstance(ground_truth, Path):
        logs = len(together) + left_out
        if logs > 1 and "log" not in read_header(ground_truth, HEADER):
            raise SonarrecError(
                f"{ground_truth}: {logs} logs are to be compared, so the truth needs a log "
                "column that names their folders; or give the folders of one log"
            )
        return [BothSides(was, now, ground_truth, _name(now)) for was, now in together], [], []
    folders = [now for _, now in together]
    said: list[str] = []
    if ground_truth is None:
        pairs, without = found_beside(folders, elsewhere)
        said = [found_where(pair) for pair in pairs]
        of_folder = {pair.results: pair for pair in pairs}
        chosen = [of_folder.get(folder) for folder in folders]
    else:
        truth = truth_by_folder(ground_truth)
        chosen = [truth(now, was) for was, now in together]
        without = [
            f"{folder}: the pairs name no truth for it; not compared"
            for folder, pair in zip(folders, chosen, strict=True)
            if pair is None
        ]
    if not any(chosen):
        others = f" (nor for {len(without) - 1} more logs)" if without[1:] else ""
        raise SonarrecError(f"{without[0]}{others}")
    return list(_logs(together, chosen)), said, without


def _logs(together: Sequence[Both], chosen: Sequence[Pair | None]) -> Iterator[BothSides]:
    for (was, now), pair in zip(together, chosen, strict=True):
        if pair is not None:
            yield BothSides(was, now, pair.ground_truth, pair.log or _name(now))
