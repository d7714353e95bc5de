"""`make pictures`: recognition in pictures as viewers, codecs and worn sonars leave them.

Every recording is rendered once, and recognised as it is and after each change to its pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from unittest.mock import patch

import cv2
import numpy as np

from sonarrec.arrays import ByteImage
from sonarrec.config import preset
from sonarrec.geometry import fan_mask
from sonarrec.nouns import Fan
from sonarrec.readers.decode.colour import LUMINANCE, find_map
from sonarrec.readers.decode.grey import single_channel
from sonarrec.recogniser.restore.saturation import Levels
from sonarrec.recogniser.restore.static_pixels import Unchanging
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import scene_fan
from tests.studies.learning.random_scenes import KINDS_OF_SCENE, random_scene
from tests.studies.results.record import options, save, show
from tests.studies.scenes import Recording, rates, strict_count
from tests.support.simulated import Job, in_processes, recognise

REPORTED = range(3001, 3004)  # 3000 was looked at while the rules were made
KINDS = (*KINDS_OF_SCENE, "vehicle", "any_floor")
FRAMES = 96
DEAD_BEAMS, OF_BEAMS = 14, 96

Pictures = list[ByteImage]
Change = Callable[[Pictures, Fan], Pictures]


def drawn_over(draw: Callable[[ByteImage, Fan], None]) -> Change:
    """The same drawing over each picture."""

    def change(pictures: Pictures, fan: Fan) -> Pictures:
        opacity = np.zeros(pictures[0].shape, np.uint8)
        draw(opacity, fan)
        share = opacity / 255.0
        return [(p * (1 - share) + 255 * share).astype(np.uint8) for p in pictures]

    return change


def grid(image: ByteImage, fan: Fan) -> None:
    """Range rings half a metre apart and bearings 5 deg apart, with smooth edges."""
    apex = (round(fan.apex_column), round(fan.apex_row))
    for range_m in np.arange(0.5, fan.range_max_m, 0.5):
        cv2.circle(image, apex, round(range_m / fan.metres_per_pixel), 255, 1, cv2.LINE_AA)
    for bearing_deg in range(-60, 61, 5):
        angle = np.radians(bearing_deg)
        end = (round(apex[0] + 3000 * np.sin(angle)), round(apex[1] - 3000 * np.cos(angle)))
        cv2.line(image, apex, end, 255, 1, cv2.LINE_AA)


def text(image: ByteImage, fan: Fan) -> None:
    at = (fan.columns // 4, fan.rows // 2)
    cv2.putText(image, "SONAR DEMO", at, cv2.FONT_HERSHEY_SIMPLEX, 1.2, 255, 2, cv2.LINE_AA)


def rings(image: ByteImage, fan: Fan) -> None:
    """Interference: five bright range bins."""
    apex = (round(fan.apex_column), round(fan.apex_row))
    for range_m in np.random.default_rng(6).uniform(fan.range_min_m, fan.range_max_m, 5):
        cv2.circle(image, apex, round(range_m / fan.metres_per_pixel), 180, 3)


def dead_beams(pictures: Pictures, fan: Fan) -> Pictures:
    row, column = np.mgrid[: fan.rows, : fan.columns]
    bearing = np.degrees(np.arctan2(column - fan.apex_column, fan.apex_row - row))
    part = (bearing - fan.bearing_min_deg) / (fan.bearing_max_deg - fan.bearing_min_deg)
    dead = np.random.default_rng(5).choice(OF_BEAMS, DEAD_BEAMS, replace=False)
    gone = np.isin(np.floor(part * OF_BEAMS), dead)
    return [np.where(gone, 0, p).astype(np.uint8) for p in pictures]


def through(name: int) -> Change:
    """Drawn in a colour map, and read as the reader does."""

    def change(pictures: Pictures, _: Fan) -> Pictures:
        drawn = [cv2.applyColorMap(p, name) for p in pictures]
        found = find_map(drawn[:3]) or LUMINANCE
        return [single_channel(p, found) for p in drawn]

    return change


def by_luminance(name: int) -> Change:
    return lambda pictures, _: [single_channel(cv2.applyColorMap(p, name)) for p in pictures]


def jpeg(quality: int) -> Change:
    def change(pictures: Pictures, _: Fan) -> Pictures:
        coded = (cv2.imencode(".jpg", p, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for p in pictures)
        return [np.asarray(cv2.imdecode(c, cv2.IMREAD_GRAYSCALE), np.uint8) for c in coded]

    return change


def within_fan(change: Callable[[ByteImage], np.ndarray]) -> Change:
    """A change to each picture, outside of the fan black all the same."""

    def change_all(pictures: Pictures, fan: Fan) -> Pictures:
        inside = fan_mask(fan) > 0
        return [np.where(inside, change(p), 0).astype(np.uint8) for p in pictures]

    return change_all


def saturated(share: float) -> Change:
    """The gain so high that this share of all echoes is drawn white."""

    def change(pictures: Pictures, _: Fan) -> Pictures:
        echoes = np.concatenate([p[p > 0][::50] for p in pictures])
        gain = 255 / np.quantile(echoes, 1 - share)
        return [np.asarray(cv2.convertScaleAbs(p, alpha=gain), np.uint8) for p in pictures]

    return change


def persistence(kept: float) -> Change:
    """A viewer's: each picture holds a share of the one before."""

    def change(pictures: Pictures, _: Fan) -> Pictures:
        found, mean = [], pictures[0].astype(float)
        for picture in pictures:
            mean = kept * mean + (1 - kept) * picture
            found.append(mean.astype(np.uint8))
        return found

    return change


