"""Results and truth to an Evaluation, of one folder, of several or of a table of pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sonarrec.evaluation.fit import Matched, fit, left_out, matched
from sonarrec.evaluation.joined import Joined, join
from sonarrec.evaluation.pairs import Pair, found_beside, found_where, one_log
from sonarrec.evaluation.same import counted_once
from sonarrec.evaluation.scoring import PROTOCOLS, Scored, score
from sonarrec.records import SonarrecError, UsageError, printable
from sonarrec.results.read import LogResults, find_logs, read_log
from sonarrec.sonar import Sonar
from sonarrec.truth.match import Truth
from sonarrec.truth.table import read_truth


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What `evaluate` found."""

    joined: Joined
    folders: tuple[Path, ...]
    """Of each log of `joined`, as given."""
    scored: tuple[Scored, ...]
    """Every method under every protocol."""
    min_visible: float
    notes: tuple[str, ...]
    """Worth knowing."""
    unused: tuple[str, ...]
    """Input that could not be used, one line each."""


def evaluate(
    results: str | Path,
    ground_truth: str | Path | None = None,
    *,
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
) -> Evaluation:
    """Score a results folder (of one log, or of several) against gt.csv.

    Without ground_truth the NAME.gt.csv, or gt.csv, beside each log is taken.
    Of several results of one recording the first counts.

    A claim is an estimate that is declared (operating point) or whose score reaches the
    threshold (curves). A landmark with visible >= min_visible is a positive.

    Protocol "paper", per frame and ID: in view and claimed = TP, each further claim of it one TP
    more; in view and not claimed = FN; not in view and claimed, however often, = FP; else TN.
    Position plays no part. Partly visible and nothing else of that ID in view: not counted.

    Protocol "strict": a claim belongs to the truth of its ID that is nearest in that frame, if
    its centre is within half a disc diameter of it in the fan plane. The first claim of a
    positive (the one of highest score) is TP; every further one, and every claim that belongs to
    no truth, is FP. A positive without a claim is FN, also where its ID is claimed elsewhere
    (FN and FP). Claims of a partly visible landmark are not counted. TN: a frame and ID of which
    nothing shows and which is not claimed. So an FP replaces a TN the first time an absent ID is
    claimed in a frame, and is an entry of its own otherwise: FPR = FP / (FP + TN) stays within
    0 to 1 and no false claim is free.

    Raises SonarrecError where files cannot be used or have no frame in common.
    """
    results = Path(results)
    check_options(min_visible, tolerance_s)
    folders = find_logs(results)
    if ground_truth is None:
        return _beside(folders, min_visible, tolerance_s, landmarks, sonar)
    table = read_truth(Path(ground_truth))
    named = [read_log(folder, landmarks, sonar) for folder in folders]
    once = counted_once(folders, named)
    if len(once.kept) > 1 and table.log is None:
        names = ", ".join(named[i].name for i in once.kept)
        raise SonarrecError(
            f"{ground_truth}: {results} holds {len(once.kept)} logs ({names}), so the truth needs "
            "a log column that names their folders; or give the folder of one log"
        )
    found = fit([matched(folders[i], table, named[i], tolerance_s) for i in once.kept])
    elsewhere = 0
    if table.log is not None and folders != [results]:
        elsewhere = int(np.count_nonzero(~np.isin(table.log, [log.name for log in named])))
    unused = [*found.unused, *left_out(found.usable, elsewhere), *once.unused]
    return pool(found.usable, min_visible, [*once.notes, *found.notes], unused)


def _beside(
    folders: list[Path],
    min_visible: float,
    tolerance_s: float | None,
    landmarks: str | None,
    sonar: Sonar | None,
) -> Evaluation:
    """Each log with the truth that lies beside it."""
    pairs, without = found_beside(folders)
    found = evaluate_pairs(
        pairs, min_visible=min_visible, tolerance_s=tolerance_s, landmarks=landmarks, sonar=sonar
    )
    return replace(
        found,
        notes=(*(printable(found_where(pair)) for pair in pairs), *found.notes),
        unused=(*map(printable, without), *found.unused),
    )


