"""One log through the recogniser and onto disk: `sonarrec run`, for programs as well."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from sonarrec.config import Config
from sonarrec.landmarks import landmarks_from_table, load_landmarks
from sonarrec.readers import open_log
from sonarrec.readers.poses_csv import read_poses
from sonarrec.recogniser.side_by_side import SideBySide
from sonarrec.recogniser.stage3_features.model import model_from_table, read_model
from sonarrec.records import Clock, FrameResult, SonarrecError, Stamps, UsageError
from sonarrec.results.run_file import read_run, run_table
from sonarrec.results.sightings import Sightings
from sonarrec.results.write import ResultsWriter
from sonarrec.sonar import Sonar, sonar_from_table


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
    sonar = sonar or Sonar()
    used: dict[str, Any] = {}  # the odometry of the earlier run
    learned = None if model is None else read_model(model)
    if earlier_run is not None:
        table = read_run(earlier_run)
        if "sonar" in table and sonar_file is None:
            sonar = sonar_from_table(table["sonar"], str(earlier_run)).updated(sonar)
        earlier = table.get("input", {})
        if earlier.get("name") == Path(path).stem:
            topic, time = topic or earlier.get("topic"), time or earlier.get("time")
            used = table.get("odometry", {})
            if odometry is None:
                odometry_topic = odometry_topic or used.get("topic")
            if used and odometry is None and odometry_topic is None:
                raise UsageError(
                    f"{earlier_run}: that run used the odometry {used.get('name')}; "
                    "give it again with --odometry"
                )
        if learned is None and "model" in table:
            learned = model_from_table(table["model"], str(earlier_run))
    if earlier_run is not None and landmarks is None and "landmarks" in table:
        landmark_set = landmarks_from_table(table["landmarks"], f"{earlier_run}: [landmarks]")
    else:
        landmark_set = load_landmarks(landmarks or "basin")
    poses = None if odometry is None else read_poses(odometry)
    if odometry_topic is not None:
        from sonarrec.readers.mcap_poses import read_topic  # with its decompressors, where needed

        poses = read_topic(Path(path), odometry_topic, time or "log")
    notes = []
    if poses is not None and used and used != poses.source:
        notes.append(f"{earlier_run}: that run used another odometry than {poses.name}")
    with open_log(path, sonar=sonar, sonar_file=sonar_file, topic=topic, time=time or "log") as log:
        frames = iter(log)
        first = next(frames, None)
        if first is None:
            told = f" ({'; '.join(log.problems[:3])})" if log.problems else ""
            raise SonarrecError(f"{path}: no usable frame{told}")
        configs = [settings] if isinstance(settings, Config) else list(settings)
        if model is not None and all(c.features.measurement == "single" for c in configs):
            raise UsageError(
                f"--model {model}: only features.measurement = track uses a model, and this preset "
                "measures single frames by the published one"
            )
        recogniser = SideBySide(
            configs, first.fan, landmark_set, learned.model if learned else None, poses
        )
        source = (log.name, *log.digest_source())
        run = run_table(configs, log.stated, first.fan, landmark_set, source, log.reading())
        if poses is not None:
            run["odometry"] = dict(poses.source)
        if learned is not None:
            run["model"] = learned.as_table()
        sightings = [Sightings(method) for method in recogniser.methods]
        stamps = deque[Stamps]()
        with ResultsWriter(out / log.name, landmark_set, run) as writer:

            def take(results: Iterable[FrameResult]) -> None:
                for result in results:
                    writer.write(result, stamps.popleft())
                    for sighting in sightings:
                        sighting.add(result)
                    if observe is not None:
                        observe(result, log.frame_count)

            try:
                for frame in chain([first], frames):
                    stamps.append(frame.stamps)
                    take(recogniser.step(frame))
            finally:  # whatever breaks off, what only waited to be judged is written
                take(recogniser.judge())
            take(recogniser.finish())
            problems = [*log.problems, *recogniser.problems()]
            writer.finish(problems)
        lines: list[str] = []
        for sighting in sightings:
            lines += [f"{sighting.method}:"] if len(sightings) > 1 else []
            lines += sighting.table()
        notes += [*log.notes, *recogniser.notes()]
        return Summary(out / log.name, writer.frames, problems, notes, lines)
