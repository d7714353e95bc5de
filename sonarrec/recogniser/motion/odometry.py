"""The sonar's motion from frame to frame: from a table of poses, else from the images."""

from __future__ import annotations

import numpy as np

from sonarrec.arrays import ByteImage
from sonarrec.config import Continuity
from sonarrec.errors import Diagnostics
from sonarrec.recogniser.motion.image_motion import MIN_MATCH, ImageMotion
from sonarrec.recogniser.plane import Plane
from sonarrec.sonar.frame import Motion
from sonarrec.sonar.geometry import PoseTable

# The pans by the table and by the images are compared where either is at least LEAST_PAN_DEG. A
# note doubts the table if at least LEAST_COMPARED were compared and most of them contradict.
LEAST_PAN_DEG = 0.3
LEAST_COMPARED = 10
# Of shifted clocks one is named if it mends at least LEAST_MENDED frames, and MENDED of those that
# contradict.
SHIFTS_NS = np.arange(-20, 21) * 250_000_000
LEAST_MENDED, MENDED = 5, 0.75
# Between the sums of the images' pans and of the table's, in the frames that were compared.
MOST_FACTOR = 1.5


class Odometry:
    """The sonar's motion: from the table of poses where that has them, else from the images."""

    def __init__(self, plane: Plane, config: Continuity, poses: PoseTable | None = None) -> None:
        self._images = ImageMotion(plane) if config.motion == "image" else None
        self._poses = poses
        self._before_ns: int | None = None
        self._begins = True  # whether the next image is the first of its stretch
        # To check the table: the frames' first and last time, how many frames have no pose, in how
        # many the images show a pan, and in how many another one, by each clock.
        self._span: tuple[int, int] | None = None
        self._frames = self._without_pose = self._compared = 0
        self._differing = np.zeros(len(SHIFTS_NS), np.int64)
        # Sums of the table's pans, deg, and of those by the images in the same direction.
        self._by_table = self._by_images = 0.0

    def begin_stretch(self) -> None:
        """No image before the next one is compared with it; poses may give its motion."""
        self._begins = True
        if self._images is not None:
            self._images.begin_stretch()

    def step(self, image: ByteImage, timestamp_ns: int) -> Motion | None:
        """The motion since the last frame. `known` is False where neither source gives it.

        None for the first frame; also where no pose is known and the image is the first of its
        stretch, or the motion is not measured in images. image: the working image. timestamp_ns: of
        the frame.
        """
        before, self._before_ns = self._before_ns, timestamp_ns
        begins, self._begins = self._begins, False
        by_poses = None
        if self._poses is not None:
            self._frames += 1
            self._without_pose += not self._poses.covers(timestamp_ns)
            first, last = self._span or (timestamp_ns, timestamp_ns)
            self._span = min(first, timestamp_ns), max(last, timestamp_ns)
            by_poses = None if before is None else self._poses.motion(before, timestamp_ns)
        if self._images is None:
            return by_poses
        if by_poses is not None:
            pan_deg, match = self._images.pan.step(image)
            larger = max(abs(by_poses.pan_deg), abs(pan_deg))
            if match >= MIN_MATCH and larger >= LEAST_PAN_DEG:
                self._compared += 1
                self._by_table += abs(by_poses.pan_deg)
                self._by_images += pan_deg * np.sign(by_poses.pan_deg)
                assert self._poses is not None
                assert before is not None
                times_ns = np.array([[before], [timestamp_ns]]) + SHIFTS_NS
                then, now = (self._poses.poses_at(t)[:, 0] for t in times_ns)
                larger_of_each = np.maximum(np.abs(now - then), abs(pan_deg))
                self._differing += ~(np.abs(now - then - pan_deg) <= 0.5 * larger_of_each)
            return by_poses
        seconds = None if begins or before is None else (timestamp_ns - before) / 1e9
        return self._images.step(image, seconds)

    def report(self, diagnostics: Diagnostics) -> None:
        """Report what is wrong with the table: bad rows, frames without a pose, contradictions."""
        if self._poses is None:
            return
        poses = self._poses
        diagnostics.problem(*poses.problems)
        if self._without_pose and self._span is not None:
            covered, log = (
                "{:.3f} to {:.3f} s".format(*(t / 1e9 for t in span))
                for span in (poses.time_ns[[0, -1]], self._span)
            )
            (begins, ends), (first, last) = poses.time_ns[[0, -1]].tolist(), self._span
            late = ""
            if self._without_pose == self._frames and abs(ends - begins - last + first) < 10**9:
                late = (
                    f"; if both began together, take {(begins - first) / 1e9:.3f} s off its times"
                )
            diagnostics.problem(
                f"{poses.name}: no pose for {self._without_pose} of {self._frames} frames; it "
                f"covers {covered}, and the frames are from {log}{late}"
            )
        differing = int(self._differing[SHIFTS_NS == 0][0])
        least = int(self._differing.min())
        mended, factor = differing - least, self._by_images / max(self._by_table, 1e-9)
        enough = self._compared >= LEAST_COMPARED
        scaled = enough and factor > 0 and not 1 / MOST_FACTOR < factor < MOST_FACTOR
        if enough and differing > self._compared / 2 and not scaled:
            yaw = "yaw is in degrees, positive to the right"
            if poses.axes == "ahead, left":
                yaw = "z of a pose points up, so its yaw is positive to the left (REP 103)"
            diagnostics.note(
                f"its rotations contradict those of the images in {differing} of "
                f"{self._compared} frames; {yaw}, and times must be by the frames' clock",
                about=poses.name,
            )
        elif mended >= max(LEAST_MENDED, MENDED * differing):
            best = SHIFTS_NS[self._differing == least] / 1e9
            shift = best[np.abs(best).argmin()]
            diagnostics.note(
                f"its rotations contradict those of the images in {differing} frames, and in "
                f"{least} if its times were {abs(shift):g} s {'later' if shift < 0 else 'earlier'};"
                " is it the frames' clock?",
                about=poses.name,
            )
        elif scaled:
            diagnostics.note(
                f"in {self._compared} frames the images rotate {factor:.2g} times as far as it "
                "says; is its yaw the whole angle, in degrees, and the field of view right?",
                about=poses.name,
            )
