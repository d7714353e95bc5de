"""The sonar's motion from frame to frame: from a table of poses, else from the images."""

from __future__ import annotations

from dataclasses import dataclass

from sonarrec.arrays import ByteImage
from sonarrec.config import Continuity
from sonarrec.errors import Diagnostics
from sonarrec.geometry import PoseTable
from sonarrec.nouns import Motion
from sonarrec.recogniser.motion.image_motion import ImageMotion
from sonarrec.recogniser.plane import Plane

# The pans by the table and by the images are compared where either is at least LEAST_TURN_DEG. A
# note doubts the table if at least LEAST_COMPARED were compared and most of them contradict.
LEAST_TURN_DEG = 0.3
LEAST_COMPARED = 10


@dataclass(slots=True)
class PoseTally:
    """Counts, over the frames so far, by which the table of poses is checked."""

    span: tuple[int, int] | None = None
    """First and last time of the frames, ns."""
    frames: int = 0
    without_pose: int = 0
    compared: int = 0
    """Frames whose pan was measured in the images too."""
    differing: int = 0
    """Those of `compared` in which the images contradict the table."""


class Odometry:
    """The sonar's motion: from the table of poses where that has them, else from the images."""

    def __init__(self, plane: Plane, config: Continuity, poses: PoseTable | None = None) -> None:
        self._images = ImageMotion(plane) if config.motion == "image" else None
        self._poses = poses
        self._before_ns: int | None = None
        self.tally = PoseTally()

    def step(self, image: ByteImage, timestamp_ns: int) -> Motion | None:
        """The motion since the last frame. `known` is False where neither source gives it.

        None for the first frame; also where no pose is known and the motion is not measured in
        images. image: the working image. timestamp_ns: of the frame.
        """
        before, self._before_ns = self._before_ns, timestamp_ns
        by_poses = None
        if self._poses is not None:
            tally = self.tally
            tally.frames += 1
            tally.without_pose += not self._poses.covers(timestamp_ns)
            first, last = tally.span or (timestamp_ns, timestamp_ns)
            tally.span = min(first, timestamp_ns), max(last, timestamp_ns)
            by_poses = None if before is None else self._poses.motion(before, timestamp_ns)
        if self._images is None:
            return by_poses
        if by_poses is not None:
            self._compare(by_poses.pan_deg, self._images.turn(image))
            return by_poses
        return self._images.step(image, None if before is None else (timestamp_ns - before) / 1e9)

    def _compare(self, pose_deg: float, image_deg: float | None) -> None:
        """Count a pan by the poses, and whether the one by the images contradicts it."""
        if image_deg is None:
            return
        larger = max(abs(pose_deg), abs(image_deg))
        if larger >= LEAST_TURN_DEG:
            self.tally.compared += 1
            self.tally.differing += abs(pose_deg - image_deg) > 0.5 * larger

    def tell(self, diagnostics: Diagnostics) -> None:
        """Report what is wrong with the table: bad rows, frames without a pose, contradictions."""
        if self._poses is None:
            return
        tally, poses = self.tally, self._poses
        diagnostics.problem(*poses.problems)
        if tally.without_pose:
            assert tally.span is not None
            covered = "{:.3f} to {:.3f} s".format(*(poses.at[[0, -1]] / 1e9))
            log = "{:.3f} to {:.3f} s".format(*(t / 1e9 for t in tally.span))
            diagnostics.problem(
                f"{poses.name}: no pose for {tally.without_pose} of {tally.frames} frames; it "
                f"covers {covered}, and the frames are from {log}"
            )
        if tally.compared < LEAST_COMPARED or tally.differing <= tally.compared / 2:
            return
        yaw = "yaw is in degrees, positive to the right"
        if poses.axes == "ahead, left":
            yaw = "z of a pose points up, so its yaw is positive to the left (REP 103)"
        diagnostics.note(
            f"its turns contradict those of the images in {tally.differing} of {tally.compared} "
            f"frames; {yaw}, and times are by the frames' clock",
            about=poses.name,
        )
