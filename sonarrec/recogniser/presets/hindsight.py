"""Hindsight of the `offline` preset: one belief for all frames of a track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.estimates import declared
from sonarrec.recogniser.stage3 import likeliest
from sonarrec.recogniser.stage3.opinions import FRAME_EXPONENT, TRACK_EXPONENT, Opinions
from sonarrec.records import Estimate, FrameResult

LEAST_MEAN_BELIEF = 0.5  # of a track's frames in an ID that hindsight declares
# An ID is added to frames of an episode if it was declared in at least this share of those that
# could have declared one. On recordings of other simulators .4 lost .033 of the TPR and saved no
# false claim.
LEAST_SHARE = 0.25


class Hindsight:
    """Revises past estimates of one method by later frames of their tracks.

    A track is one object, so one belief holds for all its frames: the pool of their beliefs (see
    Opinion). The last frame's belief would be worse, since a track is uncertain as it leaves the
    view, and wrong if it is mistaken for another as it returns.

    Frames keep their own beliefs if their mean belief in the pool's ID is below LEAST_MEAN_BELIEF.
    An ID is never declared in a frame where too little of its object is in view. A belief holds for
    one episode of a track (see Evidence), since another object may have got the track's number.

    An ID that most frames of an episode declared by themselves is taken back in none of them, since
    the mean of many frames is blurred where their motion is not quite known. An ID that too few of
    them declared (LEAST_SHARE) is added in none, else a mistake in few frames becomes one in all.

    lag: number of frames that a result waits for its revision.
    """

    def __init__(self, method: str, config: Config, landmarks: LandmarkSet) -> None:
        self._method = method
        self.lag = config.features.lag_frames
        self._threshold = config.features.declare
        self._ids = landmarks.ids
        self._opinions = Opinions(len(landmarks.ids))
        self._frame = 0  # a count, since the numbers of a log's frames may jump

    def learn(self, result: FrameResult) -> None:
        """Add a frame's estimates to the opinions of their tracks."""
        self._frame += 1
        for estimate in result.estimates:
            if estimate.method != self._method:
                continue
            opinion = self._opinions.current(estimate.object, estimate.episode, self._frame)
            opinion.add(estimate.probabilities)
            opinion.with_evidence += estimate.enough_evidence
            if estimate.declared:
                frames = opinion.declared.get(estimate.landmark, 0)
                opinion.declared[estimate.landmark] = frames + 1
            if estimate.score > opinion.orientations.get(estimate.landmark, (0.0,))[0]:
                orientation = estimate.orientation_deg + _sight_rotation(estimate)
                surest = estimate.score, orientation, estimate.orientation_sigma_deg
                opinion.orientations[estimate.landmark] = surest
        # No result that still waits is of an older track.
        self._opinions.drop_before(self._frame - 2 * self.lag)

    def revised(self, result: FrameResult) -> FrameResult:
        """A past result, which `learn` has had, with its tracks' beliefs by now."""
        estimates = list(result.estimates)
        own = [i for i, e in enumerate(estimates) if e.method == self._method]
        if not own:
            return result
        opinions = [self._opinions.get(estimates[i].object, estimates[i].episode) for i in own]
        # Each pool is sharpened as by TrackBelief.
        pools = np.exp((FRAME_EXPONENT + TRACK_EXPONENT) * np.stack([o.mean() for o in opinions]))
        beliefs = pools / pools.sum(axis=1, keepdims=True)
        best, scores = likeliest(beliefs)
        claimed = declared(scores, self._threshold)
        for n, (i, opinion) in enumerate(zip(own, opinions, strict=True)):
            if claimed[n] and opinion.beliefs_sum[best[n]] < LEAST_MEAN_BELIEF * opinion.frames:
                continue
            estimate, landmark = estimates[i], self._ids[best[n]]
            if not (estimate.declared and claimed[n] and landmark == estimate.landmark):
                own_frames = opinion.declared.get(estimate.landmark, 0)
                new_frames = opinion.declared.get(landmark, 0)
                if estimate.declared and 2 * own_frames > opinion.frames:
                    continue  # most frames declared what it would take back
                if claimed[n] and new_frames < LEAST_SHARE * opinion.with_evidence:
                    continue  # too few frames declared what it would add
            rotation = _sight_rotation(estimate)
            unknown = (0.0, estimate.orientation_deg + rotation, np.nan)
            _, orientation, sigma = opinion.orientations.get(landmark, unknown)
            estimates[i] = replace(
                estimate,
                probabilities=beliefs[n],
                landmark=landmark,
                score=float(scores[n]),
                declared=bool(claimed[n]) and estimate.in_view,
                orientation_deg=(orientation - rotation) % 360,
                orientation_sigma_deg=sigma,
            )
        return replace(result, estimates=tuple(estimates))


def _sight_rotation(estimate: Estimate) -> float:
    """Degrees from angles in the image to those from the line of sight at the beginning, which
    rotated in the image by the bearing, and over the floor as the sonar moved past."""
    return estimate.bearing_deg + estimate.sight_deg
