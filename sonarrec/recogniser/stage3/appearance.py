"""The default measurement: the appearance of a disc's shape matrix, averaged along its track.

The paper measures each frame by itself. It normalises the similarities, so that they cannot say
that a disc is no landmark. Here the grey shape matrix is averaged in the object's own frame
(track_matrix.py), described under every ID (description.py), and judged by a model of landmarks
(model.py). The beliefs of the track's frames so far are pooled (opinions.py), in place of Eq. 5 to
8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import ClassVar, Protocol

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IndexArray, IntArray, joined
from sonarrec.config import Features
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.plane import Plane
from sonarrec.recogniser.stage3 import Beliefs, Evidence, likeliest
from sonarrec.recogniser.stage3.description import Describer, Description
from sonarrec.recogniser.stage3.opinions import TrackBelief
from sonarrec.recogniser.stage3.shape_matrix import ShapeSampler, rounded_steps
from sonarrec.recogniser.stage3.track_matrix import TrackMatrix
from sonarrec.records import Groups

# An ID is declared from the LEAST_FRAMES-th frame of a track on, if enough of the disc is in view.
# Discs fewer than FEW_BEAMS beams wide need more, since one frame hardly shows their symbol.
LEAST_FRAMES, FEW_BEAMS, FRAMES_OF_FEW_BEAMS = 2, 5, 8
# Most new tracks arise by chance and end soon. So a track is judged from its LEAST_FRAMES-th frame
# on, if its object exists with at least the probability LEAST_EXISTENCE. Its averaged picture
# changes little from frame to frame. So after CONVERGED_FRAMES frames every JUDGED_EVERY-th is
# judged. In the frames between these its judgement is used if it was SURE; else each of them has a
# judgement of its own.
CONVERGED_FRAMES, JUDGED_EVERY, LEAST_EXISTENCE = 8, 3, 0.5
SURE = 0.97  # probability of one ID, or of none: .9 loses a third of the gain (tiny discs)
# Hidden arcs are looked for and left out only if an ID has at least this probability.
LIKELY = 0.4
HALF_POWER = 2 * (2 * np.log(2)) ** 0.5  # width of a Gaussian at half power, in its sigmas


class Classifier(Protocol):
    """Judges discs by their features."""

    every_frame: ClassVar[bool]
    """True while samples are gathered: every track is judged in every frame, and hidden arcs are
    not left out."""

    def probabilities(self, features: FloatArray, smear: FloatArray) -> FloatArray:
        """(n, K + 1): every ID, then 'none of these'; rows sum to 1.

        features: (n, K, F). smear: (n,) the beam's sigma across the line of sight, in disc radii.
        """
        ...


@dataclass(frozen=True, slots=True)
class _Judged:
    """What the model says of n objects.

    probabilities: (n, K + 1). rotation, rotation_sigma: (n, K) steps; the rotation is counted from
    the line of sight at the track's beginning.
    """

    probabilities: FloatArray
    rotation: FloatArray
    rotation_sigma: FloatArray


class AppearanceMeasurement:
    """Beliefs from each track's averaged shape matrix, frame by frame."""

    def __init__(
        self,
        config: Features,
        plane: Plane,
        sampler: ShapeSampler,
        landmarks: LandmarkSet,
        model: Classifier,
        beam_width_deg: float,
        remember_frames: int,
    ) -> None:
        """remember_frames: as in TrackBelief."""
        self._plane = plane
        self._matrix = TrackMatrix(config.memory_frames, len(sampler.radii))
        self._describe = Describer(
            sampler.bands, sampler.radii, landmarks, correlation_length=config.alike_radii
        )
        self._model = model
        # _earlier: row 0 is an unknown object. The others are the last judgements of the tracks in
        # view or remembered. _rows: their rows by (track number, episode).
        self._rows: dict[tuple[int, int], int] = {}
        ids = len(landmarks.ids)
        nothing = np.zeros((1, ids)), np.full((1, ids), np.nan)
        self._earlier = _Judged(np.full((1, ids + 1), 1 / (ids + 1)), *nothing)
        self._belief = TrackBelief(len(landmarks.ids), remember_frames)
        self._beam_sigma = np.radians(beam_width_deg / HALF_POWER)
        self._radius_m = landmarks.radius_m

    def gather(self, groups: Groups, grey: FloatArray, seen: BoolArray) -> Evidence:
        """Add a frame's matrices (n, L, ANGLES), from ShapeSampler, to the tracks' averages."""
        return self._matrix.step(groups, grey, seen)

    def beliefs(self, groups: Sequence[Groups], evidence: Evidence) -> Beliefs:
        """Beliefs about the groups of consecutive frames; evidence: from `gather`, concatenated."""
        tracked = joined(groups)
        smear = self._smear(tracked.positions)
        steps, _ = rounded_steps(tracked.sight_deg)
        judged, row = self._judged(groups, tracked, evidence, smear, steps)
        probabilities = self._belief(groups, evidence, judged.probabilities[row])
        best, _ = likeliest(probabilities)
        # A beam is HALF_POWER sigmas wide, a disc two radii.
        few_beams = smear * HALF_POWER * FEW_BEAMS > 2
        enough_evidence = evidence.frames >= np.where(few_beams, FRAMES_OF_FEW_BEAMS, LEAST_FRAMES)
        enough_evidence &= tracked.in_view
        return Beliefs(
            probabilities,
            judged.rotation[row, best] - steps,
            judged.rotation_sigma[row, best],
            enough_evidence,
        )

    def _judged(
        self,
        groups: Sequence[Groups],
        tracked: Groups,
        evidence: Evidence,
        smear: FloatArray,
        steps: IntArray,
    ) -> tuple[_Judged, IndexArray]:
        """Judgements by the model, and for each of n objects the row that holds its judgement.

        tracked: the n of all groups. steps: (n,) rotation of the line of sight since the track
        began, in whole steps.
        """
        rows = self._rows
        due, between = list[int](), list[int]()
        first = len(self._earlier.probabilities)
        row = np.zeros(len(smear), np.intp)
        keys = [*zip(tracked.numbers.tolist(), evidence.episodes.tolist(), strict=True)]
        ages = zip(evidence.frames.tolist(), tracked.existence.tolist(), strict=True)
        for i, (key, (frames, existence)) in enumerate(zip(keys, ages, strict=True)):
            likely = frames >= LEAST_FRAMES and existence >= LEAST_EXISTENCE
            wanted = (
                key not in rows
                or frames <= CONVERGED_FRAMES
                or (frames + key[0]) % JUDGED_EVERY == 0
            )
            if (likely and wanted) or self._model.every_frame:
                rows[key] = first + len(due)
                due.append(i)
            elif likely:
                between.append(i)
            row[i] = rows.get(key, 0)

        def judge(indices: list[int]) -> _Judged:
            existence = tracked.existence
            description = self._describe(
                evidence.brightness[indices],
                evidence.count[indices],
                existence[indices],
                smear[indices],
            )
            return _Judged(
                self._probabilities(description, evidence, existence, smear, indices),
                description.rotation + steps[indices, None],
                description.rotation_sigma,
            )

        judged = joined([self._earlier, judge(due)])
        unsure = judged.probabilities.max(axis=1) < SURE
        if between := [i for i in between if unsure[row[i]]]:
            row[between] = len(judged.probabilities) + np.arange(len(between))
            judged = joined([judged, judge(between)])
        last = groups[-1]
        known = {*last.numbers.tolist(), *last.remembered.tolist()}
        kept = [key for key in rows if key[0] in known]
        of_kept = [0, *(rows[key] for key in kept)]
        self._earlier = _Judged(*(getattr(judged, f.name)[of_kept] for f in fields(judged)))
        self._rows = {key: i for i, key in enumerate(kept, 1)}
        return judged, row

    def _probabilities(
        self,
        description: Description,
        evidence: Evidence,
        existence: FloatArray,
        smear: FloatArray,
        indices: Sequence[int],
    ) -> FloatArray:
        """(m, K + 1) by the model, of the m objects at these indices; description: of these.

        What lies under silt is not dark: an ID keeps the smaller of its probabilities with and
        without the arcs where no ring shows.
        """
        probabilities = self._model.probabilities(description.features, smear[indices])
        if self._model.every_frame:
            return probabilities
        likely = np.flatnonzero(probabilities[:, :-1].max(axis=1, initial=0) >= LIKELY)
        if not len(likely):
            return probabilities
        row = np.asarray(indices)[likely]
        hidden = self._describe.hidden(evidence.brightness[row], evidence.count[row])
        some = hidden.any(axis=1)
        if some.any():
            likely, row, hidden = likely[some], row[some], hidden[some]
            shown = evidence.count[row] * ~hidden[:, None]
            parts = self._describe(evidence.brightness[row], shown, existence[row], smear[row])
            least = self._model.probabilities(parts.features, smear[row])
            np.minimum(least, probabilities[likely], out=least)
            least[:, -1] = 1 - least[:, :-1].sum(axis=1)
            probabilities[likely] = least
        return probabilities

    def _smear(self, positions: FloatArray) -> FloatArray:
        """(n,) the beam's standard deviation across the line of sight, in disc radii.

        positions: (n, 2) working pixels.
        """
        range_m, _ = self._plane.to_polar(*positions.T)
        return np.asarray(self._beam_sigma * range_m / self._radius_m)
