"""`sonarrec simulate --background`: landmarks laid into a recording that holds none.

The recording is read once to find the sonar's path and where echoes are, then once for each layout
of discs. Only one frame is held in memory at a time. `composite` has the physics.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np

from sonarrec.arrays import BoolArray, ByteImage
from sonarrec.config import Config, preset
from sonarrec.errors import (
    SonarrecError,
    UsageError,
    name_as_text,
    number_of,
)
from sonarrec.geometry import floor_depth, slant_range
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import (
    Clock,
    Fan,
    Frame,
    Motion,
)
from sonarrec.poses import PoseTable
from sonarrec.readers.find import find_log
from sonarrec.readers.grey import DYNAMIC_RANGE_DB
from sonarrec.readers.log import Log
from sonarrec.readers.poses_csv import POSES_FILE, read_poses
from sonarrec.recogniser.beam_width import FRAMES_FOR_BEAMS, usual_beam_width_deg, with_beams
from sonarrec.recogniser.odometry import Odometry
from sonarrec.recogniser.plane import working_plane
from sonarrec.simulation.composite import Composer, LaidDisc, seen_from
from sonarrec.simulation.layout import check_room, lay_out
from sonarrec.simulation.motion import Pose
from sonarrec.simulation.truth import LandmarkTruth, truth_row, visible_share

Span = tuple[int, int | None]
OpenLog = Callable[[], Log]
"""Opens the recording again, from its first frame."""


@dataclass(frozen=True, slots=True)
class Background:
    """What the first pass found out about a recording.

    where: the recording's name for messages. path: the sonar's pose in every frame used; the first
    is at the origin. lit: (fan.rows, fan.columns) where at least half of the frames show an echo.
    unknown: number of frames whose motion neither images nor poses show; there the sonar is taken
    to have stood still. has_poses: whether the motion comes from poses. beam_width_deg: width of
    its beams, as `sonarrec run` takes it. dynamic_range_db: from black to white. problems: one line
    for each thing that could not be used.
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
    """Discs on the floor of a recording.

    landmarks: the set that they belong to. seed: of the random numbers that placed them.
    """

    landmarks: LandmarkSet
    discs: tuple[LaidDisc, ...]
    seed: int

    @property
    def landmark_count(self) -> int:
        """How many of the discs are landmarks; the others are fakes."""
        return sum(disc.kind == "landmark" for disc in self.discs)


@dataclass(frozen=True, slots=True)
class DiscLook:
    """How discs look at any contrast.

    plate_db: level of the plate between ring and sectors above the floor. beam_width_deg: width of
    the beams that smear them.
    """

    plate_db: float
    beam_width_deg: float


class _Survey:
    """What the first pass over a recording gathers, frame by frame.

    path: the sonar's pose in each frame so far. stamps: their times, ns. unknown: of these frames
    how many have no known motion. The first frame has none and does not count.
    """

    def __init__(
        self,
        first: Frame,
        where: str,
        landmarks: LandmarkSet,
        config: Config,
        poses: PoseTable | None,
    ) -> None:
        """Raises SonarrecError if a disc has no room in the fan of the first frame."""
        check_room(first.fan, landmarks, where)
        choice, radius = config.candidates, landmarks.radius_m
        self._fan = first.fan
        self._plane = working_plane(choice.plane, first.fan, radius, choice.disc_radius_px)
        self._echoes = np.zeros(first.image.shape, dtype=np.int64)
        self.odometry = Odometry(self._plane, config.continuity, poses)
        self.path: list[Pose] = []
        self.stamps: list[int] = []
        self.unknown = 0

    def add(self, frame: Frame) -> None:
        """Take in the next frame."""
        image = self._plane.warp(frame.pixels, frame.polar)
        motion = self.odometry.step(image, frame.timestamp_ns)
        self.unknown += (motion is None or not motion.known) and bool(self.path)
        before = self.path[-1] if self.path else None
        self.path.append(_moved(before, motion, floor_depth(self._fan)))
        self.stamps.append(frame.timestamp_ns)
        self._echoes += frame.image > 0

    def lit(self) -> BoolArray:
        """(fan.rows, fan.columns) where at least half of the frames show an echo."""
        return self._echoes * 2 >= len(self.path)

    def period_ns(self) -> float:
        """Median time from frame to frame, ns; 0 with a single frame."""
        return float(np.median(np.diff(self.stamps))) if len(self.stamps) > 1 else 0.0


