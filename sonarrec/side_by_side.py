"""Several presets over the same frames, and what an `offline` one knows in hindsight."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sonarrec.appearance import Judge
from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.poses import PoseTable
from sonarrec.recogniser import FRAMEWORK, SMI, Followed, Recogniser
from sonarrec.records import Estimate, Fan, FloatArray, Frame, FrameResult

# Stage 3 takes so many frames at once and costs less than half; of twice as many hardly less still.
FRAMES_AT_ONCE = 8
LEAST_BELIEF = 1e-2  # in a logarithm: no single frame rules an ID out for good


@dataclass(slots=True)
class _Opinion:
    """What a track's frames said of it, all taken together.

    log_beliefs: (K + 1,) weighted sum over the frames of log belief. weight: sum of the weights.
    turns: per ID, (score, degrees from the line of sight, their standard error) when surest of it.
    """

    log_beliefs: FloatArray
    weight: float = 0.0
    frames: int = 0
    last_frame: int = 0
    turns: dict[int, tuple[float, float, float]] = field(default_factory=dict)

    def beliefs(self) -> FloatArray:
        """(K + 1,) weighted geometric mean of the beliefs, which sums to 1."""
        mean = np.exp(self.log_beliefs / self.weight)
        return np.asarray(mean / mean.sum())


class Hindsight:
    """Revises past estimates of one method by what was learned of their tracks since.

    A track is one object, so one belief holds for all its frames: the mean of what each frame
    said, in logarithms, weighed by how many frames it had seen by then and by how sure it was. The
    last word alone would not do: as it leaves the view, or is taken for another on its return, a
    track is known badly.
    """

    def __init__(self, method: str, config: Config, landmarks: LandmarkSet) -> None:
        self._method = method
        self._lag = config.features.lag_frames
        self._threshold = config.features.declare
        self._ids = landmarks.ids
        self._opinions: dict[int, _Opinion] = {}

    def learn(self, result: FrameResult) -> None:
        """Take in a frame's estimates."""
        for estimate in result.estimates:
            if estimate.method == self._method:
                self._add(result.index, estimate)
        # No result still waiting is of an older track.
        oldest = result.index - 2 * self._lag
        self._opinions = {k: o for k, o in self._opinions.items() if o.last_frame >= oldest}

    def _add(self, frame: int, estimate: Estimate) -> None:
        opinion = self._opinions.setdefault(estimate.object, _Opinion(np.zeros(len(self._ids) + 1)))
        opinion.frames += 1
        beliefs = np.maximum(estimate.probabilities, LEAST_BELIEF)
        # Minus the entropy: its exponential is 1 where the frame is sure, 1 / (K + 1) where it is
        # not. Squared: tuning seeds.
        weight = opinion.frames * float(np.exp(beliefs @ np.log(beliefs))) ** 2
        opinion.weight += weight
        opinion.log_beliefs += weight * np.log(beliefs)
        opinion.last_frame = frame
        if estimate.score > opinion.turns.get(estimate.landmark, (0.0,))[0]:
            turn = estimate.orientation_deg + estimate.bearing_deg
            sigma = estimate.orientation_sigma_deg
            opinion.turns[estimate.landmark] = (estimate.score, turn, sigma)

    def revised(self, result: FrameResult) -> FrameResult:
        """A past result, learned before, as it is seen now."""
        return replace(result, estimates=tuple(self._revise(e) for e in result.estimates))

    def _revise(self, estimate: Estimate) -> Estimate:
        if estimate.method != self._method:
            return estimate
        opinion = self._opinions[estimate.object]
        beliefs = opinion.beliefs()
        best = int(beliefs[: len(self._ids)].argmax())
        landmark, score = self._ids[best], float(beliefs[best])
        turn, sigma = estimate.orientation_deg + estimate.bearing_deg, np.nan
        if landmark in opinion.turns:
            _, turn, sigma = opinion.turns[landmark]
        return replace(
            estimate,
            probabilities=beliefs,
            landmark=landmark,
            score=score,
            declared=score >= self._threshold,
            # The line of sight turns with the bearing, the object as seen from it does not.
            orientation_deg=(turn - estimate.bearing_deg) % 360,
            orientation_sigma_deg=sigma,
        )


class SideBySide:
    """Several configurations over the same frames, their results put together.

    Of one configuration the methods are plain `smi` and `framework`; of several each has its
    preset's name behind it. Presets that judge the same candidates by the same rule have one
    `smi`, named for the first of them. Results wait for the longest lag, and for the frames that
    stage 3 takes at once.

    tracking: the names of the framework's methods. methods: all names.
    """

    def __init__(
        self,
        configs: Sequence[Config],
        fan: Fan,
        landmarks: LandmarkSet,
        model: Judge | None = None,
        poses: PoseTable | None = None,
    ) -> None:
        behind = [f":{c.preset}" if len(configs) > 1 else "" for c in configs]
        self.tracking = [FRAMEWORK + name for name in behind]
        judged = [(c.candidates, c.smi) for c in configs]
        single = [
            SMI + name if same not in judged[:i] else None
            for i, (same, name) in enumerate(zip(judged, behind, strict=True))
        ]
        both = zip(single, self.tracking, strict=True)
        self.methods = [name for pair in both for name in pair if name is not None]
        self._recognisers = [
            Recogniser(config, fan, landmarks, model, method, smi=smi, poses=poses)
            for config, method, smi in zip(configs, self.tracking, single, strict=True)
        ]
        self._hindsight = [
            Hindsight(method, config, landmarks) if config.features.lag_frames else None
            for config, method in zip(configs, self.tracking, strict=True)
        ]
        self._lag = max(config.features.lag_frames for config in configs)
        self._followed: list[list[Followed]] = []  # frame by frame
        self._pending: deque[list[FrameResult]] = deque()

    def step(self, frame: Frame) -> Iterator[FrameResult]:
        """The results that are final after this frame, in the log's order."""
        self._followed.append([recogniser.follow(frame) for recogniser in self._recognisers])
        if len(self._followed) == FRAMES_AT_ONCE:
            yield from self.judge()

    def judge(self) -> Iterator[FrameResult]:
        """Stage 3 of the frames that wait for it: the results that are final after them."""
        followed, self._followed = self._followed, []
        if not followed:
            return
        by_recogniser = zip(*followed, strict=True)
        parts = [r.judge(f) for r, f in zip(self._recognisers, by_recogniser, strict=True)]
        for results in map(list, zip(*parts, strict=True)):
            for hindsight, result in zip(self._hindsight, results, strict=True):
                if hindsight is not None:
                    hindsight.learn(result)
            self._pending.append(results)
            if len(self._pending) > self._lag:
                yield self._final()

    def finish(self) -> Iterator[FrameResult]:
        """The results that were still waiting."""
        yield from self.judge()
        while self._pending:
            yield self._final()

    def problems(self) -> list[str]:
        """What of the poses could not be used, so far."""
        return list(dict.fromkeys(p for r in self._recognisers for p in r.odometry.problems()))

    def notes(self) -> list[str]:
        """What of the poses the frames contradict, so far."""
        return list(dict.fromkeys(n for r in self._recognisers for n in r.odometry.notes()))

    def _final(self) -> FrameResult:
        results = [
            result if hindsight is None else hindsight.revised(result)
            for hindsight, result in zip(self._hindsight, self._pending.popleft(), strict=True)
        ]
        return replace(results[0], estimates=tuple(e for r in results for e in r.estimates))
