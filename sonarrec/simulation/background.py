"""`sonarrec simulate --background`: landmarks laid into a recording that holds none.

The recording is read once for the sonar's path and for where echoes are, and once for each layout
of discs that is laid into it; only one frame is held at a time. `composite` has the physics.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.config import Config
from sonarrec.files.outputs import write_csv, writing
from sonarrec.geometry import floor_depth, slant_range
from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.poses import PoseTable
from sonarrec.readers.find import find_log
from sonarrec.readers.grey import DYNAMIC_RANGE_DB
from sonarrec.readers.log import Log
from sonarrec.readers.poses_csv import POSES_FILE, read_poses
from sonarrec.recogniser.beam_width import FRAMES_FOR_BEAMS, usual_beam_width_deg, with_beams
from sonarrec.recogniser.odometry import Odometry
from sonarrec.recogniser.plane import working_plane
from sonarrec.records import (
    BoolArray,
    ByteImage,
    Clock,
    Fan,
    Frame,
    Motion,
    SonarrecError,
    UsageError,
    name_as_text,
)
from sonarrec.simulation.composite import Composer, LaidDisc, seen_from
from sonarrec.simulation.layout import check_room, lay_out
from sonarrec.simulation.motion import Pose
from sonarrec.simulation.simulate import LandmarkTruth, truth_row, visible_share, write_image
from sonarrec.sonar import Sonar

Span = tuple[int, int | None]
OpenLog = Callable[[], Log]
"""Opens the recording anew, from its first frame."""


@dataclass(frozen=True, slots=True)
class Background:
    """What the first pass found out of a recording.

    where: names it. path: the sonar's pose in every frame used, the first at the origin. lit:
    (fan.rows, fan.columns) where at least half of the frames show an echo. unknown: frames whose
    motion neither images nor poses told; the sonar is taken to have stood still. has_poses: whether
    poses told the motion. beam_width_deg: of its beams, as a run takes it. dynamic_range_db: from
    black to white. problems: a line for each thing that could not be used.
    """

    where: str
    open: OpenLog
    span: Span
    fan: Fan
    path: tuple[Pose, ...]
    lit: BoolArray
    rate_hz: float
    unknown: int
    has_poses: bool
    beam_width_deg: float
    dynamic_range_db: float
    notes: tuple[str, ...]
    problems: tuple[str, ...]

    def frames(self) -> Iterator[Frame]:
        """The frames again, numbered from 0."""
        with self.open() as log:
            for number, frame in enumerate(log.within(self.span)):
                if number == len(self.path):  # it has grown since
                    return
                yield replace(frame, index=number)


@dataclass(frozen=True, slots=True)
class Layout:
    """Discs on the floor of a recording. seed: that they were drawn by."""

    discs: tuple[LaidDisc, ...]
    seed: int

    @property
    def landmarks(self) -> int:
        """How many are landmarks; the others are fakes."""
        return sum(disc.kind == "landmark" for disc in self.discs)


def survey(
    open_: OpenLog,
    landmarks: LandmarkSet,
    config: Config,
    poses: PoseTable | None = None,
    span: Span = (0, None),
    step: Callable[..., None] | None = None,
) -> Background:
    """Read a recording for its path.

    config: by which the motion is measured, and which may state the beams' width. poses: where they
    tell the motion, it is not measured in the images. step: called after each frame with the number
    of frames, None where unknown.
    Raises SonarrecError where the recording cannot be used, or has no room for a disc in view.
    """
    with open_() as log:
        where = name_as_text(log.path)
        odometry: Odometry | None = None
        path: list[Pose] = []
        stamps: list[int] = []
        echoes = np.zeros(0)
        unknown = 0
        frames = log.within(span)
        begin = [*islice(frames, FRAMES_FOR_BEAMS)]
        for frame in chain(begin, frames):
            if odometry is None:
                fan = frame.fan
                check_room(fan, landmarks, where)
                choice, radius = config.candidates, landmarks.radius_m
                plane = working_plane(choice.plane, fan, radius, choice.disc_radius_px)
                odometry = Odometry(plane, config.continuity, poses)
                echoes = np.zeros(frame.image.shape, dtype=np.int64)
            motion = odometry.step(plane.warp(frame.pixels, frame.polar), frame.timestamp_ns)
            unknown += (motion is None or not motion.known) and bool(path)
            path.append(_moved(path[-1] if path else None, motion, floor_depth(fan)))
            stamps.append(frame.timestamp_ns)
            echoes += frame.image > 0
            if step:
                step(log.frame_count)
        if odometry is None:
            raise UsageError(f"{where}: no frame lies in --frames {span[0]}:{span[1] or ''}")
        stated = log.dynamic_range_db
        rate = log.sonar.frame_rate_hz
        (own,), beams = with_beams([config], log.beam_width_deg, begin)
        notes = [*log.notes, *odometry.notes(), *(f"{where}: {line}" for line in beams)]
        problems = [*log.problems, *odometry.problems()]
    usual = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    notes += _doubts(where, stated, unknown, len(path))
    return Background(
        where=where,
        open=open_,
        span=span,
        fan=fan,
        path=tuple(path),
        lit=echoes * 2 >= len(path),
        rate_hz=1e9 / usual if usual > 0 else rate or 1.0,
        unknown=unknown,
        has_poses=poses is not None,
        beam_width_deg=own.features.beam_width_deg or usual_beam_width_deg(fan),
        dynamic_range_db=stated or DYNAMIC_RANGE_DB,
        notes=tuple(notes),
        problems=tuple(problems),
    )


def poses_of(
    path: str | Path, odometry: Path | None, topic: str | None, time: Clock = "log"
) -> PoseTable | None:
    """The poses of a table, or of a topic of the recording, else of the poses.csv beside it.

    Raises SonarrecError where they cannot be used.
    """
    if topic is not None:
        from sonarrec.readers.mcap.poses import read_topic  # with its decompressors, where needed

        return read_topic(Path(path), topic, time)
    file = odometry or find_log(path).beside(POSES_FILE)
    return None if file is None else read_poses(file)


def draw_layout(
    background: Background, landmarks: LandmarkSet, seed: int, count: int | None = None
) -> Layout:
    """Discs at random on the floor that the recording shows; the same seed gives the same.

    count: as layout.lay_out. Raises SonarrecError where not one landmark finds room.
    """
    rng = np.random.default_rng([seed, 17])
    fan, path, lit = background.fan, background.path, background.lit
    layout = Layout(tuple(lay_out(fan, path, lit, landmarks, rng, count)), seed)
    if not layout.landmarks:
        raise SonarrecError(
            f"{background.where}: no place on the floor shows echoes over a whole disc of radius_m "
            f"= {landmarks.radius_m:g}; see whether the geometry is right: sonarrec info --preview"
        )
    return layout


@dataclass(frozen=True, slots=True)
class ComposedFrame:
    """One frame with discs. images: by contrast (dB). truth: of gt.csv, in the layout's order."""

    index: int
    images: dict[float, ByteImage]
    truth: tuple[LandmarkTruth, ...]


