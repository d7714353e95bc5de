"""Which track declared what, and when: the lines that `sonarrec run` ends with."""

from __future__ import annotations

from dataclasses import dataclass

from sonarrec.records import FrameResult


@dataclass(slots=True)
class Sighting:
    """One landmark as one track declared it: what `sonarrec run` prints."""

    landmark: int
    track: int
    first: FrameResult
    last: FrameResult
    frames: int
    best_score: float


class Sightings:
    """Gathers which landmarks one method declared, when and how surely."""

    def __init__(self, method: str) -> None:
        self.method = method
        self._found: dict[tuple[int, int], Sighting] = {}

    def add(self, result: FrameResult) -> None:
        """Take in one frame's declared estimates."""
        for estimate in result.estimates:
            if estimate.method != self.method or not estimate.declared:
                continue
            key = (estimate.landmark, estimate.object)
            known = self._found.setdefault(key, Sighting(*key, result, result, 0, 0.0))
            known.last = result
            known.frames += 1
            known.best_score = max(known.best_score, estimate.score)

    def table(self) -> list[str]:
        """Lines to print, one per landmark and track, in order of first sight."""
        if not self._found:
            return ["no landmark declared"]
        lines = ["landmark  track  frames         from s      to s  declared  best score"]
        for s in sorted(self._found.values(), key=lambda s: (s.first.index, s.track)):
            span = f"{s.first.index}-{s.last.index}"
            times = (s.first.timestamp_ns / 1e9, s.last.timestamp_ns / 1e9)
            lines.append(
                f"{s.landmark:>8}  {s.track:>5}  {span:<11} {times[0]:>9.2f} {times[1]:>9.2f}"
                f"  {s.frames:>8}  {s.best_score:>10.3f}"
            )
        return lines
