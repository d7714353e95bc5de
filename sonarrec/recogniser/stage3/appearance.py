"""The default measurement: the symbol read off a disc's shape matrix, averaged along its track.

The paper measures each frame by itself. It normalises the similarities, so that they cannot say
that a disc is no landmark. Here the grey shape matrix is averaged in the object's own frame: angles
count from the line of sight at the track's beginning. A pan does not rotate the line of sight over
the floor; a sonar that moves past the object does. Small networks read the average's symbol,
whatever that is (reader.py). The beliefs of the track's frames so far are pooled (opinions.py), in
place of Eq. 5 to 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, NamedTuple, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, Columns, FloatArray, IntArray, Table, stacked
from sonarrec.config import Features
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.plane import Plane
from sonarrec.recogniser.stage3 import Beliefs, likeliest
from sonarrec.recogniser.stage3.opinions import Opinion, pooled
from sonarrec.recogniser.stage3.reader import Pictures, Reading, sigmoid
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, rounded_steps
from sonarrec.recogniser.tracks import Tracks

_T = TypeVar("_T", bound=np.generic)
# A track that comes back into view is judged by its new picture. The picture from before it left is
# added with weight OLD_SHARE if the two correlate by at least AT_ONCE_CORRELATION, or from the
# RETURN_FRAMES-th frame on by RETURN_CORRELATION. Speckle stays with the floor, so two pictures of
# one landmark are similar.
AT_ONCE_CORRELATION, RETURN_FRAMES, RETURN_CORRELATION, OLD_SHARE = 0.75, 3, 0.5, 0.5
# An ID is declared from the LEAST_FRAMES-th frame of a track on, if enough of the disc is in view.
# Discs fewer than FEW_BEAMS beams wide need more, since one frame hardly shows their symbol.
LEAST_FRAMES, FEW_BEAMS, FRAMES_OF_FEW_BEAMS = 2, 5, 8
# Most new tracks arise by chance and end soon. So a track is judged from its LEAST_FRAMES-th frame
# on, if its object exists with at least the probability LEAST_EXISTENCE.
LEAST_EXISTENCE = 0.5
HALF_POWER = 2 * (2 * np.log(2)) ** 0.5  # width of a Gaussian at half power, in its sigmas


class Reads(Protocol):
    """Reads symbols off pictures: a Reader, or what keeps the pictures to learn from."""

    every_frame: ClassVar[bool]
    """True while samples are gathered: every track is read in every frame."""

    def __call__(self, pictures: Pictures, /) -> Reading:
        """What is read off n pictures."""
        ...


class _Picture(NamedTuple):
    """A track's picture: (L, ANGLES) faded sums of its cells and of how often each was seen."""

    total: FloatArray
    seen: FloatArray
    episode: int
    opinion: Opinion

    def correlation(self, total: FloatArray, seen: FloatArray) -> float:
        """Correlation with another over the cells that both have seen; 0 if fewer than two."""
        both = (self.seen > 0) & (seen > 0)
        if np.count_nonzero(both) < 2:
            return 0.0
        a, b = self.total[both] / self.seen[both], total[both] / seen[both]
        a, b = a - a.mean(), b - b.mean()
        return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-9))


