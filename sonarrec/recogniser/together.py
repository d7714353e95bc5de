"""Several recognisers over the same frames, one stage behind the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

import cv2

from sonarrec.nouns import Frame, FrameResult, Selection
from sonarrec.recogniser.between_stages import AfterStage2, WorkingImage
from sonarrec.recogniser.motion.odometry import PoseTally
from sonarrec.recogniser.three_stages import ThreeStages

if TYPE_CHECKING:
    from sonarrec.recogniser.drawn.three_stages import DrawnStages

# Frames that stage 3 takes at once, which costs a third of one by one. More would save little.
FRAMES_AT_ONCE = 16
T = TypeVar("T")
Given = TypeVar("Given")
Made = TypeVar("Made")
AfterStage1 = list[tuple[WorkingImage, Selection]]
"""One frame: of each recognizer its image and what stage 1 selected in it."""


class Mapped(Protocol):
    """`map`, or what gives the same on several cores: results in the items' order."""

    def __call__(
        self, work: Callable[[Given], Made], items: Iterable[Given], /
    ) -> Iterator[Made]: ...


class UntilBroken(Iterator[T]):
    """Items that seem to end where an exception breaks them off, so that all before it go through
    what follows, however far it reads ahead. `end` then raises the exception."""

    def __init__(self, items: Iterable[T]) -> None:
        self._items = iter(items)
        self._error: BaseException = StopIteration()

    def __next__(self) -> T:
        try:
            return next(self._items)
        except BaseException as error:
            self._items = iter(())
            if isinstance(self._error, StopIteration):  # asked again, it ends again
                self._error = error
            raise StopIteration from None

    def end(self) -> None:
        """Raise what broke the items off, if anything did."""
        if not isinstance(self._error, StopIteration):
            raise self._error


class Burst(NamedTuple):
    """What stages 2 and 3 made of some frames in a row."""

    results: list[tuple[FrameResult, ...]]
    """Per frame one of each recogniser."""
    tallies: list[PoseTally]
    """One of each recogniser."""
    error: BaseException | None
    """What went wrong in stage 2 of the frame after these."""


class Together:
    """The stages of several recognisers, in step."""

    def __init__(self, recognisers: Sequence[ThreeStages | DrawnStages]) -> None:
        self._recognisers = recognisers
        self._tracked: list[list[AfterStage2]] = []  # frames that wait for stage 3

    def results(
        self,
        frames: Iterable[Frame],
        anywhere: Mapped = map,
        in_order: Mapped = map,
        observe: Callable[[AfterStage1], object] = bool,
    ) -> Iterator[tuple[FrameResult, ...]]:
        """For each frame one result of each recogniser, in bursts of FRAMES_AT_ONCE.

        anywhere: applies stage 1, which takes any frame by itself. in_order: applies stages 2 and
        3, which keep a state: all in one process, one by one. observe: called with each frame after
        stage 1, before its results. An exception in stage 1 or 2, also Ctrl-C, is raised after the
        results of all frames before it.
        """
        _without_ipp()
        images = ([r.working_image(frame) for r in self._recognisers] for frame in frames)
        selected = UntilBroken(_seen(anywhere(self.stage1, images), observe))
        for burst in in_order(self.follow, chain(selected, [None])):
            for recogniser, tally in zip(self._recognisers, burst.tallies, strict=True):
                recogniser.odometry.tally = tally
            yield from burst.results
            if burst.error is not None:
                raise burst.error
        selected.end()

    def stage1(self, images: list[WorkingImage]) -> AfterStage1:
        """Stage 1 of one frame."""
        _without_ipp()
        return [(i, r.stage1(i)) for r, i in zip(self._recognisers, images, strict=True)]

    def follow(self, selected: AfterStage1 | None) -> Burst:
        """Stage 2 of the next frame, and stage 3 where FRAMES_AT_ONCE wait or frames end (None)."""
        error = None
        if selected is not None:
            try:
                both = zip(self._recognisers, selected, strict=True)
                self._tracked.append([r.stage2(*of_one) for r, of_one in both])
            except BaseException as broken:
                error = broken
        tallies = [r.odometry.tally for r in self._recognisers]
        if error is None and selected is not None and len(self._tracked) < FRAMES_AT_ONCE:
            return Burst([], tallies, None)
        tracked, self._tracked = self._tracked, []
        if not tracked:
            return Burst([], tallies, error)
        of_each = zip(self._recognisers, zip(*tracked, strict=True), strict=True)
        results = [r.stage3(frames) for r, frames in of_each]
        return Burst([*zip(*results, strict=True)], tallies, error)


def _seen(items: Iterable[T], observe: Callable[[T], object]) -> Iterator[T]:
    """The items, each shown to `observe` first."""
    for item in items:
        observe(item)
        yield item


def _without_ipp() -> None:
    """As in the package: each thread has its own switch."""
    cv2.ipp.setUseIPP(False)
