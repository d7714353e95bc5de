"""Adapts the reader of stage 3 to labelled recordings: `sonarrec calibrate`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from sonarrec.advice.truth import FEWEST, of_positions, unchecked
from sonarrec.arrays import BoolArray, IntArray
from sonarrec.config import Config
from sonarrec.errors import (
    Diagnostics,
    SonarrecError,
    UsageError,
    command_line,
    number_of,
    printable,
)
from sonarrec.landmarks import DrawnSet, LandmarkSet
from sonarrec.learning.fit import fit, part_of
from sonarrec.learning.samples import HIDDEN, ON, Samples, Tracks, describe, label, on_a_track
from sonarrec.readers import open_log
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log
from sonarrec.recogniser.restore.beam_width import with_beams
from sonarrec.recogniser.stage3.model_file import as_toml, built_in_weights
from sonarrec.recogniser.stage3.reader import Reader, Weights
from sonarrec.recogniser.stage3.shape_matrix import rotated_codes
from sonarrec.results.folders import possible_names
from sonarrec.results.run_file import LogOptions
from sonarrec.sonar.frame import Frame
from sonarrec.tables.outputs import MODEL_MARK
from sonarrec.truth import check
from sonarrec.truth.match import Truth, match_truth
from sonarrec.truth.table import HEADER, TRUTH_FILE, TruthTable, read_truth

LEAST_MET = 0.5  # of the positions have a track on them, if the truth is that of the log
FEWEST_OF_ID = 20  # positions of an ID, on which no track is chance no longer
CLEARLY = 0.5  # belief of the built-in reader in another ID than the truth's


@dataclass(frozen=True, slots=True)
class LearningReport:
    """A learned model; lines to print on what it was learned from and how good it is; and what
    could not be used, and what the recordings do not teach."""

    model: Weights
    summary: list[str]
    diagnostics: Diagnostics

    def as_toml(self) -> str:
        """The model as a file, with what it was learned from as comments."""
        head = [
            "The last layer of the reader in stage 3, adapted to recordings (sonarrec calibrate).",
            f"{MODEL_MARK}:",
            *self.summary,
        ]
        return "".join(f"# {line}\n" for line in head) + as_toml(self.model)


def learn(
    paths: Sequence[str | Path],
    ground_truth: Path | None,
    config: Config,
    landmarks: LandmarkSet,
    log_options: LogOptions,
    *,
    observe: Callable[[], object] | None = None,
) -> LearningReport:
    """Adapt the reader to logs and their gt.csv.

    ground_truth: one for all; None: that in the folder of each log. log_options: how the logs are
    read; poses and frames do not count. observe: called at every frame.
    Raises SonarrecError if logs or truth cannot be used or hold too little.
    """
    if config.features.measurement != "track" or isinstance(landmarks, DrawnSet):
        raise UsageError(
            "the reader is adapted for discs, with features.measurement = track; drawn "
            "plates have the built-in one, and the paper's preset has the published one"
        )
    truths = [ground_truth or _truth_of_log(path) for path in paths]
    tables = {file: read_truth(file) for file in dict.fromkeys(truths)}
    for file, table in tables.items():
        if table.position is None:
            raise SonarrecError(
                f"{file}: learning needs positions; add x_px,y_px or range_m,bearing_deg"
            )
        if (many := truths.count(file)) > 1 and table.log is None:
            raise UsageError(
                f"{file}: of {many} logs, the truth needs a log column that names them"
            )
    diagnostics = Diagnostics()
    lessons: list[_Lesson] = []
    for path, file in zip(paths, truths, strict=True):
        table = tables[file]
        with open_log(path, **log_options.arguments()) as log:
            # Results are named by the log's name, with folders in front if another has the same.
            name = table.name_of(possible_names(log.name, find_log(log.path).location.resolve()))
            if name in (lesson.log for lesson in lessons):
                raise UsageError(f"{path}: a second log {name!r}; the truth tells logs by name")
            lessons.append(_lesson(table, log, name, config, landmarks, observe, diagnostics))
    used = [lesson for lesson in lessons if lesson.misfit is None]
    names = [lesson.log for lesson in lessons]
    if not any(lesson.rows for lesson in used):
        misfits = [lesson.misfit for lesson in lessons if lesson.misfit is not None]
        why = check.without_rows(file, len(table.keys), names, "it shows no landmark")
        raise SonarrecError(misfits[0] if misfits else why)
    for file, table in tables.items():
        if truths.count(file) > 1:  # of one log a truth of several is used as it is
            check.report_other_logs(diagnostics, table, names, "they teach nothing")
    return _learned(used, landmarks, diagnostics)


def _truth_of_log(path: str | Path) -> Path:
    """The truth of a log where none is named. Raises UsageError if its folder has none."""
    truth = find_log(path).companion(TRUTH_FILE)
    if truth is None:
        raise UsageError(
            f"{path}: no {TRUTH_FILE} in or beside it; label it ({HEADER}), or give --ground-truth"
        )
    return truth


@dataclass(frozen=True, slots=True)
class _Lesson:
    """What one log teaches."""

    log: str
    """Its name."""
    samples: Samples
    """Of its tracks."""
    strange: BoolArray
    """(n,) which of them lie on a stranger."""
    frames: int
    """How many were read."""
    rows: int
    """Of truth for it."""
    labelled: IntArray
    """(positions at which truth has something to be seen, landmarks: IDs, whose discs are taken for
    one), then those that a track lay on."""
    misfit: str | None
    """Why its truth cannot be that of the log, so that nothing is learned; None if it can."""


def _lesson(
    table: TruthTable,
    log: Log,
    name: str,
    config: Config,
    landmarks: LandmarkSet,
    observe: Callable[[], object] | None,
    diagnostics: Diagnostics,
) -> _Lesson:
    """Read one log, and label its tracks by the table's rows on it.

    name: of the log in the truth.
    """
    rest = iter(log)
    first = next(rest)
    (own,), beams = with_beams([config], log.beam_width_deg, first)

    def observed() -> Iterator[Frame]:
        for frame in chain([first], rest):
            if observe is not None:
                observe()
            yield frame

    tracks = describe(observed(), own, landmarks, name=name)
    truth = match_truth(table, tracks)
    strangers = match_truth(table, tracks, strangers=True)
    samples, strange = _labelled(tracks, truth, strangers)
    assert truth.position is not None
    shown = truth.visible > 0
    met = shown & on_a_track(tracks, truth.frame_index, truth.position)
    labelled = [(rows.sum(), len(np.unique(truth.landmark_index[rows]))) for rows in (shown, met)]
    misfit = check.misfit(table, tracks, truth)
    if misfit is None and shown.any() and not (samples.label < len(landmarks.ids)).any():
        # Landmarks where the truth does not have them would be learned as "none of these".
        misfit = (
            f"{table.path}: no track of {name} lies within {2 * ON * landmarks.radius_m:.3g} m of "
            f"any of its {number_of(int(shown.sum()), 'position')}; are they of this geometry?"
        )
    diagnostics.note(*(f"{name}: {line}" for line in beams))
    diagnostics.problem(*log.diagnostics.problems)
    if misfit is not None:
        diagnostics.problem(f"{misfit}; nothing is learned from {name}")
    else:
        if proposed := unchecked(table, name):
            diagnostics.note(f"{proposed}; they teach what the program takes for true already")
        again = command_line("truth", "check", table.path, Path(log.path))
        doubts = _doubts(landmarks, truth.landmark_index[shown], met[shown], samples)
        diagnostics.problem(
            *(f"{table.path}: {doubt} of {name}; is it its truth? ({again})" for doubt in doubts)
        )
        diagnostics.advise(of_positions(table, tracks, truth, again))
        check.report_rows(diagnostics, name, truth.rows, truth.between)
        if truth.unprocessed:
            diagnostics.problem(
                f"{table.path}: {truth.unprocessed} of {truth.rows} rows lie on no frame that "
                f"was read of {name}; they teach nothing"
            )
    rows, frames = truth.rows + strangers.rows, len(tracks.frame)
    return _Lesson(name, samples, strange, frames, rows, np.array(labelled), misfit)


def _doubts(
    landmarks: LandmarkSet, landmark: IntArray, met: BoolArray, samples: Samples
) -> Iterator[str]:
    """Why a truth may not be that of the log, clauses.

    landmark, met: (T,) of the positions at which something is seen; and whether a track lies there.
    """
    if met.sum() < LEAST_MET * len(met):
        yield f"only {met.sum()} of {len(met)} positions have a track on them in the frames"
    read = Reader(built_in_weights(), rotated_codes(landmarks))(samples.pictures).probabilities
    others = dict[int, int]()
    for k, name in enumerate(landmarks.ids):
        rows, own = landmark == k, samples.label == k
        if rows.sum() >= FEWEST_OF_ID and not met[rows].any():
            yield f"none of {rows.sum()} positions of ID.{name} has a track on it in the frames"
        other = int(read[own, :-1].mean(axis=0).argmax()) if own.sum() >= FEWEST else k
        if other != k and read[own, other].mean() > CLEARLY:
            others[name] = landmarks.ids[other]
    if len({*others.values()}) > 1:  # a single ID may be confused with another
        pairs = " and ".join(f"ID.{name} as ID.{other}" for name, other in others.items())
        yield f"{pairs} is read in the frames"


def _labelled(tracks: Tracks, truth: Truth, strangers: Truth) -> tuple[Samples, BoolArray]:
    """The samples of one log, and which of them lie on a stranger.

    People do not label every frame. So if a track shows a landmark in one frame, its frames without
    a label are left out: they do not count as "none of these". A row whose `visible` is 0 teaches
    nothing: scoring ignores it too.
    """
    assert truth.position is not None
    assert strangers.position is not None
    shown = strangers.visible > 0
    ids = len(tracks.landmarks.ids)
    landmark = np.where(truth.visible > 0, truth.landmark_index, HIDDEN)
    samples = label(
        tracks,
        np.append(truth.frame_index, strangers.frame_index[shown]),
        np.append(landmark, strangers.landmark_index[shown] + 1),  # not as unlabelled tracks
        np.concatenate([truth.position, strangers.position[shown]]),
    )
    other = samples.label == ids
    unsure = other & np.isin(samples.track, samples.track[samples.label < ids])
    samples = part_of(samples, ~unsure & (samples.label != HIDDEN))
    strange = samples.label > ids
    return replace(samples, label=np.minimum(samples.label, ids)), strange


def _learned(
    used: Sequence[_Lesson], landmarks: LandmarkSet, diagnostics: Diagnostics
) -> LearningReport:
    """Learn from the lessons."""
    parts = [lesson.samples for lesson in used]
    built_in, codes = built_in_weights(), rotated_codes(landmarks)
    model = fit(parts, built_in, codes)
    # They go into a comment too, where a line break in a name would end it.
    logs = ", ".join(printable(lesson.log) for lesson in used)
    frames = sum(lesson.frames for lesson in used)
    lines, unseen = [f"learned from {number_of(frames, 'frame')} of {logs}"], []
    for k, name in enumerate([*(f"ID.{i}" for i in landmarks.ids), "none of these"]):
        tracks = [p.track[p.label == k] for p in parts]
        seen, number = sum(map(len, tracks)), sum(len(np.unique(t)) for t in tracks)
        frame, track = "frame" if seen == 1 else "frames", "track" if number == 1 else "tracks"
        lines.append(f"  {name:<13} {seen:>6} {frame:<6} {number:>4} {track}")
        unseen += [name] if not seen and k < len(landmarks.ids) else []
    labelled = np.sum([lesson.labelled for lesson in used], axis=0).tolist()
    (positions, discs), (positions_met, discs_met) = labelled
    lines.append(
        f"tracks lay on {positions_met} of {number_of(positions, 'labelled position')}, and on "
        f"{discs_met} of {number_of(discs, 'landmark')} (each ID of a log counts as one)"
    )
    strange = [part_of(lesson.samples, lesson.strange) for lesson in used]
    before, after = (  # belief in any ID
        np.concatenate([1 - read(s.pictures).probabilities[:, -1] for s in strange])
        for read in (Reader(built_in, codes), Reader(model, codes))
    )
    if len(after):
        lines.append(
            f"strangers in {number_of(len(after), 'frame')}: mean belief in an ID by the built-in "
            f"model {before.mean():.3f}, learned {after.mean():.3f}"
        )
    if unseen:
        diagnostics.note(
            f"{', '.join(unseen)} never seen: all IDs share one reader, but whether it reads "
            "these is not shown"
        )
    return LearningReport(model, lines, diagnostics)
