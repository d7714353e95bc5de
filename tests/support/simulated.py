"""Simulated scenes through every method in memory: what `make scenes` rests on.

The results are the tables that `sonarrec run` writes, so that the project's own evaluation reads
them; only the images never touch the disk.
"""

from __future__ import annotations

import multiprocessing
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from tqdm import tqdm

from sonarrec.config import Config
from sonarrec.evaluation.counts import Counts, add_up, count_log
from sonarrec.evaluation.rows import Matched, match
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.presets.side_by_side import SideBySide
from sonarrec.recogniser.three_stages import FRAMEWORK, SMI
from sonarrec.results.read import read_log
from sonarrec.results.run_file import run_table
from sonarrec.results.write import ResultsWriter
from sonarrec.simulation.render import SimulatedFrame, render
from sonarrec.simulation.scene import Scene, scene_fan, scene_sonar
from sonarrec.simulation.truth import TRUTH_COLUMNS, truth_rows
from sonarrec.sonar.frame import Estimate, Fan, Frame
from sonarrec.sonar.geometry import polar_from_pixel
from sonarrec.truth.match import match_truth
from sonarrec.truth.table import read_truth, write_truth
from tests.studies.baseline import METHOD, HoughSmi, MajorityTracks, Settings

Item = TypeVar("Item")
Result = TypeVar("Result")
PROCESSES = 2
PRESETS = ("default", "paper", "offline")
METHODS = {
    "smi:paper": f"{SMI}:paper",
    "paper": f"{FRAMEWORK}:paper",
    "smi:default": f"{SMI}:default",
    "hough": METHOD,
    "default": f"{FRAMEWORK}:default",
    "offline": f"{FRAMEWORK}:offline",
}
"""As they are told: short name, and the one in estimates.csv. SMI is named for its candidates."""


@dataclass(frozen=True, slots=True)
class Job:
    """One scene to render, and what is to recognise it. folder: emptied, then written.

    rivals: plain Hough loops of baseline.py that judge the same frames, by their method.
    """

    scene: Scene
    folder: Path
    configs: Sequence[Config]
    rivals: Mapping[str, Settings] = field(default_factory=dict)


def recognise(job: Job, frames: Iterable[SimulatedFrame] | None = None) -> None:
    """Write frames.csv, estimates.csv, run.toml and gt.csv of one fan scene.

    frames: of the scene, where they are not to be rendered anew.
    """
    scene, landmarks, fan = job.scene, job.scene.landmark_set, scene_fan(job.scene)
    assert scene.sonar.layout == "fan"
    shutil.rmtree(job.folder, ignore_errors=True)
    recogniser = SideBySide(job.configs, fan, landmarks)
    rivals = [HoughRival(fan, landmarks, *named) for named in job.rivals.items()]
    about = scene_sonar(scene), fan, landmarks, (scene.name, 0, "")
    run = run_table(job.configs, recogniser.methods, *about)
    truth: list[list[object]] = []
    waiting = deque[list[Estimate]]()
    with ResultsWriter(job.folder, landmarks, run) as writer:

        def seen() -> Iterator[Frame]:
            for frame in frames or render(scene):
                truth.extend(truth_rows(frame.index, frame.truth))
                waiting.append([e for rival in rivals for e in rival.step(frame.image)])
                yield Frame(frame.index, frame.timestamp_ns, frame.image, fan)

        for result in recogniser.recognise(seen()):
            writer.write(replace(result, estimates=(*result.estimates, *waiting.popleft())))
        writer.finish([])
    write_truth(job.folder / "gt.csv", [*TRUTH_COLUMNS], truth)


def in_processes(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Do the work on each, e.g. `recognise` on jobs: PROCESSES at a time, on a core each."""
    with ProcessPoolExecutor(
        PROCESSES, multiprocessing.get_context("spawn"), cv2.setNumThreads, (1,)
    ) as workers:
        done = workers.map(work, items)
        return list(tqdm(done, total=len(items), unit="recording", leave=False, disable=None))


def matched(folder: Path) -> Matched:
    """What `recognise` wrote, with its truth."""
    log = read_log(folder)
    return match(log, match_truth(read_truth(folder / "gt.csv"), log))


def score(folders: Sequence[Path]) -> Counts:
    """What `recognise` wrote, by the project's own evaluation; all of the same IDs.

    Also of recordings without a landmark alone, which the command takes for a wrong truth.
    """
    return add_up([count_log(matched(folder)) for folder in folders], folders)


class HoughRival:
    """The plain Hough loop with its votes, one frame at a time."""

    def __init__(self, fan: Fan, landmarks: LandmarkSet, method: str, settings: Settings) -> None:
        self._fan, self._method, self._ids = fan, method, landmarks.ids
        self._loop = HoughSmi(fan, landmarks, settings)
        self._tracks = MajorityTracks(self._loop.settings, self._loop.radius)

    def step(self, image: np.ndarray) -> list[Estimate]:
        """It has no probabilities, and tells no orientation."""
        found = []
        for track, sight, winner, score, claim in self._tracks.step(self._loop(image)):
            polar = map(float, polar_from_pixel(self._fan, sight.x, sight.y))
            place = sight.x, sight.y, *polar, np.nan, np.nan
            said = np.full(len(self._ids) + 1, np.nan), self._ids[winner], score, claim
            found.append(Estimate(self._method, track, *place, *said))
        return found