class AppearanceMeasurement:
    """Beliefs from each track's averaged shape matrix, frame by frame.

    Frames fade with a memory of `memory_frames`; cells are weighted by how often they were seen. A
    track that comes back into view begins a new picture and a new episode. If the new picture
    proves similar to the one before, the earlier episode is resumed (see RETURN_FRAMES).

    Its columns of the tracks: total, seen: (n, L, ANGLES) as in _Picture. frames: (n,) of the
    picture. episode: (n,) its number, and opinion: (n,) the pool of its frames. before: (n,) the
    earlier _Picture of a remembered track, or of one that is back and not yet known to be the same
    object.
    """

    least_frames: int = LEAST_FRAMES
    """Of a track, before it is judged."""

    def __init__(
        self,
        config: Features,
        plane: Plane,
        tracks: Tracks,
        lines: int,
        landmarks: LandmarkSet,
        read: Reads,
        beam_width_deg: float,
    ) -> None:
        """lines: L."""
        self._plane, self._tracks, self._read = plane, tracks, read
        self._keep = 1 - 1 / max(config.memory_frames, 1.0)
        cells = np.zeros((lines, ANGLES))
        tracks.declare(total=cells, seen=cells, frames=0, episode=0, opinion=None, before=None)
        self._last_episode = 0
        self._ids = len(landmarks.ids)
        self._beam_sigma = np.radians(beam_width_deg / HALF_POWER)
        self._radius_m = landmarks.radius_m

    def gather(self, grey: FloatArray, seen: BoolArray) -> Columns:
        """Add a frame's matrices (n, L, ANGLES), from ShapeSampler, to the averages of the n tracks
        in view."""
        tracks, rows = self._tracks, self._tracks.in_view
        self._begin_pictures(rows)
        steps, _ = rounded_steps(tracks["sight_deg"][rows])
        grey, seen = _rotated(grey, steps), _rotated(seen, steps)
        tracks["total"][rows] = self._keep * tracks["total"][rows] + np.where(seen, grey, 0.0)
        tracks["seen"][rows] = self._keep * tracks["seen"][rows] + seen
        tracks["frames"][rows] += 1
        for row in rows:
            if tracks["before"][row] is not None:
                self._compare_pictures(row)
        total, count = (_rotated(tracks[name][rows], -steps) for name in ("total", "seen"))
        own = {name: tracks[name][rows] for name in ("frames", "episode", "opinion")}
        return {"brightness": total / np.maximum(count, 1e-9), "count": count, **own}

    def _begin_pictures(self, rows: IntArray) -> None:
        """Begin a picture of every track that has come into view; keep those of tracks that left.

        rows: of the tracks in view.
        """
        tracks = self._tracks
        total, seen, frames = tracks["total"], tracks["seen"], tracks["frames"]
        for row in np.flatnonzero(tracks["remembered"] & (frames > 0)):
            if tracks["before"][row] is None:
                picture = total[row].copy(), seen[row].copy()
                episode = tracks["episode"][row], tracks["opinion"][row]
                tracks["before"][row] = _Picture(*picture, *episode)
            total[row] = seen[row] = frames[row] = 0
        for row in rows[frames[rows] == 0]:
            self._last_episode += 1
            tracks["episode"][row], tracks["opinion"][row] = self._last_episode, Opinion()

    def _compare_pictures(self, row: int) -> None:
        """Add the earlier picture of a track that came back, or drop it (RETURN_FRAMES)."""
        tracks, picture = self._tracks, self._tracks["before"][row]
        correlation = picture.correlation(tracks["total"][row], tracks["seen"][row])
        decided = tracks["frames"][row] >= RETURN_FRAMES
        if correlation >= (RETURN_CORRELATION if decided else AT_ONCE_CORRELATION):
            tracks["total"][row] += OLD_SHARE * picture.total
            tracks["seen"][row] += OLD_SHARE * picture.seen
            tracks["frames"][row] = max(tracks["frames"][row], RETURN_FRAMES)
            tracks["episode"][row] = picture.episode
            tracks["opinion"][row] = Opinion(picture.opinion, tracks["opinion"][row])
            decided = True
        if decided:
            tracks["before"][row] = None

    def beliefs(self, frames: Sequence[Table]) -> Beliefs:
        """Beliefs about the tracks of consecutive frames."""
        tracks = stacked(frames)
        smear = self._smear(tracks["position"])
        existence, seen_in = tracks["existence"], tracks["frames"]
        # Judge the tracks that are likely to be objects; of the others nothing is known.
        likely = (seen_in >= self.least_frames) & (existence >= LEAST_EXISTENCE)
        due = np.flatnonzero(likely | self._read.every_frame)
        reading = self._read(
            Pictures(tracks["brightness"][due], tracks["count"][due], existence[due], smear[due])
        )
        n, ids = len(smear), self._ids
        of_frames = np.full((n, ids + 1), 1 / (ids + 1))
        rotation, rotation_sigma = np.zeros((n, ids)), np.full((n, ids), np.nan)
        lit = np.full((n, ANGLES), np.nan)
        of_frames[due], lit[due] = reading.probabilities, sigmoid(reading.lit)
        rotation[due], rotation_sigma[due] = reading.rotation, reading.rotation_sigma
        probabilities = pooled(tracks["opinion"], of_frames)
        best, _ = likeliest(probabilities)
        # A beam is HALF_POWER sigmas wide, a disc two radii.
        few_beams = smear * HALF_POWER * FEW_BEAMS > 2
        least_frames = np.where(few_beams, FRAMES_OF_FEW_BEAMS, self.least_frames)
        enough_evidence = seen_in >= least_frames
        return Beliefs(
            probabilities,
            rotation[np.arange(n), best],
            rotation_sigma[np.arange(n), best],
            enough_evidence & tracks["shown"],
            lit=lit,
        )

    def _smear(self, positions: FloatArray) -> FloatArray:
        """(n,) the beam's standard deviation across the line of sight, in disc radii.

        positions: (n, 2) working pixels.
        """
        range_m, _ = self._plane.to_polar(*positions.T)
        return np.asarray(self._beam_sigma * range_m / self._radius_m)


def _rotated(cells: npt.NDArray[_T], steps: IntArray) -> npt.NDArray[_T]:
    """Matrices (n, L, ANGLES), each rotated by its number of steps (n,)."""
    if not steps.any():
        return cells
    index = (np.arange(ANGLES) - steps[:, None]) % ANGLES
    return np.take_along_axis(cells, index[:, None], axis=2)
