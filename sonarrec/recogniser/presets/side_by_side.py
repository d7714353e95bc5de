"""Several presets over the same frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import cv2

from sonarrec.config import Config
from sonarrec.errors import Diagnostics
from sonarrec.geometry import PoseTable
from sonarrec.landmarks import DrawnSet, LandmarkSet
from sonarrec.nouns import Fan, Frame, FrameResult
from sonarrec.recogniser.between_stages import Tracked
from sonarrec.recogniser.presets.hindsight import Hindsight
from sonarrec.recogniser.presets.second_look import SecondLook, looks_again
from sonarrec.recogniser.restore.saturation import Levels
from sonarrec.recogniser.restore.static_pixels import Unchanging
from sonarrec.recogniser.stage3.appearance import Classifier
from sonarrec.recogniser.three_stages import FRAMEWORK, SMI, ThreeStages

# Frames that stage 3 takes at once: one by one a frame costs a sixth more, more would save nothing.
FRAMES_AT_ONCE = 16


class SideBySide:
    """Several configurations over the same frames, with one result for each frame.

    The methods of a single configuration are called `smi` and `framework`; those of several have
    the preset's name appended. Presets with the same candidates and the same SMI share one `smi`,
    named after the first of them. Results wait for the longest lag.

    tracking: the names of the framework's methods. methods: all names.
    """

    def __init__(
        self,
        configs: Sequence[Config],
        fan: Fan,
        landmarks: LandmarkSet,
        model: Classifier | None = None,
        poses: PoseTable | None = None,
    ) -> None:
        drawn = isinstance(landmarks, DrawnSet)  # plates have no single-frame method
        suffixes = [f":{c.preset}" if len(configs) > 1 else "" for c in configs]
        self.tracking = [FRAMEWORK + suffix for suffix in suffixes]
        # The ring detector's candidates depend on the beam width as well.
        candidates = [
            (c.candidates, c.smi, c.candidates.detector == "ring" and c.features.beam_width_deg)
            for c in configs
        ]
        single = [
            SMI + suffix if same not in candidates[:i] and not drawn else None
            for i, (same, suffix) in enumerate(zip(candidates, suffixes, strict=True))
        ]
        both = zip(single, self.tracking, strict=True)
        self.methods = [name for pair in both for name in pair if name is not None]
        # Configurations that differ only in hindsight share one recogniser.
        stages = [
            replace(c, preset="", features=replace(c.features, lag_frames=0)) for c in configs
        ]
        self._recogniser_of = [stages.index(config) for config in stages]
        self._recognisers = {
            i: ThreeStages(configs[i], fan, landmarks, model, self.tracking[i], single[i], poses)
            for i in dict.fromkeys(self._recogniser_of)
        }
        self._hindsight: dict[int, Hindsight] = {}
        for i, (config, method) in enumerate(zip(configs, self.tracking, strict=True)):
            if config.features.lag_frames:
                look = None
                if looks_again(config) and not drawn:
                    look = SecondLook(method, config, fan, landmarks, model)
                self._hindsight[i] = Hindsight(method, config, landmarks, look)
        self._lag = max(config.features.lag_frames for config in configs)
        self._tracked: list[list[Tracked]] = []  # frames that wait for stage 3
        # Ctrl-C may come at any moment; `waiting` goes on from there.
        self._pending: deque[list[FrameResult]] = deque()  # out of stage 3, but not yet used
        self._unlearned = 0  # so many of them, the last ones, are new to the hindsights
        self._unrevised = {i: deque[list[FrameResult]]() for i in self._hindsight}
        self._unchanging = Unchanging()
        self._levels = Levels(landmarks.radius_m)

    def recognise(self, frames: Iterable[Frame]) -> Iterator[FrameResult]:
        """Yield the results in the log's order, each when it is final.

        An exception of `frames`, also Ctrl-C, is raised after the results of all frames before it.
        After one in the stages, `waiting` yields what waits, and what was yielded last once more.
        """
        cv2.ipp.setUseIPP(False)  # as in the package: each thread has its own switch
        broken: list[BaseException] = []
        whole = _until_broken(frames, broken)
        for frame in self._levels.restored(self._unchanging.filled(whole)):
            self._tracked.append(self._track(frame))
            if len(self._tracked) == FRAMES_AT_ONCE:
                yield from self._settled()
        yield from self.waiting()
        if broken:
            raise broken[0]

    def _track(self, frame: Frame) -> list[Tracked]:
        """Stages 1 and 2 of a frame, of each recogniser."""
        tracked = []
        for i, recogniser in self._recognisers.items():
            image = recogniser.working_image(frame)
            selection = recogniser.stage1(image)
            for k, hindsight in self._hindsight.items():
                if hindsight.look is not None and self._recogniser_of[k] == i:
                    hindsight.look.take(image, selection)
            tracked.append(recogniser.stage2(frame, image, selection))
        return tracked

    def _settled(self) -> Iterator[FrameResult]:
        """Stage 3 of the frames that wait for it; the results that are final by then."""
        tracked, self._tracked = self._tracked, []
        if tracked:
            of_each = zip(self._recognisers.values(), zip(*tracked, strict=True), strict=True)
            found = [recogniser.stage3(frames) for recogniser, frames in of_each]
            new = [self._of_each(of_frame) for of_frame in zip(*found, strict=True)]
            self._pending.extend(new)
            self._unlearned += len(new)
        while self._unlearned:
            results = self._pending[-self._unlearned]
            self._unlearned -= 1
            for i, hindsight in self._hindsight.items():
                hindsight.learn(results[i])
                self._unrevised[i].append(results)
                # Each at its own lag, so that a preset's results do not depend on the others.
                self._revise(i, hindsight.lag)
            yield from self._final(self._lag + self._unlearned)

    def _revise(self, i: int, most: int) -> None:
        """Revise the oldest results by a hindsight until at most so many wait for it."""
        while len(self._unrevised[i]) > most:
            results = self._unrevised[i].popleft()
            results[i] = self._hindsight[i].revised(results[i])

    def _of_each(self, of_recognisers: Sequence[FrameResult]) -> list[FrameResult]:
        """One frame's results, one for each configuration."""
        found, results = dict(zip(self._recognisers, of_recognisers, strict=True)), []
        for i, recogniser in enumerate(self._recogniser_of):
            result = found[recogniser]
            if i != recogniser:
                own = (e for e in result.estimates if e.method == self.tracking[recogniser])
                renamed = tuple(replace(e, method=self.tracking[i]) for e in own)
                result = replace(result, estimates=renamed)
            results.append(result)
        return results

    def waiting(self) -> Iterator[FrameResult]:
        """Yield the results that wait at the end of the frames, revised by all frames so far."""
        yield from self._settled()
        for i, hindsight in self._hindsight.items():
            if hindsight.look is not None:
                hindsight.look.finish()
            self._revise(i, 0)
        yield from self._final(0)

    def tell(self, diagnostics: Diagnostics) -> None:
        """Report what is wrong with the poses of the frames so far."""
        for recogniser in self._recognisers.values():
            recogniser.odometry.tell(diagnostics)

    @property
    def restored(self) -> tuple[float, float]:
        """Shares of static pixels, and of saturated frames so far; restored before stage 1."""
        return self._unchanging.share, self._levels.saturated / max(self._levels.seen, 1)

    def _final(self, most: int) -> Iterator[FrameResult]:
        """Yield the results of the oldest frames, each as one, until at most so many wait."""
        while len(self._pending) > most:
            results = self._pending[0]
            yield replace(
                results[0],
                estimates=tuple(e for r in results for e in r.estimates),
                motion=next((r.motion for r in results if r.motion is not None), None),
            )
            self._pending.popleft()  # now it has arrived


def _until_broken(frames: Iterable[Frame], broken: list[BaseException]) -> Iterator[Frame]:
    """The frames before an exception, which goes to `broken`: what reads ahead keeps none back."""
    try:
        yield from frames
    except (Exception, KeyboardInterrupt) as error:
        broken.append(error)
