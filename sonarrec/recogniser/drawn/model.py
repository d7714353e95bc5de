"""What matches are worth: log odds, learned on simulated plates by `make plate-model`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray, FloatImage
from sonarrec.recogniser.drawn.drawings import SOFTENED
from sonarrec.tables.toml import Finite, from_table, read_toml

MODEL = Path(__file__).parent / "model.toml"


@dataclass(frozen=True, slots=True)
class PlateModel:
    """Weights of `of_one` and of `of_ids`."""

    picture: tuple[Finite, ...]
    track: tuple[Finite, ...]

    def of_pictures(self, compared: FloatImage) -> list[float]:
        """Log odds that a drawing is there, of n pictures. compared: from `comparisons`."""
        odds: list[float] = (of_one(compared) @ np.array(self.picture)).tolist()
        return odds

    def of_tracks(self, matches: FloatArray, rival: FloatArray, odds: FloatArray) -> FloatArray:
        """(n, K + 1): every ID, then 'none of these'; rows sum to 1. The rest as of `of_ids`."""
        log_odds = of_ids(matches, rival, odds) @ np.array(self.track)
        log_odds = np.concatenate([log_odds, np.zeros((len(log_odds), 1))], axis=1)
        shares = np.exp(log_odds - log_odds.max(axis=1, keepdims=True))
        return np.asarray(shares / shares.sum(axis=1, keepdims=True))


def built_in_model() -> PlateModel:
    """The model that `make plate-model` learned."""
    return from_table(PlateModel, read_toml(MODEL), str(MODEL))


def of_one(compared: FloatImage) -> FloatArray:
    """(n, 8) features of n pictures: 1, and the comparisons, of which the matches as
    Fisher's z."""
    matches, rest = np.split(compared.astype(float), [1 + len(SOFTENED)], axis=1)
    return np.concatenate(
        [np.ones((len(rest), 1)), np.arctanh(matches.clip(0, 0.99)), rest], axis=1
    )


def of_ids(matches: FloatArray, rival: FloatArray, odds: FloatArray) -> FloatArray:
    """(n, K, 5) features of every ID: 1, the averaged picture's match as Fisher's z, by how much it
    is above that of the best of all others, random drawings among them; the best of these, as
    Fisher's z; and the mean odds of single pictures.

    matches: (n, K). rival, odds: (n,).
    """
    matches = matches.astype(float)
    both = np.sort(np.concatenate([matches, rival[:, None]], axis=1), axis=1)
    margin = matches - np.where(matches >= both[:, -1:], both[:, -2:-1], both[:, -1:])
    of_track = [np.ones(len(odds)), np.arctanh(rival.clip(0, 0.99)), odds]
    ones, of_rival, odds = (np.broadcast_to(v[:, None], matches.shape) for v in of_track)
    z = np.arctanh(matches.clip(0, 0.99))
    return np.stack([ones, z, margin, of_rival, odds], axis=2)
