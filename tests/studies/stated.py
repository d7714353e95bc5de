"""`make stated`: what it costs to state the geometry or the landmarks' size wrongly.

Every recording is rendered once, and recognised with each wrong statement in turn.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from sonarrec.config import preset
from sonarrec.evaluation.curves import Count
from sonarrec.geometry import floor_depth
from sonarrec.nouns import Frame
from sonarrec.readers.guess.height import height_from_images
from sonarrec.readers.log import SETTLING_FRAMES
from sonarrec.recogniser.three_stages import FRAMEWORK
from sonarrec.runs.frames import Recogniser
from sonarrec.simulation.motion import poses
from sonarrec.simulation.render import SimulatedFrame, render
from sonarrec.simulation.scene import Scene, scene_fan
from tests.studies.bench import three_in_view
from tests.studies.learning.random_scenes import KINDS_OF_SCENE, random_scene
from tests.studies.results.record import add_record_option, save, show
from tests.studies.scenes import seeds, told
from tests.support.simulated import Job, in_processes, recognise, score

REPORTED = range(3004, 3007)
KINDS = (*KINDS_OF_SCENE, "vehicle", "any_floor")
FRAMES = 96

Statement = Callable[[Scene, Sequence[SimulatedFrame]], Scene]
"""The scene as stated. The frames are those of the scene as it is."""


def height(times: float) -> Statement:
    """The height stated is so many times the true one."""

    def stated(scene: Scene, _: Sequence[SimulatedFrame]) -> Scene:
        error = (times - 1) * scene.sonar.height_m
        return replace(scene, sonar=replace(scene.sonar, height_error_m=error))

    return stated


def tilt(error_deg: float, *, by_images: bool = True) -> Statement:
    """No height is stated, but a tilt that is wrong by so much.

    The height then follows from the first images, as in the reader; without them the axis is taken
    to meet the floor in mid-window.
    """

    def stated(scene: Scene, frames: Sequence[SimulatedFrame]) -> Scene:
        tilted = replace(scene, sonar=replace(scene.sonar, tilt_error_deg=error_deg))
        fan = replace(scene_fan(tilted), height_m=None)
        height_m = floor_depth(fan)
        if by_images:
            images = [frame.image for frame in frames[:SETTLING_FRAMES]]
            height_m = height_from_images(images, fan) or height_m
        error_m = height_m - scene.sonar.height_m
        return replace(tilted, sonar=replace(tilted.sonar, height_error_m=error_m))

    return stated


def ranges(times: float) -> Statement:
    """All ranges are stated so many times too long, as by a wrong speed of sound."""

    def stated(scene: Scene, _: Sequence[SimulatedFrame]) -> Scene:
        sonar = scene.sonar
        return replace(
            scene,
            sonar=replace(
                sonar,
                range_min_m=times * sonar.range_min_m,
                range_max_m=times * sonar.range_max_m,
            ),
        )

    return stated


def radius(times: float) -> Statement:
    """The landmarks' radius is stated so many times too large."""

    def stated(scene: Scene, _: Sequence[SimulatedFrame]) -> Scene:
        landmarks = scene.landmark_set
        return replace(scene, landmark_set=replace(landmarks, radius_m=times * landmarks.radius_m))

    return stated


def ring_from(times: float) -> Statement:
    """The ring's inner edge is stated so many times farther out."""

    def stated(scene: Scene, _: Sequence[SimulatedFrame]) -> Scene:
        landmarks = scene.landmark_set
        return replace(
            scene, landmark_set=replace(landmarks, ring=(times * landmarks.ring[0], 1.0))
        )

    return stated


def symbol_to(times: float) -> Statement:
    """The sectors are stated to end so many times farther out."""

    def stated(scene: Scene, _: Sequence[SimulatedFrame]) -> Scene:
        landmarks = scene.landmark_set
        symbol = landmarks.symbol[0], times * landmarks.symbol[1]
        return replace(scene, landmark_set=replace(landmarks, symbol=symbol))

    return stated