def compose(
    background: Background,
    layout: Layout,
    landmarks: LandmarkSet,
    contrasts: Sequence[float],
    plate_db: float,
    beam_width_deg: float,
) -> Iterator[ComposedFrame]:
    """The recording's frames with the discs of a layout, at each contrast.

    contrasts, plate_db: of ring and sectors, and of the plate, over the floor, dB.
    """
    fan = background.fan
    composer = Composer(fan, landmarks, background.dynamic_range_db, beam_width_deg)
    for frame in background.frames():
        pose = background.path[frame.index]
        surface = composer.surface(frame.image)
        shapes = [composer.footprint(disc, pose) for disc in layout.discs]
        there = [shape for shape in shapes if shape is not None]
        images = {db: composer.lay(frame.image, surface, there, db, plate_db) for db in contrasts}
        yield ComposedFrame(
            frame.index, images, truth_of(background, layout, landmarks, frame.index)
        )


def truth_of(
    background: Background, layout: Layout, landmarks: LandmarkSet, frame: int
) -> tuple[LandmarkTruth, ...]:
    """The landmarks of which something shows in a frame, in the layout's order."""
    pose = background.path[frame]
    rows = (_truth(disc, pose, background.fan, landmarks) for disc in layout.discs)
    return tuple(row for row in rows if row is not None)


def check_free(folders: Sequence[Path]) -> None:
    """Raises SonarrecError where one of the folders holds anything."""
    for folder in folders:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise SonarrecError(f"{folder}: already exists and is not empty; choose another --out")


def write_backgrounds(
    background: Background,
    layout: Layout,
    landmarks: LandmarkSet,
    folders: Mapping[float, Path],
    plate_db: float,
    beam_width_deg: float,
    step: Callable[[], None] | None = None,
) -> None:
    """Write a recording for each contrast: NNNNNN.png, sonar.toml, gt.csv and background.toml.

    folders: by contrast (dB); none may hold anything. Where poses told the motion, poses.csv; of
    another landmark set than basin, landmarks.toml. step: called after each frame. Raises
    SonarrecError where a folder is in use or cannot be written.
    """
    import tomli_w  # only writers of TOML need it

    check_free([*folders.values()])
    with writing(", ".join(map(str, folders.values()))):
        truth: list[list[Any]] = []
        for folder in folders.values():
            folder.mkdir(parents=True, exist_ok=True)
        tables = {
            db: (folder / "gt.csv").open("w", newline="", encoding="utf-8")
            for db, folder in folders.items()
        }
        try:
            writers = [csv.writer(file, lineterminator="\n") for file in tables.values()]
            for writer in writers:
                writer.writerow(["frame", *(f.name for f in fields(LandmarkTruth))])
            for one in compose(background, layout, landmarks, [*folders], plate_db, beam_width_deg):
                for db, folder in folders.items():
                    write_image(folder / f"{one.index:06d}.png", one.images[db])
                truth = [[one.index, *asdict(row).values()] for row in one.truth]
                for writer in writers:
                    writer.writerows(truth)
                if step:
                    step()
        finally:
            for file in tables.values():
                file.close()
        for db, folder in folders.items():
            if background.has_poses:
                _write_poses(folder / "poses.csv", background)
            if landmarks != load_landmarks("basin"):
                text = tomli_w.dumps(landmarks.as_table())
                (folder / "landmarks.toml").write_text(text, encoding="utf-8", newline="")
            document = _told(background, layout, landmarks, db, plate_db, beam_width_deg)
            (folder / "background.toml").write_text(
                tomli_w.dumps(document), encoding="utf-8", newline=""
            )
            # Last: a folder without geometry is not taken for a whole recording.
            sonar = {"sonar": _sonar(background).as_table()}
            (folder / "sonar.toml").write_text(tomli_w.dumps(sonar), encoding="utf-8", newline="")


