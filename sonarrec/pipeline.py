"""One log through the recogniser: onto disk (`sonarrec run`), or frame by frame."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from heapq import nlargest
from itertools import chain
from pathlib import Path
from typing import Any

from sonarrec.config import Config
from sonarrec.config import preset as config_of
from sonarrec.drawing import disc_width_px
from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.poses import PoseTable
from sonarrec.readers import open_log
from sonarrec.readers.find import SONAR_FILE, find_log, log_name
from sonarrec.readers.log import Log
from sonarrec.readers.plausible import Plausibility
from sonarrec.readers.poses_csv import read_poses
from sonarrec.recogniser.side_by_side import SideBySide
from sonarrec.recogniser.stage3_features.model import ModelFile, model_from_table, read_model
from sonarrec.records import (
    Clock,
    Fan,
    Frame,
    FrameResult,
    SonarrecError,
    Stamps,
    UsageError,
    shown,
)
from sonarrec.results.folders import folder_names
from sonarrec.results.run_file import Given, RunFile, held_results, read_run, run_table
from sonarrec.results.sightings import Sighting, Sightings
from sonarrec.results.sightings_file import sightings_in
from sonarrec.results.write import ResultsWriter
from sonarrec.sonar import Sonar, sonar_from

Presets = str | Config | Sequence[str | Config]
"""One preset by name or as a Config, or several to run side by side."""
POSES_FILE = "poses.csv"
"""Poses beside a log, or NAME.poses.csv, which are used where none are given."""
Observe = Callable[[FrameResult, int | None], None]
"""Told each result and the number of frames, where that is known."""


@dataclass(frozen=True, slots=True)
class Used:
    """What a log is run with."""

    configs: Sequence[Config]  # several: side by side, each under its own method name
    landmarks: str | Path | None = None  # a set by name or file; default: the earlier run's, basin
    model: Path | None = None  # of appearance; default: the earlier run's, else the built-in one
    earlier_run: Path | None = None  # a run.toml that serves where nothing else is given; a plain
    # file of settings has nothing that does, and changes nothing


MOST_SIGHTINGS = 20
"""Kept of each method in a Summary; sightings.csv has all."""


@dataclass(frozen=True, slots=True)
class Summary:
    """What became of one log.

    folder: where the results are. frames: how many were processed. unusable: how many could not
    be. problems: what could not be
    used, a line each. notes: what is stated against the log's own messages. candidates: over all
    frames. passes: how many sightings.csv has of each method that follows objects. sightings: of
    each of these the MOST_SIGHTINGS declared in the most frames, in order of first sight.
    up_to_date: these very results were there, so nothing was done.
    """

    folder: Path
    frames: int
    unusable: int
    candidates: int
    problems: list[str]
    notes: list[str]
    passes: dict[str, int]
    sightings: list[Sighting]
    up_to_date: bool = False


def run(
    log: str | Path,
    out: str | Path = "sonarrec_out",
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
    observe: Observe | None = None,
) -> Summary:
    """Recognise the landmarks in a log and write its results to `out`/<log name>/.

    log: an MCAP file, a bag of ROS, a folder or glob of images, a video or a sonar's own file.
    preset: "default",
    "offline", "paper", a Config, or several of them, side by side. landmarks: a set by name or
    TOML file, default `basin`. model: of `sonarrec calibrate`. sonar: geometry that wins over
    files, such as {"tilt_deg": 20.0} (keys and units of sonar.toml: m, deg). sonar_file: in place
    of the sonar.toml beside the log. topic: the image channel of an MCAP. time: which time of an
    MCAP's messages names a frame, "log" (default), "publish" or "header". odometry: CSV of the
    sonar's poses. frames: only those from the first number up to, not including, the second, if
    there is one; they keep their numbers. overwrite: do again what is up to date, and replace the
    results of another log of that name. observe: called after each frame with its FrameResult and
    the number of frames (None where unknown).

    Raises SonarrecError for input or settings that cannot be used; what was written stays.
    """
    given = Given(
        sonar=sonar_from(sonar),
        sonar_file=_path(sonar_file),
        topic=topic,
        time=time,
        odometry=_path(odometry),
        frames=frames,
    )
    used = Used(_configs(preset), landmarks, _path(model))
    return process(log, out, given, used, observe, overwrite=overwrite)


class Recogniser:
    """The landmarks in frames, without files: frames of a log in, their results out."""

    def __init__(
        self,
        source: Log | Fan,
        preset: Presets = "default",
        *,
        landmarks: str | Path | LandmarkSet = "basin",
        model: str | Path | None = None,
    ) -> None:
        """source: an opened log, or the fan geometry that frames of your own share.

        The rest is as in `run`. Raises SonarrecError where one of them cannot be used.
        """
        self._source = source
        self._configs = _configs(preset)
        chosen = landmarks if isinstance(landmarks, LandmarkSet) else load_landmarks(landmarks)
        self.landmarks = chosen
        self._model = None if model is None else read_model(Path(model)).model

    def recognise(self, frames: Iterable[Frame] | None = None) -> Iterator[FrameResult]:
        """A FrameResult per Frame, in the frames' order; some frames later than they come.

        frames: images (rows, columns) uint8 of one fan, by rising index; default, the log's own.
        Every call begins anew: nothing is remembered of the frames of another.
        """
        if frames is None:
            if isinstance(self._source, Fan):
                raise UsageError("a Recogniser made from a fan needs frames to recognise")
            frames = self._source
        left = iter(frames)
        first = next(left, None)
        if first is None:
            return
        fan = self._source if isinstance(self._source, Fan) else first.fan
        recogniser = SideBySide(self._configs, fan, self.landmarks, self._model)
        yield from recogniser.recognise(chain([first], left))


def result_names(logs: Sequence[str | Path]) -> list[str | None]:
    """The name of each log's results, no two alike; None where the log cannot be found.

    Raises UsageError where nothing tells two logs apart.
    """
    places: dict[int, tuple[str, Path]] = {}
    for i, log in enumerate(logs):
        with suppress(SonarrecError):  # said when its turn comes
            source = find_log(log)
            one = source.path if source.path.exists() else source.files[0].parent
            places[i] = source.name, one.resolve()
    names = dict(zip(places, folder_names(list(places.values())), strict=True))
    return [names.get(i) for i in range(len(logs))]


def process(
    path: str | Path,
    out: str | Path,
    given: Given,
    used: Used,
    observe: Observe | None = None,
    *,
    name: str | None = None,
    overwrite: bool = False,
) -> Summary:
    """Run one log and write `out`/<name>/, by default under the log's own name.

    The same results are not made again, and those of another log not replaced, but with overwrite.
    Raises SonarrecError for input or settings that cannot be used.
    """
    path = Path(path)
    earlier = read_run(used.earlier_run)
    same_log = earlier.input.name == shown(log_name(path))
    given = earlier.lay_under(given, same_log=same_log)
    given, notes = _with_companions(path, given, again=same_log)
    landmarks = earlier.landmark_set(used.landmarks)
    learned = _model(used, earlier)
    poses, more = _poses(path, given, earlier if same_log else read_run(None))
    notes += more
    with _opened(path, given) as log:
        span = given.frames or (0, None)
        frames = _within(log, span)
        first = next(frames, None)  # raises where there is no usable frame at all
        if first is None:
            raise UsageError(f"{shown(path)}: no frame lies in --frames {_told(span)}")
        recogniser = SideBySide(
            used.configs, first.fan, landmarks, learned.model if learned else None, poses
        )
        source = (shown(log.name), *log.digest_source())
        methods, tracking = recogniser.methods, recogniser.tracking
        table = run_table(
            used.configs, methods, log.stated, first.fan, landmarks, source, log.reading()
        )
        if poses is not None:
            table["odometry"] = dict(poses.source)
        if learned is not None:
            table["model"] = learned.as_table()
        table["input"]["path"] = shown(path)
        if given.frames is not None:
            table["input"]["frames"] = _told(span)
        folder = Path(out) / (name or log.name)
        if folder.resolve() == path.resolve():
            raise UsageError(f"{shown(folder)}: this is the log itself; choose another --out")
        if not overwrite:
            there = held_results(folder, table)
            if there.up_to_date:
                passes, longest = _longest(folder, tracking)
                return Summary(
                    folder,
                    there.frames,
                    there.unusable,
                    there.candidates,
                    there.problems,
                    [],
                    passes,
                    longest,
                    True,
                )
            notes += there.notes
        plausibility, sightings = Plausibility(), Sightings(first.fan, poses)
        with ResultsWriter(folder, landmarks, table, sightings) as writer:
            stamps = deque[Stamps]()  # of the frames whose results are waited for
            seen = _noted(chain([first], frames), stamps, plausibility)
            try:
                for result in recogniser.recognise(seen):
                    writer.write(result, stamps.popleft())
                    if observe is not None:
                        observe(result, _count(log, span))
            except BaseException:  # Ctrl-C as well: keep what is there
                if not writer.full:
                    for result in recogniser.waiting():
                        writer.write(result, stamps.popleft())
                raise
            problems = [*log.problems, *recogniser.problems()]
            writer.finish(problems, log.unusable)
        notes += [*log.notes, *recogniser.notes()]
        doubts = plausibility.contradictions(polar=log.sonar.layout == "polar")
        if not writer.candidates:
            doubts.append(_no_candidate(writer.frames, first.fan, landmarks))
        if doubts:
            look = f"`sonarrec info {shown(path)} --preview FILE.png`, with the same geometry"
            notes.append(f"{shown(path)}: {'; '.join(doubts)}; look at {look}")
        passes, longest = _longest(folder, tracking)
        return Summary(
            folder,
            writer.frames,
            log.unusable,
            writer.candidates,
            problems,
            notes,
            passes,
            longest,
        )


def _within(log: Log, span: tuple[int, int | None]) -> Iterator[Frame]:
    """The frames from the first number up to, not including, the second, if there is one."""
    for frame in log:
        if span[1] is not None and frame.index >= span[1]:
            break
        if frame.index >= span[0]:
            yield frame


def _told(span: tuple[int, int | None]) -> str:
    return f"{span[0]}:{'' if span[1] is None else span[1]}"


def _count(log: Log, span: tuple[int, int | None]) -> int | None:
    """How many frames lie in the span, None where the log does not tell."""
    if log.frame_count is None:
        return None
    end = log.frame_count if span[1] is None else min(span[1], log.frame_count)
    return max(end - span[0], 0)


def _noted(
    frames: Iterable[Frame], stamps: deque[Stamps], plausibility: Plausibility
) -> Iterator[Frame]:
    """The frames as they are, their times and what they show noted."""
    for frame in frames:
        stamps.append(frame.stamps)
        plausibility.look(frame)
        yield frame


def _no_candidate(frames: int, fan: Fan, landmarks: LandmarkSet) -> str:
    width = disc_width_px(fan, landmarks)
    of = f"a disc of {landmarks.name} would be {width:.0f} px wide here"
    return f"0 candidates in {frames} frames: {of}"


def _opened(path: Path, given: Given) -> Log:
    return open_log(
        path,
        sonar=given.sonar,
        sonar_file=given.sonar_file,
        topic=given.topic,
        time=given.time or "log",
        up_to=given.up_to,
    )


def _with_companions(path: Path, given: Given, again: bool) -> tuple[Given, list[str]]:
    """What is given, with the poses that lie beside the log, and a note for each file that was
    found and is not beside it, or was not asked for.

    again: the run of a run.toml is run again, with the poses it had.
    """
    source = find_log(path, given.up_to)
    notes = []
    geometry = source.beside(SONAR_FILE)
    if given.sonar_file is None and geometry != find_log(path).beside(SONAR_FILE):
        notes.append(f"{path}: its geometry is that of {geometry}")
    if again or given.odometry is not None or given.odometry_topic is not None:
        return given, notes
    poses = source.beside(POSES_FILE)
    if poses is None:
        return given, notes
    return replace(given, odometry=poses), [*notes, f"{path}: its poses are those of {poses}"]


def _model(used: Used, earlier: RunFile) -> ModelFile | None:
    """The appearance model of the file, else of the earlier run; None for the built-in one."""
    if used.model is None:
        return None if earlier.model is None else model_from_table(earlier.model, str(earlier.path))
    learned = read_model(used.model)
    if all(c.features.measurement == "single" for c in used.configs):
        raise UsageError(
            f"--model {used.model}: only features.measurement = track uses a model, and this "
            "preset measures single frames by the published one"
        )
    return learned


def _poses(path: Path, given: Given, earlier: RunFile) -> tuple[PoseTable | None, list[str]]:
    """The poses of a topic of the log, else of a table; None without either. With what to note.

    earlier: the run of this log that is run again. Raises UsageError where it had a table of poses
    that is not given again.
    """
    topic = given.odometry_topic
    if earlier.odometry and given.odometry is None and topic is None:
        topic = earlier.odometry.get("topic")
        if topic is None:
            raise UsageError(
                f"{earlier.path}: that run used the odometry {earlier.odometry.get('name')}; "
                "give it again with --odometry"
            )
    if topic is not None:
        from sonarrec.readers.mcap.poses import read_topic  # with its decompressors, where needed

        poses = read_topic(path, topic, given.time or "log")
    elif given.odometry is not None:
        poses = read_poses(given.odometry)
    else:
        return None, []
    if earlier.odometry and earlier.odometry != poses.source:
        return poses, [f"{earlier.path}: that run used another odometry than {poses.name}"]
    return poses, []


def _longest(folder: Path, methods: Sequence[str]) -> tuple[dict[str, int], list[Sighting]]:
    """`passes` and `sightings` of a Summary; methods: those that follow objects."""
    passes = dict.fromkeys(methods, 0)

    def seen(method: str) -> Iterator[Sighting]:
        for sighting in sightings_in(folder / "sightings.csv"):
            if sighting.method == method:
                passes[method] += 1
                yield sighting

    kept: list[Sighting] = []
    for method in methods:
        longest = nlargest(MOST_SIGHTINGS, seen(method), key=lambda s: s.frames_declared)
        kept += sorted(longest, key=lambda s: (s.first_frame, s.last_frame))
    return passes, kept


def _configs(presets: Presets) -> list[Config]:
    chosen = [presets] if isinstance(presets, str | Config) else presets
    return [config_of(one) if isinstance(one, str) else one for one in chosen]


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)
