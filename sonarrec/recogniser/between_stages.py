"""What stage 2 leaves of a frame for stage 3; what makes up the stages for one kind of landmark."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sonarrec.arrays import BoolArray, ByteImage, FloatArray
from sonarrec.nouns import Groups, Motion, Selection
from sonarrec.recogniser.motion.odometry import Odometry
from sonarrec.recogniser.plane import Plane
from sonarrec.recogniser.stage3 import Beliefs, Evidence
from sonarrec.recogniser.stage3.smi import Identification


@dataclass(frozen=True, slots=True)
class Tracked:
    """One frame after stage 2, with the shape matrices that stage 3 needs of its image.

    candidates: (n, 2) working pixels. scores: (n,) of stage 1. grey, seen: (n, L, ANGLES) shape
    matrices of the candidates, and which of their cells lie inside the fan. evidence: of the
    groups. motion: of the sonar since the frame before.
    """

    index: int
    timestamp_ns: int
    candidates: FloatArray
    scores: FloatArray
    grey: FloatArray
    seen: BoolArray
    groups: Groups
    evidence: Evidence
    motion: Motion | None


@dataclass(frozen=True, slots=True)
class Parts:
    """What recognises one kind of landmark: discs (`of_discs`), or drawn plates.

    detect: stage 1. track: the groups after one more working image, by its selection and the
    sonar's motion, if that is known. gather: what the image adds to the groups' evidence; before
    it the shape matrices of the candidates, and which of their cells lie inside the fan. beliefs:
    about the groups of consecutive frames, in the log's order; groups and evidence concatenated.
    identify: the single-frame method, of shape matrices; None if there is none.
    """

    plane: Plane
    detect: Callable[[ByteImage], Selection]
    odometry: Odometry
    track: Callable[[ByteImage, Selection, Motion | None], Groups]
    gather: Callable[[ByteImage, Selection, Groups], tuple[FloatArray, BoolArray, Evidence]]
    beliefs: Callable[[Sequence[Groups], Evidence], Beliefs]
    identify: Callable[[FloatArray, BoolArray], Identification] | None = None
