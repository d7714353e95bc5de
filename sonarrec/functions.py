"""What `import sonarrec` offers beside single functions of the rooms: the commands, for programs.

They write what the commands write, and give tables: pandas DataFrames with the columns of files.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from io import StringIO
from pathlib import Path
from typing import Any, overload

import pandas as pd

from sonarrec.errors import UsageError, local, number_of
from sonarrec.evaluation import compare as comparing
from sonarrec.evaluation.comparison import Comparison
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.match import scoring_options
from sonarrec.evaluation.pairs import read_pairs
from sonarrec.evaluation.tables import Evaluation
from sonarrec.mapping.build import MapOptions, make_map
from sonarrec.mapping.path import Drift
from sonarrec.mapping.write import MAP_COLUMNS, PASS_COLUMNS, map_rows, pass_rows, write_all
from sonarrec.nouns import Clock
from sonarrec.results.run_file import LogOptions, frame_span, span_text
from sonarrec.runs import cores
from sonarrec.runs.frames import Presets, configs_of
from sonarrec.runs.logs_table import COLUMNS, LogsTable, Row
from sonarrec.runs.many import Watch, run_apart, run_here
from sonarrec.runs.one import Observe, Summary, process, result_names
from sonarrec.runs.prepare import RunOptions
from sonarrec.runs.task import Outcome, Task
from sonarrec.sonar import Sonar, sonar_from

AnyPath = str | Path


@dataclass(frozen=True, slots=True, repr=False)
class Runs:
    """How the runs of several logs went."""

    folder: Path
    """That which holds the results of each."""
    rows: tuple[Row, ...]
    """As in logs.csv."""
    summaries: tuple[Summary, ...]
    """Of the logs that have results now."""

    @property
    def table(self) -> pd.DataFrame:
        """A row for each log, as in logs.csv; `message` says why one failed."""
        return pd.DataFrame(map(astuple, self.rows), columns=list(COLUMNS))

    def __iter__(self) -> Iterator[Summary]:
        return iter(self.summaries)

    def __repr__(self) -> str:
        failed = len(self.rows) - len(self.summaries)
        frames = sum(summary.frames for summary in self.summaries)
        done = f"{number_of(len(self.summaries), 'log')}, {number_of(frames, 'frame')}"
        return f"<{self.folder}: {done}{f'; {failed} failed' * bool(failed)}>"


@overload
def run(log: AnyPath, out: AnyPath = ..., **options: Any) -> Summary: ...
@overload
def run(log: Sequence[AnyPath], out: AnyPath = ..., **options: Any) -> Runs: ...


def run(  # type: ignore[misc]  # the overloads leave out what both have
    log: AnyPath | Sequence[AnyPath],
    out: AnyPath = "sonarrec_out",
    *,
    preset: Presets = "default",
    landmarks: str | Path | None = None,
    model: str | Path | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    sonar_file: str | Path | None = None,
    topic: str | None = None,
    time: Clock | None = None,
    odometry: str | Path | None = None,
    frames: tuple[int, int | None] | None = None,
    overwrite: bool = False,
    jobs: int | None = None,
    observe: Observe | None = None,
) -> Summary | Runs:
    """Recognise the landmarks in a log, or in each of several; results go to `out`/<log name>/.

    One log gives its Summary. Several give Runs, and one that cannot be used does not stop the
    others.

    log: an MCAP file, a bag of ROS, a folder or glob of images, a video or a sonar's own file.
    preset: "default", "offline", "paper", a Config, or several, each of a name of its own.
    landmarks: a set by name or TOML file, default `basin`. model: of `sonarrec calibrate`. sonar:
    geometry that wins over files, such as {"tilt_deg": 20.0} (keys and units of sonar.toml: m,
    deg). sonar_file: in place of the sonar.toml beside the log. topic: the image channel of an
    MCAP or bag. time: which time of its messages names a frame, "log" (default), "publish" or
    "header". odometry: CSV of the sonar's poses. frames: only those from the first number up to,
    not including, the second, if there is one; they keep their numbers. overwrite: do again what is
    up to date, and replace the results of another log of that name. jobs: how many logs
    run at once; default: the number of cores. observe: called after each frame of a single log with
    its FrameResult and the number of frames (None where unknown).

    Raises SonarrecError for input or settings that cannot be used; what was written stays.
    """
    log_options = LogOptions(
        sonar=sonar_from(sonar),
        sonar_file=None if sonar_file is None else Path(sonar_file),
        topic=topic,
        time=time,
        odometry=None if odometry is None else Path(odometry),
        # By the text that run.toml will hold: what it could not give back is refused.
        frames=None if frames is None else frame_span(span_text(frames)),
    )
    learned = None if model is None else Path(model)
    run_options = RunOptions(configs_of(preset), landmarks, learned)
    if isinstance(log, str | Path):
        return process(log, local(out), log_options, run_options, observe, overwrite=overwrite)
    if observe is not None:
        raise UsageError("observe is for a single log")
    logs = [*map(str, log)]
    tasks = [
        Task(path, name, str(local(out)), log_options, run_options, overwrite)
        for path, name in zip(logs, result_names(logs), strict=True)
    ]
    watch = _Watch(LogsTable(Path(out), tasks))
    jobs = min(jobs or cores(), len(tasks))
    if jobs > 1:
        run_apart(tasks, jobs, watch)
    else:
        run_here(tasks, watch)
    watch.table.write()
    outcomes = [watch.outcomes[i] for i in range(len(tasks))]
    summaries = tuple(o.summary for o in outcomes if o.summary is not None)
    errors = [o.error for o in outcomes if o.error is not None]
    if not summaries and errors:
        raise errors[0]
    return Runs(Path(out), watch.table.rows, summaries)


class _Watch(Watch):
    """Keeps the outcomes, and logs.csv."""

    def __init__(self, table: LogsTable) -> None:
        self.table, self.outcomes = table, dict[int, Outcome]()

    def started(self, i: int) -> None:
        self.table.started(i)

    def frames(self, i: int, done: int, total: int | None) -> None:  # noqa: ARG002
        self.table.frames(i, done)

    def ended(self, i: int, outcome: Outcome) -> None:
        self.table.ended(i, outcome)
        self.outcomes[i] = outcome


def evaluate(
    results: AnyPath = "sonarrec_out",
    ground_truth: AnyPath | None = None,
    *,
    pairs: AnyPath | None = None,
    method: str | Sequence[str] = (),
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    within_m: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    jobs: int | None = 1,
    out: AnyPath | None = None,
) -> Evaluation:
    """Score results, of one log or of several, against ground truth.

    `table` of the result has a row per method; figures, intervals and tests are those of the
    command. ground_truth: one table; default: the NAME.gt.csv, or gt.csv, beside each log. pairs: a
    CSV that names results and truth of each log, in place of both. out: a folder for the files;
    default: none is written. Of several results of one recording the first counts.

    A claim is an estimate that is declared (operating point) or whose score reaches the
    threshold (curves). A row with visible 0 is no row.

    Protocol "paper", per frame and ID: in view and claimed = TP, each further claim of it one TP
    more; in view and not claimed = FN; not in view and claimed, however often, = FP; else TN.
    Position plays no part. Half a disc or more is in view, anything less is not: as in the paper,
    every frame counts. Count.tpr_once is the TPR without the further claims.

    Protocol "strict": a landmark with visible >= min_visible is a positive; with less it is
    ignored. A claim belongs to the truth of its ID that is nearest in that frame, if
    its centre is within half a disc diameter, or within_m, of it in the fan plane. The first claim
    of a positive (the one of highest score) is TP; every further one, and every claim that belongs
    to no truth, is FP. A positive without a claim is FN, even if its ID is claimed elsewhere
    (FN and FP). Claims of a partly visible landmark are not counted. TN: a frame and ID of which
    nothing shows and which is not claimed. So an FP replaces a TN the first time an absent ID is
    claimed in a frame, and is an entry of its own otherwise: FPR = FP / (FP + TN) stays within
    0 to 1 and no false claim is free.

    method: one or several to score; default: all, the framework first.
    jobs: how many logs are read at once, each in its own process.
    Raises SonarrecError where files cannot be used or have no frame in common.
    """
    scoring = scoring_options(method, min_visible, tolerance_s, landmarks, sonar, within_m)
    logs = str(results) if pairs is None else read_pairs(Path(pairs))
    found = evaluate_logs(logs, ground_truth, scoring, jobs=jobs)
    if out is not None:
        from sonarrec.evaluation.write import write_evaluation  # brings matplotlib

        write_evaluation(Path(local(out)), found)
    return found


def compare(
    old: AnyPath,
    new: AnyPath,
    ground_truth: AnyPath | None = None,
    *,
    pairs: AnyPath | None = None,
    jobs: int | None = 1,
    **scoring: Any,
) -> Comparison:
    """What got better or worse from old to new results, each of one log or of several.

    `verdict` of the result says it in a sentence; `table` has a row per method, `figures` all rates
    with their tests, `changes` every frame and ID that is counted otherwise. Nothing is written.
    ground_truth: one table; default: that beside each log. pairs: a CSV that names the truth of
    each log. scoring: as `evaluate` takes it, `method` to `sonar`.
    """
    truth = read_pairs(Path(pairs)) if pairs else Path(ground_truth) if ground_truth else None
    options, sides = scoring_options(**scoring), (Path(old), Path(new))
    return comparing.compare(*sides, truth, options, jobs=jobs)


@dataclass(frozen=True, slots=True, repr=False)
class LandmarkMap:
    """Where the landmarks of a site lie."""

    landmarks: pd.DataFrame
    """A row for each, as in map.csv."""
    passes: pd.DataFrame
    """A row for each pass, as in passes.csv."""
    logs: int
    notes: tuple[str, ...]
    unused: tuple[str, ...]
    """Input that could not be used, a line each."""

    def __repr__(self) -> str:
        found = number_of(len(self.landmarks), "landmark")
        return f"<map of {found} from {number_of(self.logs, 'log')}>"


def map_landmarks(
    results: AnyPath | Sequence[AnyPath] = "sonarrec_out",
    out: AnyPath | None = None,
    *,
    odometry: AnyPath | Sequence[AnyPath] = (),
    drift: tuple[float, float] = (0.0, 0.0),
    method: str | None = None,
    landmarks: str | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    min_frames: int = 3,
) -> LandmarkMap:
    """Map the landmarks of one log or of several, each one once.

    out: a folder for the files of `sonarrec map`; default: none is written. odometry: tables of
    poses. drift: standard error of the poses after one minute, m and deg.
    """
    geometry = sonar_from(sonar)
    site = make_map(
        _paths(results),
        MapOptions(_paths(odometry), Drift(*drift), method, landmarks, geometry, min_frames),
    )
    if out is not None:
        write_all(Path(local(out)), site)
    found = _table(MAP_COLUMNS, map_rows(site)), _table(PASS_COLUMNS, pass_rows(site))
    told = site.diagnostics
    return LandmarkMap(*found, len(site.logs), tuple(told.notes), tuple(told.problems))


def _table(header: Iterable[str], rows: Iterable[Iterable[object]]) -> pd.DataFrame:
    """The cells of a CSV as numbers where they are numbers."""
    text = StringIO()
    csv.writer(text).writerows([header, *rows])
    text.seek(0)
    return pd.read_csv(text, dtype={"log": str})


def _paths(paths: AnyPath | Sequence[AnyPath]) -> list[Path]:
    return [Path(paths)] if isinstance(paths, str | Path) else [*map(Path, paths)]