def evaluate_pairs(
    pairs: Sequence[Pair],
    *,
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
) -> Evaluation:
    """Score several logs, each with a truth of its own, and pool them; see `evaluate`.

    Logs of equal name are told apart by their folders as given.
    """
    check_options(min_visible, tolerance_s)
    if not pairs:
        raise SonarrecError("no pair of results and ground truth to score")
    tables = {path: read_truth(path) for path in {pair.ground_truth for pair in pairs}}
    named = [_named(pair, landmarks, sonar) for pair in pairs]
    once = counted_once([pair.results for pair in pairs], named)
    cases = [
        matched(pairs[i].results, tables[pairs[i].ground_truth], named[i], tolerance_s)
        for i in once.kept
    ]
    found = fit(cases)
    unused = [*found.unused, *(line for case in found.usable for line in left_out([case]))]
    names = [case.log.name for case in found.usable]
    told_apart = [
        case
        if names.count(case.log.name) == 1
        else replace(case, log=replace(case.log, name=str(case.folder)))
        for case in found.usable
    ]
    return pool(told_apart, min_visible, [*once.notes, *found.notes], [*unused, *once.unused])


def _named(pair: Pair, landmarks: str | None, sonar: Sonar | None) -> LogResults:
    log = read_log(one_log(pair.results), landmarks, sonar)
    return log if pair.log is None else replace(log, name=pair.log)


def check_options(min_visible: float, tolerance_s: float | None) -> None:
    """Raises UsageError where one of them cannot be meant."""
    if not 0 <= min_visible <= 1:
        raise UsageError(f"--min-visible is a share of the disc, 0 to 1, not {min_visible:g}")
    if tolerance_s is not None and not 0 <= tolerance_s < math.inf:
        raise UsageError(f"--tolerance is a time in seconds, 0 or more, not {tolerance_s:g}")


def pool(
    cases: Sequence[Matched],
    min_visible: float,
    notes: Sequence[str] = (),
    unused: Sequence[str] = (),
) -> Evaluation:
    """Score logs that were read, each with its truth, as one.

    notes, unused: what is to be told besides.
    Raises SonarrecError where their landmark IDs differ, or where they name no method.
    """
    logs, truths = [case.log for case in cases], [case.truth for case in cases]
    for log in logs:
        if set(log.landmarks.ids) != set(logs[0].landmarks.ids):
            raise SonarrecError(
                f"logs {logs[0].name} and {log.name} were run with different landmark IDs and "
                "cannot be pooled; evaluate them one by one, or give --landmarks"
            )
    joined = join(logs, truths, min_visible)
    notes = [*notes, *_notes(joined, logs, truths)]
    scored = tuple(
        score(joined, m, protocol)
        for m in range(len(joined.methods))
        for protocol in PROTOCOLS
        if protocol == "paper" or joined.placed
    )
    told = tuple(map(printable, notes)), tuple(map(printable, unused))
    folders = tuple(case.folder for case in cases)
    return Evaluation(joined, folders, scored, min_visible, *told)


def _notes(joined: Joined, logs: Sequence[LogResults], truths: Sequence[Truth]) -> list[str]:
    notes = []
    if not joined.methods:
        raise SonarrecError(f"{', '.join(joined.logs)}: estimates.csv names no method to score")
    if not joined.placed:
        notes.append(
            "the strict protocol is not scored: truth or estimates lack positions, or give them "
            "in pixels while neither run.toml nor flags state metres_per_pixel and apex_px"
        )
    for log, truth in zip(logs, truths, strict=True):
        if not truth.rows:
            notes.append(f"{log.name}: no row in the ground truth, so taken to hold no landmark")
        if truth.between:
            notes.append(
                f"{log.name}: {truth.between} ground-truth rows lie between frames and are passed "
                "over for others nearer in time"
            )
        missing = [m for m in joined.methods if m not in log.methods]
        if missing:
            notes.append(
                f"{log.name}: holds nothing of {', '.join(missing)}, which counts as no claim"
            )
    seen = np.bincount(joined.method_index, minlength=len(joined.methods))
    notes += [
        f"{m}: no estimate at all" for m, n in zip(joined.methods, seen, strict=True) if not n
    ]
    positives = np.bincount(
        joined.truth_landmark_index[joined.truth_positive], minlength=len(joined.ids)
    )
    for i, n in zip(joined.ids, positives, strict=True):
        if not n:
            notes.append(f"ID.{i} is never in view: its TPR is 0/0 and says nothing")
    return notes
