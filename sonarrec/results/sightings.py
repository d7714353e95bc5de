"""Which track declared what, and when: the end of a run, the head of a report."""

from __future__ import annotations

from dataclasses import dataclass

from sonarrec.records import FrameResult


@dataclass(slots=True)
class Sighting:
    """One landmark as one track declared it."""

    landmark: int  # ID
    track: int | None  # None: of a method without tracks
    first_frame: int  # number in the log, as last_frame and surest
    last_frame: int
    start_ns: int
    end_ns: int
    best_score: float
    surest: int  # the frame of the best score
    right: int | None  # declarations with the landmark's truth beneath; None: truth not known
    frames_declared: int = 0
    declarations: int = 0  # more than frames where a frame has several
    total_score: float = 0.0

    @property
    def mean_score(self) -> float:
        """Of all declarations."""
        return self.total_score / self.declarations


class Sightings:
    """Gathers which landmarks one method declared, when and how surely. Frames come in order."""

    def __init__(self, method: str) -> None:
        self.method = method
        self._found: dict[tuple[int, int | None], Sighting] = {}

    def add(self, result: FrameResult) -> None:
        """Take in one frame's declared estimates."""
        for e in result.estimates:
            if e.method == self.method and e.declared:
                self.declared(result.index, result.timestamp_ns, e.landmark, e.object, e.score)

    def declared(
        self,
        frame: int,
        timestamp_ns: int,
        landmark: int,
        track: int | None,
        score: float,
        right: bool | None = None,
    ) -> None:
        """Take in one declaration; right: whether the truth is the same, where it is known."""
        sighting = self._found.get((landmark, track))
        if sighting is None:
            unjudged = None if right is None else 0
            sighting = Sighting(landmark, track, frame, -1, timestamp_ns, 0, -1.0, frame, unjudged)
            self._found[landmark, track] = sighting
        sighting.frames_declared += frame != sighting.last_frame
        sighting.last_frame, sighting.end_ns = frame, timestamp_ns
        sighting.declarations += 1
        sighting.total_score += score
        if sighting.right is not None:
            sighting.right += bool(right)
        if score > sighting.best_score:
            sighting.best_score, sighting.surest = score, frame

    def found(self) -> list[Sighting]:
        """One per landmark and track, in order of first sight."""
        return sorted(
            self._found.values(), key=lambda s: (s.first_frame, -1 if s.track is None else s.track)
        )

    def table(self) -> list[str]:
        """Lines to print, one per landmark and track, in order of first sight."""
        if not self._found:
            return ["no landmark declared"]
        lines = ["landmark  track  frames         from s      to s  declared  best score"]
        for s in self.found():
            span = f"{s.first_frame}-{s.last_frame}"
            lines.append(
                f"{s.landmark:>8}  {s.track:>5}  {span:<11} {s.start_ns / 1e9:>9.2f} "
                f"{s.end_ns / 1e9:>9.2f}  {s.frames_declared:>8}  {s.best_score:>10.3f}"
            )
        return lines
