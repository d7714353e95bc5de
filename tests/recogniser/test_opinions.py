"""How what a track's frames say is pooled."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sonarrec.recogniser.stage3.opinions import (
    FRAME_EXPONENT,
    LEAST_BELIEF,
    LEAST_FRAME_BELIEF,
    TRACK_EXPONENT,
    Opinion,
    pooled,
)

IDS = 4
said = arrays(float, (6, IDS + 1), elements=st.floats(0.0, 1.0)).map(
    lambda a: (a + 1e-6) / (a + 1e-6).sum(axis=1, keepdims=True)
)


@given(said)
def test_the_pool_is_the_weighted_geometric_mean_so_far(frames: np.ndarray) -> None:
    """Against the formula, written out with a product and a power for each frame."""
    found = pooled([Opinion()] * 6, frames)
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
    whole = pooled([Opinion()] * 6, frames)
    opinion = Opinion()
    parts = [pooled([opinion] * len(some), some) for some in (frames[:first], frames[first:])]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


@given(said)
def test_one_that_continues_two_has_the_frames_of_both(frames: np.ndarray) -> None:
    """As soon as a frame is added: till then those of both may still be waiting."""
    old, new = Opinion(), Opinion()
    both = Opinion(old, new)
    pooled([old, old, new, new, new], frames[:5])
    pooled([both], frames[5:])
    assert both.frames == 6
    np.testing.assert_allclose(both.beliefs, frames.sum(axis=0))
    assert both.weight > old.weight + new.weight