def survey(
    open_: OpenLog,
    landmarks: LandmarkSet,
    config: Config,
    poses: PoseTable | None = None,
    span: Span = (0, None),
    step: Callable[..., None] | None = None,
) -> Background:
    """Read a recording once, for the sonar's path.

    config: says how the motion is measured; if it does not measure it, `default` does. It may also
    state the beam width. poses: if given, the
    motion is taken from them, not measured between the images. step: called after each frame with
    the number of frames, or None if that is unknown.
    Raises SonarrecError if the recording cannot be used or has no room for a disc in view.
    """
    with open_() as log:
        where = name_as_text(log.path)
        frames = log.within(span)
        begin = [*islice(frames, FRAMES_FOR_BEAMS)]
        if not begin:
            raise UsageError(
                f"{where}: no frame lies in --frames {span[0]}:{span[1] or ''}{log.why_none()}"
            )
        fan = begin[0].fan
        # `paper` does not measure the motion, but discs lie on the floor whatever runs there later.
        measuring = config if config.continuity.motion == "image" else preset("default")
        gathered = _Survey(begin[0], where, landmarks, measuring, poses)
        for frame in chain(begin, frames):
            gathered.add(frame)
            if step:
                step(log.frame_count)
        stated_db, stated_hz = log.dynamic_range_db, log.sonar.frame_rate_hz
        (own,), beams = with_beams([config], log.beam_width_deg, begin)
        notes = [*log.notes, *gathered.odometry.notes(), *(f"{where}: {line}" for line in beams)]
        problems = [*log.problems, *gathered.odometry.problems()]
    notes += _doubts(where, stated_db, gathered.unknown, len(gathered.path))
    period_ns = gathered.period_ns()
    return Background(
        where=where,
        open=open_,
        span=span,
        fan=fan,
        path=tuple(gathered.path),
        lit=gathered.lit(),
        rate_hz=1e9 / period_ns if period_ns > 0 else stated_hz or 1.0,
        unknown=gathered.unknown,
        has_poses=poses is not None,
        beam_width_deg=own.features.beam_width_deg or usual_beam_width_deg(fan),
        dynamic_range_db=stated_db or DYNAMIC_RANGE_DB,
        notes=tuple(notes),
        problems=tuple(problems),
    )


def poses_of(
    path: str | Path, odometry: Path | None, topic: str | None, time: Clock = "log"
) -> PoseTable | None:
    """The poses from a topic of the recording, a table, or else the poses.csv beside it.

    None if there are none. Raises SonarrecError if they cannot be used.
    """
    if topic is not None:
        from sonarrec.readers.mcap.poses import read_topic  # with its decompressors, where needed

        return read_topic(Path(path), topic, time)
    file = odometry or find_log(path).beside(POSES_FILE)
    return None if file is None else read_poses(file)


def draw_layout(
    background: Background, landmarks: LandmarkSet, seed: int, count: int | None = None
) -> Layout:
    """Lay discs at random places of the floor that the recording shows.

    count: see `layout.lay_out`. The same seed gives the same layout. Raises SonarrecError if there
    is room for no landmark.
    """
    rng = np.random.default_rng([seed, 17])
    fan, path, lit = background.fan, background.path, background.lit
    layout = Layout(landmarks, tuple(lay_out(fan, path, lit, landmarks, rng, count)), seed)
    if not layout.landmark_count:
        raise SonarrecError(
            f"{background.where}: no place on the floor shows echoes over a whole disc of radius_m "
            f"= {landmarks.radius_m:g}; see whether the geometry is right: sonarrec info --preview"
        )
    return layout


def without_room(layouts: Sequence[Layout], count: int | None) -> list[str]:
    """A line if a layout has fewer landmarks than were asked for. count: None if none was."""
    least = min(layout.landmark_count for layout in layouts)
    if count is None or least >= count:
        return []
    where = " in a layout" if len(layouts) > 1 else ""
    return [f"there was room for only {least} of {number_of(count, 'landmark')}{where}"]


@dataclass(frozen=True, slots=True)
class ComposedFrame:
    """One frame with discs. images: by contrast (dB). truth: rows of gt.csv, in layout order."""

    index: int
    images: dict[float, ByteImage]
    truth: tuple[LandmarkTruth, ...]


def compose(
    background: Background, layout: Layout, look: DiscLook, contrasts: Sequence[float]
) -> Iterator[ComposedFrame]:
    """Yield the recording's frames with the discs of a layout, at each contrast.

    contrasts: levels of ring and sectors above the floor, dB.
    """
    composer = Composer(
        background.fan, layout.landmarks, background.dynamic_range_db, look.beam_width_deg
    )
    for frame in background.frames():
        pose = background.path[frame.index]
        image = frame.image
        surface = composer.surface(image)
        shapes = [composer.footprint(disc, pose) for disc in layout.discs]
        in_view = [shape for shape in shapes if shape is not None]
        images = {db: composer.lay(image, surface, in_view, db, look.plate_db) for db in contrasts}
        yield ComposedFrame(frame.index, images, truth_of(background, layout, frame.index))


def truth_of(background: Background, layout: Layout, frame: int) -> tuple[LandmarkTruth, ...]:
    """The landmarks that are at least partly in view in a frame, in the layout's order."""
    pose = background.path[frame]
    rows = (_truth(disc, pose, background.fan, layout.landmarks) for disc in layout.discs)
    return tuple(row for row in rows if row is not None)


def _doubts(where: str, stated_db: float | None, unknown: int, frames: int) -> list[str]:
    """Notes on what is assumed about a recording.

    stated_db: its dynamic range, None if it states none. unknown: see Background. frames: in all.
    """
    doubts = []
    if stated_db is None:
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
    """The pose after a motion. The motion first carries the sonar, then turns it.

    before: None at the first frame, which is the origin.
    """
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
    """The row of gt.csv; None for a fake and for a landmark that is out of view."""
    if disc.kind != "landmark":
        return None
    share = round(visible_share(fan, pose, disc.x_m, disc.y_m, landmarks.radius_m), 4)
    if share == 0:
        return None
    ground, bearing = seen_from(disc, pose)
    slant = float(slant_range(fan, ground))
    turn = disc.orientation_deg + pose.pan_deg
    return LandmarkTruth(disc.landmark, *truth_row(fan, (slant, bearing), share, turn))