def _doubts(where: str, stated: float | None, unknown: int, frames: int) -> list[str]:
    """What is assumed of a recording. stated: its dynamic range, dB. unknown: see Background."""
    doubts = []
    if stated is None:
        doubts.append(
            f"{where}: grey is taken as {DYNAMIC_RANGE_DB:g} dB from black to white; state "
            "dynamic_range_db where the sonar's is another, for contrasts go by it"
        )
    if unknown:
        doubts.append(
            f"{where}: the motion into {unknown} of {frames} frames could not be measured; "
            "discs stay where they were in the picture there, so give --odometry if it moved"
        )
    return doubts


def _moved(before: Pose | None, motion: Motion | None, height_m: float) -> Pose:
    """The pose after a motion as the recogniser has it: carried first, then turned."""
    if before is None:
        return Pose(0.0, height_m, 0.0, 0.0)
    if motion is None:
        return before
    heading = math.radians(before.pan_deg)
    cos, sin = math.cos(heading), math.sin(heading)
    return Pose(
        before.pan_deg + motion.pan_deg,
        height_m,
        before.x_m + motion.right_m * cos + motion.ahead_m * sin,
        before.y_m - motion.right_m * sin + motion.ahead_m * cos,
    )


def _truth(disc: LaidDisc, pose: Pose, fan: Fan, landmarks: LandmarkSet) -> LandmarkTruth | None:
    """The row of gt.csv, None of a fake and where nothing shows."""
    if disc.kind != "landmark":
        return None
    share = round(visible_share(fan, pose, disc.x_m, disc.y_m, landmarks.radius_m), 4)
    if share == 0:
        return None
    ground, bearing = seen_from(disc, pose)
    slant = float(slant_range(fan, ground))
    turn = disc.orientation_deg + pose.pan_deg
    return LandmarkTruth(disc.landmark, *truth_row(fan, (slant, bearing), share, turn))


def _sonar(background: Background) -> Sonar:
    """The geometry of what is written: fan images whose grey is settled."""
    fan = background.fan
    low, high = fan.bearing_min_deg, fan.bearing_max_deg
    even = math.isclose(-low, high, abs_tol=1e-9)
    quarter = (high - low) / 4
    return Sonar(
        layout="fan",
        range_min_m=fan.range_min_m,
        range_max_m=fan.range_max_m,
        field_of_view_deg=high - low if even else None,
        # Two beams whose outer edges are the fan's.
        bearings_deg=None if even else (low + quarter, high - quarter),
        tilt_deg=fan.tilt_deg,
        height_m=fan.height_m,
        frame_rate_hz=background.rate_hz,
        metres_per_pixel=fan.metres_per_pixel,
        apex_px=(fan.apex_column, fan.apex_row),
        pixel_scale="linear",
        dynamic_range_db=background.dynamic_range_db,
    )


def _write_poses(path: Path, background: Background) -> None:
    rows = (
        [round(n * 1e9 / background.rate_hz), *(round(v, 6) for v in (p.pan_deg, p.x_m, p.y_m))]
        for n, p in enumerate(background.path)
    )
    write_csv(path, ["timestamp_ns", "yaw", "x", "y"], rows)


def _told(
    background: Background,
    layout: Layout,
    landmarks: LandmarkSet,
    contrast_db: float,
    plate_db: float,
    beam_width_deg: float,
) -> dict[str, Any]:
    """background.toml: how the recording was made, and where every disc lies."""
    first, end = background.span
    return {
        "background": {
            "log": background.where,
            "frames": f"{first}:{'' if end is None else end}",
            "landmark_set": landmarks.name,
            "contrast_db": contrast_db,
            "plate_db": plate_db,
            "beam_width_deg": beam_width_deg,
            "dynamic_range_db": background.dynamic_range_db,
            "seed": layout.seed,
            "motion": "told by poses" if background.has_poses else "measured between the images",
            "motion_unknown": background.unknown,
        },
        "disc": [
            {k: round(v, 5) if isinstance(v, float) else v for k, v in asdict(disc).items()}
            for disc in layout.discs
        ],
    }
