"""Turns the stages' arrays, in working pixels, into Estimates, and decides what is declared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, Table, stacked
from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.plane import Plane
from sonarrec.recogniser.stage3 import Beliefs, likeliest, rounded
from sonarrec.recogniser.stage3.shape_matrix import STEP_DEG, Identification, rounded_steps
from sonarrec.sonar.frame import Estimate, Selection

# Standard error of a group's mean, as a share of its particles' spread: chosen on tuning seeds,
# checked against the truth by `make scenes`.
POSITION_SHARE = 0.33


def declared(score: FloatArray | float, threshold: float) -> BoolArray:
    """Whether an ID of this score is declared; the score's shape."""
    return rounded(np.asarray(score)) >= threshold


def wins(probabilities: FloatArray) -> BoolArray:
    """(n,) which objects of one frame win their likeliest ID: no other has more belief in it.

    probabilities: (n, K + 1) as in Beliefs. Of equal ones the first wins.
    """
    beliefs = rounded(probabilities[:, :-1])
    if not len(beliefs):
        return np.empty(0, bool)
    return np.asarray(beliefs.argmax(axis=0)[beliefs.argmax(axis=1)] == np.arange(len(beliefs)))


def of_candidates(selection: Selection) -> Table:
    """A frame's candidates as estimates are made of them, with the columns of tracks."""
    n = len(selection.positions)
    return Table(
        number=np.arange(n),
        position=selection.positions,
        spread=np.full((n, 2), np.nan),
        existence=selection.scores,
        sight_deg=np.zeros(n),
        shown=np.ones(n, bool),
        episode=np.zeros(n, int),
    )


class Estimates:
    """Makes the Estimates of both methods from their arrays."""

    def __init__(self, config: Config, plane: Plane, landmarks: LandmarkSet) -> None:
        self._config, self._plane, self._ids = config, plane, landmarks.ids
        self.declare = config.features.declare
        """Least score at which the framework declares an ID."""

    def of_tracks(self, method: str, frames: Sequence[Table], beliefs: Beliefs) -> list[Estimate]:
        """The framework's estimates of the tracks of some frames, n in all.

        The score is the belief in the ID. Where objects are compared, one that loses its ID to
        another has score 0.
        """
        _, scores = likeliest(beliefs.probabilities)
        if self._config.features.decide == "comparison":
            ends = np.cumsum([len(frame) for frame in frames])[:-1]
            won = np.concatenate([wins(p) for p in np.split(beliefs.probabilities, ends)])
            scores = np.where(won, scores, 0.0)
            beliefs = replace(beliefs, enough_evidence=beliefs.enough_evidence & won)
        return self._estimates(method, stacked(frames), beliefs, scores, self.declare)

    def of_candidates(
        self, method: str, candidates: Table, identity: Identification
    ) -> list[Estimate]:
        """SMI's estimates of n candidates, without standard errors."""
        least = self._config.smi.declare
        return self._estimates(method, candidates, identity.beliefs, identity.score, least)

    def _estimates(
        self, method: str, objects: Table, beliefs: Beliefs, scores: FloatArray, threshold: float
    ) -> list[Estimate]:
        """One Estimate for each of n objects. scores: (n,). threshold: as `declared`."""
        landmark_index, _ = likeliest(beliefs.probabilities)
        positions, spread, sight_deg = objects["position"], objects["spread"], objects["sight_deg"]
        range_sigma, bearing_sigma = self._plane.polar_sigma(positions, POSITION_SHARE * spread)
        column, row = self._plane.to_fan(*positions.T)
        range_m, bearing_deg = self._plane.to_polar(*positions.T)
        _, left_deg = rounded_steps(sight_deg)
        orientation_deg = (90 - bearing_deg - left_deg + beliefs.rotation * STEP_DEG) % 360
        claimed = declared(scores, threshold) & beliefs.enough_evidence
        read = [""] * len(positions) if beliefs.lit is None else _digits(beliefs.lit, left_deg)
        corners: Sequence[FloatArray | None] = [None] * len(positions)
        if beliefs.corners is not None:
            corners = [None if np.isnan(of_one).any() else of_one for of_one in beliefs.corners]
        numbers = {
            "object": objects["number"],
            "x_px": column,
            "y_px": row,
            "range_m": range_m,
            "bearing_deg": bearing_deg,
            "orientation_deg": orientation_deg,
            "existence": objects["existence"],
            "score": scores,
            "declared": claimed,
            "range_sigma_m": range_sigma,
            "bearing_sigma_deg": bearing_sigma,
            "orientation_sigma_deg": beliefs.rotation_sigma * STEP_DEG,
            "sight_deg": sight_deg,
            "episode": objects["episode"],
            "in_view": objects["shown"],
            "enough_evidence": beliefs.enough_evidence,
        }
        fields: dict[str, Sequence[Any]] = {
            **{name: values.tolist() for name, values in numbers.items()},
            "probabilities": list(beliefs.probabilities),
            "landmark": [self._ids[i] for i in landmark_index],
            "read": read,
            "corners": corners,
        }
        return [
            Estimate(method, **dict(zip(fields, values, strict=True)))
            for values in zip(*fields.values(), strict=True)
        ]


def _digits(lit: FloatArray, left_deg: FloatArray) -> list[str]:
    """What was read as text, of n objects, each as `read` in estimates.csv.

    lit: (n, ANGLES) as in Beliefs. left_deg: (n,) how far the matrix is rotated from the line of
    sight, less than a step.
    """
    share = left_deg[:, None] / STEP_DEG
    neighbour = np.where(share > 0, np.roll(lit, -1, axis=1), np.roll(lit, 1, axis=1))
    tenths = np.round((1 - np.abs(share)) * lit + np.abs(share) * neighbour, 6) * 10
    known = ~np.isnan(tenths[:, 0])
    digits = np.minimum(np.where(known[:, None], tenths, 0), 9).astype(np.uint8) + ord("0")
    return [row.tobytes().decode() if k else "" for row, k in zip(digits, known, strict=True)]
