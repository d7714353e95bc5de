"""Several presets over the same frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import cv2

from sonarrec.config import Config
from sonarrec.errors import Diagnostics
from sonarrec.landmarks import DrawnSet, LandmarkSet
from sonarrec.recogniser.presets.hindsight import Hindsight
from sonarrec.recogniser.restore.saturation import Levels
from sonarrec.recogniser.restore.static_pixels import Unchanging
from sonarrec.recogniser.ring_sizes import RingSizes
from sonarrec.recogniser.stage3.reader import Reader, Weights
from sonarrec.recogniser.stage3.shape_matrix import rotated_codes
from sonarrec.recogniser.three_stages import FRAMEWORK, SMI, DiscStages, ThreeStages, Tracked
from sonarrec.sonar.frame import Fan, Frame, FrameResult
from sonarrec.sonar.geometry import PoseTable

# Frames that stage 3 takes at once. One by one, a recording costs 63 to 93 % more time.
FRAMES_AT_ONCE = 16


class _Preset:
    """One configuration: its stages and, where past results are revised, its hindsight.

    method: name of the framework in its estimates. stages: its own, or those of an earlier preset
    that differs only in hindsight. hindsight: None if results are final at once.
    """

    def __init__(
        self, number: int, method: str, stages: ThreeStages, hindsight: Hindsight | None
    ) -> None:
        """number: of the preset; its result is at that index of the results of a frame."""
        self.method, self.stages, self.hindsight = method, stages, hindsight
        self._number = number
        self._unrevised = deque[list[FrameResult]]()

    def own(self, result: FrameResult) -> FrameResult:
        """The result by that of its stages, which may be those of another preset."""
        of_stages = self.stages.method
        if of_stages == self.method:
            return result
        estimates = (e for e in result.estimates if e.method == of_stages)
        return replace(result, estimates=tuple(replace(e, method=self.method) for e in estimates))

    def learn(self, results: list[FrameResult]) -> None:
        """Take in the results of a frame, and revise the one that is as old as the lag.

        Each preset has a lag of its own, so that its results do not depend on the others.
        """
        if self.hindsight is not None:
            self.hindsight.learn(results[self._number])
            self._unrevised.append(results)
            self.revise(self.hindsight.lag)

    def revise(self, most: int) -> None:
        """Revise the oldest results until at most so many wait for it."""
        while self.hindsight is not None and len(self._unrevised) > most:
            results = self._unrevised.popleft()
            results[self._number] = self.hindsight.revised(results[self._number])


class SideBySide:
    """Several configurations over the same frames, with one result for each frame.

    The methods of a single configuration are called `smi` and `framework`; those of several have
    the preset's name appended. Presets with the same candidates and the same SMI share one `smi`,
    named after the first of them. Results wait for the longest lag.

    tracking: the names of the framework's methods. methods: all names. sizes: has seen all frames.
    """

    def __init__(
        self,
        configs: Sequence[Config],
        fan: Fan,
        landmarks: LandmarkSet,
        model: Weights | None = None,
        poses: PoseTable | None = None,
    ) -> None:
        self.methods: list[str] = []
        self._presets: list[_Preset] = []
        by_smi, by_stages = set[object](), dict[Config, ThreeStages]()
        for number, config in enumerate(configs):
            suffix = f":{config.preset}" if len(configs) > 1 else ""
            method, smi = FRAMEWORK + suffix, None
            # The candidates of the ring detector depend on the beam width as well.
            ring = config.candidates.detector == "ring"
            candidates = config.candidates, ring and config.features.beam_width_deg
            if (candidates, config.smi) not in by_smi and not isinstance(landmarks, DrawnSet):
                by_smi.add((candidates, config.smi))
                smi = SMI + suffix
                self.methods.append(smi)
            self.methods.append(method)
            features = replace(config.features, lag_frames=0)
            but_hindsight = replace(config, preset="", features=features)
            if but_hindsight not in by_stages:
                by_stages[but_hindsight] = stages_of(
                    config, fan, landmarks, model, method=method, smi=smi, poses=poses
                )
            lag = config.features.lag_frames
            hindsight = Hindsight(method, config, landmarks) if lag else None
            preset = _Preset(number, method, by_stages[but_hindsight], hindsight)
            self._presets.append(preset)
        self.tracking = [preset.method for preset in self._presets]
        self._stages = list(by_stages.values())
        self._rings = [s for c, s in by_stages.items() if c.candidates.detector == "ring"]
        self._lag = max(config.features.lag_frames for config in configs)
        self._tracked: list[dict[ThreeStages, Tracked]] = []  # frames that wait for stage 3
        # Results that wait, a list of one frame's, one of each preset. Ctrl-C may come at any
        # moment; `waiting` goes on from here.
        self._pending = deque[list[FrameResult]]()
        self._unchanging = Unchanging()
        self._levels = Levels(landmarks.radius_m)
        self.sizes = RingSizes(landmarks)
        self._stretch: int | None = None  # of the frame before

    def recognise(self, frames: Iterable[Frame]) -> Iterator[FrameResult]:
        """Yield the results in the log's order, each when it is final.

        An exception of `frames`, also Ctrl-C, is raised after the results of all frames before it.
        After one in the stages, `waiting` yields what waits, and what was yielded last once more.
        """
        cv2.ipp.setUseIPP(False)  # as in the package: each thread has its own switch
        broken: list[BaseException] = []
        unbroken, count = _until_broken(frames, broken), 0
        for frame in self._levels.restored(self._unchanging.filled(unbroken)):
            if self._stretch not in (None, frame.stretch):
                yield from self.waiting()
                for stages in self._stages:
                    stages.begin_stretch()
            self._stretch = frame.stretch
            self._tracked.append(self._track(frame))
            count += 1
            if len(self._tracked) == FRAMES_AT_ONCE:
                self._judge()
                yield from self._final(self._lag)
        if count == 1 and not broken:
            for stages in self._stages:
                stages.judge_alone()
        yield from self.waiting()
        if broken:
            raise broken[0]

    def _track(self, frame: Frame) -> dict[ThreeStages, Tracked]:
        """Stages 1 and 2 of a frame."""
        tracked = {}
        for stages in self._stages:
            image = stages.working_image(frame)
            candidates = stages.stage1(image)
            tracked[stages] = stages.stage2(frame, image, candidates)
        best = max(
            (tracked[s].candidates["existence"].max(initial=0) for s in self._rings), default=0
        )
        self.sizes.inspect(frame, best)
        return tracked

    def _judge(self) -> None:
        """Stage 3 of the frames that wait for it, and what hindsight makes of them."""
        tracked, self._tracked = self._tracked, []
        if not tracked:
            return
        by_stages = {s: s.stage3([frame[s] for frame in tracked]) for s in self._stages}
        new = [
            [preset.own(by_stages[preset.stages][n]) for preset in self._presets]
            for n in range(len(tracked))
        ]
        self._pending.extend(new)
        for results in new:
            for preset in self._presets:
                preset.learn(results)

    def waiting(self) -> Iterator[FrameResult]:
        """Yield the results that wait at the end of the frames, revised by all frames so far."""
        self._judge()
        for preset in self._presets:
            preset.revise(0)
        yield from self._final(0)

    def report(self, diagnostics: Diagnostics) -> None:
        """Report what is wrong with the frames so far, and with their poses."""
        levels = self._levels
        if 0 < levels.black < levels.seen:
            diagnostics.note(
                f"{levels.black} of {levels.seen} frames are black, the first of them "
                f"{levels.first_black}; landmarks in view there count as missed"
            )
        for stages in self._stages:
            stages.odometry.report(diagnostics)

    @property
    def restored(self) -> tuple[float, float, str]:
        """Shares of static pixels, and of saturated frames so far, restored before stage 1; and
        what these suggest."""
        levels = self._levels
        return self._unchanging.share, levels.saturated / max(levels.seen, 1), levels.cause

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


def stages_of(
    config: Config,
    fan: Fan,
    landmarks: LandmarkSet,
    model: Weights | None,
    *,
    method: str,
    smi: str | None,
    poses: PoseTable | None,
) -> ThreeStages:
    """The three stages for the set's kind of landmark. model: the weights of the reader, None for
    the built-in ones. The other arguments are those of DiscStages."""
    if isinstance(landmarks, DrawnSet):  # plates have no single-frame method
        # Imported where it is needed: most sets are of discs, and it takes a while.
        from sonarrec.recogniser.drawn.three_stages import PlateStages

        return PlateStages(config, fan, landmarks, method=method, poses=poses)
    read = None if model is None else Reader(model, rotated_codes(landmarks))
    return DiscStages(config, fan, landmarks, read, method=method, smi=smi, poses=poses)


def _until_broken(frames: Iterable[Frame], broken: list[BaseException]) -> Iterator[Frame]:
    """The frames before an exception, which goes to `broken`: what reads ahead keeps none back."""
    try:
        yield from frames
    except (Exception, KeyboardInterrupt) as error:
        broken.append(error)