STATEMENTS: dict[str, Statement] = {
    "as it is": lambda scene, _: scene,
    "height 40 % too low": height(0.6),
    "height 20 % too low": height(0.8),
    "height 20 % too high": height(1.2),
    "height 40 % too high": height(1.4),
    "no height, tilt 15 deg too small": tilt(-15),
    "no height, tilt 5 deg too small": tilt(-5),
    "no height, the true tilt": tilt(0),
    "no height, tilt 5 deg too large": tilt(5),
    "no height, tilt 10 deg too large": tilt(10),
    "the true tilt, height by mid-window": tilt(0, by_images=False),
    "tilt 5 deg too large, height by mid-window": tilt(5, by_images=False),
    "tilt 10 deg too large, height by mid-window": tilt(10, by_images=False),
    "ranges 2 % too short": ranges(0.98),
    "ranges 2 % too long": ranges(1.02),
    "ranges 5 % too long": ranges(1.05),
    "radius 20 % too small": radius(0.8),
    "radius 10 % too small": radius(0.9),
    "radius 5 % too small": radius(0.95),
    "radius 5 % too large": radius(1.05),
    "radius 10 % too large": radius(1.1),
    "radius 20 % too large": radius(1.2),
    "the ring's inner edge 10 % too far in": ring_from(0.9),
    "the ring's inner edge 5 % too far in": ring_from(0.95),
    "the ring's inner edge 5 % too far out": ring_from(1.05),
    "the ring's inner edge 10 % too far out": ring_from(1.1),
    "sectors 15 % too short": symbol_to(0.85),
    "sectors 15 % too long": symbol_to(1.15),
}


@dataclass(frozen=True, slots=True)
class Recording:
    """A scene to render, and the folder under which each statement has its own."""

    kind: str
    seed: int
    folder: Path

    def place(self, statement: str) -> Path:
        return self.folder / statement.replace(" ", "_") / f"{self.kind}_{self.seed}"


def recognise_all(recording: Recording) -> None:
    """One recording, with every statement of it."""
    scene = random_scene(recording.seed, recording.kind, frames=FRAMES)
    frames = list(render(scene))
    for name, stated in STATEMENTS.items():
        place = recording.place(name)
        recognise(Job(stated(scene, frames), place, [preset("default")]), frames)
        # Positions are compared in pixels, since a wrong statement makes other metres of them.
        truth = pd.read_csv(place / "gt.csv")
        truth.drop(columns=["range_m", "bearing_deg"]).to_csv(place / "gt.csv", index=False)


WINDOWS = 40
HEIGHTS: dict[str, Statement] = {
    "stated": STATEMENTS["as it is"],
    "by the first images": tilt(0),
    "by mid-window": tilt(0, by_images=False),
}


def window(number: int) -> Scene:
    """A pan over three landmarks near the beam's axis, in a window as a user may set it."""
    rng = np.random.default_rng(number)
    height_m, tilt_deg = rng.uniform(0.5, 2.0), rng.uniform(12, 45)
    axis_m = height_m / math.tan(math.radians(tilt_deg))
    slant_m = math.hypot(height_m, axis_m)
    near = three_in_view()
    sonar = replace(
        near.sonar,
        range_bins=600,
        range_min_m=round(float(rng.uniform(0.2, 0.6) * slant_m), 2),
        range_max_m=round(float(rng.uniform(1.5, 4.0) * slant_m), 2),
        height_m=round(height_m, 3),
        tilt_deg=round(tilt_deg, 2),
    )
    ahead = (0.85, 1.25, 1.0)
    landmarks = tuple(
        replace(one, ground_m=share * axis_m, azimuth_deg=bearing)
        for one, share, bearing in zip(near.landmarks, ahead, (-6.0, 0.0, 6.0), strict=True)
    )
    return replace(near, name=f"window_{number}", frames=32, sonar=sonar, landmarks=landmarks)


