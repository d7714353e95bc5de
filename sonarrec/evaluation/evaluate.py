"""Results and truth to an Evaluation, of one folder, of several or of a table of pairs."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sonarrec.evaluation.joined import Joined, join
from sonarrec.evaluation.scoring import PROTOCOLS, Scored, score
from sonarrec.records import SonarrecError, UsageError, printable
from sonarrec.results.read import LogResults, find_logs, read_log
from sonarrec.sonar import Sonar
from sonarrec.tables import line_number, read_table
from sonarrec.truth.match import Truth, match_truth
from sonarrec.truth.table import TruthTable, read_truth


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What `evaluate` found."""

    joined: Joined
    scored: tuple[Scored, ...]
    """Every method under every protocol."""
    min_visible: float
    notes: tuple[str, ...]
    """Worth knowing."""
    unused: tuple[str, ...]
    """Input that could not be used, one line each."""


@dataclass(frozen=True, slots=True)
class Pair:
    """The results folder of one log and the truth that goes with it."""

    results: Path
    ground_truth: Path
    log: str | None = None
    """The log's name, where the folder's own is not wanted; the log column of the truth is matched
    with it."""


def evaluate(
    results: str | Path,
    ground_truth: str | Path,
    *,
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
) -> Evaluation:
    """Score a results folder (of one log, or of several) against gt.csv.

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
    results, ground_truth = Path(results), Path(ground_truth)
    check_options(min_visible, tolerance_s)
    table = read_truth(ground_truth)
    folders = find_logs(results)
    logs = [read_log(folder, landmarks, sonar) for folder in folders]
    if len(logs) > 1 and table.log is None:
        raise SonarrecError(
            f"{ground_truth}: {results} holds {len(logs)} logs "
            f"({', '.join(log.name for log in logs)}), so the truth needs a log column that "
            "names their folders; or give the folder of one log"
        )
    truths = [match_truth(table, log, tolerance_s) for log in logs]
    unused = _unused(table, logs, truths, single=folders == [results])
    return pool(logs, truths, min_visible, unused)


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
    logs: list[LogResults] = []
    truths: list[Truth] = []
    unused: list[str] = []
    seen: dict[str, Path] = {}
    for pair in pairs:
        folders = find_logs(pair.results)
        if folders != [pair.results]:
            raise SonarrecError(
                f"{pair.results}: holds {len(folders)} logs; give each a row of its own"
            )
        log = read_log(pair.results, landmarks, sonar)
        log = log if pair.log is None else replace(log, name=pair.log)
        table = tables[pair.ground_truth]
        logs.append(log)
        truths.append(match_truth(table, log, tolerance_s))
        unused += _unused(table, logs[-1:], truths[-1:], single=True)
        first = seen.setdefault(_identity(pair.results, log), pair.results)
        if first is not pair.results:
            raise SonarrecError(
                f"{pair.results}: the same results as {first}, once more; pooled they would count "
                "as two independent logs, so name each log once"
            )
    names = [log.name for log in logs]
    if len(set(names)) < len(names):
        logs = [
            log if names.count(log.name) == 1 else replace(log, name=str(pair.results))
            for log, pair in zip(logs, pairs, strict=True)
        ]
    return pool(logs, truths, min_visible, unused)


def _identity(folder: Path, log: LogResults) -> str:
    """Tells results from others by what the files hold: a link, or a copy, is the same."""
    digest = hashlib.sha256()
    for name in ("run.toml", "frames.csv", "estimates.csv"):
        if (folder / name).is_file():
            with (folder / name).open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
    # Two logs in which nothing was found may be alike; run.toml tells one from the other.
    if not len(log.frame_index) and not (folder / "run.toml").is_file():
        digest.update(str((folder / "estimates.csv").resolve()).encode())
    return digest.hexdigest()


def read_pairs(path: Path) -> list[Pair]:
    """Read a table of pairs: columns results, ground_truth and, if wanted, log.

    Paths are taken from the folder of the table. Raises SonarrecError where it cannot be used.
    """
    columns = ("results", "ground_truth")
    table = read_table(path, dict.fromkeys((*columns, "log"), "text"), columns, ",".join(columns))
    logs = [str(log) for log in table["log"]] if "log" in table else [None] * len(table["results"])
    for row, names in enumerate(zip(*(table[c] for c in columns), strict=True)):
        for name in map(str, names):
            try:
                (path.parent / name).stat()
            except (FileNotFoundError, NotADirectoryError):
                continue  # told where it is read
            except (OSError, ValueError) as error:  # too long, or with a NUL byte
                where = f"{path} line {line_number(path, row)}"
                raise SonarrecError(f"{where}: no path, {name[:40]!r} ({error})"[:300]) from None
    return [
        Pair(path.parent / str(results), path.parent / str(truth), log)
        for results, truth, log in zip(*(table[c] for c in columns), logs, strict=True)
    ]


def check_options(min_visible: float, tolerance_s: float | None) -> None:
    """Raises UsageError where one of them cannot be meant."""
    if not 0 <= min_visible <= 1:
        raise UsageError(f"--min-visible is a share of the disc, 0 to 1, not {min_visible:g}")
    if tolerance_s is not None and not 0 <= tolerance_s < math.inf:
        raise UsageError(f"--tolerance is a time in seconds, 0 or more, not {tolerance_s:g}")


def pool(
    logs: Sequence[LogResults],
    truths: Sequence[Truth],
    min_visible: float,
    unused: Sequence[str] = (),
) -> Evaluation:
    """Score logs that were read, each with its truth, as one.

    Raises SonarrecError where their landmark IDs differ, or where they name no method.
    """
    for log in logs:
        if set(log.landmarks.ids) != set(logs[0].landmarks.ids):
            raise SonarrecError(
                f"logs {logs[0].name} and {log.name} were run with different landmark IDs and "
                "cannot be pooled; evaluate them one by one, or give --landmarks"
            )
    joined = join(logs, truths, min_visible)
    notes = _notes(joined, logs, truths)
    scored = tuple(
        score(joined, m, protocol)
        for m in range(len(joined.methods))
        for protocol in PROTOCOLS
        if protocol == "paper" or joined.placed
    )
    return Evaluation(joined, scored, min_visible, notes, tuple(map(printable, unused)))


def _unused(
    table: TruthTable, logs: list[LogResults], truths: list[Truth], single: bool
) -> tuple[str, ...]:
    """One line per part of the input that was left out; SonarrecError where no truth is left."""
    said = []
    rows = sum(t.rows for t in truths)
    elsewhere = len(table.at) - rows
    lost = sum(t.unprocessed for t in truths) + (0 if single else elsewhere)
    frames = sum(len(log.frame) for log in logs)
    if len(table.at) and not rows:
        raise SonarrecError(
            f"{table.path}: its log column names none of {', '.join(log.name for log in logs)}"
        )
    if rows and not any(len(t.frame_index) for t in truths):
        raise SonarrecError(
            f"{table.path}: none of its {rows} rows ({table.key} {table.at.min()} to "
            f"{table.at.max()}) lies on a processed frame ({frames} frames, "
            f"{logs[0].frame[0]} to {logs[-1].frame[-1]}); is this the truth of another log?"
        )
    if lost:
        said.append(
            f"{table.path}: {lost} of {len(table.at)} rows lie on frames that were not processed; "
            f"they are not scored (the {frames} frames processed are)"
        )
    for log in logs:
        if not log.finished:
            said.append(
                f"{log.name}: the run was cut short (run.toml says finished = false); "
                f"only its {len(log.frame)} frames are scored"
            )
        if log.strays:
            said.append(
                f"{log.name}: {log.strays} estimates lie on frames that frames.csv does not list; "
                "they are not scored"
            )
    return tuple(said)


def _notes(joined: Joined, logs: Sequence[LogResults], truths: Sequence[Truth]) -> tuple[str, ...]:
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
    return tuple(map(printable, notes))
