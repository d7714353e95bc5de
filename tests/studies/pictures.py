"""`make pictures`: recognition in pictures as viewers, codecs and worn sonars leave them.

Every recording is rendered once, and recognised as it is and after each change to its pictures.
`python -m tests.studies.pictures --as-they-are --seeds 2730:2738` tells instead in how many
recordings of every kind, none of their pictures changed, a pixel is taken for drawn or dead, or a
picture for saturated or equalised. `--outlines --seeds 7100:7102` tells how well the outline of the
fan is found in pictures of every kind after each change.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np

from sonarrec.arrays import ByteImage
from sonarrec.config import preset
from sonarrec.evaluation.curves import Count
from sonarrec.geometry import fan_mask
from sonarrec.nouns import Fan, Frame
from sonarrec.readers.decode.colour import LUMINANCE, find_map
from sonarrec.readers.decode.grey import single_channel
from sonarrec.readers.guess.outline import find_outline
from sonarrec.readers.guess.plausible import FRAMES as LOOKED_AT
from sonarrec.recogniser.restore.saturation import Levels
from sonarrec.recogniser.restore.static_pixels import Unchanging
from sonarrec.recogniser.three_stages import FRAMEWORK
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import scene_fan
from tests.studies.learning.random_scenes import ALL_KINDS, KINDS_OF_SCENE, random_scene
from tests.studies.results.record import add_record_option, save, show
from tests.studies.scenes import seeds, told
from tests.support.simulated import Job, in_processes, recognise, score

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


@dataclass(frozen=True, slots=True)
class Recording:
    """A scene to render, and the folder under which each change to it has its own."""

    kind: str
    seed: int
    folder: Path

    def place(self, change: str, part: str) -> Path:
        return self.folder / part / change.replace(" ", "_") / f"{self.kind}_{self.seed}"


def recognise_all(recording: Recording) -> None:
    """Every change to one recording, with and without what is done against it."""
    scene = random_scene(recording.seed, recording.kind, frames=FRAMES)
    frames, fan = list(render(scene)), scene_fan(scene)

    def recognise_changed(name: str, change: Change, part: str) -> None:
        pictures = change([f.image for f in frames], fan)
        seen = (replace(f, image=p) for f, p in zip(frames, pictures, strict=True))
        recognise(Job(scene, recording.place(name, part), [preset("default")]), seen)

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


def restored(recording: Recording) -> tuple[float, int]:
    """Of pictures as they are: the largest share of the fan that is filled at any time, and how
    many of them are taken for saturated or equalised."""
    scene = random_scene(recording.seed, recording.kind, frames=FRAMES)
    fan, unchanging, levels = scene_fan(scene), Unchanging(), Levels(scene.landmark_set.radius_m)
    frames = (Frame(f.index, f.timestamp_ns, f.image, fan) for f in render(scene))
    most = max(unchanging.share for _ in levels.restored(unchanging.filled(frames)))
    return most, levels.saturated + levels.equalised


def outlines(recording: Recording) -> dict[str, tuple[float, float] | None]:
    """By change, of the fan's outline in the mean of the first frames: how far its apex and its far
    end are from where they are, in lengths of the fan, NaN for a far end that does not show; None
    if none is found."""
    scene = random_scene(recording.seed, recording.kind, frames=LOOKED_AT)
    fan, pictures = scene_fan(scene), [f.image for f in render(scene)]
    far_px = fan.range_max_m / fan.metres_per_pixel
    off: dict[str, tuple[float, float] | None] = {}
    for name, change in CHANGES.items():
        found = find_outline(np.mean(change(pictures, fan), axis=0))
        off[name] = None
        if found is not None:
            across, along = found.apex_column - fan.apex_column, found.apex_row - fan.apex_row
            far = math.nan if found.far_px is None else found.far_px / far_px - 1
            off[name] = math.hypot(across, along) / far_px, far
    return off


def show_outlines(found: Sequence[dict[str, tuple[float, float] | None]]) -> None:
    """A row for each change: how many outlines were found, and how far off they are at most."""
    lines: list[dict[str, str]] = []
    for name in CHANGES:
        off = np.array([one[name] for one in found if one[name] is not None]).reshape(-1, 2)
        with_end = np.count_nonzero(~np.isnan(off[:, 1]))
        most = np.nanmax(off, axis=0) if with_end else (math.nan, math.nan)
        lines.append(
            {
                "pictures": name,
                "outline found": f"{len(off)} of {len(found)}",
                "with its far end": str(with_end),
                "apex off by at most": told(most[0], ".3f"),
                "far end too far by at most": told(most[1], ".3f"),
            }
        )
    show("The fan's outline, lengths in those of the fan", lines)


def rates(recordings: Sequence[Recording], change: str, part: str) -> str:
    """TPR / FPR, strict, and how many false claims."""
    found = score([r.place(change, part) for r in recordings])
    count: Count = next(
        s.count() for s in found.scored if s.protocol == "strict" and s.method == FRAMEWORK
    )
    return f"{told(count.tpr, '.3f')} / {told(count.fpr, '.4f')}, {count.fp:g}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, change, recognise, score and tell."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.pictures", description=__doc__)
    parser.add_argument("--seeds", type=seeds, default=REPORTED, help="first:end, end left out")
    parser.add_argument("--out", type=Path, default=Path("build/pictures"))
    add_record_option(parser)
    parser.add_argument("--as-they-are", action="store_true", help="what is filled of these")
    parser.add_argument("--outlines", action="store_true", help="how well the fan is found")
    given = parser.parse_args(arguments)
    recordings = [Recording(k, s, given.out) for k, s in product(ALL_KINDS, given.seeds)]
    if given.outlines:
        show_outlines(in_processes(outlines, recordings))
        return
    if given.as_they_are:
        found = in_processes(restored, recordings)
        for recording, (share, pictures) in zip(recordings, found, strict=True):
            if share or pictures:
                print(
                    f"{recording.kind}, seed {recording.seed}: {share:.2%} of the fan filled, "
                    f"{pictures} of {FRAMES} pictures given other levels"
                )
        print(f"{sum(f != (0, 0) for f in found)} of {len(recordings)} recordings")
        return
    recordings = [Recording(k, s, given.out) for k, s in product(KINDS, given.seeds)]
    in_processes(recognise_all, recordings)
    bare = {*NOT_RESTORED, *BY_LUMINANCE}
    lines = [
        {
            "pictures": name,
            "default": rates(recordings, name, "with"),
            "not restored, by luminance": rates(recordings, name, "without")
            if name in bare
            else "",
        }
        for name in CHANGES
    ]
    show(f"TPR / FPR, protocol strict, and false claims: {len(recordings)} recordings", lines)
    save(given.record)


if __name__ == "__main__":
    main()
