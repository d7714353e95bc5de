"""How what a track's frames say is pooled."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sonarrec.recogniser.stage3 import Evidence
from sonarrec.recogniser.stage3.opinions import (
    FRAME_EXPONENT,
    LEAST_BELIEF,
    LEAST_FRAME_BELIEF,
    TRACK_EXPONENT,
    Opinions,
    TrackBelief,
)
from tests.support.groups import groups

IDS = 4
said = arrays(float, (6, IDS + 1), elements=st.floats(0.0, 1.0)).map(
    lambda a: (a + 1e-6) / (a + 1e-6).sum(axis=1, keepdims=True)
)


def evidence(*episodes: int) -> Evidence:
    n = len(episodes)
    cells = np.zeros((n, 1, 1))
    return Evidence(cells, cells, np.ones(n, np.int64), np.array(episodes, np.int64))


def beliefs_of(episodes: list[int], frames: np.ndarray) -> np.ndarray:
    """Of track 7, seen in so many frames, each in an episode of its life."""
    return TrackBelief(IDS, 400)([groups(7)] * len(frames), evidence(*episodes), frames)


@given(said)
def test_the_pool_is_the_weighted_geometric_mean_so_far(frames: np.ndarray) -> None:
    """Against the formula, written out with a product and a power for each frame."""
    found = beliefs_of([1] * 6, frames)
    for i in range(6):
        floored = np.maximum(frames[: i + 1], LEAST_BELIEF)
        sure = np.prod(floored**floored, axis=1) ** 2
        weight = sure * np.arange(1, i + 2)
        so_far = np.prod(floored ** (weight / weight.sum())[:, None], axis=0)
        expected = (
            np.maximum(frames[i], LEAST_FRAME_BELIEF) ** FRAME_EXPONENT * so_far**TRACK_EXPONENT
        )
        np.testing.assert_allclose(found[i], expected / expected.sum(), atol=1e-12)


@given(said, st.integers(1, 5))
def test_the_same_whatever_frames_come_together(frames: np.ndarray, first: int) -> None:
    whole = beliefs_of([1] * 6, frames)
    belief = TrackBelief(IDS, 400)
    parts = [
        belief([groups(7)] * len(some), evidence(*[1] * len(some)), some)
        for some in (frames[:first], frames[first:])
    ]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize("returns_to", [1, 2])
def test_a_new_episode_forgets_until_the_old_one_goes_on(returns_to: int) -> None:
    none = [0.01, 0.01, 0.01, 0.01, 0.96]
    first = [0.96, 0.01, 0.01, 0.01, 0.01]
    frames = np.array([none] * 8 + [first] * 3)
    found = beliefs_of([1] * 8 + [2, 2, returns_to], frames)
    alone = beliefs_of([2, 2, 2], frames[8:])
    np.testing.assert_array_equal(found[8:10], alone[:2])
    if returns_to == 2:
        np.testing.assert_array_equal(found[10], alone[2])
    else:
        assert found[10, 0] < alone[2, 0]  # the eight frames count again


def test_episodes_that_prove_to_be_one_share_their_opinion() -> None:
    opinions = Opinions(IDS)
    for frame, episode in enumerate((1, 1, 2, 1)):
        opinions.current(7, episode, frame).add(np.full(IDS + 1, 0.2))
    assert opinions.get(7, 1) is opinions.get(7, 2)
    assert opinions.get(7, 1).frames == 4


def test_what_cannot_come_back_is_forgotten() -> None:
    """Of a track that returns again and again, the episodes that came to nothing too."""
    belief = TrackBelief(IDS, 10)
    row = np.full((1, IDS + 1), 0.2)
    for episode in range(100):
        belief([groups(7)] * 3, evidence(episode, episode, episode), row.repeat(3, axis=0))
        assert len(belief._opinions._of) <= 5  # ten frames hold parts of five episodes at most
    before = belief([groups(1)], evidence(200), np.eye(IDS + 1)[:1])
    belief([groups(2)] * 10, evidence(*[300] * 10), row.repeat(10, axis=0))
    again = belief([groups(1)], evidence(200), row)  # away for ten frames: still known
    assert again[0, 0] > 0.5
    belief([groups(2)] * 11, evidence(*[300] * 11), row.repeat(11, axis=0))
    np.testing.assert_allclose(belief([groups(1)], evidence(200), row), row)
    assert before[0, 0] > 0.99
