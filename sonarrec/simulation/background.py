"""`sonarrec simulate --background`: landmarks laid into a recording that holds none.

The recording is read once to find the sonar's path and where echoes are (`survey`), then once for
each layout of discs (`background_files`). Only one frame is held in memory at a time. `composite`
has the physics.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np

from sonarrec.arrays import BoolArray
from sonarrec.config import Config, preset
from sonarrec.errors import Diagnostics, SonarrecError, UsageError, name_as_text
from sonarrec.geometry import STEEPEST, floor_depth, ground_range
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Clock, Fan, Frame, Motion
from sonarrec.poses import PoseTable
from sonarrec.readers.decode.grey import DYNAMIC_RANGE_DB
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log
from sonarrec.readers.poses_csv import POSES_FILE, read_poses
from sonarrec.recogniser.motion.odometry import Odometry
from sonarrec.recogniser.plane import working_plane
from sonarrec.recogniser.restore.beam_width import usual_beam_width_deg, with_beams
from sonarrec.simulation.motion import Pose
from sonarrec.simulation.truth import visible_share

WHOLE = 0.99  # share of a disc's area from which it counts as whole in view
Span = tuple[int, int | None]
OpenLog = Callable[[], Log]  # opens the recording again, from its first frame


@dataclass(frozen=True, slots=True)
class Background:
    """What the first pass found out about a recording.

    where: the recording's name for messages. path: the sonar's pose in every frame used; the first
    is at the origin. lit: (fan.rows, fan.columns) where at least half of the frames show an echo.
    unknown: number of frames whose motion neither images nor poses show; there the sonar is taken
    to have stood still. has_poses: whether the motion comes from poses. beam_width_deg: width of
    its beams, as `sonarrec run` takes it. dynamic_range_db: from black to white.
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
    diagnostics: Diagnostics

    def frames(self) -> Iterator[Frame]:
        """The frames again, numbered from 0; not those by which the recording has grown since."""
        with self.open() as log:
            for number, frame in enumerate(islice(log.within(self.span), len(self.path))):
                yield replace(frame, index=number)


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
    state the beam width. poses: if given, the motion is taken from them. step: called after each
    frame with the number of frames, or None if that is unknown.
    Raises SonarrecError if the recording cannot be used or has no room for a disc in view.
    """
    with open_() as log:
        where = name_as_text(log.path)
        frames = log.within(span)
        first = next(frames, None)
        if first is None:
            raise UsageError(
                f"{where}: no frame lies in --frames {span[0]}:{span[1] or ''}{log.why_none()}"
            )
        fan = first.fan
        _check_room(fan, landmarks, where)
        # `paper` does not measure the motion, but discs lie on the floor whatever runs there later.
        measuring = config if config.continuity.motion == "image" else preset("default")
        choice = measuring.candidates
        plane = working_plane(choice.plane, fan, landmarks.radius_m, choice.disc_radius_px)
        odometry = Odometry(plane, measuring.continuity, poses)
        echoes = np.zeros(first.image.shape, dtype=np.int64)
        path, stamps, unknown = list[Pose](), list[int](), 0
        for frame in chain([first], frames):
            motion = odometry.step(plane.warp(frame.pixels, frame.polar), frame.timestamp_ns)
            # The first frame has no motion and does not count.
            unknown += (motion is None or not motion.known) and bool(path)
            path.append(_moved(path[-1] if path else None, motion, floor_depth(fan)))
            stamps.append(frame.timestamp_ns)
            echoes += frame.image > 0
            if step:
                step(log.frame_count)
        stated_db, stated_hz = log.dynamic_range_db, log.sonar.frame_rate_hz
        (own,), beams = with_beams([config], log.beam_width_deg, first)
        told = log.diagnostics
        odometry.tell(told)
        told.note(*beams)
    if stated_db is None:
        told.note(
            f"grey is taken as {DYNAMIC_RANGE_DB:g} dB from black to white; state "
            "dynamic_range_db where the sonar's is another, for contrasts go by it"
        )
    if unknown:
        told.note(
            f"the motion into {unknown} of {len(path)} frames could not be measured; "
            "discs stay where they were in the picture there, so give --odometry if it moved"
        )
    period_ns = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    return Background(
        where=where,
        open=open_,
        span=span,
        fan=fan,
        path=tuple(path),
        lit=echoes * 2 >= len(path),
        rate_hz=1e9 / period_ns if period_ns > 0 else stated_hz or 1.0,
        unknown=unknown,
        has_poses=poses is not None,
        beam_width_deg=own.features.beam_width_deg or usual_beam_width_deg(fan),
        dynamic_range_db=stated_db or DYNAMIC_RANGE_DB,
        diagnostics=told,
    )


def poses_of(
    path: str | Path, odometry: Path | None, topic: str | None, time: Clock = "log"
) -> PoseTable | None:
    """The poses from a topic of the recording, a table, or else the poses.csv beside it.

    None if there are none. Raises SonarrecError if they cannot be used.
    """
    if topic is not None:
        from sonarrec.readers.messages.poses import read_topic  # brings decompressors

        return read_topic(Path(path), topic, time)
    file = odometry or find_log(path).beside(POSES_FILE)
    return None if file is None else read_poses(file)


def nearest_floor_m(fan: Fan) -> float:
    """The least slant range at which the fan shows floor."""
    return max(fan.range_min_m, STEEPEST * floor_depth(fan))


def _check_room(fan: Fan, landmarks: LandmarkSet, where: str) -> None:
    """Raise SonarrecError if no whole disc can be in view. where: names the recording."""
    nearest = nearest_floor_m(fan)
    if nearest >= fan.range_max_m:
        raise SonarrecError(
            f"{where}: nothing of the floor is in view: from height_m = {floor_depth(fan):g} it "
            f"begins at {nearest:.2f} m and range_max_m = {fan.range_max_m:g}; correct one of them"
        )
    near, far = (float(ground_range(fan, r)) for r in (nearest, fan.range_max_m))
    middle = math.radians((fan.bearing_min_deg + fan.bearing_max_deg) / 2)
    here = Pose(0.0, floor_depth(fan), 0.0, 0.0)
    shares = [
        visible_share(fan, here, g * math.sin(middle), g * math.cos(middle), landmarks.radius_m)
        for g in np.linspace(near, far, 40).tolist()
    ]
    if max(shares) < WHOLE:
        raise SonarrecError(
            f"{where}: a disc of radius_m = {landmarks.radius_m:g} is nowhere whole in view: the "
            f"fan shows {nearest:.2f} to {fan.range_max_m:.2f} m of the floor and "
            f"{fan.bearing_max_deg - fan.bearing_min_deg:.1f} deg; choose smaller --landmarks"
        )


def _moved(before: Pose | None, motion: Motion | None, height_m: float) -> Pose:
    """The pose after a motion, first its shift, then its pan. before: None at the first frame."""
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
