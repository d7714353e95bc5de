"""Old and new results put together log by log, on the frames that both hold, with their truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.evaluation.fit import Matched, checked, cut_short, fit, matched
from sonarrec.evaluation.pairs import Elsewhere, Pair, found_beside, found_where, truth_of
from sonarrec.evaluation.same import counted_once, recording
from sonarrec.evaluation.settings import SettingChange, changed_settings
from sonarrec.records import SonarrecError
from sonarrec.results.read import LogResults, find_logs, read_log
from sonarrec.results.same_log import check_one_log
from sonarrec.sonar import Sonar
from sonarrec.truth.table import TruthTable, read_truth

Read = tuple[Path, LogResults]
"""One log's results and their folder."""


@dataclass(frozen=True, slots=True)
class Sides:
    """The logs of both sides, in one order, cut to common frames."""

    before: list[Matched]
    after: list[Matched]
    settings: list[SettingChange]
    notes: list[str]
    unused: list[str]


def both_sides(
    old: Path,
    new: Path,
    ground_truth: Path | Sequence[Pair] | None,
    tolerance_s: float | None,
    landmarks: str | None,
    sonar: Sonar | None,
    elsewhere: Elsewhere | None = None,
) -> Sides:
    """Read two results folders and what is true; the arguments are those of `compare.compare`.

    Raises SonarrecError where logs differ, or nothing is in common.
    """
    before, after = (
        [(folder, read_log(folder, landmarks, sonar)) for folder in find_logs(side)]
        for side in (old, new)
    )
    together, unused = _pair_up(old, new, before, after)
    notes = [line for pair in together for line in _checked(*pair)]
    folders, logs = zip(*(b for _, b in together), strict=True)
    once = counted_once(folders, list(map(recording, folders, logs)), lambda i: logs[i].frame)
    together = [together[i] for i in once.kept]
    notes += [*once.notes, *once.unused]
    changes = changed_settings((b.name, a.run, b.run) for (_, a), (_, b) in together)
    truths, said, without = _truths(together, ground_truth, elsewhere)
    notes += said
    unused += without
    cases: list[Matched] = []
    olds: dict[Path, LogResults] = {}
    for ((was, a), (now, b)), truth in zip(together, truths, strict=True):
        if truth is None:
            continue
        table, name = truth
        common = np.intersect1d(a.frame, b.frame)
        if not len(common):
            raise SonarrecError(f"{b.name}: {was} and {now} have no frame in common")
        for side, log in ((was, a), (now, b)):
            alone = len(log.frame) - len(common)
            unused += [f"{log.name}: {alone} frames are in {side} only; not compared"] * bool(alone)
            unused += cut_short(log)
        olds[now] = _only(replace(a, name=name), common)
        cases.append(matched(now, table, _only(replace(b, name=name), common), tolerance_s))
    found = fit([checked(case) for case in cases])
    usable = [cases[i] for i in found.usable]
    return Sides(
        before=[replace(case, log=olds[case.folder]) for case in usable],
        after=usable,
        settings=changes,
        notes=[*dict.fromkeys(notes), *found.notes],
        unused=[*dict.fromkeys(unused), *found.unused],
    )


def _checked(old: Read, new: Read) -> list[str]:
    """What to note of two results to be compared. Raises SonarrecError where they cannot be."""
    (was, a), (now, b) = old, new
    note = check_one_log(was, a.run, now, b.run)
    if a.landmarks.ids != b.landmarks.ids:
        ids = (", ".join(map(str, log.landmarks.ids)) for log in (a, b))
        raise SonarrecError(
            f"{was} and {now}: run with the landmark IDs {' and '.join(ids)}; to compare them the "
            "same IDs are needed, in the same order, or --landmarks"
        )
    unknown = (folder for folder, log in (old, new) if not log.run.table)
    return [
        *([note] if note else []),
        *(f"{folder}: no run.toml, so its settings are not known" for folder in unknown),
    ]


def _pair_up(
    old: Path, new: Path, before: list[Read], after: list[Read]
) -> tuple[list[tuple[Read, Read]], list[str]]:
    """Which goes with which: by name, else by SHA-256; two folders of one log each in any case."""
    if len(before) == len(after) == 1:
        return [(before[0], after[0])], []
    pairs = []
    for b in after:
        same = [a for a in before if _sha256(a) == _sha256(b) is not None]
        named = [a for a in before if a[1].name == b[1].name]
        chosen = next((a for a in named if a in same), None) or next(iter([*same, *named]), None)
        if chosen is not None:
            pairs.append((chosen, b))
    if not pairs:
        raise SonarrecError(f"{old} and {new} have no log in common, by name or by SHA-256")
    used = {folder for pair in pairs for folder, _ in pair}
    alone = [
        f"{log.name}: is in {side} only; not compared"
        for side, logs in ((old, before), (new, after))
        for folder, log in logs
        if folder not in used
    ]
    return pairs, alone


def _sha256(read: Read) -> tuple[str, str | None] | None:
    """Of the recording, with its topic; None where run.toml does not say."""
    source = read[1].run.input
    return (source.sha256, source.topic) if source.sha256 else None


def _truths(
    together: Sequence[tuple[Read, Read]],
    ground_truth: Path | Sequence[Pair] | None,
    elsewhere: Elsewhere | None,
) -> tuple[list[tuple[TruthTable, str] | None], list[str], list[str]]:
    """The truth of each log and the name it has there, None where there is none; a line for each
    that was found, and for each that has none."""
    if isinstance(ground_truth, Path):
        table = read_truth(ground_truth)
        if len(together) > 1 and table.log is None:
            raise SonarrecError(
                f"{ground_truth}: {len(together)} logs are compared, so the truth needs a log "
                "column that names their folders; or give the folders of one log"
            )
        return [(table, b.name) for _, (_, b) in together], [], []
    folders = [now for _, (now, _) in together]
    said: list[str] = []
    if ground_truth is None:
        pairs, without = found_beside(folders, elsewhere)
        said = [found_where(pair) for pair in pairs]
        chosen = [next((p for p in pairs if p.results == folder), None) for folder in folders]
    else:
        chosen = [truth_of(ground_truth, now, was) for (was, _), (now, _) in together]
        without = [
            f"{folder}: the pairs name no truth for it; not compared"
            for folder, pair in zip(folders, chosen, strict=True)
            if pair is None
        ]
    if not any(chosen):
        raise SonarrecError("; ".join(without))
    tables = {pair.ground_truth: read_truth(pair.ground_truth) for pair in chosen if pair}
    return (
        [
            None if pair is None else (tables[pair.ground_truth], pair.log or b.name)
            for pair, (_, (_, b)) in zip(chosen, together, strict=True)
        ],
        said,
        without,
    )


def _only(log: LogResults, frames: Any) -> LogResults:
    """The results on some of the log's frames, given by number."""
    kept = np.isin(log.frame, frames)
    mine = kept[log.frame_index]
    return replace(
        log,
        frame=log.frame[kept],
        timestamp_ns=None if log.timestamp_ns is None else log.timestamp_ns[kept],
        method=log.method[mine],
        frame_index=(np.cumsum(kept) - 1)[log.frame_index[mine]],
        landmark_index=log.landmark_index[mine],
        score=log.score[mine],
        declared=log.declared[mine],
        position=None if log.position is None else log.position[mine],
        orientation=log.orientation[mine],
        object=log.object[mine],
        probability=None if log.probability is None else log.probability[mine],
    )