CHANGES: dict[str, Change] = {
    "as they are": lambda pictures, _: pictures,
    "white grid": drawn_over(grid),
    "white text": drawn_over(text),
    "five bright range bins": drawn_over(rings),
    f"{DEAD_BEAMS} of {OF_BEAMS} beams dead": dead_beams,
    "jet": through(cv2.COLORMAP_JET),
    "viridis": through(cv2.COLORMAP_VIRIDIS),
    "a twentieth saturated": saturated(0.05),
    "a tenth saturated": saturated(0.1),
    "a fifth saturated": saturated(0.2),
    "histogram equalised": within_fan(cv2.equalizeHist),
    "JPEG, quality 20": jpeg(20),
    "16 grey levels": within_fan(lambda p: p & 0xF0),
    "gamma 2": within_fan(lambda p: 255 * (p / 255.0) ** 2),
    "blurred, 2 pixels": within_fan(lambda p: cv2.GaussianBlur(p, (0, 0), 2.0)),
    "CLAHE": within_fan(lambda p: cv2.createCLAHE(4.0, (8, 8)).apply(p)),
    "persistence .5": persistence(0.5),
    "persistence .8": persistence(0.8),
}
# Those against which the recogniser does something; they are also run without it.
NOT_RESTORED = (
    "white grid",
    "white text",
    "five bright range bins",
    f"{DEAD_BEAMS} of {OF_BEAMS} beams dead",
    "a twentieth saturated",
    "a tenth saturated",
    "a fifth saturated",
    "histogram equalised",
)
BY_LUMINANCE = {
    "jet": by_luminance(cv2.COLORMAP_JET),
    "viridis": by_luminance(cv2.COLORMAP_VIRIDIS),
}


def recognise_all(recording: Recording) -> None:
    """Every change to one recording, with and without what is done against it."""
    scene = random_scene(recording.seed, recording.kind, frames=FRAMES)
    frames, fan = list(render(scene)), scene_fan(scene)

    def recognise_changed(name: str, change: Change, part: str) -> None:
        pictures = change([f.image for f in frames], fan)
        seen = (replace(f, image=p) for f, p in zip(frames, pictures, strict=True))
        recognise(Job(scene, recording.place(f"{part}/{name}"), [preset("default")]), seen)

    for name, change in CHANGES.items():
        recognise_changed(name, change, "with")
    for name, change in BY_LUMINANCE.items():
        recognise_changed(name, change, "without")
    with (
        patch.object(Unchanging, "filled", lambda _, frames: frames),
        patch.object(Levels, "restored", lambda _, frames: frames),
    ):
        for name in NOT_RESTORED:
            recognise_changed(name, CHANGES[name], "without")


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, change, recognise, score and tell."""
    given = options("pictures", __doc__, REPORTED).parse_args(arguments)
    recordings = [Recording(k, s, given.out) for k, s in product(KINDS, given.seeds)]
    in_processes(recognise_all, recordings)

    def figures(change: str, part: str) -> str:
        """TPR / FPR, strict, and how many false claims."""
        count = strict_count([r.place(f"{part}/{change}") for r in recordings])
        return f"{rates(count)}, {count.fp:g}"

    bare = {*NOT_RESTORED, *BY_LUMINANCE}
    lines = [
        {
            "pictures": name,
            "default": figures(name, "with"),
            "not restored, by luminance": figures(name, "without") if name in bare else "",
        }
        for name in CHANGES
    ]
    show(f"TPR / FPR, protocol strict, and false claims: {len(recordings)} recordings", lines)
    save(given.record)


if __name__ == "__main__":
    main()
