"""Which radius, or ring, of the landmarks fits a log: `sonarrec info --try-radii`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

from sonarrec.errors import UsageError
from sonarrec.landmarks import DrawnSet, LandmarkSet
from sonarrec.readers.log import Log
from sonarrec.recogniser.three_stages import FRAMEWORK
from sonarrec.runs.frames import Recogniser

# With a radius that is 5 % off one landmark in twenty is lost, with 10 % half or more (`make
# stated`): steps of 10 % leave no gap.
STEP = 1.1
STEPS = 7  # of radii above the stated one, and below: 0.51 to 1.95 times
EDGES = (0.8, 0.9, 1.1, 1.2)  # of the ring's inner edge, at the stated radius
LEAST_RING = 0.02
STRETCHES = 8  # landmarks may be in view in a part of the log alone
MOST_FRAMES = 256
MOST_BYTES = 2**26  # all frames are kept, since every radius needs them
CLEARLY_MORE = 2.0
ALIKE = 0.9  # a ring is named if with the best radius fewer than so many of its frames declare
FEW = 8


@dataclass(frozen=True, slots=True)
class RadiusTrial:
    """What was recognised with one radius and ring of the landmark set.

    ring_from: where the ring begins, as a share of the radius. frames_declared: frames in which at
    least one landmark is declared. ids: the same for each ID that is declared at all.
    """

    radius_m: float
    ring_from: float
    frames_declared: int
    ids: dict[int, int]


@dataclass(frozen=True, slots=True)
class RadiusTrials:
    """The trials, by rising radius, then by ring. frames: number that each of them saw."""

    stated_m: float
    stated_from: float
    frames: int
    trials: tuple[RadiusTrial, ...]

    def as_table(self) -> dict[str, Any]:
        """Every field by its name, and the radius and ring that clearly fit better, for JSON."""
        m, ring = (self.better.radius_m, self.better.ring_from) if self.better else (None, None)
        return {**asdict(self), "better_m": m, "better_from": ring}

    @property
    def better(self) -> RadiusTrial | None:
        """The trial that declares most, if it clearly declares more than the stated set."""
        stated = next(t for t in self.trials if self.is_stated(t))
        radii = [t for t in self.trials if t.ring_from == self.stated_from]
        best = max(radii, key=lambda t: t.frames_declared)
        rings = [t for t in self.trials if ALIKE * t.frames_declared > best.frames_declared]
        best = min(rings, key=lambda t: abs(t.ring_from - self.stated_from), default=best)
        clear = best.frames_declared > max(CLEARLY_MORE * stated.frames_declared, FEW)
        return best if clear else None

    def is_stated(self, trial: RadiusTrial) -> bool:
        """Whether it is that of the set as stated."""
        return (trial.radius_m, trial.ring_from) == (self.stated_m, self.stated_from)


def try_radii(
    log: Log, landmarks: LandmarkSet, frame_count: int | None, observe: Callable[[int], None]
) -> RadiusTrials:
    """Recognise a part of a log with radii from half to twice that of the landmark set, and with
    other inner edges of the ring.

    The preset is `default`. frame_count: of the log; None if unknown: then its first frames are
    used. observe: called after each frame of each trial with the number of all these frames.
    Raises SonarrecError if no frame can be used.
    """
    if isinstance(landmarks, DrawnSet):
        raise UsageError(f"landmark set {landmarks.name}: other radii are tried of discs alone")
    first = next(iter(log))
    most = max(min(MOST_FRAMES, MOST_BYTES // first.pixels.nbytes), STRETCHES)
    frames = [frame for span in _spans(most, frame_count) for frame in log.within(span)]
    others = [float(f"{landmarks.radius_m * STEP**k:.3g}") for k in range(-STEPS, STEPS + 1) if k]
    visible = [radius_m for radius_m in others if radius_m <= first.fan.range_max_m]
    sets = [replace(landmarks, radius_m=m) for m in sorted([*visible, landmarks.radius_m])]
    inner, outer = landmarks.ring
    edges = [round(share * inner, 3) for share in EDGES]
    sets += [
        replace(landmarks, ring=(edge, outer))
        for edge in edges
        if landmarks.symbol[1] <= edge < outer - LEAST_RING and edge != inner
    ]
    trials = []
    for tried in sets:
        recogniser = Recogniser(log, landmarks=tried)
        any_id, ids = 0, Counter[int]()
        for result in recogniser.recognise(frames):
            declared = {
                e.landmark for e in result.estimates if e.method == FRAMEWORK and e.declared
            }
            any_id += bool(declared)
            ids.update(declared)
            observe(len(sets) * len(frames))
        trials.append(RadiusTrial(tried.radius_m, tried.ring[0], any_id, dict(sorted(ids.items()))))
    return RadiusTrials(landmarks.radius_m, inner, len(frames), tuple(trials))


def _spans(most: int, frame_count: int | None) -> list[tuple[int, int]]:
    """(first number, one past the last) of stretches with `most` frames together, spread evenly."""
    if frame_count is None or frame_count <= most:
        return [(0, most)]
    length = most // STRETCHES
    begins = [round(n * (frame_count - length) / (STRETCHES - 1)) for n in range(STRETCHES)]
    return [(begin, begin + length) for begin in begins]