def heights(number: int) -> dict[str, tuple[float, int, int]]:
    """By HEIGHTS: height over the true one; right claims, of 32 x 3; other claims.

    A claim is right within half a disc's diameter of the landmark that it names.
    """
    scene = window(number)
    frames, found = list(render(scene)), {}
    for name, statement in HEIGHTS.items():
        fan = scene_fan(statement(scene, frames))
        near_px = scene.landmark_set.radius_m / fan.metres_per_pixel
        own = (Frame(f.index, f.timestamp_ns, f.image, fan) for f in frames)
        right = claims = 0
        for frame, result in zip(frames, Recogniser(fan).recognise(own), strict=True):
            declared = [e for e in result.estimates if e.declared and e.method == FRAMEWORK]
            claims += len(declared)
            right += sum(
                any(
                    e.landmark == one.landmark
                    and math.hypot(e.x_px - one.x_px, e.y_px - one.y_px) <= near_px
                    for e in declared
                )
                for one in frame.truth
            )
        found[name] = floor_depth(fan) / scene.sonar.height_m, right, claims - right
    return found


def told_of_windows(found: Sequence[dict[str, tuple[float, int, int]]]) -> list[dict[str, object]]:
    lines: list[dict[str, object]] = []
    for name in HEIGHTS:
        ratios, right, other = zip(*(of[name] for of in found), strict=True)
        lines.append(
            {
                "height": name,
                "over the true one, least / median / most": " / ".join(
                    f"{x:.2f}" for x in (min(ratios), np.median(ratios), max(ratios))
                ),
                "right claims, of 96, mean": f"{np.mean(right):.1f}",
                "other claims, in all": sum(other),
                "logs with fewer than 80 right": sum(n < 80 for n in right),
            }
        )
    return lines


VEHICLES = 12
CHANGES_OF_HEIGHT = (1.0, 1.5, 2.0, 2.5)


@dataclass(frozen=True, slots=True)
class Dive:
    """A vehicle's run whose height above the floor goes up and down once.

    times: the greatest height over the least; their geometric mean is stated.
    """

    seed: int
    times: float
    folder: Path

    def recognise(self) -> None:
        scene = random_scene(self.seed, "vehicle")
        turn = 2 * np.pi * np.arange(scene.frames) / scene.frames
        higher = self.times ** (0.5 * np.sin(turn + self.seed))
        path = [
            replace(pose, height_m=pose.height_m * float(by))
            for pose, by in zip(poses(scene), higher, strict=True)
        ]
        recognise(Job(scene, self.place, [preset("default")]), render(scene, path))

    @property
    def place(self) -> Path:
        return self.folder / f"height_{self.times:g}" / f"vehicle_{self.seed}"


def told_of_dives(first_seed: int, folder: Path) -> list[dict[str, object]]:
    lines: list[dict[str, object]] = []
    for times in CHANGES_OF_HEIGHT:
        dives = [Dive(first_seed + n, times, folder) for n in range(VEHICLES)]
        in_processes(Dive.recognise, dives)
        lines.append({"greatest height over least": times} | rates([dive.place for dive in dives]))
    return lines


def rates(places: Sequence[Path]) -> dict[str, object]:
    """TPR / FPR, strict, and how many false claims."""
    count: Count = next(
        s.count() for s in score(places).scored if s.protocol == "strict" and s.method == FRAMEWORK
    )
    return {
        "default": f"{told(count.tpr, '.3f')} / {told(count.fpr, '.4f')}",
        "false claims": f"{count.fp:g}",
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, recognise, score and print."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.stated", description=__doc__)
    parser.add_argument("--seeds", type=seeds, default=REPORTED, help="first:end, end left out")
    parser.add_argument("--out", type=Path, default=Path("build/stated"))
    add_record_option(parser)
    parser.add_argument("--windows", action="store_true", help="the second table alone")
    parser.add_argument("--dives", action="store_true", help="the third table alone")
    given = parser.parse_args(arguments)
    if not given.windows:
        lines = told_of_dives(100 * given.seeds.start, given.out)
        show(f"{VEHICLES} vehicles, the mean height stated", lines)
    if given.dives:
        return
    numbers = [100 * given.seeds.start + n for n in range(WINDOWS)]
    show(f"{WINDOWS} windows", told_of_windows(in_processes(heights, numbers)))
    if given.windows:
        return
    recordings = [Recording(k, s, given.out) for k, s in product(KINDS, given.seeds)]
    in_processes(recognise_all, recordings)
    show(
        f"TPR / FPR, protocol strict: {len(recordings)} recordings",
        [{"stated": n} | rates([r.place(n) for r in recordings]) for n in STATEMENTS],
    )
    save(given.record)


if __name__ == "__main__":
    main()
