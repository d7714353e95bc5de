"""The paper's measurement (Section 3.4, Algorithms 1 and 2, Eq. 5 to 8).

The motion model carries each object's belief over the IDs from frame to frame; the measurement
model updates it by the shape matrices of each frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sonarrec.arrays import BoolArray, Columns, FloatArray, Table, stacked
from sonarrec.config import Features
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.stage3 import Beliefs
from sonarrec.recogniser.stage3.shape_matrix import Identification, without_none
from sonarrec.recogniser.tracks import Tracks

# Measurement models, rows k = true ID, columns j = measured ID.
TABLE_2 = np.array(  # range window 1.25 m
    [
        [0.3195, 0.2392, 0.2608, 0.1805],
        [0.2463, 0.3168, 0.1834, 0.2535],
        [0.2554, 0.1742, 0.3230, 0.2474],
        [0.1715, 0.2452, 0.2548, 0.3285],
    ]
)
TABLE_3 = np.array(  # range window 2.50 m
    [
        [0.3341, 0.2480, 0.2520, 0.1659],
        [0.2637, 0.3087, 0.1922, 0.2354],
        [0.2399, 0.1769, 0.3229, 0.2603],
        [0.1681, 0.2485, 0.2515, 0.3319],
    ]
)
LEAST_PREDICTED = 1e-300  # belief, to avoid 0 / 0
PAPER_SECTORS = ((1, 0, 0, 0), (1, 0, 1, 0), (1, 1, 0, 0), (1, 1, 1, 0))


def measurement_model(landmarks: LandmarkSet, window_m: float) -> FloatArray:
    """(K, K) L[k, j] = P(measured as ID j | is ID k); rows sum to 1.

    For the paper's four IDs it is Table 2 or 3, that of the nearer range window by ratio. For other
    sets nothing is published. There it is the normalised share of sectors in which two IDs agree,
    of which the tables are noisy versions. window_m: length of the range window.
    """
    if landmarks.sectors == PAPER_SECTORS:
        model = TABLE_2 if window_m < (1.25 * 2.50) ** 0.5 else TABLE_3
    else:
        sectors = np.asarray(landmarks.sectors)
        model = (sectors[:, None] == sectors[None]).mean(axis=2)
    return np.asarray(model / model.sum(axis=1, keepdims=True))


def motion_model(now: FloatArray, before: FloatArray, power: float) -> FloatArray:
    """(n, m) P(object now is object before), from the inverse distance; rows sum to 1.

    now: (n, 2), before: (m, 2) positions in pixels. Nearer than a pixel counts as a pixel.
    """
    distance = np.maximum(np.linalg.norm(now[:, None] - before[None], axis=2), 1.0)
    # Relative to the least of a row, since a high power of pixels would underflow to 0.
    closeness = (distance / distance.min(axis=1, keepdims=True)) ** -power
    return np.asarray(closeness / closeness.sum(axis=1, keepdims=True))


def update(predicted: FloatArray, measured: FloatArray, model: FloatArray) -> FloatArray:
    """Eq. 6 to 8. predicted, measured: (n, K), model: (K, K) L[k, j]; returns (n, K).

    Jeffrey's rule: the posteriors under each possible measurement, weighted by its probability.
    """
    # If the model confuses no IDs, an ID whose belief was rounded to 0 may still be measured.
    predicted = np.maximum(predicted, LEAST_PREDICTED)
    joint = model[None] * predicted[:, :, None]  # Eq. 6: (n, k, j)
    posterior = joint / joint.sum(axis=1, keepdims=True)  # Eq. 7
    belief = np.einsum("nkj,nj->nk", posterior, measured)  # Eq. 8
    return np.asarray(belief / belief.sum(axis=1, keepdims=True))


class _Belief:
    """In what a track is: (K,), None before its first frame."""

    now: FloatArray | None = None


class PublishedMeasurement:
    """Similarities of single frames, and the beliefs by Eq. 5 to 8.

    Its column of the tracks: belief: (n,) of _Belief.
    """

    def __init__(
        self,
        config: Features,
        tracks: Tracks,
        identify: Callable[[FloatArray, BoolArray], Identification],
        landmarks: LandmarkSet,
        window_m: float,
    ) -> None:
        """identify: SMI of (n, L, ANGLES) matrices. window_m: as in measurement_model."""
        self._config, self._tracks, self._identify = config, tracks, identify
        self._model = measurement_model(landmarks, window_m)
        tracks.declare(belief=_Belief)
        self.begin_stretch()

    def begin_stretch(self) -> None:
        """Forget the frame before."""
        # Positions of its tracks, and the beliefs in these.
        self._before: tuple[FloatArray, FloatArray] = np.empty((0, 2)), np.empty((0, 0))

    def gather(self, grey: FloatArray, seen: BoolArray) -> Columns:
        """The frame's own matrices (n, L, ANGLES), from ShapeSampler, as evidence."""
        belief = self._tracks["belief"][self._tracks.in_view]
        return {"grey": grey, "seen": seen, "belief": belief, "episode": np.zeros(len(grey), int)}

    def beliefs(self, frames: Sequence[Table]) -> Beliefs:
        """Beliefs about the tracks of consecutive frames.

        The paper has no 'none of these', so its belief is 0.
        """
        tracks = stacked(frames)
        single = self._identify(tracks["grey"], tracks["seen"])
        ends = np.cumsum([len(frame) for frame in frames])[:-1]
        measured = np.split(single.measurement(self._config.least_ring), ends)
        beliefs = [self.update(f, q) for f, q in zip(frames, measured, strict=True)]
        return without_none(np.concatenate(beliefs), single.rotation)

    def update(self, tracks: Table, measured: FloatArray) -> FloatArray:
        """(n, K) beliefs about the tracks of the next frame. measured: (n, K) q of Eq. 8."""
        beliefs = update(self._predicted(tracks), measured, self._model)
        for belief, now in zip(tracks["belief"], beliefs, strict=True):
            belief.now = now
        self._before = tracks["position"], beliefs
        return beliefs

    def _predicted(self, tracks: Table) -> FloatArray:
        """(n, K) Eq. 5. Setting `new_belief` says what is believed of a new object."""
        config, (before, beliefs) = self._config, self._before
        predicted = np.full((len(tracks), len(self._model)), 1 / len(self._model))
        known = np.array([belief.now is not None for belief in tracks["belief"]], bool)
        if config.motion_model == "inverse_distance" and len(before):
            known |= config.new_belief == "neighbours"
            same = motion_model(tracks["position"][known], before, config.distance_power)
            predicted[known] = same @ beliefs
        elif known.any():
            predicted[known] = [belief.now for belief in tracks["belief"][known]]
        return predicted
