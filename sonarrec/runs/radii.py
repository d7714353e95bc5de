"""Which radius of the landmarks fits a log: `sonarrec info --try-radii`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

from sonarrec.landmarks import LandmarkSet
from sonarrec.readers.log import Log
from sonarrec.recogniser.three_stages import FRAMEWORK
from sonarrec.runs.frames import Recogniser

# With a radius that is 5 % off one landmark in twenty is lost, with 10 % half or more (`make
# stated`): steps of 10 % leave no gap.
STEP = 1.1
STEPS = 7  # of radii above the stated one, and below: 0.51 to 1.95 times
STRETCHES = 8  # landmarks may be in view in a part of the log alone
MOST_FRAMES = 256
MOST_BYTES = 2**26  # all frames are kept, since every radius needs them
CLEARLY_MORE = 2.0
FEW = 8


@dataclass(frozen=True, slots=True)
class RadiusTrial:
    """What was recognised with one radius of the landmark set.

    frames_declared: frames in which at least one landmark is declared. ids: the same for each ID
    that is declared at all.
    """

    radius_m: float
    frames_declared: int
    ids: dict[int, int]


@dataclass(frozen=True, slots=True)
class RadiusTrials:
    """The trials, by rising radius. frames: number of frames that each of them saw."""

    stated_m: float
    frames: int
    trials: tuple[RadiusTrial, ...]

    def as_table(self) -> dict[str, Any]:
        """Every field by its name, and the radius that clearly fits better, for JSON."""
        return {**asdict(self), "better_m": self.better.radius_m if self.better else None}

    @property
    def better(self) -> RadiusTrial | None:
        """The trial that declares most, if it clearly declares more than the stated radius."""
        stated = next(t for t in self.trials if t.radius_m == self.stated_m)
        best = max(self.trials, key=lambda t: t.frames_declared)
        clear = best.frames_declared > max(CLEARLY_MORE * stated.frames_declared, FEW)
        return best if clear else None


def try_radii(
    log: Log, landmarks: LandmarkSet, frame_count: int | None, observe: Callable[[int], None]
) -> RadiusTrials:
    """Recognise a part of a log with radii from half to twice that of the landmark set.

    The preset is `default`. frame_count: of the log; None if unknown: then its first frames are
    used. observe: called after each frame of each trial with the number of all these frames.
    Raises SonarrecError if no frame can be used.
    """
    first = next(iter(log))
    most = max(min(MOST_FRAMES, MOST_BYTES // first.pixels.nbytes), STRETCHES)
    frames = [frame for span in _spans(most, frame_count) for frame in log.within(span)]
    others = [float(f"{landmarks.radius_m * STEP**k:.3g}") for k in range(-STEPS, STEPS + 1) if k]
    visible = [radius_m for radius_m in others if radius_m <= first.fan.range_max_m]
    radii_m = sorted([*visible, landmarks.radius_m])
    trials = []
    for radius_m in radii_m:
        recogniser = Recogniser(log, landmarks=replace(landmarks, radius_m=radius_m))
        any_id, ids = 0, Counter[int]()
        for result in recogniser.recognise(frames):
            declared = {
                e.landmark for e in result.estimates if e.method == FRAMEWORK and e.declared
            }
            any_id += bool(declared)
            ids.update(declared)
            observe(len(radii_m) * len(frames))
        trials.append(RadiusTrial(radius_m, any_id, dict(sorted(ids.items()))))
    return RadiusTrials(landmarks.radius_m, len(frames), tuple(trials))


def _spans(most: int, frame_count: int | None) -> list[tuple[int, int]]:
    """(first number, one past the last) of stretches with `most` frames together, spread evenly."""
    if frame_count is None or frame_count <= most:
        return [(0, most)]
    length = most // STRETCHES
    begins = [round(n * (frame_count - length) / (STRETCHES - 1)) for n in range(STRETCHES)]
    return [(begin, begin + length) for begin in begins]
