"""One log through the recogniser and onto disk: `sonarrec run`, for programs as well."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from sonarrec.config import Config
from sonarrec.poses import PoseTable
from sonarrec.readers import open_log
from sonarrec.readers.poses_csv import read_poses
from sonarrec.recogniser.side_by_side import SideBySide
from sonarrec.recogniser.stage3_features.model import ModelFile, model_from_table, read_model
from sonarrec.records import Clock, Frame, FrameResult, Stamps, UsageError
from sonarrec.results.run_file import Stated, lay_under, run_table
from sonarrec.results.sightings import Sightings
from sonarrec.results.write import ResultsWriter
from sonarrec.sonar import Sonar


@dataclass(frozen=True, slots=True)
class Summary:
    """What became of one log: where the results are, what could not be used, and what was stated
    against the log's own messages."""

    folder: Path
    frames: int
    problems: list[str]
    notes: list[str]
    sightings: list[str]


def process(
    path: str | Path,
    out: Path,
    settings: Config | Sequence[Config],
    *,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
    sonar_file: Path | None = None,
    earlier_run: Path | None = None,
    topic: str | None = None,
    time: Clock | None = None,
    odometry: Path | None = None,
    odometry_topic: str | None = None,
    model: Path | None = None,
    observe: Callable[[FrameResult, int | None], None] | None = None,
) -> Summary:
    """Run one log and write `out`/<log name>/.

    settings: several are run side by side, each under its own method name.
    sonar: geometry that wins over every file. time: which of the log's times names a frame,
    default its log time. earlier_run: a run.toml whose geometry and landmark set, and whose topic
    and time if it was of this log, serve where nothing else is given; a plain settings file has
    none of them and changes nothing. odometry: a table of the sonar's poses (see poses.py).
    odometry_topic: the topic of the log that has them, in place of a table.
    model: an appearance model (stage3_features/model.py), default that of the earlier run, else
    the built-in one.
    observe: told each result and the number of frames, where that is known. Raises SonarrecError
    for input or settings that cannot be used.
    """
    stated = lay_under(
        earlier_run,
        Path(path).stem,
        landmarks=landmarks,
        sonar=sonar or Sonar(),
        sonar_file=sonar_file,
        topic=topic,
        time=time,
        odometry=odometry,
        odometry_topic=odometry_topic,
    )
    configs = [settings] if isinstance(settings, Config) else list(settings)
    learned = _model(model, configs, stated, earlier_run)
    clock = stated.time or "log"
    poses = _poses(Path(path), odometry, stated.odometry_topic, clock)
    notes = []
    if poses is not None and stated.odometry and stated.odometry != poses.source:
        notes.append(f"{earlier_run}: that run used another odometry than {poses.name}")
    with open_log(
        path, sonar=stated.sonar, sonar_file=sonar_file, topic=stated.topic, time=clock
    ) as log:
        frames = iter(log)
        first = next(frames)  # raises where there is no usable frame
        recogniser = SideBySide(
            configs, first.fan, stated.landmarks, learned.model if learned else None, poses
        )
        source = (log.name, *log.digest_source())
        methods = recogniser.methods
        run = run_table(
            configs, methods, log.stated, first.fan, stated.landmarks, source, log.reading()
        )
        if poses is not None:
            run["odometry"] = dict(poses.source)
        if learned is not None:
            run["model"] = learned.as_table()
        sightings = [Sightings(method) for method in recogniser.tracking]
        stamps = deque[Stamps]()
        with ResultsWriter(out / log.name, stated.landmarks, run) as writer:

            def stamped(frames: Iterable[Frame]) -> Iterator[Frame]:
                for frame in frames:
                    stamps.append(frame.stamps)
                    yield frame

            for result in recogniser.recognise(stamped(chain([first], frames))):
                writer.write(result, stamps.popleft())
                for sighting in sightings:
                    sighting.add(result)
                if observe is not None:
                    observe(result, log.frame_count)
            problems = [*log.problems, *recogniser.problems()]
            writer.finish(problems)
        notes += [*log.notes, *recogniser.notes()]
        return Summary(out / log.name, writer.frames, problems, notes, _lines(sightings))


def _model(
    path: Path | None, configs: Sequence[Config], stated: Stated, earlier_run: Path | None
) -> ModelFile | None:
    """The appearance model of the file, else of the earlier run; None for the built-in one."""
    if path is None:
        return None if stated.model is None else model_from_table(stated.model, str(earlier_run))
    learned = read_model(path)
    if all(c.features.measurement == "single" for c in configs):
        raise UsageError(
            f"--model {path}: only features.measurement = track uses a model, and this preset "
            "measures single frames by the published one"
        )
    return learned


def _poses(log: Path, table: Path | None, topic: str | None, time: Clock) -> PoseTable | None:
    """The poses of a topic of the log, else of a table; None without either."""
    if topic is not None:
        from sonarrec.readers.mcap.poses import read_topic  # with its decompressors, where needed

        return read_topic(log, topic, time)
    return None if table is None else read_poses(table)


def _lines(sightings: Sequence[Sightings]) -> list[str]:
    """What each method declared, the methods by their names where there are several."""
    lines: list[str] = []
    for sighting in sightings:
        lines += [f"{sighting.method}:"] if len(sightings) > 1 else []
        lines += sighting.table()
    return lines
