"""`make stated`: what it costs to state the geometry or the landmarks' size wrongly.

Every recording is rendered once, and recognised with each wrong statement in turn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import pandas as pd

from sonarrec.config import preset
from sonarrec.geometry import floor_depth
from sonarrec.readers.guess.height import height_from_images
from sonarrec.readers.log import SETTLING_FRAMES
from sonarrec.simulation.render import SimulatedFrame, render
from sonarrec.simulation.scene import Scene, scene_fan
from tests.studies.learning.random_scenes import KINDS_OF_SCENE, random_scene
from tests.studies.results.record import options, save, show
from tests.studies.scenes import Recording, rates, strict_count
from tests.support.simulated import Job, in_processes, recognise

REPORTED = range(3004, 3007)
KINDS = (*KINDS_OF_SCENE, "vehicle", "any_floor")
FRAMES = 96

Statement = Callable[[Scene, Sequence[SimulatedFrame]], Scene]
"""The scene as stated. The frames are those of the scene as it is."""


def with_sonar(scene: Scene, **changes: float) -> Scene:
    return replace(scene, sonar=replace(scene.sonar, **changes))


def height(times: float) -> Statement:
    """The height stated is so many times the true one."""
    return lambda scene, _: with_sonar(scene, height_error_m=(times - 1) * scene.sonar.height_m)


def tilt(error_deg: float) -> Statement:
    """A tilt that is wrong by so much, and no height: it follows from the first images."""

    def stated(scene: Scene, frames: Sequence[SimulatedFrame]) -> Scene:
        tilted = with_sonar(scene, tilt_error_deg=error_deg)
        fan = replace(scene_fan(tilted), height_m=None)
        images = [frame.image for frame in frames[:SETTLING_FRAMES]]
        height_m = height_from_images(images, fan) or floor_depth(fan)
        return with_sonar(tilted, height_error_m=height_m - scene.sonar.height_m)

    return stated


def ranges(times: float) -> Statement:
    """All ranges are stated so many times too long, as by a wrong speed of sound."""
    return lambda scene, _: with_sonar(
        scene,
        range_min_m=times * scene.sonar.range_min_m,
        range_max_m=times * scene.sonar.range_max_m,
    )


def discs(radius: float = 1, ring: float = 1, sectors: float = 1) -> Statement:
    """The radius, the ring's inner edge and the sectors' end are stated so many times too large."""

    def stated(scene: Scene, _: Sequence[SimulatedFrame]) -> Scene:
        true = scene.landmark_set
        told = replace(
            true,
            radius_m=radius * true.radius_m,
            ring=(ring * true.ring[0], true.ring[1]),
            symbol=(true.symbol[0], sectors * true.symbol[1]),
        )
        return replace(scene, landmark_set=told)

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
    "ranges 2 % too short": ranges(0.98),
    "ranges 2 % too long": ranges(1.02),
    "ranges 5 % too long": ranges(1.05),
    "radius 20 % too small": discs(radius=0.8),
    "radius 10 % too small": discs(radius=0.9),
    "radius 5 % too small": discs(radius=0.95),
    "radius 5 % too large": discs(radius=1.05),
    "radius 10 % too large": discs(radius=1.1),
    "radius 20 % too large": discs(radius=1.2),
    "the ring's inner edge 10 % too far in": discs(ring=0.9),
    "the ring's inner edge 5 % too far in": discs(ring=0.95),
    "the ring's inner edge 5 % too far out": discs(ring=1.05),
    "the ring's inner edge 10 % too far out": discs(ring=1.1),
    "sectors 15 % too short": discs(sectors=0.85),
    "sectors 15 % too long": discs(sectors=1.15),
}


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


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, recognise, score and print."""
    given = options("stated", __doc__, REPORTED).parse_args(arguments)
    recordings = [Recording(k, s, given.out) for k, s in product(KINDS, given.seeds)]
    in_processes(recognise_all, recordings)
    show(
        f"TPR / FPR, protocol strict: {len(recordings)} recordings",
        [
            {"stated": name, "default": rates(count), "false claims": f"{count.fp:g}"}
            for name in STATEMENTS
            for count in [strict_count([r.place(name) for r in recordings])]
        ],
    )
    save(given.record)


if __name__ == "__main__":
    main()
