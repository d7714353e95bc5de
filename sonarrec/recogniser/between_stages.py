"""What each stage hands to the next, for one frame or for several at once; what makes them up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import BoolArray, ByteImage, FloatArray, IntArray, joined
from sonarrec.nouns import Estimate, FrameResult, Groups, Motion, Selection
from sonarrec.recogniser.motion.odometry import Odometry
from sonarrec.recogniser.plane import Plane
from sonarrec.recogniser.stage3 import Beliefs, Evidence
from sonarrec.recogniser.stage3.smi import Identification


@dataclass(frozen=True, slots=True)
class WorkingImage:
    """One frame in the working plane."""

    frame: int
    """The frame's number."""
    timestamp_ns: int
    image: ByteImage
    """(rows, columns) of the plane."""


@dataclass(frozen=True, slots=True)
class AfterStage2:
    """One frame after stage 2, with the shape matrices that stage 3 needs of its image."""

    frame: int
    """The frame's number."""
    timestamp_ns: int
    candidates: FloatArray
    """(n, 2) pixels of the working image."""
    scores: FloatArray
    """(n,) of stage 1."""
    grey: FloatArray
    """(n, L, ANGLES) shape matrices of the candidates."""
    seen: BoolArray
    """(n, L, ANGLES) which of their cells lie inside the fan."""
    groups: Groups
    """m of them."""
    evidence: Evidence
    """Of the groups, from `Measurement.gather`."""
    motion: Motion | None = None
    """Of the sonar since the frame before."""


class Batch:
    """Some frames, at least one: all their candidates in one array, and all their groups."""

    def __init__(self, frames: Sequence[AfterStage2]) -> None:
        self._frames = frames
        self._candidates = [len(f.candidates) for f in frames]
        self._tracks = [len(f.groups.numbers) for f in frames]
        self.candidates: FloatArray = np.concatenate([f.candidates for f in frames])
        """(n, 2) working pixels."""
        self.candidate_numbers: IntArray = np.concatenate([np.arange(n) for n in self._candidates])
        """(n,) counted from 0 in each frame."""
        self.scores: FloatArray = np.concatenate([f.scores for f in frames])
        """(n,) of stage 1."""
        self.grey: FloatArray = np.concatenate([f.grey for f in frames])
        """(n, L, ANGLES), and so is `seen`: as in AfterStage2."""
        self.seen: BoolArray = np.concatenate([f.seen for f in frames])
        self.groups = [f.groups for f in frames]
        """Frame by frame."""
        self.tracked = joined(self.groups)
        """All m of them."""
        self.evidence = joined([f.evidence for f in frames])
        """Of all m."""

    def results(self, single: list[Estimate], tracked: list[Estimate]) -> list[FrameResult]:
        """The estimates frame by frame: those of the candidates, then those of the groups.

        single: of all candidates, in order; empty if the single-frame method is not run. tracked:
        of all groups, in order.
        """
        singles = _split(single, self._candidates if single else [0] * len(self._candidates))
        return [
            FrameResult(f.frame, f.timestamp_ns, candidates, tracks, (*a, *b), f.motion)
            for f, candidates, tracks, a, b in zip(
                self._frames,
                self._candidates,
                self._tracks,
                singles,
                _split(tracked, self._tracks),
                strict=True,
            )
        ]


def _split(estimates: list[Estimate], counts: Sequence[int]) -> list[list[Estimate]]:
    ends = np.cumsum(counts).tolist()
    return [estimates[end - n : end] for end, n in zip(ends, counts, strict=True)]


@dataclass(frozen=True, slots=True)
class Parts:
    """What recognises one kind of landmark: discs (`of_discs`), or drawn plates.

    detect: stage 1. track: the groups after one more working image, by its selection and the
    sonar's motion, if that is known. gather: what the image adds to the groups' evidence; before
    it the shape matrices of the candidates, and which of their cells lie inside the fan. beliefs:
    as of Measurement. identify: the single-frame method, of shape matrices; None if there is none.
    """

    plane: Plane
    detect: Callable[[ByteImage], Selection]
    odometry: Odometry
    track: Callable[[ByteImage, Selection, Motion | None], Groups]
    gather: Callable[[ByteImage, Selection, Groups], tuple[FloatArray, BoolArray, Evidence]]
    beliefs: Callable[[Sequence[Groups], Evidence], Beliefs]
    identify: Callable[[FloatArray, BoolArray], Identification] | None = None
