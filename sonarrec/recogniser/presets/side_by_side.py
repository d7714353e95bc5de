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
from sonarrec.recogniser.presets.hindsight import Hindsight
from sonarrec.recogniser.presets.second_look import SecondLook, looks_again
from sonarrec.recogniser.restore.saturation import Levels
from sonarrec.recogniser.restore.static_pixels import Unchanging
from sonarrec.recogniser.stage3.appearance import Classifier
from sonarrec.recogniser.three_stages import FRAMEWORK, SMI, DiscStages, ThreeStages, Tracked
from sonarrec.records import Fan, Frame, FrameResult

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
        # Configurations that differ only in hindsight share the stages of the first of them.
        alike = [replace(c, preset="", features=replace(c.features, lag_frames=0)) for c in configs]
        self._stages_of = [alike.index(one) for one in alike]
        self._stages: dict[int, ThreeStages] = {}
        for i in dict.fromkeys(self._stages_of):
            config, method = configs[i], self.tracking[i]
            if isinstance(landmarks, DrawnSet):
                # Imported where it is needed: most sets are of discs, and it takes a while.
                from sonarrec.recogniser.drawn.three_stages import PlateStages

                stages: ThreeStages = PlateStages(
                    config, fan, landmarks, method=method, poses=poses
                )
            else:
                stages = DiscStages(
                    config, fan, landmarks, model, method=method, smi=single[i], poses=poses
                )
            self._stages[i] = stages
        self._hindsight: dict[int, Hindsight] = {}
        for i, (config, method) in enumerate(zip(configs, self.tracking, strict=True)):
            if config.features.lag_frames:
                look = None
                if looks_again(config) and not drawn:
                    look = SecondLook(method, config, fan, landmarks, model)
                self._hindsight[i] = Hindsight(method, config, landmarks, look)
        self._lag = max(config.features.lag_frames for config in configs)
        self._tracked: list[dict[int, Tracked]] = []  # frames that wait for stage 3
        # Ctrl-C may come at any moment; `waiting` goes on from there.
        self._new: deque[list[FrameResult]] = deque()  # out of stage 3
        self._pending: deque[list[FrameResult]] = deque()  # which the hindsights have had
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

    def _track(self, frame: Frame) -> dict[int, Tracked]:
        """Stages 1 and 2 of a frame."""
        tracked = {}
        for i, stages in self._stages.items():
            image = stages.working_image(frame)
            candidates = stages.stage1(image)
            tracked[i] = stages.stage2(frame, image, candidates)
            for k, hindsight in self._hindsight.items():
                if self._stages_of[k] == i:
                    hindsight.see(tracked[i], image, candidates)
        return tracked

    def _settled(self) -> Iterator[FrameResult]:
        """Stage 3 of the frames that wait for it; the results that are final by then."""
        tracked, self._tracked = self._tracked, []
        if tracked:
            found = {i: s.stage3([f[i] for f in tracked]) for i, s in self._stages.items()}
            self._new.extend(
                [self._result_of(k, found[i][n]) for k, i in enumerate(self._stages_of)]
                for n in range(len(tracked))
            )
        while self._new:
            self._pending.append(self._new[0])  # if stopped here, it is there twice, but not lost
            results = self._new.popleft()
            for i, hindsight in self._hindsight.items():
                hindsight.learn(results[i])
                self._unrevised[i].append(results)
                # Each at its own lag, so that a preset's results do not depend on the others.
                self._revise(i, hindsight.lag)
            yield from self._final(self._lag)

    def _result_of(self, k: int, result: FrameResult) -> FrameResult:
        """The result of configuration k by that of its stages, which may be another's."""
        if self._stages_of[k] == k:
            return result
        own = (e for e in result.estimates if e.method == self.tracking[self._stages_of[k]])
        return replace(result, estimates=tuple(replace(e, method=self.tracking[k]) for e in own))

    def _revise(self, i: int, most: int) -> None:
        """Revise the oldest results by a hindsight until at most so many wait for it."""
        while len(self._unrevised[i]) > most:
            results = self._unrevised[i].popleft()
            results[i] = self._hindsight[i].revised(results[i])

    def waiting(self) -> Iterator[FrameResult]:
        """Yield the results that wait at the end of the frames, revised by all frames so far."""
        yield from self._settled()
        for i, hindsight in self._hindsight.items():
            hindsight.finish()
            self._revise(i, 0)
        yield from self._final(0)

    def tell(self, diagnostics: Diagnostics) -> None:
        """Report what is wrong with the poses of the frames so far."""
        for stages in self._stages.values():
            stages.odometry.tell(diagnostics)

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
