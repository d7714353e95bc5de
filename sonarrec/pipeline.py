"""One log through the recogniser: onto disk (`sonarrec run`), or frame by frame."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sonarrec.config import Config
from sonarrec.config import preset as config_of
from sonarrec.drawing import disc_width_px
from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.poses import PoseTable
from sonarrec.readers import open_log
from sonarrec.readers.find import find_log, log_name
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
    Origin,
    SonarrecError,
    Stamps,
    UsageError,
)
from sonarrec.results.folders import folder_names
from sonarrec.results.run_file import Given, RunFile, held_results, read_run, run_table
from sonarrec.results.sightings import Sightings
from sonarrec.results.write import ResultsWriter
from sonarrec.sonar import Sonar, sonar_from

Presets = str | Config | Sequence[str | Config]
"""One preset by name or as a Config, or several to run side by side."""
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


@dataclass(frozen=True, slots=True)
class Summary:
    """What became of one log.

    folder: where the results are. frames: how many were processed. problems: what could not be
    used, a line each. notes: what is stated against the log's own messages. sightings: what was
    declared, in lines to print. up_to_date: these very results were there, so nothing was done.
    """

    folder: Path
    frames: int
    problems: list[str]
    notes: list[str]
    sightings: list[str]
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
    overwrite: bool = False,
    observe: Observe | None = None,
) -> Summary:
    """Recognise the landmarks in a log and write its results to `out`/<log name>/.

    log: an MCAP file, a folder of images, a glob of images or a video. preset: "default",
    "offline", "paper", a Config, or several of them, side by side. landmarks: a set by name or
    TOML file, default `basin`. model: of `sonarrec calibrate`. sonar: geometry that wins over
    files, such as {"tilt_deg": 20.0} (keys and units of sonar.toml: m, deg). sonar_file: in place
    of the sonar.toml beside the log. topic: the image channel of an MCAP. time: which time of an
    MCAP's messages names a frame, "log" (default), "publish" or "header". odometry: CSV of the
    sonar's poses. overwrite: do again what is up to date, and replace the results of another log of
    that name. observe: called after each frame with its FrameResult and the number of frames
    (None where unknown).

    Raises SonarrecError for input or settings that cannot be used; what was written stays.
    """
    given = Given(
        sonar=sonar_from(sonar),
        sonar_file=_path(sonar_file),
        topic=topic,
        time=time,
        odometry=_path(odometry),
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


def result_names(
    logs: Sequence[str | Path], fetched: Mapping[int, Path] = MappingProxyType({})
) -> list[str | None]:
    """The name of each log's results, no two alike; None where the log cannot be found.

    fetched: by the number of a log on a server its path there.
    Raises UsageError where nothing tells two logs apart.
    """
    places: dict[int, tuple[str, Path]] = {}
    for i, log in enumerate(logs):
        if i in fetched:
            places[i] = log_name(fetched[i]), fetched[i]
            continue
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
    origin: Origin | None = None,
) -> Summary:
    """Run one log and write `out`/<name>/, by default under the log's own name.

    origin: where a log that was fetched is from; run.toml and every line say that, not `path`.
    The same results are not made again, and those of another log not replaced, but with overwrite.
    Raises SonarrecError for input or settings that cannot be used.
    """
    path, told = Path(path), origin.told if origin else str
    earlier = read_run(used.earlier_run)
    same_log = earlier.input.name == path.stem
    given = earlier.lay_under(given, same_log=same_log)
    landmarks = earlier.landmark_set(used.landmarks)
    learned = _model(used, earlier)
    poses, notes = _poses(path, given, earlier if same_log else read_run(None))
    with _opened(path, given) as log:
        frames = iter(log)
        first = next(frames)  # raises where there is no usable frame
        recogniser = SideBySide(
            used.configs, first.fan, landmarks, learned.model if learned else None, poses
        )
        source = (log.name, *log.digest_source())
        methods = recogniser.methods
        table = run_table(
            used.configs, methods, log.stated, first.fan, landmarks, source, log.reading()
        )
        if poses is not None:
            table["odometry"] = dict(poses.source)
        if learned is not None:
            table["model"] = learned.as_table()
        table["input"]["path"] = origin.url if origin else str(path)
        folder = Path(out) / (name or log.name)
        if not overwrite:
            there = held_results(folder, table)
            if there.up_to_date:
                return Summary(folder, there.frames, there.problems, [], [], up_to_date=True)
            notes += there.notes
        sightings = [Sightings(method) for method in recogniser.tracking]
        plausibility, candidates = Plausibility(), 0
        with ResultsWriter(folder, landmarks, table) as writer:
            for result, stamps in _results(recogniser, chain([first], frames), plausibility):
                writer.write(result, stamps)
                candidates += result.candidates
                for sighting in sightings:
                    sighting.add(result)
                if observe is not None:
                    observe(result, log.frame_count)
            problems = [told(line) for line in (*log.problems, *recogniser.problems())]
            writer.finish(problems)
        notes += [*log.notes, *recogniser.notes()]
        doubts = plausibility.contradictions(polar=log.sonar.layout == "polar")
        if not candidates:
            doubts.append(_no_candidate(writer.frames, first.fan, landmarks))
        if doubts:
            look = f"`sonarrec info {path} --preview FILE.png`, with the same geometry"
            notes.append(f"{path}: {'; '.join(doubts)}; look at {look}")
        notes = [told(note) for note in notes]
        return Summary(folder, writer.frames, problems, notes, _lines(sightings))


def _results(
    recogniser: SideBySide, frames: Iterable[Frame], plausibility: Plausibility
) -> Iterator[tuple[FrameResult, Stamps]]:
    """Every frame's result, and the log's times of that frame."""
    stamps = deque[Stamps]()  # of the frames whose results are waited for

    def stamped() -> Iterator[Frame]:
        for frame in frames:
            stamps.append(frame.stamps)
            plausibility.look(frame)
            yield frame

    for result in recogniser.recognise(stamped()):
        yield result, stamps.popleft()


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
    )


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


def _lines(sightings: Sequence[Sightings]) -> list[str]:
    """What each method declared, the methods by their names where there are several."""
    lines: list[str] = []
    for sighting in sightings:
        lines += [f"{sighting.method}:"] if len(sightings) > 1 else []
        lines += sighting.table()
    return lines


def _configs(presets: Presets) -> list[Config]:
    chosen = [presets] if isinstance(presets, str | Config) else presets
    return [config_of(one) if isinstance(one, str) else one for one in chosen]


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)
