"""Several recognisers over the same frames, on one core or on several."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice

import cv2

from sonarrec.nouns import Frame, FrameResult
from sonarrec.recogniser.between_stages import AfterStage1, AfterStage2, WorkingImage
from sonarrec.recogniser.motion.odometry import PoseTally
from sonarrec.recogniser.own_process import CAN_FORK, OwnProcess
from sonarrec.recogniser.prefetch import Prefetcher
from sonarrec.recogniser.three_stages import ThreeStages

# Frames that stage 3 takes at once, which costs a third of one by one. More would save little.
FRAMES_AT_ONCE = 16


@dataclass(frozen=True, slots=True)
class Burst:
    """What the later stages made of some frames in a row."""

    results: list[tuple[FrameResult, ...]]
    """Per frame one of each recogniser."""
    tallies: list[PoseTally]
    """One of each recogniser."""


def recognise_together(
    recognisers: Sequence[ThreeStages], frames: Iterable[Frame], *, ahead: bool = False
) -> Iterator[tuple[FrameResult, ...]]:
    """Several recognisers over the same frames: for each frame, one result of each recogniser.

    Results come in bursts of FRAMES_AT_ONCE. An exception on the way, also Ctrl-C, is raised after
    the results of all frames before it were yielded. ahead: whether two cores share the work: one
    reads the frames, the other does the later stages, and stage 1 is done by the one that has time.
    Where there can be no process for that, reading and stage 1 have a thread each. Raises
    ChildProcessError where the process was killed.
    """
    cv2.ipp.setUseIPP(False)  # as in the package: each thread has its own switch
    select, follow = partial(_select, recognisers), partial(_follow, recognisers)
    with ExitStack() as running:
        process: OwnProcess[list[WorkingImage], list[AfterStage1], Burst] | None = None
        if ahead and CAN_FORK:  # before anything runs ahead in a thread
            with suppress(OSError):  # no room for another process
                process = OwnProcess(select, follow, sum(r.most_bytes for r in recognisers))
                running.callback(process.close)
        images: Iterable[list[WorkingImage]]
        images = ([r.working_image(frame) for r in recognisers] for frame in frames)
        if process is not None:
            bursts = process.results(images)
        elif ahead:
            images = running.enter_context(closing(Prefetcher(images)))
            bursts = follow(running.enter_context(closing(Prefetcher(map(select, images)))))
        else:
            bursts = follow(map(select, images))
        for burst in bursts:
            for recogniser, tally in zip(recognisers, burst.tallies, strict=True):
                recogniser.odometry.tally = tally
            yield from burst.results


def _select(
    recognisers: Sequence[ThreeStages], images: Sequence[WorkingImage]
) -> list[AfterStage1]:
    """Stage 1 of all recognisers over one frame."""
    return [r.stage1(image) for r, image in zip(recognisers, images, strict=True)]


def _follow(
    recognisers: Sequence[ThreeStages], selected: Iterable[list[AfterStage1]]
) -> Iterator[Burst]:
    """Stages 2 and 3 of all recognisers, FRAMES_AT_ONCE frames at a time."""
    left, broken = iter(selected), None
    while broken is None:
        tracked: list[list[AfterStage2]] = []
        try:
            for each in islice(left, FRAMES_AT_ONCE):
                tracked.append([r.stage2(x) for r, x in zip(recognisers, each, strict=True)])
                del each  # its maps are large: free them before the next are made
        except BaseException as error:
            broken = error
        if not tracked:
            break
        per_recogniser = zip(*tracked, strict=True)
        results = (r.stage3(x) for r, x in zip(recognisers, per_recogniser, strict=True))
        yield Burst([*zip(*results, strict=True)], [r.odometry.tally for r in recognisers])
    if broken is not None:
        raise broken
